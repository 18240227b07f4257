"""Regressions where samples are fewer than inputs, as in a patch of a large array: solved by their samples, not inputs.

The weights of a ridge regression are sums of samples, ``w = Z' a``, so each step takes n x n products instead of n x
(4 inputs), and may go by the curvature: a patch of 256 cells is fitted in a twentieth of the time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import expit

Array = NDArray[np.float32]

_STEPS = 12  # few suffice: each goes by the curvature


def logistic(x: Array, y: Array, own: Array, ridge: float, usual: Array) -> tuple[Array, Array]:
    """Fit two ridge logistic regressions for each of k cells, none of which speaks for itself.

    Args:
        x: ``[n, inputs]``.
        y: 0 or 1, ``[n, 2, k]``.
        own: ``[n, f, k]``, the f columns of ``x`` that belong to each of the k cells.
        ridge: per sample; of the bias too.
        usual: log odds ``[n, 2, k]`` (or what broadcasts to that) that the regressions are added to.

    Returns:
        The coefficients of the samples ``[n, 2, k]``, and the bias ``[2, k]``. The weights are ``x.T @ coefficients``,
        but 0 for a cell's own columns.
    """
    n = len(x)
    matching = x @ x.T + 1  # the bias is the weight of a column of ones
    # No logistic loss bends more than a quarter of its samples' covariance (Boehning 1992): steps go by this bound.
    turn = linalg.inv(0.25 * matching.astype(np.float64) / n + ridge * np.eye(n)).astype(np.float32)
    of_cell = np.ascontiguousarray(own.transpose(2, 0, 1))  # (k, n, f)

    def odds(a: Array) -> Array:
        without = of_cell @ (of_cell.transpose(0, 2, 1) @ a.transpose(2, 0, 1))  # (k, n, 2)
        return np.asarray((matching @ a.reshape(n, -1)).reshape(a.shape) - without.transpose(1, 2, 0) + usual)

    a, ahead = np.zeros_like(y), np.zeros_like(y)
    for k in range(_STEPS):  # Nesterov's method: each step from a point ahead of the last
        slope = (expit(odds(ahead)) - y) / np.float32(n) + np.float32(ridge) * ahead
        after = ahead - (turn @ slope.reshape(n, -1)).reshape(a.shape)
        a, ahead = after, after + np.float32(k / (k + 3)) * (after - a)
    return a, a.sum(axis=0)


def covariance_and_precision(
    z: NDArray[np.float64], taper: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the covariance of ``[n, inputs]`` and its inverse.

    Shrunk (Ledoit and Wolf 2004), and multiplied by ``taper [inputs, inputs]``, which falls with the distance of two
    cells: few samples show correlations at a distance that are not there (Houtekamer and Mitchell 2001).
    """
    from sklearn.covariance import LedoitWolf

    covariance = LedoitWolf(store_precision=False).fit(z).covariance_ * taper
    try:
        return covariance, linalg.cho_solve(linalg.cho_factor(covariance), np.eye(len(covariance)))
    except linalg.LinAlgError:
        return covariance, linalg.pinvh(covariance)
