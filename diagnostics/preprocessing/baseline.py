"""Baseline: the reading of each cell without contact, its noise and its drift.

Estimates per cell ``q05(readings) + max(0, drift + 6 sigma - tolerance)``: the 0.05 quantile, plus
the upward drift of the baseline between recordings, plus noise. The drift is mirrored from the
downward drift, which loads do not hide, but a baseline of 0 does: there it comes from the frame
with the least total load in each recording, and drift that less than a quarter of the cells show is
not found. The noise sigma is a robust estimate from second differences, median(|x_{t+1} - 2 x_t +
x_{t-1}|) / (0.6745 sqrt 6), as ``scipy.stats.median_abs_deviation(scale="normal")`` of a series
without trend.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from diagnostics.preprocessing.levels import LEAST_LOADED, LIGHT, LOW, RARE
from diagnostics.preprocessing.quantiles import known_quantile
from diagnostics.preprocessing.readings import CELLS, RecordingBlocks, spread

_NOISE = 6.0  # standard deviations from the low quantile to the highest of many readings

Floats = NDArray[np.float64]


def baseline(
    recordings: Sequence[Floats], present: NDArray[np.bool_], tolerance: float, full_scale: float
) -> Floats:
    """Return the highest reading without contact of each cell, ``[D]``, see the module.

    Args:
        recordings: ``[T, D]`` each.
        present: bool ``[D]``, cells from which drift and noise are estimated.
        tolerance: a constant run stays within +- this; smaller drift is covered by it.
        full_scale: of the layout.
    """
    readings = RecordingBlocks.of(recordings)
    cells = spread(np.flatnonzero(present))
    low = _low(readings)
    offsets = []
    unloaded = []
    curvatures = []
    for i in readings.some:
        frames = readings.piece(i, slice(None), cells)
        received = ~np.isnan(frames).any(axis=0)
        if len(frames) > 2 and received.any():
            whole = frames[:, received]
            offsets.append(np.quantile(whole, LOW, axis=0) - low[cells[received]])
            least_loaded = whole[whole.sum(axis=1).argmin()]
            unloaded.append(
                np.minimum(least_loaded, np.quantile(whole, LEAST_LOADED, axis=0))
                - low[cells[received]]
            )
            # A load changes slowly: its second difference is small.
            curvatures.append(np.median(np.abs(np.diff(whole, 2, axis=0)), axis=0))
    if not offsets:
        return low
    offset = np.concatenate(offsets)
    light = offset < LIGHT * full_scale
    drift = _highest(offset[light], np.concatenate(unloaded)[light])
    noise = deviation(float(np.quantile(np.concatenate(curvatures), LEAST_LOADED)))
    found: Floats = low + max(0.0, drift + _NOISE * noise - tolerance)
    return found


def _highest(offset: Floats, unloaded: Floats) -> float:
    """Return the upward drift of unloaded cells, mirrored from the downward drift: light loads hide
    the upper end.

    Equals twice the median minus the 0.001 quantile, between two and three times the median. Where
    a baseline of 0 hides the downward drift, it is the 0.999 quantile of a normal distribution with
    the upper quartile of ``unloaded``.

    Args:
        offset: low quantiles of the readings of a cell in a recording, ``[n]``.
        unloaded: readings of these cells with hardly any load on the array, ``[n]``.
    """
    if not len(offset):
        return 0.0
    usual = max(0.0, float(np.median(offset)))
    below = usual - float(np.quantile(offset, RARE, method="lower"))
    if below <= usual:  # no cell ever read less than its baseline
        above = float(np.quantile(unloaded, 1 - LEAST_LOADED)) - usual
        return usual + max(usual, above * float(ndtri(RARE) / ndtri(LEAST_LOADED)))
    return usual + float(np.clip(below, usual, 2 * usual))


def _low(readings: RecordingBlocks) -> Floats:
    """Return the low quantile of the readings of each cell, ``[D]``; 0 without any reading."""
    n_cells = readings.given[0].shape[1]
    low = np.zeros(n_cells)
    for first in range(0, n_cells, CELLS):
        cells = np.arange(first, min(first + CELLS, n_cells))
        pieces = [readings.piece(i, slice(None), cells) for i in range(len(readings))]
        low[cells] = np.nan_to_num(known_quantile(np.concatenate(pieces), LOW, axis=0))
    return low


def deviation(curvature: float) -> float:
    """Return the standard deviation of noise whose second differences have this median size."""
    return float(curvature / (0.6745 * np.sqrt(6)))
