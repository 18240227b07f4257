"""Heads fitted without a gradient step to the features of the network and to the healthy cells.

A head has two experts. The first is a mixture of kernel ridge regressions on class indicators (as
classifiers: Suykens and Vandewalle 1999) or on values. Each has a kernel of some views of a window:
the penultimate features of the network, the healthy cells, these smoothed
(:mod:`adaptfault.adaptation.cell_summary`), the moments of the contact on each pad in the imputed
windows (:mod:`adaptfault.adaptation.contact_moments`), and these corrected. All but the features
are of loads, the readings above the rest of each cell. The correction is one more kernel ridge
regression, of the error that the imputation makes on training windows, whose dead cells are known:
what only these windows have helps to learn (privileged information: Vapnik and Vashist 2009). It is
cross-fitted, so a window is corrected without its own dead cells. A Gaussian kernel suits what
changes smoothly, a Laplacian kernel what hangs on single values: it is the limit of a forest of
random trees (Balog, Lakshminarayanan, Ghahramani, Roy and Teh 2016). The network has seen its
training windows, so its features tell them apart better than new ones; three of the kernels do not
use them. The shares of the mixture are those with the highest likelihood of held-out windows
(stacking of predictive distributions: Yao, Vehtari, Simpson and Gelman 2018).

The second expert is a forest (:mod:`adaptfault.models.forest`) on the course of each healthy cell.
Trees choose their inputs, so they do not mind rests and gains that differ by cell, and texture
raises the spread of a cell where it hardly moves its mean. The two are pooled: the product of their
probabilities, each to the power of a weight (logarithmic opinion pool: Genest and Zidek 1986), or a
weighted mean of values. The weights, too, have the highest likelihood of held-out windows. In a
mixture an expert that is often right, but rarely sure, would only take away from the sure one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.data.windows import evenly
from adaptfault.models.forest import TREES, Forest, fit_forest

Views = Sequence[Tensor]

# Distances of a view (0: features, 1: cells, 2: smoothed cells, 3: moments, 4: restored moments),
# squared or absolute.
_DISTANCES = (
    (0, True),
    (1, True),
    (2, True),
    (0, False),
    (1, False),
    (3, True),
    (3, False),
    (4, True),
    (4, False),
)
_KERNELS = ((0, 1, 2, 5), (6,), (7,), (8,))  # of these; the first also restores
# indices of the views
_MOMENTS = 3
_COURSE = 4  # of a forest alone
_RESTORED = 4  # of the views that kernels have
_USED = sorted({i for kernel in _KERNELS for i in kernel})
_RIDGES = (0.2, 0.02, 0.002)  # added to a kernel's diagonal, which is 1
_SAMPLE = 1_000  # windows on which widths and ridges are chosen, of training and of validation each
_LINEAR_C = 0.3  # inverse strength of the linear head's ridge penalty
_EM_STEPS = 100
_MOST_WEIGHT = 10.0  # of an expert, where all are always right
_NO_CLASS = -1e4  # logit of a class without training windows
MOST_WINDOWS = 5_000  # a head's cost grows with their cube


class Head(nn.Module):
    """Kernel expansions, which weight each known window by its similarity to the input, and a
    forest.

    Args:
        known: the views of the M windows it was fitted on, each ``[M, p]``, the restored moments
            last.
        widths: units of the distances.
        weights: ``[kernels, M, n]``.
        bias: ``[n]``.
        shares: of each kernel in the probabilities or values, summing to 1.
        forest: of the course of the cells.
        pooling: weights ``[2]`` of the kernels and of the forest.
        units: of the moments ``[p]``, by which those in ``known`` are divided.
        restoring: weights ``[M, p]`` of the regression that restores moments, in these units.
        rest: what each cell reads without load ``[D]``; the views are those of the loads above it.
        values: the outputs are values, not logits.
    """

    widths: Tensor
    weights: Tensor
    bias: Tensor
    shares: Tensor
    pooling: Tensor
    units: Tensor
    restoring: Tensor
    rest: Tensor

    def __init__(
        self,
        known: Views,
        widths: Tensor,
        weights: Tensor,
        bias: Tensor,
        shares: Tensor,
        forest: Forest,
        pooling: Tensor,
        units: Tensor,
        restoring: Tensor,
        rest: Tensor,
        *,
        values: bool = False,
    ) -> None:
        super().__init__()
        self.values = values
        for i, view in enumerate(known):
            self.register_buffer(f"known{i}", view)
        self.register_buffer("units", units)
        self.register_buffer("restoring", restoring)
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
        known = [torch.zeros(*shape) for shape in about["known"]]
        moments = known[_RESTORED]
        return cls(
            known,
            widths=torch.zeros(len(_DISTANCES)),
            weights=torch.zeros(len(_KERNELS), len(moments), n),
            bias=torch.zeros(n),
            shares=torch.zeros(len(_KERNELS)),
            forest=Forest.empty(about["forest"], n),
            pooling=torch.zeros(2),
            units=torch.ones(moments.shape[1]),
            restoring=torch.zeros_like(moments),
            rest=torch.zeros(about["cells"]),
            values=about["values"],
        )

    @classmethod
    def blank(cls, known: Views, n: int, cells: int, *, values: bool = False) -> Head:
        """Build a head for n classes or values that knows views of some windows, of so many cells,
        and has learnt nothing from them."""
        known = [*known[:_COURSE], known[_MOMENTS]]
        about = {
            "known": [list(view.shape) for view in known],
            "forest": Forest.blank(n).about,
            "cells": cells,
            "values": values,
        }
        return cls.empty(about, n)

    @property
    def known(self) -> list[Tensor]:
        """The views of the windows it was fitted on."""
        return [self.get_buffer(f"known{i}") for i in range(_RESTORED + 1)]

    @property
    def about(self) -> dict[str, Any]:
        """Argument of :meth:`empty`; JSON-safe."""
        return {
            "known": [list(view.shape) for view in self.known],
            "forest": self.forest.about,
            "cells": len(self.rest),
            "values": self.values,
        }

    def knowing(self, known: Views, forest: Forest) -> Head:
        """Return the same head with other views of the windows it was fitted on, and another
        forest."""
        return Head(
            known,
            self.widths,
            self.weights,
            self.bias,
            self.shares,
            forest,
            self.pooling,
            self.units,
            self.restoring,
            self.rest,
            values=self.values,
        )

    def forward(self, views: Views) -> Tensor:
        """Map the views of N windows, each ``[N, p]``, to logits or values ``[N, n]``."""
        grown = self.forest(views[_COURSE])
        views = _in_units(views[:_COURSE], self.units)
        widths = self.widths.double()
        distances = self._distances(views)
        restored = _kernel(distances, widths, _KERNELS[0]) @ self.restoring.double()
        distances |= self._distances([*views, views[_MOMENTS] + restored.float()], _RESTORED)
        outputs = [
            _kernel(distances, widths, of) @ weights.double() + self.bias
            for of, weights in zip(_KERNELS, self.weights, strict=True)
        ]
        experts = [
            mixture(outputs, self.shares, values=self.values),
            grown.double() if self.values else _votes(grown, self.bias),
        ]
        return pooled(experts, self.pooling, values=self.values).float()

    def _distances(self, views: Views, first: int = 0) -> dict[int, Tensor]:
        """Return the distances to the known windows that kernels use, of the given views from
        ``first`` on.

        Double precision: large weights of both signs nearly cancel; the error in single precision
        is up to 4e-4. Absolute distances, the most expensive part, are sums without cancellation:
        in single precision 4e-7.
        """
        distances = {}
        for i in _USED:
            view, squared = _DISTANCES[i]
            if first <= view < len(views):
                kind = torch.double if squared else torch.float
                distance = _distance(
                    views[view].to(kind), self.known[view].to(kind), squared=squared
                )
                distances[i] = distance.double()
        return distances


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


def _votes(likely: Tensor, bias: Tensor) -> Tensor:
    """Return the logits of a forest: no class is less likely than one tree of a group would make
    it."""
    return torch.log(likely.double() + 1 / TREES) + bias


def ridge_regression(
    kernel: Tensor, targets: Tensor, folds: NDArray[np.int64], ridge: float
) -> tuple[Tensor, Tensor]:
    """Fit a kernel ridge regression, and the same without each fold, from one Cholesky
    decomposition.

    Equivalent to ``sklearn.kernel_ridge.KernelRidge(alpha=ridge, kernel="precomputed")``. The
    residual of the windows f of a fold, predicted without them, is P_ff^-1 (P r)_f: P is the block
    of the inverse of the kernel, and P r the weights, of all windows that are held out.

    Args:
        kernel: ``[M, M]``.
        targets: ``[M, k]``.
        folds: int ``[n]``; the last n windows are held out in turn, those of one fold together.
        ridge: added to the diagonal.

    Returns:
        The weights ``[M, k]``, and ``[n, k]``: what a fit without its fold predicts for each
        held-out window.
    """
    m = len(targets) - len(folds)  # never held out
    diagonal = kernel.diagonal()
    original = diagonal.clone()
    diagonal.add_(ridge)
    root = torch.linalg.cholesky(kernel)
    diagonal.copy_(original)
    within = root[:m, :m]
    between = root[m:, :m]
    first = torch.linalg.solve_triangular(within, targets[:m], upper=False)
    inverse = torch.cholesky_inverse(root[m:, m:])
    last = inverse @ (targets[m:] - between @ first)
    weights = torch.cat(
        [torch.linalg.solve_triangular(within.T, first - between.T @ last, upper=True), last]
    )

    held_out = targets[m:].clone()
    fold = torch.from_numpy(folds).to(kernel.device)
    for each in torch.unique(fold):
        out = fold == each
        held_out[out] -= torch.cholesky_solve(
            last[out], torch.linalg.cholesky(inverse[out][:, out])
        )
    return weights, held_out


def fit_head(
    training: Views,
    held: Views,
    training_targets: NDArray[np.float32],
    held_targets: NDArray[np.float32],
    folds: NDArray[np.int64],
    *,
    whole: Tensor | None = None,
    rest: Tensor | None = None,
    values: bool = False,
    forest: bool = True,
) -> tuple[Head, Tensor]:
    """Fit a head to all windows; ridges, scales and weights minimise the loss of held-out windows.

    The loss is the cross entropy, or the mean squared error of values.

    Args:
        training, held: the views of windows, each ``[M, p]`` and ``[n, p]``.
        training_targets, held_targets: ``[M, k]`` and ``[n, k]``, class indicators, probabilities
        or values; a class
            without windows is never predicted.
        folds: int ``[M + n]``; the windows of a fold are held out together.
        whole: the moments ``[M + n, p]`` of the windows with all cells; None: no cell is dead.
        rest: what each cell reads without load ``[D]``, kept for the views of other windows.
        values: the targets are values.
        forest: False leaves the forest out.

    Returns:
        The head, and the outputs ``[n, k]`` for the held windows, each by a head fitted without its
        fold.
    """
    task = (_Values if values else _Classes)(training_targets, held_targets)
    kernels = slice(None, _COURSE)
    both = [torch.cat(pair) for pair in zip(training[kernels], held[kernels], strict=True)]
    on = both[0].device
    whole = both[_MOMENTS] if whole is None else whole
    units = _units(whole)
    both = _in_units(both, units)
    widths = torch.ones(len(_DISTANCES), device=on)
    distances = _distances(both, widths)
    similar = _kernel(distances, widths, _KERNELS[0])
    restoring, restored = _restore(similar, both[_MOMENTS], whole / units, folds)
    both.append(restored)
    # large: no more than needed
    distances = {i: each for i, each in distances.items() if i not in _KERNELS[0]}
    distances |= _distances(both, widths, _RESTORED)
    targets = task.targets.to(on)
    m = len(training_targets)
    n = len(held_targets)
    folds = folds[m:]
    kept = evenly(n, _SAMPLE)
    few = np.concatenate([evenly(m, _SAMPLE), m + kept])  # enough to compare ridges
    all_weights = []
    all_held = []
    for of in _KERNELS:
        kernel = similar if of is _KERNELS[0] else _kernel(distances, widths, of)
        weights, found = _best_ridge_regression(
            kernel, targets, folds, few, lambda found: task.loss(found, kept)
        )
        scale, outputs = task.outputs(found.cpu())
        all_weights.append(weights * scale.to(on))
        all_held.append(outputs)
    shares = task.shares(all_held)
    course = torch.cat([training[_COURSE], held[_COURSE]]).cpu().numpy()
    mixed = mixture(all_held, shares, values=values)
    trees = Forest.blank(targets.shape[1])
    pooling = torch.tensor([1.0, 0.0])
    outputs = mixed
    if forest:
        trees, grown = task.said(*fit_forest(course, task.targets.numpy(), folds, values=values))
        pooling = task.pooling([mixed, grown])
        outputs = pooled([mixed, grown], pooling, values=values).float()
    head = Head(
        both,
        widths,
        torch.stack(all_weights),
        task.bias.to(on),
        shares.to(on),
        trees.to(on),
        pooling.to(on),
        units,
        restoring,
        torch.zeros(1) if rest is None else rest,
        values=values,
    )
    return head, outputs


def _restore(
    kernel: Tensor, imputed: Tensor, whole: Tensor, folds: NDArray[np.int64]
) -> tuple[Tensor, Tensor]:
    """Return weights of what has to be added to imputed moments ``[N, p]``, and cross-fitted
    restored ones."""
    missing = whole - imputed
    if not missing.any():
        return torch.zeros_like(imputed), imputed
    few = evenly(len(folds), _SAMPLE)
    truth = missing[few].cpu()
    weights, found = _best_ridge_regression(
        kernel, missing, folds, few, lambda found: float((found - truth).square().mean())
    )
    return weights, imputed + found


def _best_ridge_regression(
    kernel: Tensor,
    targets: Tensor,
    folds: NDArray[np.int64],
    few: NDArray[np.intp],
    loss: Callable[[Tensor], float],
) -> tuple[Tensor, Tensor]:
    """Return :func:`ridge_regression` with the ridge that has the least ``loss`` on ``few`` of the
    windows."""
    sample = kernel if len(few) == len(kernel) else kernel[few][:, few]
    held = few - (len(targets) - len(folds))  # negative: never held out
    folds_of_few = folds[held[held >= 0]]
    tried = [
        loss(ridge_regression(sample, targets[few], folds_of_few, ridge)[1].cpu())
        for ridge in _RIDGES
    ]
    return ridge_regression(kernel, targets, folds, _RIDGES[int(np.argmin(tried))])


class _Classes:
    """Class indicators as targets of a regression, and its predictions as logits."""

    def __init__(self, training: NDArray[np.float32], held: NDArray[np.float32]) -> None:
        every = np.concatenate([training, held])
        self.targets = torch.from_numpy(every - np.float32(1 / every.shape[1]))
        self.y = held.argmax(axis=1)
        self.bias = torch.zeros(every.shape[1]).masked_fill(
            torch.from_numpy(every.max(axis=0) == 0), _NO_CLASS
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
        return forest, _votes(likely, self.bias)

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


class _Values:
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


def _units(moments: Tensor) -> Tensor:
    """Return the standard deviation of each moment ``[N, p]``; 1 where it is constant, up to
    rounding."""
    spread = moments.std(0, correction=0)
    size = moments.square().mean(0).sqrt()
    return torch.where(spread > math.sqrt(torch.finfo(moments.dtype).eps) * size, spread, 1.0)


def _in_units(views: Views, units: Tensor) -> list[Tensor]:
    """Return views with the moments divided by their units."""
    return [view / units if i == _MOMENTS else view for i, view in enumerate(views)]


def _distances(views: Views, widths: Tensor, first: int = 0) -> dict[int, Tensor]:
    """Return the distances of the windows that kernels use, of the given views from ``first`` on.

    Their units, the medians, are put into ``widths``.

    Raises:
        ValueError: a view is not finite.
    """
    if not all(bool(view.square().sum().isfinite()) for view in views):
        raise ValueError(
            "the network gives features that are not finite: check the recordings, and train it"
            " anew"
        )
    distances = {}
    sample = evenly(len(views[0]), _SAMPLE)
    for i in _USED:
        index, squared = _DISTANCES[i]
        if not first <= index < len(views):
            continue
        view = views[index]
        least = 0.0
        distance = _distance(view, view, squared=True) if squared else _absolute_distances(view)
        width = float(distance[sample][:, sample].median())
        if squared and width < _rounding(view):
            view = view.double()
            distance = _distance(view, view, squared=True).float()
            least = _rounding(view)
            width = float(distance[sample][:, sample].median())
        widths[i] = max(width, least) or 1.0
        distances[i] = distance
    return distances


def _rounding(view: Tensor) -> float:
    """Return the unit of squared distances below which their rounding errors exceed the smallest
    ridge.

    A squared distance is a difference of sums of p squares, so its error is about sqrt(p) eps times
    these (Higham and Mary 2019). M x M random errors change an eigenvalue of a kernel by up to 2
    sqrt(M) times their size (Wigner 1955).
    """
    m, p = view.shape
    size = float(view.square().sum(1).mean())
    return 2.0 * math.sqrt(m * p) * torch.finfo(view.dtype).eps * size / min(_RIDGES)


def _kernel(distances: Mapping[int, Tensor], widths: Tensor, of: Sequence[int]) -> Tensor:
    """Return the kernel exp(-mean) of some distances in units of their widths.

    It is Gaussian for squared distances, Laplacian for absolute ones.
    """
    total = distances[of[0]] / (-len(of) * widths[of[0]])
    for i in of[1:]:
        total.addcdiv_(distances[i], widths[i], value=-1 / len(of))
    return total.exp_()


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
    bias = torch.full((n_classes,), _NO_CLASS)
    weight[classifier.classes_] = torch.from_numpy(slopes.astype(np.float32))
    bias[classifier.classes_] = torch.from_numpy(
        (intercept - slopes @ scaler.mean_).astype(np.float32)
    )
    return weight, bias


def _absolute_distances(x: Tensor) -> Tensor:
    """Return the absolute distances ``[N, N]`` of the rows of ``x [N, p]``; ten times as fast as
    ``torch.cdist``."""
    from scipy.spatial.distance import squareform

    pairs = nn.functional.pdist(x, p=1).cpu().numpy()
    return torch.from_numpy(squareform(pairs, checks=False)).to(x.device)


def _distance(a: Tensor, b: Tensor, *, squared: bool) -> Tensor:
    """Return the distances ``[N, M]`` of the rows of ``a [N, p]`` and ``b [M, p]``: sums of squares
    or of amounts."""
    if not squared and torch.compiler.is_compiling():  # an export: ONNX has no cdist
        return (a[:, None] - b).abs().sum(2)
    if not squared:
        return torch.cdist(a, b, p=1)
    return (
        torch.addmm(b.square().sum(1), a, b.T, alpha=-2)
        .add_(a.square().sum(1)[:, None])
        .clamp_min_(0.0)
    )
