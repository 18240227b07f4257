"""The reduced-input model: phi drops the faulty cells, a front end says what they would most likely read (Section IV).

The paper's D - k inputs no longer form the grid that its convolutions need. So the reduced model owns a front end from
the healthy cells to the whole grid: the identity on the healthy ones, an affine map onto the missing ones. Folding that
map into a network's first linear layer would be optimal-brain-surgeon deletion of the missing inputs: the same thing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.network import TactileTransformer
from adaptfault.windows import Windows
from diagnostics import FaultSet

_MOST_FRAMES = 20_000  # a covariance needs no more; frames are thinned evenly


@dataclass(frozen=True)
class CellStatistics:
    """Mean and covariance of healthy frames: all that the linear fill of any F needs.

    Attributes:
        mean: ``[D]``, on the 0..1 scale.
        covariance: ``[D, D]``, shrunk (Ledoit and Wolf 2004), so that any part of it can be inverted.
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @classmethod
    def fit(cls, windows: Windows) -> CellStatistics:
        """Estimate from the frames of fault-free windows."""
        from sklearn.covariance import LedoitWolf

        frames = windows.x.reshape(-1, windows.x.shape[2])
        thin = np.linspace(0, len(frames) - 1, min(len(frames), _MOST_FRAMES)).astype(int)
        estimate = LedoitWolf().fit(frames[thin].astype(np.float64))
        return cls(estimate.location_, estimate.covariance_)

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

    def forward(self, x: Tensor) -> Tensor:
        """Map ``[N, T, D-k]`` to ``[N, T, D]``; what is filled in lies within 0..1, as a sensor would read."""
        filled = torch.nn.functional.linear(x, self.weight, self.bias).clamp(0.0, 1.0)
        return torch.cat([x, filled], dim=-1)[..., self.order]


class ReducedModel(nn.Module):
    """A classifier of the D - k healthy cells: front end, then the fault-free model's network.

    With F empty it is the fault-free model, bit for bit: there is no front end.

    Args:
        network: the classifier of windows ``[N, T, D]``.
        fault_set: F, the cells that no longer enter.
        front: from ``[N, T, D-k]`` to ``[N, T, D]``; None where F is empty.
    """

    def __init__(self, network: TactileTransformer, fault_set: FaultSet, front: nn.Module | None) -> None:
        super().__init__()
        self.network, self.fault_set = network, fault_set
        self.front = front if len(fault_set) else None

    def complete(self, x: Tensor) -> Tensor:
        """Map the healthy cells' windows ``[N, T, D-k]`` to whole ones ``[N, T, D]``.

        Raises:
            ValueError: windows of another width.
        """
        width = self.fault_set.n_cells - len(self.fault_set)
        if x.dim() != 3 or x.shape[2] != width:
            raise ValueError(f"expected windows of the {width} healthy cells [N, T, {width}], got {list(x.shape)}")
        return x if self.front is None else self.front(x)

    def features(self, x: Tensor) -> Tensor:
        """Map windows of the healthy cells ``[N, T, D-k]`` to what the network's head weighs, ``[N, 128]``."""
        return self.network.features(self.complete(x))

    def forward(self, x: Tensor) -> Tensor:
        """Map windows of the healthy cells ``[N, T, D-k]``, scaled to 0..1, to logits ``[N, n_classes]``."""
        logits: Tensor = self.network(self.complete(x))
        return logits


def phi(x: NDArray[Any], fault_set: FaultSet) -> NDArray[Any]:
    """The paper's feature selector: drop the faulty cells from ``[..., D]``, giving ``[..., D-k]`` (Section IV).

    Raises:
        ValueError: the last axis is not D.
    """
    if x.shape[-1] != fault_set.n_cells:
        raise ValueError(f"F is over {fault_set.n_cells} cells, the windows have {x.shape[-1]}: {list(x.shape)}")
    return x[..., fault_set.healthy]


def reduce_windows(windows: Windows, fault_set: FaultSet) -> Windows:
    """Apply :func:`phi` to windows."""
    return Windows(phi(windows.x, fault_set), windows.y, windows.recording)
