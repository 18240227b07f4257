"""The coefficient of determination of predicted values, and the share of each window in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def r2(true: ArrayLike, predicted: ArrayLike) -> float:
    """Return the coefficient of determination of values ``[N, ...]``, mean over those that vary; 0
    if none varies."""
    return float(explained(true, predicted).mean())


def explained(true: ArrayLike, predicted: ArrayLike) -> NDArray[np.float64]:
    """Return 1 - squared error / variance of each window and each value that varies, ``[N, v]``.

    One column of 0 if none varies. The mean over the windows is the coefficient of determination
    of a value.
    """
    t = np.asarray(true, dtype=np.float64)
    p = np.asarray(predicted, dtype=np.float64)
    t = t.reshape(len(t), -1)
    p = p.reshape(len(p), -1)
    variance = ((t - t.mean(axis=0)) ** 2).mean(axis=0)
    # a constant has the variance of rounding
    varies = t.min(axis=0) < t.max(axis=0)
    if not varies.any():
        return np.zeros((len(t), 1))
    shares: NDArray[np.float64] = 1 - (t - p)[:, varies] ** 2 / variance[varies]
    return shares
