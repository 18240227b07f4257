"""Linear recalibration of imputed readings on held-out frames, with the standard deviation of the
error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Recalibration:
    """Correction ``offset + gain * p`` of predictions p for m cells.

    The gain is the least-squares slope of the reading on the prediction, limited to 0..1. So the
    corrected prediction has at most the squared error of the mean of the cell on the frames of the
    fit.

    Attributes:
        gain, offset: ``[m]``.
        deviation: ``[m]``, root mean squared error after the correction.
    """

    gain: Values
    offset: Values
    deviation: Values

    @classmethod
    def fit(
        cls,
        predicted: NDArray[Any],
        reading: NDArray[Any],
        *,
        total: float,
        repeats: float = 1.0,
        prior_error: Values | float = 0.0,
        prior_variance: Values | float = 0.0,
        prior_frames: float = 0.0,
    ) -> Recalibration:
        """Fit to held-out predictions and readings, both ``[n, m]`` about rest.

        Args:
            predicted, reading: frames with contact; all other frames have 0 in both.
            total: number of frames, those without contact included.
            repeats: number of frames that each of the n stands for.
            prior_error, prior_variance: ``[m]``, variances of error and prediction assumed in
            ``prior_frames`` more
                frames, whose slope is 1. So few frames give a gain near 1.
            prior_frames: weight of the prior.
        """
        p = predicted.astype(np.float64)
        y = reading.astype(np.float64)
        share = repeats / total
        prior_share = prior_frames / total
        mean_p = share * p.sum(axis=0)
        mean_y = share * y.sum(axis=0)
        variance = share * (p * p).sum(axis=0) - mean_p**2 + prior_share * prior_variance
        covariance = share * (p * y).sum(axis=0) - mean_p * mean_y + prior_share * prior_variance
        seen = variance > 0
        gain = np.where(seen, np.clip(covariance / np.where(seen, variance, 1), 0, 1), 1.0)
        offset = np.where(seen, mean_y - gain * mean_p, 0.0) / (1 + prior_share)
        idle = max(0.0, total - repeats * len(p))
        squares = repeats * ((y - offset - gain * p) ** 2).sum(axis=0) + idle * offset**2
        return cls(
            gain, offset, np.sqrt((squares + prior_frames * prior_error) / (total + prior_frames))
        )


def two_folds(recording: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Assign frames ``[M]`` to two folds by recording; the frames of a single recording are cut in
    the middle."""
    recordings, index = np.unique(recording, return_inverse=True)
    if len(recordings) > 1:
        return np.asarray(index.ravel() % 2 == 1)
    return np.arange(len(recording)) >= len(recording) / 2
