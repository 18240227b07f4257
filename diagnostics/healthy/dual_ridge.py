"""Dual ridge: logistic regressions and covariances where samples are fewer than inputs, as in a
tile of a large array.

The weights of a ridge regression are linear combinations of the samples, ``w = Z' a`` (representer
theorem), so each step takes n x n products instead of n x (4 inputs). Equals the primal solution of
scikit-learn's ``LogisticRegression`` with an L2 penalty and an offset. Preferred for n < inputs;
slower otherwise. An array of 64 x 32 cells is fitted in 40 % of the time that the primal solver
takes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import expit

Array = NDArray[np.float32]

# of accelerated quadratic bounds: weights within 0.02 of the minimum, see test_local_regression.py
STEPS = 14


def logistic(x: Array, y: Array, own: Array, ridge: float, usual: Array) -> tuple[Array, Array]:
    """Fit two ridge logistic regressions for each of k cells, without the features of the cell
    itself.

    Args:
        x: ``[n, inputs]``.
        y: 0 or 1, ``[n, 2, k]``.
        own: ``[n, f, k]``, the f columns of ``x`` that belong to each of the k cells.
        ridge: per sample; of the bias too.
        usual: offset of the log odds, ``[n, 2, k]`` or broadcast to it.

    Returns:
        Dual coefficients ``[n, 2, k]`` and bias ``[2, k]``. The weights are ``x.T @ coefficients``,
        0 for the columns of the cell itself.
    """
    n = len(x)
    gram = x @ x.T + 1  # the bias is the weight of a column of ones
    # The Hessian of a logistic loss is at most a quarter of the samples' covariance (Boehning
    # 1992).
    preconditioner = linalg.inv(0.25 * gram.astype(np.float64) / n + ridge * np.eye(n)).astype(
        np.float32
    )
    own_columns = np.ascontiguousarray(own.transpose(2, 0, 1))  # (k, n, f)

    def odds(a: Array) -> Array:
        # (k, n, 2)
        own_part = own_columns @ (own_columns.transpose(0, 2, 1) @ a.transpose(2, 0, 1))
        return np.asarray(
            (gram @ a.reshape(n, -1)).reshape(a.shape) - own_part.transpose(1, 2, 0) + usual
        )

    a = np.zeros_like(y)
    ahead = np.zeros_like(y)
    for k in range(STEPS):  # Nesterov's acceleration
        gradient = (expit(odds(ahead)) - y) / np.float32(n) + np.float32(ridge) * ahead
        after = ahead - (preconditioner @ gradient.reshape(n, -1)).reshape(a.shape)
        a, ahead = after, after + np.float32(k / (k + 3)) * (after - a)
    return a, a.sum(axis=0)


def covariance_and_precision(
    z: NDArray[np.float64], taper: NDArray[np.float64] | float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the covariance of samples ``[n, inputs]`` and its inverse.

    Shrunk (Ledoit and Wolf 2004) and multiplied by ``taper`` (``[inputs, inputs]``, falling with
    distance; 1: none): few samples produce spurious correlations at a distance (Houtekamer and
    Mitchell 2001).
    """
    from sklearn.covariance import LedoitWolf

    covariance = LedoitWolf(store_precision=False).fit(z).covariance_ * taper
    try:
        return covariance, linalg.cho_solve(linalg.cho_factor(covariance), np.eye(len(covariance)))
    except linalg.LinAlgError:
        return covariance, linalg.pinvh(covariance)


def regression_on_known(
    covariance: NDArray[np.float64], precision: NDArray[np.float64], known: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the weights ``[unknown, known]`` of the conditional mean of the unknown inputs, given
    the known ones.

    Args:
        covariance, precision: ``[inputs, inputs]``, each the inverse of the other.
        known: bool ``[inputs]``; some are known, and some are not.
    """
    unknown = ~known
    if unknown.sum() <= known.sum():
        within = precision[np.ix_(unknown, unknown)]
        across = precision[np.ix_(unknown, known)]
        of_few: NDArray[np.float64] = -linalg.solve(within, across, assume_a="pos")
        return of_few
    within = covariance[np.ix_(known, known)]
    across = covariance[np.ix_(known, unknown)]
    of_many: NDArray[np.float64] = linalg.solve(within, across, assume_a="pos").T
    return of_many
