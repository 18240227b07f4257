"""Odd frames: single frames in which most of an array, or of a pad, reads something that the frames
before and after do not.

A cell jumps in frame t where it is outside of what it read before and after, the medians of up to
three frames each, by 5 % of the usual range of the array and four times the size that a tenth of
its frames reach. Where enough cells jump, the frame is one of three:

- **corrupt**: the jumps agree with no neighbour, although the loads of other frames do (Spearman
  1904), or nearly every cell reads one and the same number that it does
  not read otherwise, or most cells read far above everything else in the log. Bytes were exchanged,
  lost, or replaced on the way.
- a **spike**: three quarters of the cells jump by the same amount. Supply, bus, or a discharge.
- an **impact**: everything else. It stays.

Neighbours are those of the grid, or the cell that follows each cell best in the log: which of both
tells more of the loads of usual frames. A frame that is left out is replaced by the one before it.

Not detected: an odd frame in which few cells jump, more than one in three successive frames, and
corruption of fewer than sixteen cells that no neighbour is known of.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import LEAST_LOADED, LIGHT, LOW, MAJORITY, P_MIN
from diagnostics.preprocessing.quantiles import known_quantile

_NEAR = 3  # frames before and after, of which the medians are taken
_USUAL = 4.0  # times the jumps that a tenth of the frames reach
_FEWEST = 4  # jumping cells; fewer blink
_ENOUGH = 16  # jumping cells, whose agreement with their neighbours can be measured
_AGREES = 0.25  # of the median jump, by which a cell may jump otherwise in a spike
_BEYOND = 1.5  # times the highest reading of usual frames
_SAMPLE = 64  # usual frames, whose loads are compared with their neighbours: a size
_BLOCK = 1 << 20  # readings that are looked at together: a size
_LARGEST = float(np.finfo(np.float32).max)
_MOST = 4000  # frames from which the cell that follows each is found: a size

Kind = Literal["corrupt", "spike"]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class OddFrame:
    """A frame that is no measurement of all its cells.

    Attributes:
        kind: "corrupt" or "spike".
        recording: in which it is, from 0.
        frame: its number in that recording, from 0.
        pads: of which it is odd.
        size: median jump of their cells, in the layout's unit.
        strength: sum of the sizes of all jumps, in those that are unusual.
    """

    kind: Kind
    recording: int
    frame: int
    pads: tuple[int, ...]
    size: float
    strength: float = 0.0


def find_odd_frames(
    recordings: Sequence[NDArray[Any]], layout: SensorLayout
) -> tuple[OddFrame, ...]:
    """Return the odd frames of a log, in their order.

    Args:
        recordings: ``[T, D]`` each, in the layout's unit; NaN = missing.
        layout: the array.
    """
    if not recordings:
        return ()
    present = layout.is_cell
    usual = _Usual.of(recordings, present)
    if usual is None:
        return ()
    candidates = {
        (i, t)
        for i, frames in enumerate(recordings)
        for t, *_ in _candidates(frames, usual.least, layout)
    }
    if not candidates:
        return ()
    usual_frames = evenly(recordings, candidates)
    if not np.isfinite(usual_frames[:, present]).any():
        return ()
    test = _Test(usual_frames, layout, usual)
    found = []
    for i in sorted({i for i, _ in candidates}):
        frames = recordings[i]
        of_recording: list[OddFrame] = []
        # What is beside an odd frame is judged again without it.
        while True:
            known = {one.frame for one in of_recording}
            new = [one for one in test.odd(i, frames) if one.frame not in known]
            if not new:
                break
            of_recording += _largest(new)
            frames = without_odd_frames([recordings[i]], of_recording, layout, first=i)[0]
        found += sorted(of_recording, key=lambda one: one.frame)
    return tuple(found)


def _largest(odd: Sequence[OddFrame]) -> list[OddFrame]:
    """Return the odd frames of a recording without those beside a larger one."""
    return [
        one
        for one in odd
        if all(
            abs(one.frame - other.frame) > _NEAR or one.strength >= other.strength for other in odd
        )
    ]


def _candidates(
    recording: NDArray[Any], least: Floats, layout: SensorLayout
) -> Iterator[tuple[int, Floats, Floats, Floats]]:
    """Yield the frames of a recording in which a quarter of the cells of a pad jump: number, jumps,
    their sizes and readings, ``[D]`` each."""
    present = layout.is_cell
    of_pad = np.bincount(layout.pad_of[present], minlength=layout.pads)
    enough = np.maximum(_FEWEST, LEAST_LOADED * of_pad)
    step = max(4 * _NEAR, _BLOCK // len(present))
    for begin in range(0, len(recording), step):
        first = max(0, begin - _NEAR)
        frames = _finite(recording[first : begin + step + _NEAR])
        arrived = np.flatnonzero(~np.isnan(frames).all(axis=1, where=present))
        frames = frames[arrived]
        numbers = first + arrived
        jumps, sizes = jumps_of(frames)
        jumped = (np.abs(jumps) > least) & present
        jumped &= ((numbers >= begin) & (numbers < begin + step))[:, None]
        for t in np.flatnonzero(jumped.sum(axis=1) >= _FEWEST).tolist():
            counts = np.bincount(layout.pad_of[jumped[t]], minlength=layout.pads)
            if (counts >= enough).any():
                yield int(numbers[t]), jumps[t], sizes[t], frames[t]


def without_odd_frames(
    recordings: Sequence[NDArray[Any]],
    odd: Sequence[OddFrame],
    layout: SensorLayout,
    *,
    first: int = 0,
) -> list[NDArray[Any]]:
    """Return recordings ``[T, D]`` in which each odd frame repeats the one before it, or at the
    begin of a recording the one after; others are not copied. ``first``: number of the first
    recording."""
    cleaned = list(recordings)
    for i in sorted({one.recording for one in odd}):
        frames = np.array(recordings[i - first])
        of_recording = [one for one in odd if one.recording == i]
        for one in of_recording:
            cells = np.isin(layout.pad_of, one.pads)
            good = _nearest_good(one, of_recording, len(frames))
            frames[one.frame, cells] = frames[good, cells]
        cleaned[i - first] = frames
    return cleaned


def _finite(frames: NDArray[Any]) -> Floats:
    """Return frames ``[T, D]`` with NaN for what is infinite, or too large for a difference."""
    finite = np.array(frames, dtype=np.float64)
    finite[~(np.abs(finite) <= _LARGEST)] = np.nan
    return finite


def _nearest_good(one: OddFrame, odd: Sequence[OddFrame], n_frames: int) -> int:
    """Return the frame that stands in the place of an odd one."""
    bad = {other.frame for other in odd if set(other.pads) & set(one.pads)}
    for way in (range(one.frame - 1, -1, -1), range(one.frame + 1, n_frames)):
        for t in way:
            if t not in bad:
                return t
    return one.frame


def jumps_of(frames: Floats) -> tuple[Floats, Floats]:
    """Return by how much each reading of ``[T, D]`` lies outside of what its cell read before and
    after, and by how much it differs from the middle of both; 0 where that is unknown."""
    before = _median_before(frames)
    after = _median_before(frames[::-1])[::-1]
    outside = frames - np.clip(frames, np.minimum(before, after), np.maximum(before, after))
    return np.nan_to_num(outside), np.nan_to_num(frames - (before + after) / 2)


def _median_before(frames: Floats) -> Floats:
    """Return the median of the up to three frames before each one, ``[T, D]``; before the first,
    what continues the next two."""
    median = np.full_like(frames, np.nan)
    if len(frames) >= _NEAR:
        median[0] = 2 * frames[1] - frames[2]
    for t in range(1, min(_NEAR, len(frames))):
        median[t] = np.median(frames[:t], axis=0)
    if len(frames) > _NEAR:
        a = frames[:-3]
        b = frames[1:-2]
        c = frames[2:-1]
        median[_NEAR:] = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
    return median


@dataclass(frozen=True)
class _Usual:
    """What the cells of a log read and how they jump in most frames.

    Attributes:
        low, high: ``[D]``, between which nine tenths of the readings of each cell lie.
        least: ``[D]``, size of a jump of each cell that is none of the usual ones.
    """

    low: Floats
    high: Floats
    least: Floats

    @classmethod
    def of(cls, recordings: Sequence[NDArray[Any]], present: Mask) -> _Usual | None:
        """Return it of recordings ``[T, D]``; None where nothing changes."""
        sample = evenly(recordings)
        cells = sample[:, present]
        cells = cells[~np.isnan(cells).all(axis=1)]
        if len(cells) < 2 * _NEAR:
            return None
        top = float(np.quantile(np.nanmax(cells, axis=1), 1 - 2 * LOW))
        bottom = float(np.quantile(np.nanmin(cells, axis=1), 2 * LOW))
        if not top > bottom:
            return None
        step = max(1, len(recordings) // _SAMPLE)
        few = max(_SAMPLE, _MOST * step // len(recordings))
        jumps = np.concatenate([jumps_of(_finite(r[:few]))[0] for r in recordings[::step]])
        by_cell = np.quantile(np.abs(jumps), 1 - 2 * LOW, axis=0)
        low = np.full(len(present), np.nan)
        high = low.copy()
        low[present] = known_quantile(sample[:, present], LOW, axis=0)
        high[present] = known_quantile(sample[:, present], 1 - LOW, axis=0)
        return cls(low, high, np.maximum(LIGHT * (top - bottom), _USUAL * by_cell))

    @property
    def rest(self) -> Floats:
        """Reading of each cell without load, ``[D]``: of both ends, that at which the cells differ
        less."""
        return self.low if np.nanstd(self.low) <= np.nanstd(self.high) else self.high


class _Test:
    """Tells what a candidate is, from the usual frames of the log.

    Args:
        sample: usual frames, ``[n, D]``.
        layout: the array.
        usual: of the log.
    """

    def __init__(self, sample: Floats, layout: SensorLayout, usual: _Usual) -> None:
        self._layout = layout
        self._usual = usual
        self._rest = usual.rest
        loaded = np.abs(sample - self._rest) > usual.least
        if loaded.sum(axis=1).max() < _ENOUGH:  # one load throughout counts as no rest
            self._rest = np.full_like(self._rest, np.nanmin(self._rest))
        self._present = layout.is_cell
        self._sample = sample
        self._highest = float(np.nanmax(sample[:, self._present]))
        self._least_of: dict[bytes, float] = {}

    def odd(self, recording: int, frames: NDArray[Any]) -> list[OddFrame]:
        """Return the odd frames among those of a recording ``[T, D]`` with this number."""
        found = []
        last = len(frames) - 1
        for t, jumps, sizes, frame in _candidates(frames, self._usual.least, self._layout):
            kind, pads = self.told(jumps, frame, at_end=t in (0, last))
            if kind is not None:
                of_pads = np.isin(self._layout.pad_of, pads) & self._present
                size = float(np.median(sizes[of_pads]))
                strength = np.abs(jumps / self._usual.least)[of_pads].sum()
                found.append(OddFrame(kind, recording, t, pads, size, float(strength)))
        return found

    def told(
        self, jumps: Floats, frame: Floats, *, at_end: bool
    ) -> tuple[Kind | None, tuple[int, ...]]:
        """Return what a candidate is, and of which pads; None: an impact.

        Args:
            jumps, frame: ``[D]``.
            at_end: it is the first or the last frame of its recording, where a contact may begin
                or end: only what is too high is odd there.
        """
        kind = self._kind(jumps, frame, self._present, at_end)
        if kind is not None:
            jumped = self._present & (np.abs(jumps) > self._usual.least)
            return kind, tuple(np.unique(self._layout.pad_of[jumped]).tolist())
        # One pad of several that jumps to one reading, or by one amount, has a bus that fails: it
        # is judged as its group.
        pads = tuple(
            pad
            for pad in range(self._layout.pads)
            if self._is_scrambled(jumps, frame, self._present & (self._layout.pad_of == pad))
        )
        return ("corrupt", pads) if pads else (None, ())

    def _jumped(self, jumps: Floats, read: Mask) -> Mask | None:
        """Return which of some cells jumped, bool ``[D]``; None: too few."""
        jumped = read & (np.abs(jumps) > self._usual.least)
        return jumped if jumped.sum() >= max(_FEWEST, LEAST_LOADED * read.sum()) else None

    def _is_scrambled(self, jumps: Floats, frame: Floats, on: Mask) -> bool:
        """Return whether what some cells (bool ``[D]``) read agrees neither with their neighbours
        nor with one reading, nor with one jump."""
        read = on & np.isfinite(frame)
        jumped = self._jumped(jumps, read)
        if jumped is None or len(np.unique(frame[read])) == 1:
            return False
        return not self._is_spike(jumps, jumped, read) and self._disagrees(frame, jumped, read)

    @staticmethod
    def _is_spike(jumps: Floats, jumped: Mask, read: Mask) -> bool:
        """Return whether most cells jumped by the same amount."""
        typical = float(np.median(jumps[read]))
        alike = np.abs(jumps[read] - typical) <= _AGREES * abs(typical)
        most = jumped.sum() >= MAJORITY * read.sum()
        return bool(most and alike.mean() >= 1 - LEAST_LOADED)

    def _kind(self, jumps: Floats, frame: Floats, on: Mask, at_end: bool) -> Kind | None:
        """Return what a candidate is of some cells (bool ``[D]``)."""
        read = on & np.isfinite(frame)
        jumped = self._jumped(jumps, read)
        if jumped is None:
            return None
        if self._is_one_number(frame[read], read, at_end):
            return "corrupt"
        if self._is_spike(jumps, jumped, read):
            return "spike"
        if (frame[read] > _BEYOND * self._highest).mean() > MAJORITY:
            return "corrupt"
        return "corrupt" if self._disagrees(frame, jumped, read) else None

    def _is_one_number(self, readings: Floats, read: Mask, at_end: bool) -> bool:
        """Return whether nearly all ``readings`` of some cells (bool ``[D]``) are one number that
        most of them do not read otherwise."""
        values, times = np.unique(readings, return_counts=True)
        if times.max() < (1 - 2 * LOW) * len(readings):
            return False
        value = values[times.argmax()]
        usual = self._usual
        known = value <= usual.high + usual.least
        if not at_end:
            known &= value >= usual.low - usual.least
        return bool(known[read].mean() < MAJORITY)

    def _disagrees(self, frame: Floats, jumped: Mask, on: Mask) -> bool:
        """Return whether the loads of a frame ``[D]`` agree with those of their neighbours less
        than usual loads of the same cells do, and not more than by chance.

        Args:
            frame: ``[D]``.
            jumped: bool ``[D]``, the cells that jumped.
            on: bool ``[D]``, those to which the question is limited.
        """
        if jumped.sum() < _ENOUGH:
            return False
        loads = np.nan_to_num(frame - self._rest)
        loaded = np.abs(loads) > self._usual.least
        if loaded[jumped].mean() < MAJORITY:  # they fell to their rest
            return False
        agreement, count = _agreement(loads, on & (jumped | loaded), self._beside)
        return agreement < self._least(on) and chance_of(agreement, count) > P_MIN

    @cached_property
    def _beside(self) -> NDArray[np.intp]:
        """The neighbours of each cell, ``[D, k]``; -1: none."""
        ways = [self._layout.beside, _followers(self._sample)[:, None]]
        usual = [np.median(self._agreements(beside, self._present)) for beside in ways]
        return ways[int(np.argmax(usual))]

    def _least(self, on: Mask) -> float:
        """Return the least agreement of usual loads on some cells (bool ``[D]``) with their
        neighbours, at most half of the usual one."""
        key = on.tobytes()
        if key not in self._least_of:
            usual = self._agreements(self._beside, on)
            self._least_of[key] = min(*usual, MAJORITY * float(np.median(usual)))
        return self._least_of[key]

    def _agreements(self, beside: NDArray[np.intp], on: Mask) -> list[float]:
        """Return how usual loads of some cells (bool ``[D]``) agree with those ``beside``; 0 where
        it is unknown."""
        loads = np.nan_to_num(self._sample - self._rest)
        loaded = (np.abs(loads) > self._usual.least) & on
        some = np.flatnonzero(loaded.sum(axis=1) >= _ENOUGH)
        some = some[:: max(1, len(some) // _SAMPLE)].tolist()
        of_frames = [_agreement(loads[t], loaded[t], beside) for t in some]
        return [one for one, count in of_frames if chance_of(one, count) < 1] or [0.0]


def evenly(
    recordings: Sequence[NDArray[Any]], without: Set[tuple[int, int]] = frozenset()
) -> Floats:
    """Return evenly spread frames of a log, ``[n, D]``, without some, given by recording and
    number."""
    step = max(1, sum(map(len, recordings)) // _MOST)
    chosen = [
        [t for t in range(0, len(frames), step) if (i, t) not in without]
        for i, frames in enumerate(recordings)
    ]
    return np.concatenate(
        [_finite(frames[some]) for frames, some in zip(recordings, chosen, strict=True)]
    )


def _followers(sample: Floats) -> NDArray[np.intp]:
    """Return which other cell's readings follow those of each cell best, ``[D]``; -1: none."""
    ranged = np.nan_to_num(sample - known_quantile(sample, 0.5, axis=0))
    spread = ranged.std(axis=0)
    moves = spread > 0
    scaled = np.where(moves, ranged / np.where(moves, spread, 1.0), 0.0).astype(np.float32)
    correlation = scaled.T @ scaled / len(scaled)
    np.fill_diagonal(correlation, -np.inf)
    return np.where(moves, correlation.argmax(axis=1), -1)


def _agreement(loads: Floats, loaded: Mask, beside: NDArray[np.intp]) -> tuple[float, int]:
    """Return the rank correlation of the loads ``[D]`` of some cells with the mean of their
    neighbours', and of how many cells it is; 1 and 0 where that cannot be measured."""
    known = beside >= 0
    around = np.where(known, loads[beside], 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    both = loaded & known.any(axis=1)
    count = int(both.sum())
    if count < _ENOUGH or not np.ptp(around[both]) or not np.ptp(loads[both]):
        return 1.0, 0
    return rank_correlation(loads[both], around[both]), count


def rank_correlation(first: Floats, second: Floats) -> float:
    """Return Spearman's rank correlation of two rows ``[n]``, neither of which is constant; as
    :func:`scipy.stats.spearmanr`, in a fifth of its time on a few cells."""
    one = _centred_ranks(first)
    other = _centred_ranks(second)
    correlation = one @ other / np.sqrt((one @ one) * (other @ other))
    return float(np.clip(correlation, -1.0, 1.0))


def _centred_ranks(values: Floats) -> Floats:
    """Return the ranks of values ``[n]``, equal ones at their mean, around 0."""
    _, place, times = np.unique(values, return_inverse=True, return_counts=True)
    ranks = np.cumsum(times) - (times - 1) / 2
    return ranks[place] - (len(values) + 1) / 2


def chance_of(correlation: float, count: int) -> float:
    """Return how likely so high a rank correlation of so many independent pairs is."""
    if count == 0 or correlation <= -1:
        return 1.0
    if correlation >= 1:
        return 0.0
    from scipy.special import stdtr  # a check of a data set rarely needs it, and waits for it

    freedom = count - 2
    against = correlation * np.sqrt(freedom / ((1 + correlation) * (1 - correlation)))
    return float(stdtr(freedom, -against))
