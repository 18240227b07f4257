"""Kernels of windows for a head, and kernel ridge regression with held-out folds.

Distances are in units of their medians. The joint kernel is exp(-(f + s + m) / 3): f and s are
squared distances of the features of the network and of the smoothed cells, m the sum of the
distances of the moments in each coordinate. The kernel of the moments is exp(-m). A Gaussian suits
what changes smoothly, a Laplacian kernel what hangs on single values: it is the limit of a forest
of random trees (Balog, Lakshminarayanan, Ghahramani, Roy and Teh 2016). Values, such as a force,
change smoothly with the moments: for them, m is a squared distance, too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.data.windows import evenly

KERNELS = 2
RIDGES = (0.2, 0.02, 0.002)  # added to a kernel's diagonal, which is 1
SAMPLE = 1_000  # windows on which widths and ridges are chosen
_ROWS = 256  # of a kernel, computed at once


class Views(NamedTuple):
    """What a head sees of N windows.

    Attributes:
        features: of the network ``[N, p]``.
        smooth: the healthy cells with their neighbours ``[N, q]``.
        moments: of the contact on each pad ``[N, r]``.
        course: of each healthy cell over time ``[N, s]``, double; of the forest alone.
    """

    features: Tensor
    smooth: Tensor
    moments: Tensor
    course: Tensor

    def select(self, which: slice | NDArray[np.intp]) -> Views:
        """Return the views of some of the windows."""
        return Views(*(view[which] for view in self))

    def __add__(self, other: tuple[Tensor, ...]) -> Views:  # type: ignore[override]
        """Return the views of these windows and of others."""
        return Views(*(torch.cat(pair) for pair in zip(self, other, strict=True)))


class Known(NamedTuple):
    """The views of which kernels are, of the windows that a head was fitted on."""

    features: Tensor
    smooth: Tensor
    moments: Tensor


def kernels(
    known: Known, widths: Tensor, views: Views, *, values: bool = False
) -> tuple[Tensor, Tensor]:
    """Return the joint kernel and that of the moments between windows, double ``[N, M]`` each.

    Double precision: large weights of both signs nearly cancel; the error in single precision is up
    to 4e-4. Sums of amounts are without cancellation: in single precision 4e-7.

    Args:
        known: M windows.
        widths: ``[3]``, units of the distances.
        views: N windows.
        values: the outputs are values, not classes.
    """
    features, smooth, moments = widths.double()
    of_features = squared(views.features.double(), known.features.double()) / features
    of_smooth = squared(views.smooth.double(), known.smooth.double()) / smooth
    if values:
        of_moments = squared(views.moments.double(), known.moments.double()) / moments
    else:
        of_moments = amounts(views.moments, known.moments).double() / moments
    joint = torch.exp(-(of_features + of_smooth + of_moments) / len(Known._fields))
    return joint, torch.exp(-of_moments)


class Kernels:
    """The kernels of M windows with each other.

    Args:
        known: their views.
        values: the outputs are values, not classes.

    Attributes:
        widths: ``[3]``, the units of the distances.

    Raises:
        ValueError: a view is not finite.
    """

    def __init__(self, known: Known, *, values: bool = False) -> None:
        if not all(bool(view.square().sum().isfinite()) for view in known):
            raise ValueError(
                "the network gives features that are not finite: check the recordings, and train"
                " it anew"
            )
        self._smooth = [_centred(known.features), _centred(known.smooth)]
        self._moments = known.moments
        self._power = 2 if values else 1
        sample = evenly(len(known.moments), SAMPLE)
        pairs = self._apart(known.moments[sample])
        widths = [1.0, 1.0, (float(pairs.median()) if len(pairs) else 0.0) or 1.0]
        for i, view in enumerate(self._smooth):
            widths[i], self._smooth[i] = _unit(view, sample)
        self.widths = torch.tensor(widths, device=known.moments.device)

    def _apart(self, moments: Tensor) -> Tensor:
        """Return the distance of each pair of rows."""
        return nn.functional.pdist(moments, p=self._power).pow_(self._power)

    def upper(self, *, joint: bool) -> Tensor:
        """Return the upper triangle of the joint kernel, or of that of the moments, ``[M, M]``.

        What lies below the diagonal is undefined.
        """
        n = len(self._moments)
        parts = len(Known._fields) if joint else 1
        *scales, amount = (parts * self.widths).tolist()
        views = []
        if joint:
            views = [
                view / math.sqrt(scale) for view, scale in zip(self._smooth, scales, strict=True)
            ]
        pairs = self._apart(self._moments / amount ** (1 / self._power))
        kernel = torch.zeros(n, n, device=pairs.device)
        first = 0
        for start in range(0, n, _ROWS):
            rows = kernel[start : start + _ROWS, start:]
            for view in views:
                rows += squared(view[start : start + _ROWS], view[start:])
            for i in range(len(rows)):
                rest = n - start - i - 1
                rows[i, i + 1 :] += pairs[first : first + rest]
                first += rest
            rows.neg_().exp_()
        return kernel


def _centred(view: Tensor) -> Tensor:
    """Return a view about its mean: distances stay, and their rounding errors are smaller."""
    return view - view.mean(0)


def _unit(view: Tensor, sample: NDArray[np.intp]) -> tuple[float, Tensor]:
    """Return the unit of squared distances, their median, and the view in the precision that it
    needs."""
    of = view[sample]
    width = float(squared(of, of).median())
    if width >= _rounding(view):
        return width or 1.0, view
    precise = view.double()
    of = precise[sample]
    return max(float(squared(of, of).median()), _rounding(precise)) or 1.0, precise


def _rounding(view: Tensor) -> float:
    """Return the unit of squared distances below which their rounding errors exceed the smallest
    ridge.

    A squared distance is a difference of sums of p squares, so its error is about sqrt(p) eps times
    these (Higham and Mary 2019). M x M random errors change an eigenvalue of a kernel by up to 2
    sqrt(M) times their size (Wigner 1955).
    """
    m, p = view.shape
    size = float(view.square().sum(1).mean())
    return 2.0 * math.sqrt(m * p) * torch.finfo(view.dtype).eps * size / min(RIDGES)


def squared(a: Tensor, b: Tensor) -> Tensor:
    """Return the squared distances ``[N, M]`` of the rows of ``a [N, p]`` and ``b [M, p]``."""
    squares = torch.addmm(b.square().sum(1), a, b.T, alpha=-2)
    return squares.add_(a.square().sum(1)[:, None]).clamp_min_(0.0)


def amounts(a: Tensor, b: Tensor) -> Tensor:
    """Return the sums ``[N, M]`` of the distances in each coordinate of ``a [N, p]`` and
    ``b [M, p]``."""
    if torch.compiler.is_compiling():  # an export: ONNX has no cdist
        return (a[:, None] - b).abs().sum(2)
    return torch.cdist(a, b, p=1)


def ridge_regression(
    kernel: Tensor, targets: Tensor, folds: NDArray[np.int64], ridge: float
) -> tuple[Tensor, Tensor]:
    """Fit a kernel ridge regression, and the same without each fold, from one Cholesky
    decomposition.

    Equivalent to ``sklearn.kernel_ridge.KernelRidge(alpha=ridge, kernel="precomputed")``. The
    residual of the windows f of a fold, predicted without them, is P_ff^-1 (P r)_f: P is the block
    of the inverse of the kernel, and P r the weights, of all windows that are held out.

    Args:
        kernel: ``[M, M]``, whose upper triangle counts; it is overwritten, to save its memory.
        targets: ``[M, k]``.
        folds: int ``[n]``; the last n windows are held out in turn, those of one fold together.
        ridge: added to the diagonal.

    Returns:
        The weights ``[M, k]``, and ``[n, k]``: what a fit without its fold predicts for each
        held-out window.
    """
    m = len(targets) - len(folds)  # never held out
    kernel.diagonal().add_(ridge)
    root = kernel.mT
    torch.linalg.cholesky(root, out=root)
    weights = torch.cholesky_solve(targets, root)
    inverse = torch.cholesky_inverse(root[m:, m:])
    held_out = targets[m:].clone()
    fold = torch.from_numpy(folds).to(kernel.device)
    for each in torch.unique(fold):
        out = fold == each
        held_out[out] -= torch.cholesky_solve(
            weights[m:][out], torch.linalg.cholesky(inverse[out][:, out])
        )
    return weights, held_out
