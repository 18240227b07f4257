"""Constant runs: since when each cell holds one value.

Finds, for each cell, the longest run at the end of the log within +- tolerance of one value:

    start = min { s : max(x_s..x_T) - min(x_s..x_T) <= 2 tolerance }

A stuck cell is constant from its onset on, up to the dither of the converter. So is a healthy cell
without contact, or under a static load: a constant run alone is no evidence of a fault.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.readings import SEGMENT, held
from diagnostics.preprocessing.scale import Scale

Floats = NDArray[np.float64]

SHORTEST_RUN = 5  # frames; shorter runs are not tested


@dataclass(frozen=True)
class ConstantRuns:
    """The constant run at the end of the log, for each cell; readings in the layout's unit.

    Attributes:
        start: int ``[D]``, number of the first frame of the run; 0 where the cell never moved.
        length: int ``[D]``, frames of the run with a reading.
        low, high: float ``[D]``, range of the readings in the run; inf and -inf before the first
        reading.
        last: float ``[D]``, the last reading; NaN: none yet.
        same: int ``[D]``, consecutive frames with exactly that reading.
        missed: int ``[D]``, consecutive frames without a reading, up to now.
        missed_since: int ``[D]``, number of the first of these; meaningless where ``missed`` is 0.
    """

    start: NDArray[np.intp]
    length: NDArray[np.intp]
    low: Floats
    high: Floats
    last: Floats
    same: NDArray[np.intp]
    missed: NDArray[np.intp]
    missed_since: NDArray[np.intp]

    @classmethod
    def begin(cls, n_cells: int) -> ConstantRuns:
        """Return the state before any frame."""
        zero = np.zeros(n_cells, np.intp)
        nothing = np.full(n_cells, np.inf)
        last = np.full(n_cells, np.nan)
        return cls(zero, zero, nothing, -nothing, last, zero, zero, zero)

    def extend(
        self,
        frames: Floats,
        numbers: NDArray[np.intp],
        tolerance: float,
    ) -> ConstantRuns:
        """Return the runs after more frames.

        Args:
            frames: ``[t, D]``, t >= 1; NaN = missing, which neither ends nor extends a run.
            numbers: int ``[t]``, of the frames, ascending.
            tolerance: a run stays within +- this of one value.
        """
        missing = np.isnan(frames)
        any_missing = bool(missing.any())
        top = np.where(missing, -np.inf, frames) if any_missing else frames
        bottom = np.where(missing, np.inf, frames) if any_missing else frames
        low = np.minimum(self.low, bottom.min(axis=0))
        high = np.maximum(self.high, top.max(axis=0))
        received = (~missing).sum(axis=0) if any_missing else np.full(len(self.low), len(frames))
        readings = held(frames, self.last)
        start = self.start
        length = self.length + received
        broke = np.flatnonzero(high - low > 2 * tolerance)
        if len(broke):
            start = start.copy()
            length = length.copy()
            # The first frame of the new run lies in this block: search backwards.
            highest = np.maximum.accumulate(top[::-1, broke], axis=0)
            lowest = np.minimum.accumulate(bottom[::-1, broke], axis=0)
            # the spread only grows: a prefix of True
            count = (highest - lowest <= 2 * tolerance).sum(axis=0)
            at = np.arange(len(broke))
            first = len(frames) - count
            if any_missing:  # it begins with a reading
                first = (~missing[:, broke] & (np.arange(len(frames))[:, None] >= first)).argmax(
                    axis=0
                )
            start[broke] = numbers[first]
            length[broke] = np.minimum(count, received[broke])
            low[broke] = lowest[count - 1, at]
            high[broke] = highest[count - 1, at]
        latest = (_changed(readings) * np.arange(1, len(readings), dtype=np.int32)[:, None]).max(
            axis=0
        )
        same = np.where(latest > 0, len(readings) - latest, self.same + len(frames))
        missed, since = (
            self._missed(missing, numbers)
            if any_missing
            else (np.zeros_like(same), self.missed_since)
        )
        return ConstantRuns(start, length, low, high, readings[-1].copy(), same, missed, since)

    def _missed(
        self, missing: NDArray[np.bool_], numbers: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the consecutive frames without a reading of each cell, and the number of the
        first."""
        all_of_them = missing.all(axis=0)
        missed = np.where(all_of_them, self.missed + len(missing), (~missing[::-1]).argmax(axis=0))
        since = numbers[len(missing) - np.clip(missed, 1, len(missing))]
        return missed, np.where(all_of_them & (self.missed > 0), self.missed_since, since)

    def of(self, cells: NDArray[np.intp]) -> ConstantRuns:
        """Return the runs of some cells."""
        return ConstantRuns(*(values[cells] for values in vars(self).values()))

    @property
    def value(self) -> Floats:
        """float ``[D]``, centre of the readings in the run; NaN without any reading."""
        value = np.full(len(self.high), np.nan)
        np.add(self.high, self.low, out=value, where=np.isfinite(self.high))
        return value / 2

    @property
    def moved(self) -> NDArray[np.bool_]:
        """bool ``[D]``, True where the cell read another value before the run."""
        moved: NDArray[np.bool_] = self.start > 0
        return moved


def _changed(readings: Floats) -> NDArray[np.bool_]:
    """Return where a reading differs from the one before, bool ``[t, D]``."""
    changed = np.asarray(readings[1:] != readings[:-1])
    if np.isnan(readings[0]).any():
        changed &= ~np.isnan(readings[:-1])
    return changed


def segments(
    recording: Floats, scale: Scale, length: int = SEGMENT
) -> Iterator[tuple[Floats, NDArray[np.intp], ConstantRuns]]:
    """Yield pieces of a healthy recording ``[T, D]``: frames, their numbers, and the constant runs
    at their end."""
    runs = ConstantRuns.begin(recording.shape[1])
    for first in range(0, len(recording), length):
        frames = recording[first : first + length]
        numbers = np.arange(first, first + len(frames))
        runs = runs.extend(frames, numbers, scale.near / 2)
        yield frames, numbers, runs
