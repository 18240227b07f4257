"""Plausibility of recordings: recordings of another sensor must not change the running version."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from adaptfault.data.windows import hold_missing, scale
from adaptfault.imputation.statistics import CellStatistics
from diagnostics import FaultSet, SensorLayout

_MARGIN = 0.05  # of full scale: calibrated readings may lie outside the range by so much
_MOST_OUTSIDE = 0.01  # largest share of readings outside the margin
_RIDGE = 1e-6  # of the mean variance: covariances are stored in single precision


def implausible(recording: NDArray[Any], layout: SensorLayout) -> str | None:
    """Return why a recording ``[T, D]`` cannot be from this sensor; None if it can."""
    frames = recording[:, layout.is_cell]
    present = ~np.isnan(frames)
    if not present.any():
        return "it holds no reading"
    margin = _MARGIN * layout.full_scale
    outside = present & ((frames < -margin) | (frames > layout.full_scale + margin))
    if (share := outside.sum() / present.sum()) > _MOST_OUTSIDE:
        return (
            f"{share:.0%} of its readings lie outside 0 to {layout.full_scale:g} {layout.unit}"
            f" (from {np.nanmin(frames):.4g} to {np.nanmax(frames):.4g}): raw counts, or another"
            " sensor"
        )
    return None


def contradiction(
    recordings: list[NDArray[Any]],
    fault_set: FaultSet,
    statistics: CellStatistics,
    layout: SensorLayout,
) -> float:
    """Return the residual variance ratio of the healthy cells.

    Per recording: variance of the error of the linear conditional mean of each healthy cell given
    the others, divided by the variance of the cells; then the median over recordings. Far below 1
    on the sensor of the statistics. Above 1 the others predict a cell worse than its mean: cells in
    another order, another sensor, noise, or undetected faults. Recordings whose total variance is
    below the residual variance of the statistics are excluded, because the residuals of noise alone
    exceed its variance by construction. 0 where that excludes all of them (idle or static).
    """
    healthy = np.array(
        sorted(set(fault_set.healthy.tolist()) & set(np.flatnonzero(layout.is_cell).tolist()))
    )
    covariance = statistics.covariance[np.ix_(healthy, healthy)]
    covariance = covariance + (
        _RIDGE * np.trace(covariance) / len(healthy) + np.finfo(float).tiny ** 0.25
    ) * np.eye(len(healthy))
    precision = cho_solve(cho_factor(covariance, lower=True), np.eye(len(healthy)))
    # residual variance of recordings like those of the statistics
    expected = float((1 / np.diag(precision)).sum())
    ratios = []
    for recording in recordings:
        off = (
            hold_missing(scale(recording, layout))[:, healthy].astype(np.float64)
            - statistics.mean[healthy]
        )
        error = off @ precision / np.diag(precision)  # of each cell, predicted from all others
        if (moved := float(off.var(axis=0).sum())) > expected:
            ratios.append(float(error.var(axis=0).sum()) / moved)
    return float(np.median(ratios)) if ratios else 0.0
