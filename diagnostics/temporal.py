"""Temporal evidence: since when has a cell held one value?

A stuck cell holds its value from its onset to the end of the log, up to the converter's dither. So does a healthy one
that nothing touches: stillness raises the question, and the other cells answer it (see ``spatial``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class LastRuns:
    """The longest still stretch at the end of a log, for each cell.

    Attributes:
        start: int ``[D]``, first frame of the stretch; 0 where the cell never moved.
        value: float ``[D]``, what the cell reads during it; NaN for a cell that never delivered a reading.
        moved: bool ``[D]``, True where the cell read something else before.
    """

    start: NDArray[np.intp]
    value: NDArray[np.float64]
    moved: NDArray[np.bool_]


def last_runs(log: NDArray[np.float64], tolerance: float) -> LastRuns:
    """Find the still stretch that ends each cell's log.

    Args:
        log: ``[T, D]``, T >= 1; NaN = missing, which neither breaks nor proves stillness.
        tolerance: a cell is still while it stays within +- this of one value.
    """
    backwards = log[::-1]
    # Missing readings must not show in the running extremes.
    highest = np.maximum.accumulate(np.where(np.isnan(backwards), -np.inf, backwards))
    lowest = np.minimum.accumulate(np.where(np.isnan(backwards), np.inf, backwards))
    length = (highest - lowest <= 2 * tolerance).sum(axis=0)  # the spread only grows: a prefix of True
    start = len(log) - length
    last = np.maximum(length - 1, 0)[None, :]
    high, low = np.take_along_axis(highest, last, 0)[0], np.take_along_axis(lowest, last, 0)[0]
    heard = np.isfinite(high)
    value = np.where(heard, (np.where(heard, high, 0.0) + np.where(heard, low, 0.0)) / 2, np.nan)
    return LastRuns(start=start, value=value, moved=start > 0)
