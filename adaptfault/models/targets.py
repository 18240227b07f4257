"""Targets of a head and its experts' outputs: classes as logits, or values in their units."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.models.forest import TREES, Forest

_EM_STEPS = 100
_MOST_WEIGHT = 10.0  # of an expert, where all are always right
NO_CLASS = -1e4  # logit of a class without training windows


def mixture(outputs: Sequence[Tensor], shares: Tensor, *, values: bool = False) -> Tensor:
    """Return the weighted mean of outputs ``[N, n]``: of values, or of probabilities as their
    logarithm."""
    if values:
        return torch.stack([share * out for share, out in zip(shares, outputs, strict=True)]).sum(0)
    logs = [
        torch.log_softmax(out, 1) + share.log() for share, out in zip(shares, outputs, strict=True)
    ]
    return torch.logsumexp(torch.stack(logs), 0)


def pooled(outputs: Sequence[Tensor], weights: Tensor, *, values: bool = False) -> Tensor:
    """Return the weighted sum of outputs ``[N, n]``: of values, or of log probabilities."""
    known = [out if values else torch.log_softmax(out, 1) for out in outputs]
    return torch.stack([weight * out for weight, out in zip(weights, known, strict=True)]).sum(0)


def votes(likely: Tensor, bias: Tensor) -> Tensor:
    """Return the logits of a forest: no class is less likely than one tree of a group would make
    it."""
    return torch.log(likely.double() + 1 / TREES) + bias


class Classes:
    """Class indicators as targets of a regression, and its predictions as logits."""

    def __init__(self, training: NDArray[np.float32], held: NDArray[np.float32]) -> None:
        every = np.concatenate([training, held])
        self.targets = torch.from_numpy(every - np.float32(1 / every.shape[1]))
        self.y = held.argmax(axis=1)
        self.bias = torch.zeros(every.shape[1]).masked_fill(
            torch.from_numpy(every.max(axis=0) == 0), NO_CLASS
        )

    def loss(self, found: Tensor, kept: NDArray[np.intp]) -> float:
        """Return the loss of outputs for some of the held-out windows."""
        return calibrate(found + self.bias, self.y[kept])[1]

    def outputs(self, found: Tensor) -> tuple[Tensor, Tensor]:
        """Return the scale ``[k]`` of the weights, and logits with that scale."""
        scale = calibrate(found + self.bias, self.y)[0]
        return torch.where(self.bias < 0, 0.0, scale), scale * found + self.bias

    def said(self, forest: Forest, likely: Tensor) -> tuple[Forest, Tensor]:
        """Return a forest, and what it says of held-out windows as logits."""
        return forest, votes(likely, self.bias)

    def shares(self, logits: Sequence[Tensor]) -> Tensor:
        """Return the shares of a mixture with the highest likelihood of the classes, by expectation
        maximisation."""
        index = torch.arange(len(self.y)), torch.from_numpy(self.y)
        likely = torch.stack([torch.softmax(of.double(), 1)[index] for of in logits], 1)
        likely = likely.clamp_min(torch.finfo(torch.double).tiny)
        shares = torch.full((len(logits),), 1 / len(logits), dtype=torch.double)
        for _ in range(_EM_STEPS):
            of_each = shares * likely
            shares = (of_each / of_each.sum(1, keepdim=True)).mean(0)
        return shares.float()

    def pooling(self, logits: Sequence[Tensor]) -> Tensor:
        """Return the weights, not negative, of the pool with the highest likelihood of the
        classes."""
        from scipy.optimize import minimize

        known = torch.stack([torch.log_softmax(of.double(), 1) for of in logits], 2)
        labels = torch.from_numpy(self.y)
        of_truth = known[torch.arange(len(labels)), labels]

        def loss(weights: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
            pool = known @ torch.from_numpy(weights)
            expected = torch.einsum("nk,nkj->nj", pool.softmax(1), known)
            lost = nn.functional.cross_entropy(pool, labels)
            return lost.item(), (expected - of_truth).mean(0).numpy()

        start = np.full(len(logits), 1 / len(logits))
        bounds = [(0.0, _MOST_WEIGHT)] * len(logits)
        found = minimize(loss, start, jac=True, bounds=bounds, method="L-BFGS-B")
        return torch.from_numpy(found.x).float()


class Values:
    """Standardised values as targets of a regression."""

    def __init__(self, training: NDArray[np.float32], held: NDArray[np.float32]) -> None:
        every = torch.from_numpy(np.concatenate([training, held])).double()
        mean = every.mean(0)
        unit = every.std(0, correction=0)
        unit[unit == 0] = 1.0
        self.targets = ((every - mean) / unit).float()
        self.unit = unit.float()
        self.bias = mean.float()
        self.truth = self.targets[len(training) :]

    def loss(self, found: Tensor, kept: NDArray[np.intp]) -> float:
        """Return the loss of outputs for some of the held-out windows."""
        return float((found - self.truth[kept]).square().mean())

    def outputs(self, found: Tensor) -> tuple[Tensor, Tensor]:
        """Return the scale ``[k]`` of the weights, and values."""
        return self.unit, found * self.unit + self.bias

    def said(self, forest: Forest, found: Tensor) -> tuple[Forest, Tensor]:
        """Return a forest, and what it says of held-out windows, in the unit of the values."""
        return forest.scaled(self.unit, self.bias), found * self.unit + self.bias

    def pooling(self, values: Sequence[Tensor]) -> Tensor:
        """Return the weights of the two experts, as :meth:`shares`."""
        return self.shares(values)

    def shares(self, values: Sequence[Tensor]) -> Tensor:
        """Return the shares of the mixture with the least squared error; not negative, of sum 1."""
        from scipy.optimize import nnls

        found = np.stack(
            [((of - self.bias) / self.unit).double().numpy().ravel() for of in values], axis=1
        )
        shares, _ = nnls(found, self.truth.double().numpy().ravel())
        total = shares.sum()
        even = np.full(len(shares), 1 / len(shares))
        return torch.from_numpy((shares / total if total > 0 else even).astype(np.float32))


def calibrate(logits: Tensor, y: NDArray[np.int64]) -> tuple[float, float]:
    """Return the scale of logits ``[N, n_classes]`` with the lowest cross entropy for classes
    ``[N]``, and that loss.

    One scale does not change the order of the classes (temperature scaling, Guo et al. 2017).
    """
    from scipy.optimize import minimize_scalar

    labels = torch.from_numpy(y)
    found = minimize_scalar(
        lambda log_scale: float(
            nn.functional.cross_entropy(logits * float(np.exp(log_scale)), labels)
        ),
        bounds=(-3.0, 6.0),
        method="bounded",
    )
    return float(np.exp(found.x)), float(found.fun)


def log_likelihood(logits: Tensor, y: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the log probability ``[N]`` of the classes y, of logits ``[N, n_classes]`` in their
    best scale for y."""
    likely = torch.log_softmax(calibrate(logits, y)[0] * logits.double(), 1)
    return np.asarray(likely.numpy()[np.arange(len(likely)), y])
