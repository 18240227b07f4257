"""Baseline: the reading of each cell without contact, its noise and drift, and the lower limit of healthy readings.

Estimates per cell ``q05(readings) + max(0, drift + 6 sigma - tolerance)``: the 0.05 quantile, plus the upward drift of
the baseline between recordings (mirrored from the downward drift, which loads do not hide), plus noise. The noise sigma
is a robust estimate from second differences, median(|x_{t+1} - 2 x_t + x_{t-1}|) / (0.6745 sqrt 6), as
``scipy.stats.median_abs_deviation(scale="normal")`` of a series without trend.

Detects open cells without contact (:class:`LowerLimit`): on arrays whose cells rest above 0, a cell that lost its wire
reads a constant value below the lower limit. Where cells rest at 0 an open cell looks like any unloaded one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.contact_events import SEGMENT
from diagnostics.preprocessing.readings import CELLS, RecordingBlocks
from diagnostics.preprocessing.scale import LIGHT

if TYPE_CHECKING:
    from diagnostics.events.constant_runs import ConstantRuns

LOW = 0.05  # quantile of all readings of a cell: its baseline
_UNLOADED = 0.03  # quantile of the readings in one recording: its baseline there, unless loaded throughout
_CALM = 0.25  # quantile of the noise over cells and recordings: loaded cells have more
_NOISE = 6.0  # standard deviations from the low quantile to the highest of many readings
_RARE = 0.001  # share of cells and recordings that is ignored
FEWEST = 8  # recordings from which differences between recordings can be estimated
MAJORITY = 0.5  # of recordings, frames or cells: what most do is usual
MARGIN = 1.5  # times the most that healthy cells showed: what no healthy cell shows
CERTAIN_RATIO = 12.0  # log likelihood ratio fault : healthy of what only a fault explains
_AS_EVER = -2.0  # log likelihood ratio of a usual reading that an open cell does not give

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LowerLimit:
    """Lower limit of the highest reading of a healthy cell in a constant run.

    Attributes:
        reading: float ``[D]``, in the layout's unit; full scale where noise permits no constant run; -inf: unknown.
        usual: the lowest median, over recordings, of unloaded readings above ``reading``; -inf: unknown.
    """

    reading: Floats
    usual: float

    @classmethod
    def unknown(cls, n_cells: int) -> LowerLimit:
        """Return the limit of a cold start: no reading is too low."""
        return cls(np.full(n_cells, -np.inf), -np.inf)

    @classmethod
    def fit(
        cls,
        low: Floats,
        last: Floats,
        peaks: Floats,
        most: Floats,
        present: NDArray[np.bool_],
        tolerance: float,
        full_scale: float,
    ) -> LowerLimit:
        """Fit to the results of :func:`_low`, with unloaded readings up to ``most`` (``[D]``)."""
        peak_values = peaks[:, present]
        reading = np.full(
            len(low), np.quantile(peak_values[np.isfinite(peak_values)], _RARE, method="lower") - 2 * tolerance
        )
        # Where most cells rest at 0, a cell that always reads more is loaded.
        if len(peaks) >= FEWEST and np.median(low[present]) > tolerance:
            peak = peaks - low
            unloaded = peak < LIGHT * full_scale
            often = np.count_nonzero(unloaded, axis=0) >= MAJORITY * len(peaks)
            peak_values = peak[unloaded & present]
            rare = float(np.quantile(peak_values, _RARE, method="lower"))
            margin = max((MARGIN - 1) * (float(np.median(peak_values)) - rare), tolerance)
            reading = np.where(often, np.maximum(reading, low + rare - margin), reading)
        above = (np.median((row - reading)[rests]) for row in last if (rests := present & (row <= most)).any())
        return cls(reading, float(min(above, default=-np.inf)))

    def lower(self, runs: ConstantRuns, rests: NDArray[np.bool_]) -> float:
        """Return by how much all cells that rest (bool ``[D]``) read less than ever in the reference, 0 or below."""
        if not (np.isfinite(self.usual) and rests.any()):
            return 0.0
        return min(0.0, float(np.median((runs.value - self.reading)[rests])) - self.usual)

    def evidence(
        self, runs: ConstantRuns, rests: NDArray[np.bool_], tolerance: float, present: NDArray[np.bool_], lower: float
    ) -> Floats:
        """Return the log likelihood ratio open : healthy of a constant run without contact, ``[D]``.

        12 for a run below the limit and below that of all cells, -2 for a usual one, 0 else.

        Args:
            runs: the constant runs.
            rests: bool ``[D]``, cells at their baseline or below.
            tolerance: readings within 2 tolerances of 0 are at the low rail.
            present: bool ``[D]``.
            lower: see :meth:`lower`.
        """
        received = present & np.isfinite(runs.value)
        least = self.reading + lower
        less = received & (runs.length >= SEGMENT) & (runs.high < least)
        open_ = (runs.high <= 2 * tolerance) | (runs.high < least[present].min())
        as_ever = rests & received & (runs.high >= least) & (least > tolerance)
        return untouched_evidence(less, less & open_, as_ever, present)


def untouched_evidence(
    unusual: NDArray[np.bool_], broken: NDArray[np.bool_], as_ever: NDArray[np.bool_], present: NDArray[np.bool_]
) -> Floats:
    """Return the log likelihood ratio fault : healthy of cells without contact, ``[D]``: 12, -2 or 0.

    All are 0 where more than half of the cells are unusual.

    Args:
        unusual: bool ``[D]``, cells that behave as they never did in the reference.
        broken: bool ``[D]``, those of them that only a fault explains: 12.
        as_ever: bool ``[D]``, cells that behave as ever, unlike broken ones: -2.
        present: bool ``[D]``.
    """
    if unusual.sum() > MAJORITY * present.sum():
        return np.zeros(len(present))
    return np.where(broken, CERTAIN_RATIO, np.where(as_ever, _AS_EVER, 0.0))


def baseline(
    recordings: Sequence[Floats], present: NDArray[np.bool_], tolerance: float, full_scale: float
) -> tuple[Floats, LowerLimit]:
    """Return the highest reading of each cell without contact, ``[D]``, and the lower limit of healthy cells.

    The baseline of a cell without any reading is 0.

    Args:
        recordings: ``[T, D]`` each.
        present: bool ``[D]``, cells from which drift and noise are estimated.
        tolerance: a constant run stays within +- this; smaller drift is covered by it.
        full_scale: of the layout.
    """
    low, last, peaks = _low(recordings)
    cells, some = RecordingBlocks.of(recordings).sample(present)
    offsets, curvatures = [], []
    for frames in some:
        received = ~np.isnan(frames).any(axis=0)
        if len(frames) > 2 and received.any():
            whole = frames[:, received]
            offsets.append(np.quantile(whole, _UNLOADED, axis=0) - low[cells[received]])
            curvatures.append(
                np.median(np.abs(np.diff(whole, 2, axis=0)), axis=0)
            )  # a load changes slowly: its second difference is small
    if not offsets:
        return low, LowerLimit.unknown(len(low))
    offset = np.concatenate(offsets)
    light = offset[offset < LIGHT * full_scale]
    noise = float(np.quantile(np.concatenate(curvatures), _CALM)) / (0.6745 * np.sqrt(6))
    most = low + max(0.0, _highest(light) + _NOISE * noise - tolerance)
    if noise > tolerance:
        return most, LowerLimit(np.full(len(low), full_scale), -np.inf)
    return most, LowerLimit.fit(low, last, peaks, most, present, tolerance, full_scale)


def _highest(offset: Floats) -> float:
    """Return the upward drift of unloaded cells, mirrored from the downward drift: light loads hide the upper end.

    Equals twice the median minus the 0.001 quantile, between two and three times the median.
    """
    if not len(offset):
        return 0.0
    usual = max(0.0, float(np.median(offset)))
    below = usual - float(np.quantile(offset, _RARE, method="lower"))
    return usual + min(max(below, usual), 2 * usual)


def _low(recordings: Sequence[Floats]) -> tuple[Floats, Floats, Floats]:
    """Return the low quantile of the readings of each cell, and its last reading and lowest peak in each recording.

    Shapes: ``[D]`` (0 without any reading), and twice ``[recordings, D]``.
    """
    readings, n_cells = RecordingBlocks.of(recordings), recordings[0].shape[1]
    low, (last, peaks) = np.zeros(n_cells), np.full((2, len(readings), n_cells), np.nan)
    for first in range(0, n_cells, CELLS):
        cells = np.arange(first, min(first + CELLS, n_cells))
        pieces = [readings.piece(i, slice(None), cells) for i in range(len(readings))]
        for i, frames in enumerate(pieces):
            last[i, cells], peaks[i, cells] = frames[-1], _lowest_peak(frames)
        frames = np.concatenate(pieces)
        received = ~np.isnan(frames).all(axis=0)
        low[cells[received]] = np.nanquantile(frames[:, received], LOW, axis=0)
    return low, last, peaks


def _lowest_peak(frames: Floats) -> Floats:
    """Return the minimum over half segments of the highest reading in each, ``[D]``: that of a constant run."""
    length = min(SEGMENT // 2, len(frames))
    whole = len(frames) // length * length
    lowest: Floats = np.fmin.reduce(np.fmax.reduce(frames[:whole].reshape(-1, length, frames.shape[1]), axis=1), axis=0)
    return lowest
