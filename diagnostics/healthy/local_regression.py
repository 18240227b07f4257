"""The regressions of cells, each from the others: what is fitted of a whole array, or of one of its patches.

Two logistic ones say whether a cell stays unloaded throughout a touch and whether it stays loaded throughout, a linear
one says how hard it is loaded. What cells that cannot be trusted would have read is filled in from the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import expit, logit

from diagnostics.healthy.dual_ridge import covariance_and_precision
from diagnostics.healthy.dual_ridge import logistic as dual_logistic
from diagnostics.healthy.stacking import RegressionOutput
from diagnostics.preprocessing.scale import Array

FEATURES = 4  # of a cell in a touch, see Summary.features
RIDGE = 0.03  # on standardised inputs, per sample
_FREE = 1e-6  # the same for the bias
_STEPS = 25  # of accelerated descent; the ridge makes it converge
_LEAST_SPREAD = 0.02  # of the root load: nothing is predicted more exactly
_FEWEST = 6  # stretches in which a cell was loaded; of fewer its own spread is not known


@dataclass(frozen=True)
class Start:
    """What is known of a patch before its own touches are seen.

    Attributes:
        weight, bias: ``[4, inputs, 2, outputs]`` and ``[2]``, of features that are not standardised.
        ridge: of what is learned on top of them.
        taper: ``[inputs, inputs]``, how much two cells may have to do with each other.
    """

    weight: NDArray[np.float64]
    bias: NDArray[np.float64]
    ridge: float
    taper: NDArray[np.float64]


@dataclass(frozen=True)
class LocalRegression:
    """The model of some cells (``outputs``) from those around them (``inputs``, which hold the outputs too).

    Attributes:
        inputs, outputs: int, cell indices; ``place``: where the outputs lie among the inputs.
        mean, scale: of the features of the inputs, ``[4, inputs]``.
        weight: ``[4 inputs, 2 outputs]``, never loaded and always loaded; no cell speaks for itself.
        bias: ``[2 outputs]``.
        covariance, precision: of the mean root loads, standardised, ``[inputs, inputs]``.
        spread: ``[outputs]``.
        surest: no probability is taken for nearer to 0 or 1.
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
        # Matrix products round differently in another memory order: a stored and restored one must say the same.
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                object.__setattr__(self, name, np.ascontiguousarray(value))

    def at(self, cells: NDArray[np.intp]) -> LocalRegression:
        """Return the same model of another array, whose ``cells`` are the inputs here."""
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
        """Fit on features ``[n, 4, D]``.

        One patch of many, of few samples, has a ``start``.
        """
        from sklearn.covariance import LedoitWolf

        x = features[:, :, inputs]
        mean, scale = x.mean(axis=0), x.std(axis=0)
        if start is None:
            scale[scale < 1e-4] = np.inf  # what never changes tells nothing
        else:  # or has not changed yet
            scale = np.broadcast_to(np.maximum(scale.mean(axis=1, keepdims=True), 1e-2), scale.shape).copy()
        z = (x - mean) / scale
        place = np.searchsorted(inputs, outputs)
        targets = np.concatenate([x[:, 2, place] == 0, x[:, 3, place] == 1], axis=1).astype(np.float32)
        own = np.arange(FEATURES) * len(inputs) + np.tile(place, 2)[:, None]
        flat = z.reshape(len(z), -1)
        if start is None:
            weight, bias = _logistic(flat, targets, own)
            estimate = LedoitWolf().fit(z[:, 1].astype(np.float64))
            covariance, precision = estimate.covariance_, estimate.precision_
        else:
            shared = start.weight.reshape(flat.shape[1], -1).astype(np.float32)
            shared_odds = x.reshape(len(z), -1) @ shared + np.repeat(start.bias, len(outputs)).astype(np.float32)
            y = targets.reshape(len(z), 2, -1)
            of_samples, own_bias = dual_logistic(flat, y, z[:, :, place], start.ridge, shared_odds.reshape(y.shape))
            weight, bias = flat.T @ of_samples.reshape(len(z), -1), own_bias.ravel()
            weight[own, np.arange(len(own))[:, None]] = 0
            weight += shared * scale.reshape(-1, 1)
            bias += mean.reshape(-1) @ shared + np.repeat(start.bias, len(outputs)).astype(np.float32)
            covariance, precision = covariance_and_precision(z[:, 1].astype(np.float64), start.taper)
        if not z[:, 1].any():  # cells of which none was ever touched say nothing of each other
            covariance = precision = np.eye(len(inputs))
        z1 = z[:, 1].astype(np.float64)
        error = (z1 @ precision / np.diag(precision))[:, place] * np.where(np.isfinite(scale[1]), scale[1], 0)[place]
        # Where nothing is loaded nothing errs: the spread is that of the loaded stretches.
        known_values = x[:, 2, place] > 0
        spread = np.sqrt((error**2 * known_values).sum(axis=0) / np.maximum(known_values.sum(axis=0), 1))
        usual = float(np.sqrt(np.mean(spread**2)))
        spread = np.maximum(np.where(known_values.sum(axis=0) < _FEWEST, 2 * usual, spread), _LEAST_SPREAD)
        spread[~known_values.any(axis=0)] = np.nan  # how a cell reads that was never loaded is unknown
        return cls(
            inputs, outputs, place, mean, scale, weight, bias,
            covariance, precision, spread, p_floor,
        )  # fmt: skip

    def predict(self, features: Array, predictors: NDArray[np.bool_]) -> tuple[NDArray[np.float64], ...]:
        """Return what ``RegressionOutput`` holds, of the outputs: ``[n, outputs]`` each."""
        z = (features[:, :, self.inputs] - self.mean) / self.scale
        known = predictors[self.inputs]
        self._fill(z, known)
        odds = (z.reshape(len(z), -1) @ self.weight + self.bias).astype(np.float64)
        never, always = odds[:, : len(self.outputs)], odds[:, len(self.outputs) :]
        # What all the other cells say of a cell: for those filled in, just what they were filled with.
        mean = z[:, 1].astype(np.float64)
        mean = mean[:, self.place] - mean @ self.precision[:, self.place] / np.diag(self.precision)[self.place]
        scale = np.where(np.isfinite(self.scale[1]), self.scale[1], 0)[self.place]
        usual = np.broadcast_to(self.mean[2][self.place], never.shape)
        return never, always, mean * scale + self.mean[1][self.place], usual

    def _fill(self, z: Array, known: NDArray[np.bool_]) -> None:
        """Write into ``z`` ``[n, 4, inputs]`` what the unknown cells would say, as the linear regression has it."""
        unknown = ~known
        if not unknown.any():
            return
        if not known.any():
            z[:] = 0
            return
        if unknown.sum() <= known.sum():
            among, between = self.precision[np.ix_(unknown, unknown)], self.precision[np.ix_(unknown, known)]
            regression = -linalg.solve(among, between, assume_a="pos")
        else:
            among, between = self.covariance[np.ix_(known, known)], self.covariance[np.ix_(known, unknown)]
            regression = linalg.solve(among, between, assume_a="pos").T
        z[:, :, unknown] = z[:, :, known] @ regression.T.astype(np.float32)


def predict_regressions(
    local_regressions: Sequence[LocalRegression], features: Array, predictors: NDArray[np.bool_]
) -> RegressionOutput:
    """Return what the models say of their cells, 0 for others; see :meth:`HealthyModel.predict`."""
    shape = (len(features), features.shape[2])
    regressed = RegressionOutput(np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape))
    for regression in local_regressions:
        of_regression = regression.predict(features, predictors)
        for values, said in zip(vars(regressed).values(), of_regression, strict=True):
            values[:, regression.outputs] = said
    return regressed


def _logistic(x: Array, y: Array, own: NDArray[np.intp]) -> tuple[Array, Array]:
    """Fit one ridge logistic regression for each column of ``y`` ``[n, k]``, in which some weights stay 0.

    Each step minimises a parabola above the loss, of the same curvature for all (Boehning's bound), from a point ahead
    of the last (Nesterov): a tenth of the steps that plain gradients take.

    Args:
        x: ``[n, d]``.
        y: ``[n, k]``, 0 or 1.
        own: int ``[k, f]``, the inputs whose weight stays 0, for each column.
    """
    n, d = x.shape
    x = np.concatenate([x, np.ones((n, 1), np.float32)], axis=1)
    penalty = np.full((d + 1, 1), RIDGE, np.float32)
    penalty[d] = _FREE
    inverse = np.linalg.inv((x.T @ x).astype(np.float64) / (4 * n) + np.diag(penalty[:, 0])).astype(np.float32)
    # What a step has to give up for the weights that stay 0 is shared out among the others.
    block = np.linalg.inv(inverse[own[:, :, None], own[:, None, :]].astype(np.float64)).astype(np.float32)  # (k, f, f)
    given_up = np.einsum("dkf,kfg->kdg", inverse[:, own], block)
    weight = np.zeros((d + 1, y.shape[1]), np.float32)
    weight[d] = logit((y.sum(axis=0) + 1) / (n + 2))  # an imaginary sample of each kind keeps it finite
    ahead, column = weight, np.arange(len(own))[:, None]
    for step in range(_STEPS):
        change = inverse @ (x.T @ ((expit(x @ ahead) - y) / np.float32(n)) + penalty * ahead)
        change -= np.matmul(given_up, change[own, column][:, :, None])[:, :, 0].T
        change[own, column] = 0
        following = ahead - change
        ahead = following + np.float32(step / (step + 3)) * (following - weight)
        weight = following
    return weight[:d], weight[d]
