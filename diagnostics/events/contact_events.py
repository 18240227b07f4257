"""Touches: a log boiled down to what touched the array, one summary for each touch.

The frames of one touch are not independent: evidence adds up over touches, hardly over the frames of one. So a touch is
all that is remembered: for each cell how hard and how long it was loaded. A touch ends when its load is released, or
when the load has moved elsewhere; however long a static hold lasts, it is one touch. Each is kept in a few parts, so
that a cell that fails in the middle of one can be judged by what came after.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.running_extremes import highest_so_far, lowest_so_far
from diagnostics.preprocessing.scale import Array

SEGMENT = 32  # frames that are looked at together
_PARTS = 6  # of a touch at most; neighbours are put together beyond that
_RELEASED = 0.3  # of its highest load: when less is left, a touch is over
_LEAST = 0.1  # root load: what moved less in all has touched nothing
_WEAKEST = 0.1  # of the strongest touch so far: less is unrest, not a touch that could end
_SLIGHT = 0.05  # of a load that holds still: less is a breath, not its release
_MOVING = 0.25  # of a load must be going, and as much of it gone, when a touch is said to be over
_ELSEWHERE = 0.2  # of the load must go in one frame, and as much come, when another touch begins with it
# Or so much, if that is so often what goes and comes in nine of ten frames: in static holds nothing else moves.
_STIRS, _STIRRED, _MOSTLY = 0.06, 3.0, 0.9
_STAYS = 0.65  # of the cells it loads stay as they are: then it is the same touch, whatever else changes
_SAME_PLACE = 0.6  # cosine between loads of one touch; less alike, and it is another


@dataclass(frozen=True)
class Summary:
    """Some consecutive frames of one touch.

    Attributes:
        first: number of the first frame; n: how many.
        most: root load ``[D]``, the highest.
        total: the sum of the root loads ``[D]``.
        loaded: ``[D]``, in how many frames each cell was loaded.
    """

    first: int
    n: int
    most: Array
    total: Array
    loaded: Array

    @classmethod
    def of(cls, root_load: Array, first: int, root_near: float) -> Summary:
        """Sum up frames, ``[t, D]`` root loads."""
        loaded = (root_load > root_near).sum(axis=0, dtype=np.float32)
        return cls(first, len(root_load), root_load.max(axis=0), root_load.sum(axis=0), loaded)

    def __add__(self, other: Summary) -> Summary:
        return Summary(
            min(self.first, other.first),
            self.n + other.n,
            np.maximum(self.most, other.most),
            self.total + other.total,
            self.loaded + other.loaded,
        )

    def features(self) -> Array:
        """Return ``[4, D]``: highest and mean root load, ever loaded, share of the frames loaded."""
        return np.stack([self.most, self.total / self.n, (self.loaded > 0).astype(np.float32), self.loaded / self.n])


@dataclass(frozen=True)
class ContactEvent:
    """One touch: at most six parts, and the range of the root loads of each cell in it, ``[D]``.

    What has held still ``since`` that frame, or later, has not outlasted the touch before: it may belong to this one.

    How far a load has risen within the touch tells when it is released. A cell that holds one value has no part in
    that, whatever it holds.
    """

    parts: tuple[Summary, ...]
    lowest: Array
    highest: Array
    since: int

    @property
    def first(self) -> int:
        """Number of its first frame."""
        return self.parts[0].first

    @property
    def end(self) -> int:
        """About the number of the first frame after it."""
        return self.parts[-1].first + self.parts[-1].n

    @property
    def n(self) -> int:
        """How many frames it was looked at in."""
        return sum(part.n for part in self.parts)

    def amplitude(self, weigh: Array) -> float:
        """How far its load has moved, summed over the cells with weights ``[D]``."""
        return float((self.highest - self.lowest) @ weigh)

    def suffixes(self) -> list[Summary]:
        """Return the summary from each part on to the end, the whole touch first."""
        ends = [self.parts[-1]]
        for part in self.parts[-2::-1]:
            ends.append(part + ends[-1])
        return ends[::-1]

    def grown(self, part: Summary, lowest: Array, highest: Array) -> ContactEvent:
        """Return the touch with one more part."""
        parts = [*self.parts, part]
        if len(parts) > _PARTS:
            sizes = [a.n + b.n for a, b in pairwise(parts)]
            i = int(np.argmin(sizes))
            parts[i : i + 2] = [parts[i] + parts[i + 1]]
        return ContactEvent(
            tuple(parts), np.minimum(self.lowest, lowest), np.maximum(self.highest, highest), self.since
        )

    def same_location(self, part: Summary, lowest: Array) -> bool:
        """Whether ``part`` loads about the same cells; no load lies anywhere."""
        floor = np.minimum(self.lowest, lowest)
        before, now = self.mean() - floor, part.total / part.n - floor
        size = float(np.sqrt((before @ before) * (now @ now)))
        return size <= _LEAST**2 or float(before @ now) >= _SAME_PLACE * size

    def persists(self, part: Summary, root_near: float, start: NDArray[np.intp], jumped: NDArray[np.bool_]) -> bool:
        """Whether most of the cells that it loads hold in ``part`` what they held in it; see ``EventLog.extend``.

        Cells that have never moved may have been broken all along, and those that hold still for longer than it lasts.
        """
        own = (self.mean() > root_near) & (start >= self.since) & ~jumped
        held = own & (start > 0) & (start < self.end) & (part.most > root_near)
        return int(held.sum()) > _STAYS * int(own.sum())

    def released_since(self, part: Summary, ongoing: bool) -> int:
        """Return since which frame its load may have been going, if another touch begins with ``part``.

        One that was ``ongoing`` was left somewhen in the segment before, else it had been released.
        """
        return max(part.first - SEGMENT, self.first) + 1 if ongoing else min(part.first, self.end)

    def mean(self) -> Array:
        """Return the mean root load of each cell, ``[D]``."""
        return sum((p.total for p in self.parts[1:]), self.parts[0].total) / np.float32(self.n)


@dataclass(frozen=True)
class EventLog:
    """The touches of a log so far, in time order; the last one still goes on.

    Attributes:
        kept: the touches.
        widest: the largest swing of one so far; what is under a tenth of it is no touch of its own.
        fading: the load of the last touch is going; such frames belong to no touch.
        last: root loads ``[D]`` of the last frame.
    """

    kept: tuple[ContactEvent, ...] = ()
    largest: float = 0.0
    releasing: bool = False
    last: Array | None = None

    def extend(
        self,
        root: Array,
        numbers: NDArray[np.intp],
        root_near: float,
        start: NDArray[np.intp],
        jumped: NDArray[np.bool_],
    ) -> EventLog:
        """Return the touches after more frames.

        Args:
            root: root loads ``[t, D]`` of the frames, t >= 1.
            numbers: int ``[t]``, of the frames, ascending.
            root_near: the root load from which on a cell counts as loaded.
            start: int ``[D]``, number of the frame from which on each cell is still. Whether a load is released is
                asked of those that move in these frames: broken cells hold their value for ever.
            jumped: bool ``[D]``, cells that jumped to where they are, and may be broken: how large a load is that could
                be released is asked of the others. Where most of them did in these frames another part of the touch
                begins, so that they can be judged from there on.
        """
        kept, largest, releasing, last = list(self.kept), self.largest, self.releasing, self.last
        ongoing = bool(kept) and not releasing  # the next part belongs to the last touch
        begin = 0
        still = start <= numbers[0]
        weigh = np.stack([~still, ~(still & jumped)], axis=1).astype(np.float32)  # a product sums over either
        before = np.concatenate([root[:1] if last is None else last[None], root[:-1]])
        begins = self._begins(root, before, numbers, root_near, start)
        broke = _most_common(start[jumped & ~still])
        edges = sorted({*begins, *np.flatnonzero(numbers == broke).tolist(), len(root)})
        while begin < len(root):
            if releasing:
                begin += _still_going(root[begin:], last)
                if begin == len(root):
                    break
                releasing = ongoing = False
            edges = [edge for edge in edges if edge > begin]
            ahead = root[begin : edges[0]]
            lowest, highest = lowest_so_far(ahead), highest_so_far(ahead)
            if begin in begins:
                ongoing = False
                # What lay there before is where the load of this touch has come from, all at once.
                lowest = np.minimum(lowest, before[begin])
            elif ongoing:
                lowest = np.minimum(lowest, kept[-1].lowest)
                highest = np.maximum(highest, kept[-1].highest)
            (floor, lowest_of_all), (peak, highest_of_all) = (lowest @ weigh).T, (highest @ weigh).T
            now, moving = (ahead @ weigh)[:, 0], peak - floor
            # What holds still since the touch began is the load that would have to go.
            held = still & (start >= (kept[-1].since if ongoing else numbers[begin]))
            weakest = max(_WEAKEST * largest, _LEAST, _SLIGHT * float(ahead[0] @ held))
            enough = np.maximum(_MOVING * (highest_of_all - lowest_of_all), weakest)
            # A load that only relaxes is lowest in the end too, but most of it is still there.
            gone = peak - now >= _MOVING * peak
            released = (now - floor <= _RELEASED * moving) & (moving > enough) & gone
            end = int(released.argmax()) if released.any() else len(ahead)
            if end:
                part = Summary.of(ahead[:end], int(numbers[begin]), root_near)
                low, high = lowest[end - 1], highest[end - 1]
                # Cells that broke do not make another touch.
                same = ongoing and (part.first == broke or kept[-1].same_location(part, low))
                follows = bool(kept) and begin not in begins
                if same or (follows and kept[-1].persists(part, root_near, start, jumped)):
                    kept[-1] = kept[-1].grown(part, low, high)
                else:
                    if kept:
                        largest = max(largest, kept[-1].amplitude(weigh[:, 1]))
                    since = kept[-1].released_since(part, ongoing) if follows else part.first
                    kept.append(ContactEvent((part,), low, high, since))
                ongoing = True
            begin += end
            if begin < edges[0]:
                releasing, last = True, root[begin]
                begin += 1
        return EventLog(tuple(kept), largest, releasing, root[-1])

    def _begins(
        self, root: Array, before: Array, numbers: NDArray[np.intp], root_near: float, start: NDArray[np.intp]
    ) -> list[int]:
        """Return the frames in which the load is all at once elsewhere, as where another recording begins."""
        step = root - before
        step -= np.clip(step, -root_near, root_near)  # what is less is unrest
        moving = ((start >= numbers[0]) & (start > 0)).astype(np.float32)
        exchanged = (np.abs(step) @ moving - np.abs(step @ moving)) / 2  # what came as well as went
        share = exchanged / np.maximum(np.maximum(root @ moving, before @ moving), np.float32(1e-9))
        at = np.flatnonzero((share >= _STIRS) & (exchanged >= _LEAST))
        if not len(at):
            return []
        at = at[share[at] >= min(_ELSEWHERE, _STIRRED * float(np.quantile(share, _MOSTLY)))]
        # What has not moved since the last touch began may be held by it; what has held still for longer is not.
        own = (before[at] > root_near) & (start >= (self.kept[-1].since if self.kept else 0))
        persists = own & (start < numbers[at, None])
        begins: list[int] = at[persists.sum(axis=1) <= _STAYS * own.sum(axis=1)].tolist()
        return begins

    def without_loads(self) -> EventLog:
        """Return the same without what the cells did in the touches that are over: only when they were."""
        nothing = np.zeros(0, np.float32)
        over = (
            ContactEvent((Summary(t.first, t.end - t.first, nothing, nothing, nothing),), nothing, nothing, t.since)
            for t in self.kept[:-1]
        )
        return replace(self, kept=(*over, *self.kept[-1:]))

    def split(self, keep: int) -> tuple[EventLog, EventLog]:
        """Return (all but the last ``keep`` touches, those)."""
        return replace(self, kept=self.kept[:-keep]), replace(self, kept=self.kept[-keep:])


def count_repeats(
    events: Sequence[ContactEvent], least: float = _SAME_PLACE, among: NDArray[np.bool_] | slice = slice(None)
) -> NDArray[np.intp]:
    """Return how many touches before each load about the same cells, int ``[n]``.

    With a cosine of at least so much, ``among`` all cells or some (bool ``[D]``): those stuck under load are in every
    touch.
    """
    if not events:
        return np.zeros(0, np.intp)
    means = np.stack([event.mean()[among] for event in events])
    sizes = np.linalg.norm(means, axis=1)
    matching = means @ means.T >= least * np.maximum(sizes[:, None] * sizes, _LEAST**2)
    return np.asarray(np.tril(matching, -1).sum(axis=1))


def _still_going(root: Array, last: Array | None) -> int:
    """Return in how many frames of ``[t, D]`` a load that is going still goes on: they say nothing new."""
    sums = root.sum(axis=1)
    before = np.concatenate([[sums[0] if last is None else last.sum()], sums[:-1]])
    return int(np.logical_and.accumulate(sums < before).sum())


def _most_common(numbers: NDArray[np.intp]) -> int:
    """Return the number of the frame that is named most often, -1 if there is none."""
    if not len(numbers):
        return -1
    found, times = np.unique(numbers, return_counts=True)
    return int(found[times.argmax()])
