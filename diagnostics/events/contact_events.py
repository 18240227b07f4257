"""Contact events: a log is segmented into contacts, each summarised by the load of every cell.

Frames of one contact are strongly correlated, so evidence adds up over events, not over frames. An
event ends when

    sum_i load_i(t) - min <= 0.3 (max - min)    over the cells that move: its load is released, or
    cos(mean load, load of the next part) < 0.6     its load has moved elsewhere, or
    a fifth of the load moves in one frame      another contact begins, as where a recording begins.

A static hold is one event, however long it lasts. An online change detection with hysteresis, as in
onset detection; offline, ``ruptures.Pelt`` on the total load finds similar boundaries. Each event
keeps at most six parts, so that a cell that fails within an event can be tested on the parts after
the failure. Two contacts at the same time are one event, and loads below 10 % of the strongest
event are not events.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.readings import SEGMENT
from diagnostics.preprocessing.scale import Array

_PARTS = 6  # of an event at most; beyond that the shortest neighbours are merged: a size
_RELEASED = 0.3  # share of the load that is left when an event ends
_MIN_AMPLITUDE = 0.1  # root load, summed over the cells: smaller changes are noise
_WEAKEST = 0.1  # of the largest amplitude so far: smaller changes do not end an event
_LEAST_OF_HELD = 0.05  # of the constant load: smaller changes are not its release
# share of the load that must move, and share that must be gone, at the end of an event
_MOVING = 0.25
# share of the load that vanishes and appears elsewhere in one frame where another event begins
_EXCHANGED = 0.2
# In a static hold less suffices: 0.06 of the load and three times the 0.9 quantile over the frames.
_MIN_EXCHANGED = 0.06
_OUTLYING = 3.0
_QUANTILE = 0.9
_PERSISTING = 0.65  # share of the loaded cells that hold their value: then the event continues
_SAME_PLACE = 0.6  # cosine between mean loads from which on two events load the same cells
THE_SAME = 0.95  # cosine from which on they are the same

Cells = NDArray[np.intp]


@dataclass(frozen=True)
class Summary:
    """Summary of some consecutive frames of one event.

    Attributes:
        first: number of the first frame.
        n: number of frames.
        most: float ``[D]``, highest root load, 0 to 1.
        total: float ``[D]``, sum of the root loads over the frames.
        loaded: float ``[D]``, number of frames in which the cell is loaded.
    """

    first: int
    n: int
    most: Array
    total: Array
    loaded: Array

    @classmethod
    def of(cls, root_load: Array, first: int, root_near: float) -> Summary:
        """Summarise root loads ``[t, D]``."""
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
        """Return ``[4, D]``: highest root load, mean root load, 1 if ever loaded, share of the
        frames loaded."""
        return np.stack(
            [
                self.most,
                self.total / self.n,
                (self.loaded > 0).astype(np.float32),
                self.loaded / self.n,
            ]
        )


@dataclass(frozen=True)
class ContactEvent:
    """One contact event.

    Attributes:
        parts: at most six consecutive summaries.
        lowest, highest: float ``[D]``, range of the root load of each cell in the event.
        since: a load that is constant since this frame, or later, may belong to this event; one
            that is constant for longer outlasted the event before.
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
        """Number of the frame after the last part; frames of the release follow."""
        return self.parts[-1].first + self.parts[-1].n

    @property
    def n(self) -> int:
        """Number of frames in all parts."""
        return sum(part.n for part in self.parts)

    def amplitude(self, weights: Array) -> float:
        """Return the range of the root load, summed over the cells with weights ``[D]``."""
        return float((self.highest - self.lowest) @ weights)

    @property
    def whole(self) -> Summary:
        """The summary of the whole event."""
        return self.suffixes()[0]

    def suffixes(self) -> list[Summary]:
        """Return the summaries from the start of each part to the end of the event, the whole event
        first."""
        ends = [self.parts[-1]]
        for part in self.parts[-2::-1]:
            ends.append(part + ends[-1])
        return ends[::-1]

    def grown(self, part: Summary, lowest: Array, highest: Array) -> ContactEvent:
        """Return the event with one more part."""
        parts = [*self.parts, part]
        if len(parts) > _PARTS:
            sizes = [a.n + b.n for a, b in pairwise(parts)]
            i = int(np.argmin(sizes))
            parts[i : i + 2] = [parts[i] + parts[i + 1]]
        return ContactEvent(
            tuple(parts),
            np.minimum(self.lowest, lowest),
            np.maximum(self.highest, highest),
            self.since,
        )

    def same_location(self, part: Summary, lowest: Array) -> bool:
        """Return whether ``part`` loads about the same cells; True where either has no load."""
        floor = np.minimum(self.lowest, lowest)
        before = self.mean() - floor
        now = part.total / part.n - floor
        size = float(np.sqrt((before @ before) * (now @ now)))
        return size <= _MIN_AMPLITUDE**2 or float(before @ now) >= _SAME_PLACE * size

    def persists(self, part: Summary, root_near: float, start: Cells) -> bool:
        """Return whether most of its loaded cells hold the same value in ``part``; see
        ``EventLog.extend``.

        Cells that never moved, or that are constant for longer than the event lasts, may be broken
        and do not count.
        """
        own = (self.mean() > root_near) & (start >= self.since)
        held = own & (start > 0) & (start < self.end) & (part.most > root_near)
        return int(held.sum()) > _PERSISTING * int(own.sum())

    def released_since(self, part: Summary, ongoing: bool) -> int:
        """Return the first frame at which its load may have been released, if the next event begins
        with ``part``.

        An ``ongoing`` event was released at some frame of the segment before.
        """
        return max(part.first - SEGMENT, self.first) + 1 if ongoing else min(part.first, self.end)

    def mean(self) -> Array:
        """Return the mean root load of each cell, ``[D]``."""
        return sum((p.total for p in self.parts[1:]), self.parts[0].total) / np.float32(self.n)


@dataclass(frozen=True)
class EventLog:
    """The contact events of a log so far.

    Attributes:
        kept: the events in time order; the last may continue.
        largest: the largest amplitude of a completed event.
        releasing: whether the load of the last event is being released; such frames belong to no
            event.
        last: root loads ``[D]`` of the last frame.
    """

    kept: tuple[ContactEvent, ...] = ()
    largest: float = 0.0
    releasing: bool = False
    last: Array | None = None

    def extend(self, root: Array, numbers: Cells, root_near: float, start: Cells) -> EventLog:
        """Return the events after more frames.

        Args:
            root: root loads ``[t, D]`` of the frames, t >= 1.
            numbers: int ``[t]``, of the frames, ascending.
            root_near: the root load from which on a cell counts as loaded.
            start: int ``[D]``, first frame of the constant run of each cell. Only cells that move
                in these frames decide whether a load is released: broken cells hold their value.
        """
        kept = list(self.kept)
        largest = self.largest
        releasing = self.releasing
        last = self.last
        begin = 0
        constant = start <= numbers[0]
        # (moving, all)
        weights = np.stack([~constant, np.ones_like(constant)], axis=1).astype(np.float32)
        before = np.concatenate([root[:1] if last is None else last[None], root[:-1]])
        begins = self._begins(root, before, numbers, root_near, start)
        while begin < len(root):
            if releasing:
                begin += _releasing_frames(root[begin:], last)
                if begin == len(root):
                    break
            follows = bool(kept) and begin not in begins
            ongoing = follows and not releasing  # the next part belongs to the last event
            edge = min((edge for edge in begins if edge > begin), default=len(root))
            ahead = root[begin:edge]
            lowest = so_far(np.minimum, ahead)
            highest = so_far(np.maximum, ahead)
            if begin in begins:
                # The load of this event rose in one frame, from the frame before.
                lowest = np.minimum(lowest, before[begin])
            elif ongoing:
                lowest = np.minimum(lowest, kept[-1].lowest)
                highest = np.maximum(highest, kept[-1].highest)
            # Loads that are constant since the event began would have to be released.
            held = constant & (start >= (kept[-1].since if ongoing else numbers[begin]))
            least = _LEAST_OF_HELD * float(ahead[0] @ held)
            weakest = max(_WEAKEST * largest, _MIN_AMPLITUDE, least)
            end = _release(ahead @ weights, lowest @ weights, highest @ weights, weakest)
            if end:
                part = Summary.of(ahead[:end], int(numbers[begin]), root_near)
                extremes = lowest[end - 1], highest[end - 1]
                same = ongoing and kept[-1].same_location(part, extremes[0])
                if same or (follows and kept[-1].persists(part, root_near, start)):
                    kept[-1] = kept[-1].grown(part, *extremes)
                else:
                    largest = max([largest, *(one.amplitude(weights[:, 1]) for one in kept[-1:])])
                    since = kept[-1].released_since(part, ongoing) if follows else part.first
                    kept.append(ContactEvent((part,), *extremes, since))
            begin += end
            releasing = begin < edge
            if releasing:
                last = root[begin]
                begin += 1
        return EventLog(tuple(kept), largest, releasing, root[-1])

    def _begins(
        self,
        root: Array,
        before: Array,
        numbers: Cells,
        root_near: float,
        start: Cells,
    ) -> list[int]:
        """Return the frames in which a load vanishes and another appears elsewhere, as where a
        recording begins."""
        step = root - before
        step -= np.clip(step, -root_near, root_near)  # smaller changes are noise
        # Cells that are constant from a frame before on hold their value, or are broken.
        moving = ((start >= numbers[:, None]) & (start > 0)).astype(np.float32)
        step *= moving
        exchanged = (
            np.abs(step).sum(axis=1) - np.abs(step.sum(axis=1))
        ) / 2  # vanished here and appeared there
        load = np.maximum((root * moving).sum(axis=1), (before * moving).sum(axis=1))
        share = exchanged / np.maximum(load, np.float32(1e-9))
        at = np.flatnonzero((share >= _MIN_EXCHANGED) & (exchanged >= _MIN_AMPLITUDE))
        if not len(at):
            return []
        if share[at].min() < _EXCHANGED:
            at = at[share[at] >= min(_EXCHANGED, _OUTLYING * float(np.quantile(share, _QUANTILE)))]
        # A cell that is constant for longer than the last event lasts is not held by it.
        own = (before[at] > root_near) & (start >= (self.kept[-1].since if self.kept else 0))
        persists = own & (start < numbers[at, None])
        begins: list[int] = at[persists.sum(axis=1) <= _PERSISTING * own.sum(axis=1)].tolist()
        return begins

    def split(self, keep: int) -> tuple[EventLog, EventLog]:
        """Return (all but the last ``keep`` events, the last ``keep``)."""
        return replace(self, kept=self.kept[:-keep]), replace(self, kept=self.kept[-keep:])


def count_repeats(
    events: Sequence[ContactEvent],
    least: float = _SAME_PLACE,
    among: NDArray[np.bool_] | slice = slice(None),
) -> Cells:
    """Return for each event the number of earlier events that load about the same cells, int
    ``[n]``.

    Args:
        events: in time order.
        least: cosine between mean loads from which on two events load the same cells.
        among: bool ``[D]``, the cells compared; cells stuck under load would make all events
            similar.
    """
    if not events:
        return np.zeros(0, np.intp)
    means = np.stack([event.mean()[among] for event in events])
    sizes = np.linalg.norm(means, axis=1)
    similar = means @ means.T >= least * np.maximum(sizes[:, None] * sizes, _MIN_AMPLITUDE**2)
    return np.asarray(np.tril(similar, -1).sum(axis=1))


def so_far(extreme: np.ufunc, frames: Array) -> Array:
    """Return ``extreme.accumulate(frames)``, ``[t, D]``, of np.minimum or np.maximum, in half its
    time."""
    # Parallel prefix scan over 1, 2, 4, ... frames (Hillis and Steele, Data parallel algorithms,
    # 1986).
    running = frames
    reach = 1
    while reach < len(frames):
        further = np.empty_like(running)
        further[:reach] = running[:reach]
        extreme(running[reach:], running[:-reach], out=further[reach:])
        running = further
        reach = 2 * reach
    return running


def _release(load: Array, lowest: Array, highest: Array, weakest: float) -> int:
    """Return the first frame in which the load of an event is released; the number of frames, if in
    none.

    Args:
        load: root load, summed over the moving and over all cells, ``[t, 2]``.
        lowest, highest: the same of the extremes of each cell so far, ``[t, 2]``.
        weakest: smaller changes are no release.
    """
    (floor, lowest_of_all), (peak, highest_of_all) = lowest.T, highest.T
    now = load[:, 0]
    moving = peak - floor
    enough = np.maximum(_MOVING * (highest_of_all - lowest_of_all), weakest)
    # A relaxing load is also lowest at its end, but most of it remains.
    gone = peak - now >= _MOVING * peak
    released = (now - floor <= _RELEASED * moving) & (moving > enough) & gone
    return int(released.argmax()) if released.any() else len(load)


def _releasing_frames(root: Array, last: Array | None) -> int:
    """Return the number of first frames of ``[t, D]`` in which the total load still falls."""
    sums = root.sum(axis=1)
    before = np.concatenate([[sums[0] if last is None else last.sum()], sums[:-1]])
    return int(np.logical_and.accumulate(sums < before).sum())
