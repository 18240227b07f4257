"""The reduced-input model: phi drops the faulty cells, a front end says what they would most likely read (Section IV).

The paper's D - k inputs no longer form the grid that its convolutions need. So the reduced model owns a front end from
the healthy cells to the whole grid (:mod:`adaptfault.imputation.linear`): the identity on the healthy ones, what these
say about them on the missing ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.adaptation.heads import Blend, summarise
from adaptfault.data.windows import Windows
from adaptfault.models.network import TactileTransformer
from diagnostics import FaultSet


class ReducedModel(nn.Module):
    """A classifier of the D - k healthy cells: front end, then the fault-free model's network, perhaps a new head.

    With F empty it is the fault-free model, bit for bit: there is no front end.

    Args:
        network: the classifier of windows ``[N, T, D]``.
        fault_set: F, the cells that no longer enter.
        front: from ``[N, T, D-k]`` to ``[N, T, D]``; None where F is empty.
        head: weighs the network's features and the healthy cells themselves; None: the network's own head does.
    """

    seen: Tensor

    def __init__(
        self,
        network: TactileTransformer,
        fault_set: FaultSet,
        front: nn.Module | None,
        head: Blend | None = None,
    ) -> None:
        super().__init__()
        self.network, self.fault_set, self.head = network, fault_set, head
        self.front = front if len(fault_set) else None
        seen = network.layout.present.ravel()[fault_set.healthy]  # positions that the layout lacks say nothing
        self.register_buffer("seen", torch.from_numpy(np.flatnonzero(seen)), persistent=False)

    def complete(self, x: Tensor) -> Tensor:
        """Map the healthy cells' windows ``[N, T, D-k]`` to whole ones ``[N, T, D]``.

        Raises:
            ValueError: windows of another width.
        """
        width = self.fault_set.n_cells - len(self.fault_set)
        if x.dim() != 3 or x.shape[2] != width:
            raise ValueError(f"expected windows of the {width} healthy cells [N, T, {width}], got {list(x.shape)}")
        return x if self.front is None else self.front(x)

    def views(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map windows of the healthy cells ``[N, T, D-k]`` to what a head weighs.

        Returns:
            The network's features ``[N, 128]``, and ``[N, 2 H]``, the summary of the H healthy cells that exist.
        """
        return self.network.features(self.complete(x)), summarise(x[..., self.seen])

    def forward(self, x: Tensor) -> Tensor:
        """Map windows of the healthy cells ``[N, T, D-k]``, scaled to 0..1, to logits ``[N, n_classes]``."""
        logits: Tensor = self.network(self.complete(x)) if self.head is None else self.head(self.views(x))
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
