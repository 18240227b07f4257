"""The coefficient of determination of predicted values."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def r2(true: ArrayLike, predicted: ArrayLike) -> float:
    """Return the coefficient of determination of values ``[N, k]``, mean over those that vary; 0 if
    none varies."""
    t = np.asarray(true, dtype=np.float64)
    p = np.asarray(predicted, dtype=np.float64)
    total = ((t - t.mean(axis=0)) ** 2).sum(axis=0)
    varies = total > 0
    return (
        float((1 - ((t - p) ** 2).sum(axis=0)[varies] / total[varies]).mean())
        if varies.any()
        else 0.0
    )
