"""Fills: front ends that say what the missing cells would most likely read, from the healthy ones, without training.

The linear fill is the Gaussian conditional mean. Folding it into a network's first linear layer would be optimal-brain-
surgeon deletion of the missing inputs: the same thing. It cannot know that contact is thresholded and has edges, so the
nearest fill adds what it got wrong on the healthy frames that look most like this one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.data.windows import Windows, evenly
from diagnostics import FaultSet

_MOST_FRAMES = 20_000  # a covariance needs no more; frames are thinned evenly
_REFERENCE_FRAMES = 3_000  # that the nearest fill compares with
_PROBES = 100  # of them, that tell how near neighbours lie
_NEAR, _WIDTH = 0.01, 0.05  # of the kernel, in units of the typical squared distance within which 1 % of them lie


@dataclass(frozen=True)
class CellStatistics:
    """What the fills of any F need to know of healthy frames.

    Attributes:
        mean: ``[D]``, on the 0..1 scale.
        covariance: ``[D, D]``, shrunk (Ledoit and Wolf 2004), so that any part of it can be inverted.
        frames: ``[M, D]``, some of them: the nearest fill's reference.
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    frames: NDArray[np.float32]

    @classmethod
    def fit(cls, windows: Windows) -> CellStatistics:
        """Estimate from the frames of fault-free windows."""
        from sklearn.covariance import LedoitWolf

        frames = windows.x.reshape(-1, windows.x.shape[2])
        frames = frames[evenly(len(frames), _MOST_FRAMES)]
        estimate = LedoitWolf().fit(frames.astype(np.float64))
        return cls(estimate.location_, estimate.covariance_, cls.reference(windows))

    @staticmethod
    def reference(windows: Windows) -> NDArray[np.float32]:
        """Return the frames ``[M, D]`` that the nearest fill compares with."""
        frames = windows.x.reshape(-1, windows.x.shape[2])
        return frames[evenly(len(frames), _REFERENCE_FRAMES)]

    def linear(self, fault_set: FaultSet) -> AffineFill:
        """Return the linear fill for F."""
        return AffineFill(fault_set, *self.conditional_mean(fault_set))

    def nearest(self, fault_set: FaultSet) -> NearestFill:
        """Return the linear fill for F with the nearest frames' residuals added."""
        return NearestFill(fault_set, self.linear(fault_set), self.frames)

    def conditional_mean(self, fault_set: FaultSet) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return ``weight [k, D-k]`` and ``bias [k]`` of E[missing | healthy] = weight @ healthy + bias.

        The Gaussian conditional mean, S_FR S_RR^-1, R being the healthy cells.
        """
        from scipy.linalg import cho_factor, cho_solve

        missing, healthy = np.flatnonzero(fault_set.mask), fault_set.healthy
        if not len(missing) or not len(healthy):
            return np.zeros((len(missing), len(healthy))), self.mean[missing]
        between = self.covariance[np.ix_(healthy, missing)]
        # An array of cells that never moved has covariance 0: no cell says anything about another.
        within = self.covariance[np.ix_(healthy, healthy)] + np.finfo(float).tiny ** 0.25 * np.eye(len(healthy))
        weight = cho_solve(cho_factor(within), between).T
        return weight, self.mean[missing] - weight @ self.mean[healthy]

    @cached_property
    def precision(self) -> NDArray[np.float64]:
        """Inverse of the covariance, ``[D, D]``."""
        from scipy.linalg import cho_factor, cho_solve

        still = np.finfo(float).tiny ** 0.25  # as in conditional_mean
        factor = cho_factor(self.covariance + still * np.eye(len(self.mean)))
        return np.asarray(cho_solve(factor, np.eye(len(self.mean))))

    def expected(self, frames: NDArray[Any], missing: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return what the ``missing [D]`` cells of ``frames [n, D]`` would read, ``[n, k]``, not yet limited to 0..1.

        The same mean as :meth:`conditional_mean`, from the precision P: mean_F - P_FF^-1 P_FR (x_R - mean_R). Quicker
        for few cells, where the set of them is another for each frame.
        """
        surprise = np.where(missing, 0.0, frames - self.mean) @ self.precision[:, missing]
        within = self.precision[np.ix_(missing, missing)]
        # For a handful of cells numpy's solver is a few times quicker than scipy's Cholesky.
        return np.asarray(self.mean[missing] - np.linalg.solve(within, surprise.T).T)


class AffineFill(nn.Module):
    """Front end from the healthy cells to all: healthy ones pass unchanged, missing ones are an affine map of them.

    Args:
        fault_set: F.
        weight: ``[k, D-k]``.
        bias: ``[k]``.
    """

    order: Tensor

    def __init__(self, fault_set: FaultSet, weight: NDArray[Any], bias: NDArray[Any]) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.as_tensor(np.ascontiguousarray(weight), dtype=torch.float32))
        self.bias = nn.Parameter(torch.as_tensor(np.ascontiguousarray(bias), dtype=torch.float32))
        # Position of each cell in [healthy, missing].
        order = np.argsort(np.concatenate([fault_set.healthy, np.flatnonzero(fault_set.mask)]))
        self.register_buffer("order", torch.from_numpy(order), persistent=False)

    @classmethod
    def empty(cls, fault_set: FaultSet) -> AffineFill:
        """Build a fill to load a state into."""
        k = len(fault_set)
        return cls(fault_set, np.zeros((k, fault_set.n_cells - k)), np.zeros(k))

    def missing(self, x: Tensor) -> Tensor:
        """Map ``[..., D-k]`` to what the missing cells would read, ``[..., k]``, not yet limited to 0..1."""
        return torch.nn.functional.linear(x, self.weight, self.bias)

    def merge(self, x: Tensor, filled: Tensor) -> Tensor:
        """Put healthy cells ``[..., D-k]`` and filled ones ``[..., k]`` in the order of the array, ``[..., D]``."""
        return torch.cat([x, filled.clamp(0.0, 1.0)], dim=-1)[..., self.order]

    def forward(self, x: Tensor) -> Tensor:
        """Map ``[N, T, D-k]`` to ``[N, T, D]``; what is filled in lies within 0..1, as a sensor would read."""
        return self.merge(x, self.missing(x))


class NearestFill(nn.Module):
    """Front end that adds to the linear fill what it missed on the healthy frames that look most alike.

    A kernel regression of the linear fill's residuals (Nadaraya 1964, Watson 1964) on the square roots of the healthy
    cells, whose width is the typical distance of a near neighbour. Nothing in it is trained.

    Args:
        fault_set: F.
        linear: the linear fill for F.
        frames: ``[M, D]`` fault-free frames to compare with.
    """

    roots: Tensor
    residuals: Tensor
    width: Tensor

    def __init__(self, fault_set: FaultSet, linear: AffineFill, frames: NDArray[np.float32]) -> None:
        super().__init__()
        self.linear = linear
        healthy, missing = frames[:, fault_set.healthy], frames[:, np.flatnonzero(fault_set.mask)]
        with torch.no_grad():
            expected = linear.missing(torch.from_numpy(healthy)).numpy()
        roots = np.sqrt(np.maximum(healthy, 0.0))
        self.register_buffer("roots", torch.from_numpy(roots))
        self.register_buffer("residuals", torch.from_numpy(missing - expected))
        self.register_buffer("width", torch.tensor(_WIDTH * near_distance(roots), dtype=torch.float32))

    def forward(self, x: Tensor) -> Tensor:
        """Map ``[N, T, D-k]`` to ``[N, T, D]``; what is filled in lies within 0..1."""
        # The frame's own square is the same for every neighbour, so the softmax does without it.
        roots, own = x.clamp_min(0.0).sqrt() * (2 / self.width), self.roots.square().sum(1) / -self.width
        weights = torch.softmax(nn.functional.linear(roots, self.roots, own), dim=-1)  # (N, T, M), in one pass
        return self.linear.merge(x, self.linear.missing(x) + weights @ self.residuals)


def near_distance(roots: NDArray[np.float32]) -> float:
    """Return the squared distance of a near neighbour, the typical one among frames ``[M, R]``; never 0."""
    from sklearn.metrics.pairwise import euclidean_distances

    distance = euclidean_distances(roots[evenly(len(roots), _PROBES)], roots, squared=True)
    rank = min(1 + round(_NEAR * len(roots)), len(roots) - 1)  # the nearest is the frame itself
    near = np.partition(distance, rank, axis=1)[:, rank]
    return float(np.median(near[near > 0])) if (near > 0).any() else 1.0
