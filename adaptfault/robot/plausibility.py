"""Whether recordings look like this robot's sensor at all: what does not must not change what the robot runs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from adaptfault.data.windows import hold_missing, scale
from adaptfault.imputation.statistics import CellStatistics
from diagnostics import FaultSet, SensorLayout

_BEYOND = 0.05  # of full scale: how far a reading may lie outside, as calibrations do
_MOST_BEYOND = 0.01  # share of readings that may lie further out
_RIDGE = 1e-6  # of the mean variance: covariances are stored in single precision


def implausible(recording: NDArray[Any], layout: SensorLayout) -> str | None:
    """Say what is wrong with a recording ``[T, D]`` by itself; None if nothing is."""
    frames = recording[:, layout.present.ravel()]
    heard = ~np.isnan(frames)
    if not heard.any():
        return "it holds no reading"
    margin = _BEYOND * layout.full_scale
    beyond = heard & ((frames < -margin) | (frames > layout.full_scale + margin))
    if (share := beyond.sum() / heard.sum()) > _MOST_BEYOND:
        return (
            f"{share:.0%} of its readings lie outside 0 to {layout.full_scale:g} {layout.unit}"
            f" (from {np.nanmin(frames):.4g} to {np.nanmax(frames):.4g}): raw counts, or another sensor"
        )
    return None


def contradiction(
    recordings: list[NDArray[Any]], fault_set: FaultSet, statistics: CellStatistics, layout: SensorLayout
) -> float:
    """Return how much of what the healthy cells read the other healthy cells do not explain.

    Of each recording that has movement, the variance of the error when each healthy cell is predicted from the others
    (linear conditional mean), divided by the variance of the cells; then the median over recordings. On a sensor like
    the one that the statistics are of it is far below 1. Above 1 the others predict a cell worse than its own mean
    does: cells in another order, another sensor, noise, or faults that were not found. 0 if nothing moved.
    """
    healthy = np.array(sorted(set(fault_set.healthy.tolist()) & set(np.flatnonzero(layout.present.ravel()).tolist())))
    covariance = statistics.covariance[np.ix_(healthy, healthy)]
    covariance = covariance + (_RIDGE * np.trace(covariance) / len(healthy) + np.finfo(float).tiny ** 0.25) * np.eye(
        len(healthy)
    )
    precision = cho_solve(cho_factor(covariance, lower=True), np.eye(len(healthy)))
    ratios = []
    for recording in recordings:
        off = hold_missing(scale(recording, layout))[:, healthy].astype(np.float64) - statistics.mean[healthy]
        error = off @ precision / np.diag(precision)  # of each cell, predicted from all others
        if moved := float(off.var(axis=0).sum()):
            ratios.append(float(error.var(axis=0).sum()) / moved)
    return float(np.median(ratios)) if ratios else 0.0
