"""Regressions where samples are fewer than inputs, as in a patch of a large array: solved by their samples, not inputs.

The weights of a ridge regression are sums of samples, ``w = Z' a``, so each step takes n x n products instead of n x
(4 inputs), and may go by the curvature: a patch of 256 cells is fitted in a twentieth of the time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import expit, logit

Array = NDArray[np.float32]

_STEPS = 12  # few suffice: each goes by the curvature


def logistic(x: Array, y: Array, own: Array, ridge: float) -> tuple[Array, Array]:
    """Fit two ridge logistic regressions for each of k cells, none of which speaks for itself.

    Args:
        x: ``[n, inputs]``.
        y: 0 or 1, ``[n, 2, k]``.
        own: ``[n, f, k]``, the f columns of ``x`` that belong to each of the k cells.
        ridge: per sample.

    Returns:
        The coefficients of the samples ``[n, 2, k]``, and the bias ``[2, k]``. The weights are ``x.T @ coefficients``,
        but 0 for a cell's own columns.
    """
    n = len(x)
    bias: Array = logit((y.sum(axis=0) + 1) / (n + 2)).astype(
        np.float32
    )  # an imaginary sample of each kind keeps it finite
    alike = x @ x.T
    # No logistic loss bends more than a quarter of its samples' covariance (Boehning 1992): steps go by this bound.
    bound = 0.25 * (alike + 1) / n + ridge * np.eye(n)  # + 1: the bias
    turn = linalg.inv(bound.astype(np.float64)).astype(np.float32)
    of_cell = np.ascontiguousarray(own.transpose(2, 0, 1))  # (k, n, f)

    def odds(a: Array, b: Array) -> Array:
        by_cell = a.transpose(2, 0, 1)  # (k, n, 2)
        without: Array = (of_cell @ (of_cell.transpose(0, 2, 1) @ by_cell)).transpose(1, 2, 0)
        result = (alike @ a.reshape(n, -1)).reshape(a.shape) - without + b
        return np.asarray(result, np.float32)

    a, ahead_a, ahead_b = np.zeros_like(y), np.zeros_like(y), bias
    for k in range(_STEPS):  # Nesterov's method: each step from a point ahead of the last
        error = (expit(odds(ahead_a, ahead_b)) - y) / np.float32(n)
        slope = (turn @ (error + np.float32(ridge) * ahead_a).reshape(n, -1)).reshape(a.shape)
        next_a = ahead_a - slope
        next_b: Array = ahead_b - slope.sum(axis=0)
        momentum = np.float32(k / (k + 3))
        ahead_a, ahead_b = next_a + momentum * (next_a - a), next_b + momentum * (next_b - bias)
        a, bias = next_a, next_b
    return a, bias


def covariance_and_precision(z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the shrunk covariance of ``[n, inputs]`` (Ledoit and Wolf 2004) and its inverse."""
    from sklearn.covariance import LedoitWolf

    covariance = LedoitWolf(store_precision=False).fit(z).covariance_
    try:
        return covariance, linalg.cho_solve(linalg.cho_factor(covariance), np.eye(len(covariance)))
    except linalg.LinAlgError:
        return covariance, linalg.pinvh(covariance)
