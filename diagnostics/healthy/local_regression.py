"""Local regressions: each cell of a tile regressed on the other cells around it.

Estimates log odds that a cell stays unloaded, or loaded, throughout an event (two ridge logistic
regressions on four features a cell), and its mean root load (a Gaussian conditional mean with a
Ledoit-Wolf covariance). The logistic ones equal scikit-learn's ``LogisticRegression(C=1 / (n *
ridge))`` with the weights of the cell itself fixed at 0; the conditional mean of cell i is ``-sum_j
P_ij z_j / P_ii`` with the precision matrix P, as in Gaussian graphical models. Cells that are no
predictors are replaced by their conditional mean given the predictors. Interactions between cells
are not modelled; the stacking adds them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from diagnostics.healthy.dual_ridge import STEPS, covariance_and_precision, regression_on_known
from diagnostics.healthy.dual_ridge import logistic as dual_logistic
from diagnostics.preprocessing.levels import FEWEST
from diagnostics.preprocessing.scale import Array

FEATURES = 4  # per cell and event, see Summary.features
RIDGE = 0.03  # per sample, on standardised inputs
_BIAS_RIDGE = 1e-6  # the bias is free; above 0 so that the bound can be inverted
_MIN_SPREAD = 0.02  # of the root load: no reading is predicted more exactly


@dataclass(frozen=True)
class Start:
    """The shared prior of one tile.

    Attributes:
        weight: ``[4, inputs, 2, outputs]``, of features that are not standardised.
        bias: ``[2]``.
        ridge: per sample, on the difference from the prior.
        taper: ``[inputs, inputs]``, factor on the covariance of two cells, 0 to 1.
    """

    weight: NDArray[np.float64]
    bias: NDArray[np.float64]
    ridge: float
    taper: NDArray[np.float64]


@dataclass(frozen=True)
class LocalRegression:
    """Regressions of the ``outputs`` of a tile on its ``inputs``.

    Attributes:
        inputs, outputs: int, cell indices; the inputs include the outputs.
        place: int ``[outputs]``, position of each output among the inputs.
        mean, scale: float ``[4, inputs]``, of the features.
        weight: float ``[4 inputs, 2 outputs]``, never and always loaded; 0 for the features of the
            cell itself.
        bias: float ``[2 outputs]``.
        covariance, precision: float ``[inputs, inputs]``, of the standardised mean root loads.
        spread: float ``[outputs]``, root mean square error of the mean root load; NaN: never
            loaded.
        p_floor: lower limit of the probabilities.
    """

    inputs: NDArray[np.intp]
    outputs: NDArray[np.intp]
    place: NDArray[np.intp]
    mean: Array
    scale: Array
    weight: Array
    bias: Array
    covariance: NDArray[np.float64]
    precision: NDArray[np.float64]
    spread: NDArray[np.float64]
    p_floor: float

    def __post_init__(self) -> None:
        # Matrix products round differently in another memory order; a restored model must predict
        # the same bits.
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                object.__setattr__(self, name, np.ascontiguousarray(value))

    def at(self, cells: NDArray[np.intp]) -> LocalRegression:
        """Return the same model with its inputs at ``cells`` (int ``[inputs]``) of another
        array."""
        return replace(self, inputs=cells, outputs=cells[self.place])

    @classmethod
    def fit(
        cls,
        features: Array,
        inputs: NDArray[np.intp],
        outputs: NDArray[np.intp],
        p_floor: float,
        start: Start | None = None,
    ) -> LocalRegression:
        """Fit to excerpts of events.

        Args:
            features: ``[n, 4, D]``.
            inputs, outputs: cell indices, ascending.
            p_floor: lower limit of the probabilities.
            start: the shared prior of a tile of a large array, which has fewer samples than inputs.
        """
        x = features[:, :, inputs]
        mean = x.mean(axis=0)
        scale = x.std(axis=0)
        if start is None:
            scale[scale < 1e-4] = np.inf  # a constant feature gets no weight
        else:  # a feature that is constant in a few samples may still change
            scale = np.broadcast_to(
                np.maximum(scale.mean(axis=1, keepdims=True), 1e-2), scale.shape
            ).copy()
        z = (x - mean) / scale
        place = np.searchsorted(inputs, outputs)
        targets = np.concatenate([x[:, 2, place] == 0, x[:, 3, place] == 1], axis=1).astype(
            np.float32
        )
        own = np.arange(FEATURES) * len(inputs) + np.tile(place, 2)[:, None]
        flat = z.reshape(len(z), -1)
        z1 = z[:, 1].astype(np.float64)
        if start is None:
            weight, bias = _logistic(flat, targets, own)
        else:
            shared = start.weight.reshape(flat.shape[1], -1).astype(np.float32)
            shared_bias = np.repeat(start.bias, len(outputs)).astype(np.float32)
            shared_odds = x.reshape(len(z), -1) @ shared + shared_bias
            y = targets.reshape(len(z), 2, -1)
            of_samples, own_bias = dual_logistic(
                flat, y, z[:, :, place], start.ridge, shared_odds.reshape(y.shape)
            )
            weight = flat.T @ of_samples.reshape(len(z), -1)
            bias = own_bias.ravel()
            weight[own, np.arange(len(own))[:, None]] = 0
            weight += shared * scale.reshape(-1, 1)
            bias += mean.reshape(-1) @ shared + shared_bias
        covariance, precision = covariance_and_precision(z1, 1.0 if start is None else start.taper)
        if not z1.any():  # no event in this tile: cells count as independent
            covariance = precision = np.eye(len(inputs))
        error = (z1 @ precision / np.diag(precision))[:, place] * np.where(
            np.isfinite(scale[1]), scale[1], 0
        )[place]
        # An unloaded cell is predicted almost exactly: only excerpts in which the cell is loaded
        # count.
        loaded = x[:, 2, place] > 0
        spread = np.sqrt((error**2 * loaded).sum(axis=0) / np.maximum(loaded.sum(axis=0), 1))
        typical = float(np.sqrt(np.mean(spread**2)))
        spread = np.maximum(np.where(loaded.sum(axis=0) < FEWEST, 2 * typical, spread), _MIN_SPREAD)
        spread[~loaded.any(axis=0)] = np.nan
        return cls(
            inputs,
            outputs,
            place,
            mean,
            scale,
            weight,
            bias,
            covariance,
            precision,
            spread,
            p_floor,
        )

    def predict(
        self, features: Array, predictors: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], ...]:
        """Return what :func:`predict_regressions` does, of the outputs alone: four times
        ``[n, outputs]``."""
        z = (features[:, :, self.inputs] - self.mean) / self.scale
        known = predictors[self.inputs]
        self._fill(z, known)
        odds = (z.reshape(len(z), -1) @ self.weight + self.bias).astype(np.float64)
        never = odds[:, : len(self.outputs)]
        always = odds[:, len(self.outputs) :]
        # The conditional mean given all other cells; for imputed cells it equals the imputed value.
        mean = z[:, 1].astype(np.float64)
        mean = (
            mean[:, self.place]
            - mean @ self.precision[:, self.place] / np.diag(self.precision)[self.place]
        )
        scale = np.where(np.isfinite(self.scale[1]), self.scale[1], 0)[self.place]
        usual = np.broadcast_to(self.mean[2][self.place], never.shape)
        return never, always, mean * scale + self.mean[1][self.place], usual

    def _fill(self, z: Array, known: NDArray[np.bool_]) -> None:
        """Replace the unknown cells in ``z`` (``[n, 4, inputs]``) by their conditional mean given
        the known ones."""
        unknown = ~known
        if not unknown.any():
            return
        if not known.any():
            z[:] = 0
            return
        regression = regression_on_known(self.covariance, self.precision, known)
        z[:, :, unknown] = z[:, :, known] @ regression.T.astype(np.float32)


def predict_regressions(
    local_regressions: Sequence[LocalRegression], features: Array, predictors: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the outputs of all regressions, ``[4, n, D]``, 0 for cells without one; see
    :meth:`HealthyModel.predict`.

    Log odds that the cell stays unloaded, and loaded, throughout; its mean root load; and the share
    of the reference excerpts in which it is loaded.
    """
    regressed = np.zeros((4, len(features), features.shape[2]))
    for regression in local_regressions:
        for values, predicted in zip(
            regressed, regression.predict(features, predictors), strict=True
        ):
            values[:, regression.outputs] = predicted
    return regressed


def _logistic(x: Array, y: Array, own: NDArray[np.intp]) -> tuple[Array, Array]:
    """Fit one ridge logistic regression for each column of ``y``, in which some weights are fixed
    at 0.

    Minimises a quadratic upper bound of the loss with one curvature for all columns (Boehning
    1992), accelerated (Nesterov 1983). Each step is a ridge regression on the working responses
    ``odds / 4 + y - expit(odds)``.

    Args:
        x: ``[n, d]``.
        y: ``[n, k]``, 0 or 1.
        own: int ``[k, f]``, the inputs whose weight is 0, for each column.

    Returns:
        Weights ``[d, k]`` and biases ``[k]``.
    """
    n, d = x.shape
    x = np.concatenate([x, np.ones((n, 1), np.float32)], axis=1)
    penalty = np.diag(np.append(np.full(d, RIDGE), _BIAS_RIDGE))
    inverse = np.linalg.inv((x.T @ x).astype(np.float64) / (4 * n) + penalty).astype(np.float32)
    solve = inverse @ x.T / np.float32(n)
    # Project onto the subspace in which the fixed weights are 0 (Lagrange multipliers).
    # (k, f, f)
    block = np.linalg.inv(inverse[own[:, :, None], own[:, None, :]].astype(np.float64)).astype(
        np.float32
    )
    projection = np.einsum("dkf,kfg->kdg", inverse[:, own], block)
    weight = np.zeros((d + 1, y.shape[1]), np.float32)
    weight[d] = logit((y.sum(axis=0) + 1) / (n + 2))  # Laplace smoothing keeps it finite
    ahead = weight
    column = np.arange(len(own))[:, None]
    for step in range(STEPS):
        odds = x @ ahead
        following = solve @ (odds / 4 + y - expit(odds))
        following -= np.matmul(projection, following[own, column][:, :, None])[:, :, 0].T
        following[own, column] = 0
        ahead = following + np.float32(step / (step + 3)) * (following - weight)
        weight = following
    return weight[:d], weight[d]
