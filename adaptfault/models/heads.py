"""Heads fitted without a gradient step to the features of the network and to the healthy cells.

A head has two experts. The first is a mixture of two kernel ridge regressions on class indicators
(as classifiers: Suykens and Vandewalle 1999) or on values (:mod:`adaptfault.models.kernels`). They
are of the penultimate features of the network, of the healthy cells smoothed
(:mod:`adaptfault.adaptation.cell_summary`), and of the moments of the contact on each pad in the
imputed windows (:mod:`adaptfault.adaptation.contact_moments`). All but the features are of loads,
the readings above the rest of each cell. The network has seen its training windows, so its features
tell them apart better than new ones; the second kernel does not use them. The shares of the mixture
are those with the highest likelihood of held-out windows (stacking of predictive distributions:
Yao, Vehtari, Simpson and Gelman 2018).

The second expert is a forest (:mod:`adaptfault.models.forest`) on the course of each healthy cell.
Trees choose their inputs, so they do not mind rests and gains that differ by cell, and texture
raises the spread of a cell where it hardly moves its mean. The two are pooled: the product of their
probabilities, each to the power of a weight (logarithmic opinion pool: Genest and Zidek 1986), or a
weighted mean of values. The weights, too, have the highest likelihood of held-out windows. In a
mixture an expert that is often right, but rarely sure, would only take away from the sure one.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.data.windows import evenly
from adaptfault.models.forest import Forest, fit_forest
from adaptfault.models.kernels import (
    KERNELS,
    RIDGES,
    SAMPLE,
    Kernels,
    Known,
    Views,
    kernels,
    ridge_regression,
)
from adaptfault.models.targets import NO_CLASS, Classes, Values, mixture, pooled, votes

_LINEAR_C = 0.3  # inverse strength of the linear head's ridge penalty
MOST_WINDOWS = 5_000  # a head's cost grows with their cube


class Head(nn.Module):
    """Kernel expansions, which weight each known window by its similarity to the input, and a
    forest.

    Args:
        known: the views of the M windows it was fitted on, the moments in ``units``.
        widths: ``[3]``, units of the distances of the views.
        weights: ``[kernels, M, n]``.
        bias: ``[n]``.
        shares: of each kernel in the probabilities or values, summing to 1.
        forest: of the course of the cells.
        pooling: weights ``[2]`` of the kernels and of the forest.
        units: of the moments ``[r]``.
        rest: what each cell reads without load ``[D]``; the views are those of the loads above it.
        values: the outputs are values, not logits.
    """

    widths: Tensor
    weights: Tensor
    bias: Tensor
    shares: Tensor
    pooling: Tensor
    units: Tensor
    rest: Tensor

    def __init__(
        self,
        known: Known,
        widths: Tensor,
        weights: Tensor,
        bias: Tensor,
        shares: Tensor,
        forest: Forest,
        pooling: Tensor,
        units: Tensor,
        rest: Tensor,
        *,
        values: bool = False,
    ) -> None:
        super().__init__()
        self.values = values
        for name, view in known._asdict().items():
            self.register_buffer(name, view)
        self.register_buffer("units", units)
        self.register_buffer("rest", rest)
        self.register_buffer("widths", widths)
        self.register_buffer("weights", weights)
        self.register_buffer("bias", bias)
        self.register_buffer("shares", shares)
        self.register_buffer("pooling", pooling)
        self.forest = forest

    @classmethod
    def empty(cls, about: Mapping[str, Any], n: int) -> Head:
        """Build a head to load a state into, from :attr:`about` and the number of classes or
        values."""
        known = Known(*(torch.zeros(*shape) for shape in about["known"]))
        return cls(
            known,
            widths=torch.zeros(len(known)),
            weights=torch.zeros(KERNELS, len(known.moments), n),
            bias=torch.zeros(n),
            shares=torch.zeros(KERNELS),
            forest=Forest.empty(about["forest"], n),
            pooling=torch.zeros(2),
            units=torch.ones(known.moments.shape[1]),
            rest=torch.zeros(about["cells"]),
            values=about["values"],
        )

    @classmethod
    def blank(cls, views: Views, n: int, cells: int, *, values: bool = False) -> Head:
        """Build a head for n classes or values that knows views of some windows, of so many cells,
        and has learnt nothing from them."""
        about = {
            "known": [list(view.shape) for view in _known(views)],
            "forest": Forest.blank(n).about,
            "cells": cells,
            "values": values,
        }
        return cls.empty(about, n)

    @property
    def known(self) -> Known:
        """The views of the windows it was fitted on."""
        return Known(*(self.get_buffer(name) for name in Known._fields))

    @property
    def about(self) -> dict[str, Any]:
        """Argument of :meth:`empty`; JSON-safe."""
        return {
            "known": [list(view.shape) for view in self.known],
            "forest": self.forest.about,
            "cells": len(self.rest),
            "values": self.values,
        }

    def with_forest(self, forest: Forest) -> Head:
        """Return the same head with another forest."""
        other = copy.copy(self)
        other._modules = {**self._modules, "forest": forest}
        return other

    def forward(self, views: Views) -> Tensor:
        """Map the views of N windows to logits or values ``[N, n]``."""
        grown = self.forest(views.course)
        views = views._replace(moments=views.moments / self.units)
        outputs = [
            kernel @ weights.double() + self.bias
            for kernel, weights in zip(
                kernels(self.known, self.widths, views, values=self.values),
                self.weights,
                strict=True,
            )
        ]
        experts = [
            mixture(outputs, self.shares, values=self.values),
            grown.double() if self.values else votes(grown, self.bias),
        ]
        return pooled(experts, self.pooling, values=self.values).float()


def fit_head(
    training: Views,
    held: Views,
    training_targets: NDArray[np.float32],
    held_targets: NDArray[np.float32],
    folds: NDArray[np.int64],
    *,
    rest: Tensor | None = None,
    values: bool = False,
    forest: bool = True,
) -> tuple[Head, Tensor]:
    """Fit a head to all windows; ridges, scales and weights minimise the loss of held-out windows.

    The loss is the cross entropy, or the mean squared error of values.

    Args:
        training, held: the views of M windows and of n.
        training_targets, held_targets: ``[M, k]`` and ``[n, k]``, class indicators, probabilities
            or values; a class without windows is never predicted.
        folds: int ``[n]``, 0 to 4; the held windows of a fold are held out together.
        rest: what each cell reads without load ``[D]``, kept for the views of other windows.
        values: the targets are values.
        forest: False leaves the forest out.

    Returns:
        The head, and the outputs ``[n, k]`` for the held windows, each by a head fitted without its
        fold.

    Raises:
        ValueError: a view is not finite.
    """
    task = (Values if values else Classes)(training_targets, held_targets)
    both = training + held
    units = _units(both.moments)
    known = _known(both._replace(moments=both.moments / units))
    of_windows = Kernels(known, values=values)
    on = known.moments.device
    weights, all_held = _regressions(of_windows, task, folds)
    shares = task.shares(all_held)
    outputs = mixed = mixture(all_held, shares, values=values)
    trees = Forest.blank(task.targets.shape[1])
    pooling = torch.tensor([1.0, 0.0])
    if forest:
        course = both.course.cpu().numpy()
        trees, grown = task.said(*fit_forest(course, task.targets.numpy(), folds, values=values))
        pooling = task.pooling([mixed, grown])
        outputs = pooled([mixed, grown], pooling, values=values).float()
    head = Head(
        known,
        of_windows.widths,
        weights,
        task.bias.to(on),
        shares.to(on),
        trees.to(on),
        pooling.to(on),
        units,
        torch.zeros(1) if rest is None else rest,
        values=values,
    )
    return head, outputs


def _known(views: Views) -> Known:
    return Known(views.features, views.smooth, views.moments)


def _regressions(
    of_windows: Kernels, task: Classes | Values, folds: NDArray[np.int64]
) -> tuple[Tensor, list[Tensor]]:
    """Return the weights ``[kernels, M, k]`` of the regressions, and the held-out outputs of
    each."""
    all_weights = []
    all_held = []
    for joint in (True, False):
        weights, found = _regression(of_windows.upper(joint=joint), task, folds)
        scale, outputs = task.outputs(found)
        all_weights.append(weights * scale.to(weights.device))
        all_held.append(outputs)
    return torch.stack(all_weights), all_held


def _regression(
    kernel: Tensor, task: Classes | Values, folds: NDArray[np.int64]
) -> tuple[Tensor, Tensor]:
    """Return the weights and held-out outputs of the regression with the ridge that has the least
    loss on a sample.

    The kernel, of which the upper triangle counts, is overwritten.
    """
    targets = task.targets.to(kernel.device)
    m = len(targets) - len(folds)
    kept = evenly(len(folds), SAMPLE // 2)
    few = np.concatenate([evenly(m, SAMPLE // 2), m + kept])
    sample = kernel[few][:, few]
    losses = []
    for ridge in RIDGES:
        _, found = ridge_regression(sample.clone(), targets[few], folds[kept], ridge)
        losses.append(task.loss(found.cpu(), kept))
    best = RIDGES[int(np.argmin(losses))]
    weights, found = ridge_regression(kernel, targets, folds, best)
    return weights, found.cpu()


def _units(moments: Tensor) -> Tensor:
    """Return the standard deviation of each moment ``[N, p]``; 1 where it is constant, up to
    rounding."""
    spread = moments.std(0, correction=0)
    size = moments.square().mean(0).sqrt()
    return torch.where(spread > math.sqrt(torch.finfo(moments.dtype).eps) * size, spread, 1.0)


def linear_head(
    features: NDArray[np.float64], y: NDArray[np.int64], n_classes: int
) -> tuple[Tensor, Tensor]:
    """Return weight ``[n_classes, p]`` and bias ``[n_classes]`` of a multinomial logistic
    regression on ``[N, p]``."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.preprocessing import StandardScaler

    scaler = StandardScaler().fit(features)
    classifier = LogisticRegression(C=_LINEAR_C, max_iter=300).fit(scaler.transform(features), y)
    coefficients = classifier.coef_
    intercept = classifier.intercept_
    if len(classifier.classes_) == 2:  # scikit-learn keeps one row then
        coefficients = np.vstack([-coefficients, coefficients]) / 2
        intercept = np.array([-1, 1]) * intercept / 2
    slopes = coefficients / scaler.scale_
    weight = torch.zeros(n_classes, features.shape[1])
    bias = torch.full((n_classes,), NO_CLASS)
    weight[classifier.classes_] = torch.from_numpy(slopes.astype(np.float32))
    bias[classifier.classes_] = torch.from_numpy(
        (intercept - slopes @ scaler.mean_).astype(np.float32)
    )
    return weight, bias
