"""Conditional mean with a recalibration and an error that are measured on held-out frames."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.windows import evenly
from adaptfault.imputation.recalibration import Recalibration
from adaptfault.imputation.statistics import CellStatistics
from diagnostics import FaultSet

_HELD_OUT = 2_000  # frames of each fold on which the error is measured

Floats = NDArray[np.float64]


class CrossFitted:
    """Gaussian conditional mean of any missing cells, recalibrated by two-fold cross-fitting.

    Args:
        frames: ``[M, D]``, healthy.
        fold: bool ``[M]``; the frames of each fold are predicted by the other.
    """

    def __init__(self, frames: NDArray[Any], fold: NDArray[np.bool_]) -> None:
        self._whole = CellStatistics.of_frames(frames)
        self._halves = [CellStatistics.of_frames(frames[fold == side]) for side in (False, True)]
        self._held_out = [
            (of := frames[fold == side])[evenly(len(of), _HELD_OUT)] for side in (True, False)
        ]

    def affine(self, fault_set: FaultSet) -> tuple[Floats, Floats, Floats]:
        """Return weight ``[k, D-k]``, bias ``[k]`` and standard deviation of the error ``[k]`` for
        F."""
        healthy = fault_set.healthy
        missing = np.flatnonzero(fault_set.mask)
        mean = self._whole.mean[missing]
        predicted = []
        readings = []
        for half, frames in zip(self._halves, self._held_out, strict=True):
            weight, bias = half.conditional_mean(fault_set)
            predicted.append(frames[:, healthy] @ weight.T + (bias - mean))
            readings.append(frames[:, missing] - mean)
        held_out = np.concatenate(readings)
        correction = Recalibration.fit(np.concatenate(predicted), held_out, total=len(held_out))
        weight, bias = self._whole.conditional_mean(fault_set)
        bias = mean + correction.gain * (bias - mean) + correction.offset
        return correction.gain[:, None] * weight, bias, correction.deviation


def by_missing(
    missing: NDArray[np.bool_],
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.bool_]]]:
    """Yield the frames of ``missing [n, D]`` that lack the same cells, and which these are, bool
    ``[D]``; frames that lack none are left out."""
    rows = np.flatnonzero(missing.any(axis=1))
    if not len(rows):
        return
    _, first, group = np.unique(
        np.packbits(missing[rows], axis=1), axis=0, return_index=True, return_inverse=True
    )
    for number, mask in enumerate(missing[rows[first]]):
        yield rows[group.ravel() == number], mask
