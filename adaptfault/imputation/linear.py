"""Front ends that map the healthy cells to all cells: conditional mean, optionally with a kernel
regression.

The linear front end is the Gaussian conditional mean. Folding it into the first linear layer of a
network equals optimal-brain-surgeon deletion of the missing inputs. It cannot represent that
contact is thresholded and has edges. The nearest-neighbour front end adds a kernel regression of
its residuals on healthy frames.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.imputation.kernel import bandwidth
from diagnostics import FaultSet


class AffineFill(nn.Module):
    """Front end from the healthy cells to all: healthy cells pass unchanged, missing ones are an
    affine map of them.

    Args:
        fault_set: F.
        weight: ``[k, D-k]``.
        bias: ``[k]``.
    """

    order: Tensor

    def __init__(self, fault_set: FaultSet, weight: NDArray[Any], bias: NDArray[Any]) -> None:
        super().__init__()
        self.weight = nn.Parameter(
            torch.as_tensor(np.ascontiguousarray(weight), dtype=torch.float32)
        )
        self.bias = nn.Parameter(torch.as_tensor(np.ascontiguousarray(bias), dtype=torch.float32))
        # Position of each cell in [healthy, missing].
        order = np.argsort(np.concatenate([fault_set.healthy, np.flatnonzero(fault_set.mask)]))
        self.register_buffer("order", torch.from_numpy(order), persistent=False)

    @classmethod
    def empty(cls, fault_set: FaultSet) -> AffineFill:
        """Build a front end to load a state into."""
        k = len(fault_set)
        return cls(fault_set, np.zeros((k, fault_set.n_cells - k)), np.zeros(k))

    def missing(self, x: Tensor) -> Tensor:
        """Map ``[..., D-k]`` to the imputed readings of the missing cells, ``[..., k]``, not
        clipped."""
        return torch.nn.functional.linear(x, self.weight, self.bias)

    def merge(self, x: Tensor, filled: Tensor) -> Tensor:
        """Put healthy cells ``[..., D-k]`` and imputed ones ``[..., k]`` in the order of the array,
        ``[..., D]``."""
        return torch.cat([x, filled.clamp(0.0, 1.0)], dim=-1)[..., self.order]

    def forward(self, x: Tensor) -> Tensor:
        """Map ``[N, T, D-k]`` to ``[N, T, D]``; imputed readings are clipped to 0..1."""
        return self.merge(x, self.missing(x))


class NearestFill(nn.Module):
    """Front end that adds a kernel regression of the residuals of the linear front end.

    The Nadaraya-Watson estimator (Nadaraya 1964, Watson 1964) on the square roots of the healthy
    cells. The bandwidth is the typical distance of a near neighbour. It has no trained parameters.

    Args:
        fault_set: F.
        linear: the linear front end for F.
        frames: ``[M, D]`` fault-free frames.
    """

    roots: Tensor
    residuals: Tensor
    width: Tensor

    def __init__(
        self, fault_set: FaultSet, linear: AffineFill, frames: NDArray[np.float32]
    ) -> None:
        super().__init__()
        self.linear = linear
        healthy = frames[:, fault_set.healthy]
        missing = frames[:, np.flatnonzero(fault_set.mask)]
        with torch.no_grad():
            expected = linear.missing(torch.from_numpy(healthy)).numpy()
        roots = np.sqrt(np.maximum(healthy, 0.0))
        self.register_buffer("roots", torch.from_numpy(roots))
        self.register_buffer("residuals", torch.from_numpy(missing - expected))
        self.register_buffer("width", torch.tensor(bandwidth(roots), dtype=torch.float32))

    def forward(self, x: Tensor) -> Tensor:
        """Map ``[N, T, D-k]`` to ``[N, T, D]``; imputed readings are clipped to 0..1."""
        # The squared norm of the frame itself cancels in the softmax.
        roots = x.clamp_min(0.0).sqrt() * (2 / self.width)
        own = self.roots.square().sum(1) / -self.width
        # (N, T, M), in one pass
        weights = torch.softmax(nn.functional.linear(roots, self.roots, own), dim=-1)
        return self.linear.merge(x, self.linear.missing(x) + weights @ self.residuals)
