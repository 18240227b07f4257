"""Temporal evidence: since when has a cell held one value, and how abruptly did it get there?

A stuck cell holds its value from its onset to the end of the log, up to the converter's dither. So does a healthy one
that nothing touches: stillness raises the question, and the other cells answer it (see ``spatial``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.readings import held

Floats = NDArray[np.float64]

SHORTEST_RUN = 5  # frames; shorter stillness is not worth a question
_JUMPS = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 1.0])  # of full scale, edges of bins
_LATELY = 64  # frames
_MOST = 4.0  # log ratio: jumps alone prove nothing
_COMPANY = 0.2  # share of the loaded cells: when so many jump at once, a grasp was released


@dataclass(frozen=True)
class ConstantRuns:
    """The still stretch that ends the log so far, for each cell. Knows nothing of frames before the last.

    Attributes:
        start: int ``[D]``, number of the first frame of the stretch; 0 where the cell never moved.
        length: int ``[D]``, its frames with a reading.
        low, high: float ``[D]``, the lowest and highest reading of it; inf and -inf before the first reading.
        jump: float ``[D]``, by how much the reading changed in the step before it; 0 where it never moved.
        company: float ``[D]``, share of the loaded cells that fell, or rose, as drastically in that very step.
        last: float ``[D]``, the last reading.
        same: int ``[D]``, how many frames on end have had exactly that reading.
        missed: int ``[D]``, how many frames on end have had none by now.
        missed_since: int ``[D]``, number of the first of these; meaningless where there is none.
    """

    start: NDArray[np.intp]
    length: NDArray[np.intp]
    low: Floats
    high: Floats
    jump: Floats
    company: Floats
    last: Floats
    same: NDArray[np.intp]
    missed: NDArray[np.intp]
    missed_since: NDArray[np.intp]

    @classmethod
    def begin(cls, n_cells: int) -> ConstantRuns:
        """Nothing seen yet."""
        zero, nothing = np.zeros(n_cells, np.intp), np.full(n_cells, np.inf)
        jump, last = np.zeros(n_cells), np.full(n_cells, np.nan)
        return cls(zero, zero, nothing, -nothing, jump, jump, last, zero, zero, zero)

    def extend(
        self, frames: Floats, numbers: NDArray[np.intp], tolerance: float, baseline: Floats | float = 0.0
    ) -> ConstantRuns:
        """Return the runs after more frames. A cell is still while it stays within +- ``tolerance`` of one value.

        Args:
            frames: ``[t, D]``, t >= 1; NaN = missing, which neither breaks nor proves a run.
            numbers: int ``[t]``, of the frames, ascending.
            tolerance: as far as a converter's dither goes.
            resting: float ``[D]``, what untouched cells read.
        """
        missing = np.isnan(frames)
        any_missing = bool(missing.any())
        top = np.where(missing, -np.inf, frames) if any_missing else frames
        bottom = np.where(missing, np.inf, frames) if any_missing else frames
        low, high = np.minimum(self.low, bottom.min(axis=0)), np.maximum(self.high, top.max(axis=0))
        received = (~missing).sum(axis=0) if any_missing else np.full(len(self.low), len(frames))
        readings = held(frames, self.last)
        start, length, jump, company = self.start, self.length + received, self.jump, self.company
        broke = np.flatnonzero(high - low > 2 * tolerance)
        if len(broke):
            start, length, jump, company = start.copy(), length.copy(), jump.copy(), company.copy()
            # Among these frames lies the first of the stretch that ends here: look for it from the end.
            highest = np.maximum.accumulate(top[::-1, broke], axis=0)
            lowest = np.minimum.accumulate(bottom[::-1, broke], axis=0)
            count = (highest - lowest <= 2 * tolerance).sum(axis=0)  # the spread only grows: a prefix of True
            at = np.arange(len(broke))
            first = len(frames) - count
            if any_missing:  # it begins with a reading
                first = (~missing[:, broke] & (np.arange(len(frames))[:, None] >= first)).argmax(axis=0)
            start[broke] = numbers[first]
            length[broke] = np.minimum(count, received[broke])
            # What the cells did in the steps into those stretches.
            steps = np.flatnonzero(np.bincount(first))
            which = np.searchsorted(steps, first)
            before, after = readings[steps], readings[steps + 1]
            step, size = after - before, np.fmax(after, before) - baseline
            drastic = np.maximum(0.5 * size, 4 * tolerance)
            # Cells broken from the start hold their value all along: only others could have jumped too.
            able = (high - low > 2 * tolerance) | self.moved
            able |= self.length < _LATELY
            loaded = np.maximum(_in_each((size > 4 * tolerance) & able), 1)
            # A release lets cells fall together and none rise, a grasp the other way round: only cells that go the same
            # way are company. When many break at once, some fall and some rise.
            share = np.stack([_in_each(step < -drastic), _in_each(step > drastic)]) / loaded
            low[broke], high[broke] = lowest[count - 1, at], highest[count - 1, at]
            into = step[which, broke]
            jump[broke] = np.where(np.isnan(into), 0.0, into)
            company[broke] = share[(jump[broke] > 0).astype(np.intp), which]
        latest = (_changed(readings) * np.arange(1, len(readings), dtype=np.int32)[:, None]).max(axis=0)
        same = np.where(latest > 0, len(readings) - latest, self.same + len(frames))
        missed, since = self._missed(missing, numbers) if any_missing else (np.zeros_like(same), self.missed_since)
        return ConstantRuns(start, length, low, high, jump, company, readings[-1].copy(), same, missed, since)

    def _missed(
        self, missing: NDArray[np.bool_], numbers: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return how many frames on end each cell has missed, and the number of the first of these."""
        all_of_them = missing.all(axis=0)
        missed = np.where(all_of_them, self.missed + len(missing), (~missing[::-1]).argmax(axis=0))
        since = numbers[len(missing) - np.clip(missed, 1, len(missing))]
        return missed, np.where(all_of_them & (self.missed > 0), self.missed_since, since)

    def of(self, cells: NDArray[np.intp]) -> ConstantRuns:
        """Return the runs of some cells."""
        return ConstantRuns(*(values[cells] for values in vars(self).values()))

    @property
    def value(self) -> Floats:
        """float ``[D]``, what each cell reads during its stretch; NaN for one that never delivered a reading."""
        return np.where(np.isfinite(self.high), (np.nan_to_num(self.high) + np.nan_to_num(self.low)) / 2, np.nan)

    @property
    def moved(self) -> NDArray[np.bool_]:
        """bool ``[D]``, True where the cell read something else before."""
        moved: NDArray[np.bool_] = self.start > 0
        return moved

    @property
    def alone(self) -> NDArray[np.bool_]:
        """bool ``[D]``, False where a cell jumped into its stretch as many others did, as when a grasp ends."""
        alone: NDArray[np.bool_] = self.company < _COMPANY
        return alone


def same_for(readings: Floats, before: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return for how many frames on end each cell has read exactly the same, by the end of each frame, ``[t, D]``.

    Args:
        readings: ``[1 + t, D]``, see ``readings.held``.
        before: int ``[D]``, for how many frames on end it had been the first of these.
    """
    number = np.arange(1, len(readings))[:, None]
    since = np.maximum.accumulate(np.where(_changed(readings), number - 1, -before), axis=0)
    return np.asarray(number - since)


def _changed(readings: Floats) -> NDArray[np.bool_]:
    """Return where a reading differs from the one before it, bool ``[t, D]``."""
    changed = np.asarray(readings[1:] != readings[:-1])
    if np.isnan(readings[0]).any():
        changed &= ~np.isnan(readings[:-1])
    return changed


def _in_each(which: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return how many cells of ``[t, D]`` there are in each frame."""
    count: NDArray[np.int32] = which.sum(axis=1, dtype=np.int32)  # faster than what NumPy would count in
    return count


def segments(
    recording: Floats, length: int, tolerance: float
) -> Iterator[tuple[Floats, NDArray[np.intp], NDArray[np.intp]]]:
    """Yield a recording ``[T, D]`` in pieces: frames, their numbers, and from which on each cell ``[D]`` is still."""
    runs = ConstantRuns.begin(recording.shape[1])
    for first in range(0, len(recording), length):
        frames = recording[first : first + length]
        numbers = np.arange(first, first + len(frames))
        runs = runs.extend(frames, numbers, tolerance)
        yield frames, numbers, runs.start


@dataclass(frozen=True)
class JumpHistogram:
    """How abruptly healthy cells become still: what the jump into a still stretch says of a fault.

    A broken cell jumps by whatever lies between its load and the value it sticks to; a healthy one is mostly let go
    little by little, and when a whole grasp is released its neighbours fall with it. Few healthy ones rise in one step
    to a load that they then hold.

    Attributes:
        log_ratio: ``[2, bins]``, log likelihood ratio fault : healthy of a fall and of a rise of each size.
    """

    log_ratio: Floats

    @classmethod
    def fit(
        cls, recordings: Sequence[Floats], tolerance: float, full_scale: float, baseline: Floats | float = 0.0
    ) -> JumpHistogram:
        """Count the jumps of healthy cells, recordings ``[T, D]`` each; untouched ones read ``baseline`` (``[D]``)."""
        healthy = np.ones((2, len(_JUMPS) - 1))
        for recording in recordings:
            runs = ConstantRuns.begin(recording.shape[1])
            for first in range(0, len(recording), SHORTEST_RUN):
                frames = recording[first : first + SHORTEST_RUN]
                runs = runs.extend(frames, np.arange(first, first + len(frames)), tolerance, baseline)
                fresh = runs.moved & (runs.length >= SHORTEST_RUN) & (runs.length < 2 * SHORTEST_RUN) & runs.alone
                for up in (0, 1):
                    jumps = runs.jump[fresh & ((runs.jump > 0) == up)]
                    healthy[up] += np.histogram(np.abs(jumps) / full_scale, _JUMPS)[0]
        ratio = np.diff(_JUMPS) / (healthy / healthy.sum(axis=1, keepdims=True))
        # A cell that rested when it broke did not jump: half of the faults look like anything healthy.
        return cls(np.minimum(np.log(0.5 + 0.5 * ratio), _MOST))

    @classmethod
    def silent(cls) -> JumpHistogram:
        """Without a reference jumps say nothing."""
        return cls(np.zeros((2, len(_JUMPS) - 1)))

    def evidence(self, runs: ConstantRuns, full_scale: float) -> Floats:
        """Return the log likelihood ratio ``[D]``, 0 where a cell never moved or jumped in company."""
        return np.where(runs.alone, self.size(runs, full_scale), 0.0)

    def size(self, runs: ConstantRuns, full_scale: float) -> Floats:
        """Return what the size of each jump would say of a cell that jumped alone, ``[D]``; 0 where it never moved."""
        which = np.searchsorted(_JUMPS[1:-1], np.abs(runs.jump) / full_scale, side="right")
        return np.where(runs.moved, self.log_ratio[(runs.jump > 0).astype(np.intp), which], 0.0)
