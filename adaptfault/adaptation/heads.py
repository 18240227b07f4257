"""Heads fitted in closed form, without a gradient, to the features of the network and to the healthy cells.

The kernel head is a kernel ridge regression on class indicators (as a classifier: Suykens and Vandewalle 1999) or on
values. Its kernel is a weighted sum over two views of a window, each with its own bandwidth: the penultimate features
of the network, and mean and maximum of each healthy cell, which do not depend on imputation. On real grasps each view
alone is better on some fault sets; the sum is about as good as the better one on all. For classes, the probabilities
may be averaged with a forest of randomised trees, where held-out windows favour it.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.adaptation.forest import TREES, Forest
from adaptfault.data.windows import evenly

_WIDTH = 0.7  # of the Gaussian kernel, in units of the median squared distance
_SAMPLE = 1_000  # windows on which bandwidths and shares of the views are chosen
_RIDGE = 0.05  # added to the kernel's diagonal, which is 1
_LINEAR_C = 0.3  # inverse strength of the linear head's ridge penalty
_VIEW_SHARES = ((0.5, 0.5), (1.0, 0.0), (0.0, 1.0))  # of features and healthy cells in the kernel
_RIDGES = (0.05, 0.005, 0.0005)  # of a regression, chosen on held-out windows
_KERNEL_SHARES = (1.0, 0.67, 0.5, 0.33, 0.0)  # of the kernel head beside the forest
_NO_CLASS = -1e4  # logit of a class without training windows
MOST_WINDOWS = 5_000  # a kernel head's cost grows with their cube


def summarise(x: Tensor) -> Tensor:
    """Map windows ``[N, T, H]`` on the 0..1 scale to ``[N, 2 H]``: the roots of each cell's mean and maximum.

    The root stabilises the variance: it raises the weight of light contact.
    """
    return torch.cat([x.mean(1), x.amax(1)], dim=1).clamp_min(0.0).sqrt()


class KernelHead(nn.Module):
    """Kernel expansion: each known window is weighted by its similarity to the input.

    Args:
        views: of the M windows it was fitted on, each ``[M, p]``.
        widths: of each view's kernel, a squared distance.
        shares: of each view in the kernel, summing to 1.
        weights: ``[M, n_classes]``.
        bias: ``[n_classes]``.
    """

    widths: Tensor
    shares: Tensor
    weights: Tensor
    bias: Tensor

    def __init__(
        self, views: Sequence[Tensor], widths: Sequence[float], shares: Sequence[float], weights: Tensor, bias: Tensor
    ) -> None:
        super().__init__()
        for i, view in enumerate(views):
            self.register_buffer(f"known{i}", view)
        self.register_buffer("widths", torch.as_tensor(widths, dtype=torch.float32, device=weights.device))
        self.register_buffer("shares", torch.as_tensor(shares, dtype=torch.float32, device=weights.device))
        self.register_buffer("weights", weights)
        self.register_buffer("bias", bias)

    @classmethod
    def empty(cls, shapes: Sequence[Sequence[int]], n_classes: int) -> KernelHead:
        """Build a head to load a state into; ``shapes`` are those of the views."""
        n = shapes[0][0]
        none = [0.0] * len(shapes)
        return cls([torch.zeros(*s) for s in shapes], none, none, torch.zeros(n, n_classes), torch.zeros(n_classes))

    @property
    def known(self) -> list[Tensor]:
        """The views of the windows it was fitted on."""
        return [self.get_buffer(f"known{i}") for i in range(len(self.shares))]

    @property
    def shapes(self) -> list[list[int]]:
        """Arguments of :meth:`empty`."""
        return [list(view.shape) for view in self.known]

    def scaled(self, scale: float) -> KernelHead:
        """Return the head with its logits multiplied by ``scale``; excluded classes stay excluded."""
        return KernelHead(self.known, self.widths.tolist(), self.shares.tolist(), self.weights * scale, self.bias)

    def forward(self, views: Sequence[Tensor]) -> Tensor:
        """Map views of N windows, each ``[N, p]``, to logits ``[N, n_classes]``."""
        # Double precision: large weights of both signs nearly cancel; the error in single precision is up to 4e-4.
        kernel = sum(
            share * torch.exp(-_squared_distance(view.double(), other.double()) / width)
            for view, other, width, share in zip(views, self.known, self.widths, self.shares, strict=True)
        )
        logits: Tensor = (kernel @ self.weights.double() + self.bias).float()
        return logits


class Blend(nn.Module):
    """The head of a reduced model: a kernel head, or its probabilities averaged with those of a forest.

    Args:
        kernel: uses both views.
        forest: uses the second view, the healthy cells; None: kernel head alone.
        share: of the kernel head in the probabilities.
        scale: of the forest's logits.
    """

    def __init__(
        self, kernel: KernelHead, forest: Forest | None = None, share: float = 1.0, scale: float = 1.0
    ) -> None:
        super().__init__()
        self.kernel, self.forest, self.share, self.scale = kernel, forest, share, scale

    @classmethod
    def empty(cls, about: Mapping[str, Any], n_classes: int) -> Blend:
        """Build a head to load a state into, from :attr:`about`."""
        forest = None if about["forest"] is None else Forest.empty(about["forest"])
        return cls(KernelHead.empty(about["kernel"], n_classes), forest, about["share"], about["scale"])

    @property
    def about(self) -> dict[str, Any]:
        """Arguments of :meth:`empty`; JSON-safe."""
        forest = None if self.forest is None else self.forest.about
        return {"kernel": self.kernel.shapes, "forest": forest, "share": self.share, "scale": self.scale}

    def forward(self, views: Sequence[Tensor]) -> Tensor:
        """Map views of N windows, each ``[N, p]``, to logits ``[N, n_classes]``."""
        logits: Tensor = self.kernel(views)
        return logits if self.forest is None else blend(logits, self.scale * self.forest(views[1]), self.share)


def blend(one: Tensor, other: Tensor, share: float) -> Tensor:
    """Return the logarithm of the weighted mean of two softmax outputs, with weight ``share`` on ``one``."""
    mixed = share * torch.softmax(one, 1) + (1 - share) * torch.softmax(other, 1)
    return mixed.clamp_min(torch.finfo(mixed.dtype).tiny).log()


class KernelFit:
    """Kernel heads for known windows with several shares of the views, each evaluated on held-out windows.

    Args:
        views: of the M known windows, each ``[M, p]``, on the device of the computation.
        targets: ``[M, n_classes]``, class indicators or probabilities; a class without windows is never predicted.
        folds: int ``[n]``; the last n windows are held out in turn, those of one fold together.
        values: the targets are standardised values, not classes.
    """

    def __init__(
        self,
        views: Sequence[Tensor],
        targets: NDArray[np.float32],
        folds: NDArray[np.int64],
        *,
        values: bool = False,
    ) -> None:
        self.views, self.targets, self.folds, self.values = views, targets, folds, values
        distances = [_squared_distance(view, view) for view in views]
        sample = evenly(len(views[0]), _SAMPLE)
        self.widths = [_WIDTH * (float(d[sample][:, sample].median()) or 1.0) for d in distances]
        self.kernels = [d.div_(-width).exp_() for d, width in zip(distances, self.widths, strict=True)]

    def thinned(self, most: int) -> KernelFit:
        """Return the same with at most so many of the windows that are never held out, for quick comparisons."""
        n = len(self.folds)
        m = len(self.targets) - n
        if m <= most:
            return self
        kept = np.concatenate([evenly(m, most), np.arange(m, m + n)])
        few = copy.copy(self)
        few.views, few.targets = [view[kept] for view in self.views], self.targets[kept]
        few.kernels = [kernel[kept][:, kept] for kernel in self.kernels]
        return few

    def fit(self, shares: Sequence[float], ridge: float = _RIDGE) -> tuple[KernelHead, Tensor]:
        """Fit a head on all windows.

        The windows that are never held out are eliminated first; the remaining Schur complement is a small system for
        each fold.

        Returns:
            The head, whose logits have no scale yet (:func:`calibrate`), and on the CPU ``[n, n_classes]``, the logits
            of each held-out window by a head fitted without its fold.
        """
        kernel = torch.zeros_like(self.kernels[0])
        for share, of_view in zip(shares, self.kernels, strict=True):
            if share:
                kernel.add_(of_view, alpha=share)
        kernel.diagonal().add_(ridge)
        n_classes, n = self.targets.shape[1], len(self.folds)
        targets = torch.from_numpy(self.targets - np.float32(0 if self.values else 1 / n_classes)).to(kernel.device)
        m = len(targets) - n  # never held out
        root = torch.linalg.cholesky(kernel[:m, :m])
        half = torch.linalg.solve_triangular(root, torch.cat([kernel[:m, m:], targets[:m]], dim=1), upper=False)
        between, first = half[:, :n], half[:, n:]
        expected = between.T @ first  # of the held-out windows by the others
        rest, residual = kernel[m:, m:] - between.T @ between, targets[m:] - expected

        held_out = torch.empty_like(residual)
        folds = torch.from_numpy(self.folds).to(kernel.device)
        for fold in torch.unique(folds):
            out, known = folds == fold, folds != fold
            within = torch.linalg.cholesky(rest[known][:, known])
            held_out[out] = expected[out] + rest[out][:, known] @ torch.cholesky_solve(residual[known], within)
        last = torch.cholesky_solve(residual, torch.linalg.cholesky(rest))
        weights = torch.cat([torch.linalg.solve_triangular(root.T, first - between @ last, upper=True), last])

        lacking = torch.from_numpy((self.targets.max(axis=0) == 0) & (not self.values))
        bias = torch.zeros(n_classes).masked_fill(lacking, _NO_CLASS)
        weights = weights.masked_fill(lacking.to(weights.device), 0.0)
        head = KernelHead(self.views, self.widths, shares, weights, bias.to(weights.device))
        return head, held_out.cpu().masked_fill(lacking, _NO_CLASS)


def fit_head(
    training: Sequence[Tensor],
    held: Sequence[Tensor],
    training_targets: NDArray[np.float32],
    held_targets: NDArray[np.float32],
    folds: NDArray[np.int64],
) -> tuple[Blend, Tensor]:
    """Fit a head to all windows; views, kernel share and scale minimise the cross entropy of held-out windows.

    Args:
        training, held: both views of windows, each ``[M, p]`` and ``[n, p]``.
        training_targets, held_targets: ``[M, n_classes]`` and ``[n, n_classes]``.
        folds: int ``[n]``; the windows of a fold are held out together.

    Returns:
        The head, and the logits ``[n, n_classes]`` of the held windows, each by a head fitted without its fold.
    """
    both = [torch.cat(pair) for pair in zip(training, held, strict=True)]
    classes, y = training_targets.argmax(axis=1), held_targets.argmax(axis=1)
    fit = KernelFit(both, np.concatenate([training_targets, held_targets]), folds)
    few = fit.thinned(_SAMPLE)
    tried = [calibrate(few.fit(shares)[1], y)[1] for shares in _VIEW_SHARES]
    head, logits = fit.fit(_VIEW_SHARES[int(np.argmin(tried))])
    scale, _ = calibrate(logits, y)
    kernel, logits = head.scaled(scale), scale * logits

    n_classes = logits.shape[1]
    voted = torch.empty_like(logits)
    halves = []
    for half in (0, 1):  # held out in turn
        known, out = folds % 2 != half, folds % 2 == half
        x, labels = torch.cat([training[1], held[1][known]]), np.concatenate([classes, y[known]])
        halves.append(Forest.fit(x, labels, n_classes, trees=TREES // 2, seed=half))
        voted[out] = halves[-1](held[1][out]).cpu()
    scale, _ = calibrate(voted, y)
    losses = [calibrate(blend(logits, scale * voted, share), y)[1] for share in _KERNEL_SHARES]
    share = _KERNEL_SHARES[int(np.argmin(losses))]
    if share == 1.0:
        return Blend(kernel), logits
    return Blend(kernel, halves[0] + halves[1], share, scale), blend(logits, scale * voted, share)


def fit_value_head(
    training: Sequence[Tensor],
    held: Sequence[Tensor],
    training_values: NDArray[np.float32],
    held_values: NDArray[np.float32],
    folds: NDArray[np.int64],
) -> tuple[Blend, Tensor]:
    """Fit a kernel ridge regression; views and ridge minimise the squared error of held-out windows.

    Equivalent to ``sklearn.kernel_ridge.KernelRidge`` on standardised values with a precomputed kernel.

    Args:
        training, held: both views of windows, each ``[M, p]`` and ``[n, p]``.
        training_values, held_values: ``[M, k]`` and ``[n, k]``.
        folds: int ``[n]``; the windows of a fold are held out together.

    Returns:
        The head, and the values ``[n, k]`` of the held windows, each by a head fitted without its fold.
    """
    both = [torch.cat(pair) for pair in zip(training, held, strict=True)]
    values = np.concatenate([training_values, held_values]).astype(np.float64)
    mean, deviation = values.mean(axis=0), values.std(axis=0)
    deviation[deviation == 0] = 1.0
    fit = KernelFit(both, ((values - mean) / deviation).astype(np.float32), folds, values=True)
    few, choices = fit.thinned(_SAMPLE), [(shares, ridge) for shares in _VIEW_SHARES for ridge in _RIDGES]
    truth = torch.from_numpy(((held_values - mean) / deviation).astype(np.float32))
    tried = [float((few.fit(*choice)[1] - truth).square().mean()) for choice in choices]
    head, found = fit.fit(*choices[int(np.argmin(tried))])
    scale, offset = (torch.as_tensor(v, dtype=torch.float32) for v in (deviation, mean))
    on = head.weights.device
    weights, bias = head.weights * scale.to(on), head.bias * scale.to(on) + offset.to(on)
    return Blend(KernelHead(head.known, head.widths.tolist(), head.shares.tolist(), weights, bias)), (
        found * scale + offset
    )


def calibrate(logits: Tensor, y: NDArray[np.int64]) -> tuple[float, float]:
    """Return the scale of logits ``[N, n_classes]`` with the lowest cross entropy for classes ``[N]``, and that loss.

    One scale does not change the order of the classes (temperature scaling, Guo et al. 2017).
    """
    from scipy.optimize import minimize_scalar

    labels = torch.from_numpy(y)
    found = minimize_scalar(
        lambda log_scale: float(nn.functional.cross_entropy(logits * float(np.exp(log_scale)), labels)),
        bounds=(-3.0, 6.0),
        method="bounded",
    )
    return float(np.exp(found.x)), float(found.fun)


def linear_head(features: NDArray[np.float64], y: NDArray[np.int64], n_classes: int) -> tuple[Tensor, Tensor]:
    """Return weight ``[n_classes, p]`` and bias ``[n_classes]`` of a multinomial logistic regression on ``[N, p]``."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.preprocessing import StandardScaler

    scaler = StandardScaler().fit(features)
    classifier = LogisticRegression(C=_LINEAR_C, max_iter=300).fit(scaler.transform(features), y)
    coefficients, intercept = classifier.coef_, classifier.intercept_
    if len(classifier.classes_) == 2:  # scikit-learn keeps one row then
        coefficients, intercept = np.vstack([-coefficients, coefficients]) / 2, np.array([-1, 1]) * intercept / 2
    slopes = coefficients / scaler.scale_
    weight, bias = torch.zeros(n_classes, features.shape[1]), torch.full((n_classes,), _NO_CLASS)
    weight[classifier.classes_] = torch.from_numpy(slopes.astype(np.float32))
    bias[classifier.classes_] = torch.from_numpy((intercept - slopes @ scaler.mean_).astype(np.float32))
    return weight, bias


def _squared_distance(a: Tensor, b: Tensor) -> Tensor:
    """Return the squared distances ``[N, M]`` of the rows of ``a [N, p]`` and ``b [M, p]``."""
    return (a.square().sum(1)[:, None] + b.square().sum(1) - 2 * a @ b.T).clamp_min(0.0)
