"""When does a healthy cell rest? P(idle | the other cells), a logistic regression for each cell, all fitted at once.

An open cell looks idle, and so does a healthy one beside the contact: everything turns on how sharply the two can be
told apart. What decides is which cells around it are loaded, and how much, so each cell enters twice: as the square
root of its reading (noise grows with load) and as loaded or not. On real grasps this explains idleness far better than
the nearest frames do (log loss 0.13 against 0.22).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

_FRAMES = 2500  # fitted on so many at most
_RIDGE = 0.007  # on standardised inputs, per frame
_STEPS = 100  # of accelerated gradient descent; the ridge makes it converge
_RESTING_QUANTILE = 0.05  # of a cell's readings: where it rests
_SUREST = 0.002  # a probability is never taken for nearer to 0 or 1

Array = NDArray[np.float32]


@dataclass(frozen=True)
class IdleModel:
    """P(a cell is idle | what the others read).

    Attributes:
        resting: float ``[D]``, what each cell reads when nothing touches it.
        near: how far from that it still counts as idle.
        mean, scale: of the inputs, ``[2 D]``.
        weight: ``[2 D, D]``; a cell never speaks for itself.
        bias: ``[D]``.
    """

    resting: Array
    near: float
    mean: Array
    scale: Array
    weight: Array
    bias: Array

    @classmethod
    def fit(cls, frames: Array, near: float) -> IdleModel:
        """Fit on healthy frames ``[R, D]``."""
        frames = frames[np.linspace(0, len(frames) - 1, min(len(frames), _FRAMES)).astype(int)]
        resting = np.quantile(frames, _RESTING_QUANTILE, axis=0).astype(np.float32)
        inputs = _inputs(frames, resting, near)
        mean, scale = inputs.mean(axis=0), inputs.std(axis=0)
        scale[scale < 1e-6] = np.inf  # what never changes tells nothing
        inputs = (inputs - mean) / scale
        idle = (np.abs(frames - resting) <= near).astype(np.float32)
        own = np.concatenate([np.eye(frames.shape[1], dtype=bool)] * 2)
        # The usual share of idle frames is the start; one imaginary frame of each kind keeps it finite.
        bias = logit((idle.sum(axis=0) + 1) / (len(idle) + 2)).astype(np.float32)
        weight = np.zeros((inputs.shape[1], frames.shape[1]), np.float32)
        steepest = float(np.linalg.eigvalsh(inputs.T @ inputs / len(inputs))[-1])
        step = 1 / (0.25 * (steepest + 1) + _RIDGE)
        ahead_w, ahead_b = weight, bias
        for k in range(_STEPS):  # Nesterov's method: each step from a point ahead of the last
            error = (expit(inputs @ ahead_w + ahead_b) - idle) / len(inputs)  # (R, D)
            next_w = ahead_w - step * (inputs.T @ error + _RIDGE * ahead_w)
            next_w[own] = 0
            next_b = ahead_b - step * error.sum(axis=0)
            momentum = k / (k + 3)
            ahead_w, ahead_b = next_w + momentum * (next_w - weight), next_b + momentum * (next_b - bias)
            weight, bias = next_w, next_b
        return cls(resting, near, mean, scale, weight, bias)

    def heard(self, trusted: NDArray[np.bool_]) -> float:
        """Return the share of the cells with something to say that are ``trusted`` (bool ``[D]``)."""
        telling = np.isfinite(self.scale[: len(trusted)])
        return float(trusted[telling].mean()) if telling.any() else 0.0

    def probability(self, frames: Array, cells: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return P(idle) ``[T, len(cells)]`` for whole frames ``[T, D]``."""
        inputs = (_inputs(frames, self.resting, self.near) - self.mean) / self.scale
        p: NDArray[np.float64] = expit((inputs @ self.weight[:, cells] + self.bias[cells]).astype(np.float64))
        return np.clip(p, _SUREST, 1 - _SUREST)


def _inputs(frames: Array, resting: Array, near: float) -> Array:
    load = np.maximum(frames - resting, 0)
    return np.concatenate([np.sqrt(load), load > near], axis=1, dtype=np.float32)
