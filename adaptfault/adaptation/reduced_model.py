"""The reduced-input model: phi drops the faulty cells, a front end imputes them (Section IV).

The D - k inputs of the paper do not form the grid that its convolutions need. The reduced model
therefore has a front end from the healthy cells to the whole grid
(:mod:`adaptfault.imputation.linear`): the identity on healthy cells, the conditional mean on
missing ones.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from adaptfault.adaptation.cell_summary import CellSummary
from adaptfault.adaptation.contact_moments import ContactMoments
from adaptfault.data.windows import Windows
from adaptfault.models.any_model import AnyModel
from adaptfault.models.heads import Head
from adaptfault.models.kernels import Views
from adaptfault.models.network import TactileTransformer
from diagnostics import FaultSet


class ReducedModel(nn.Module):
    """A model of the D - k healthy cells: front end, network, and a new head or the head of the
    network.

    With F empty there is no front end, and the outputs are those of the network, bit for bit.

    Args:
        network: maps windows ``[N, T, D]`` to logits or values.
        fault_set: F, the dropped cells.
        front: from ``[N, T, D-k]`` to ``[N, T, D]``; None where F is empty.
        head: uses the features of the network and the healthy cells; None: the head of the network.
        rest: what each cell reads without load ``[D]``, for a head to come; None: 0.
    """

    rest: Tensor
    healthy: Tensor

    def __init__(
        self,
        network: TactileTransformer | AnyModel,
        fault_set: FaultSet,
        front: nn.Module | None,
        head: Head | None = None,
        rest: Tensor | None = None,
    ) -> None:
        super().__init__()
        rest = torch.zeros(fault_set.n_cells) if rest is None else rest
        self.register_buffer("rest", rest, persistent=False)
        self.network = network
        self.fault_set = fault_set
        self.head = head
        self.front = front if len(fault_set) else None
        healthy = torch.from_numpy(fault_set.healthy.copy())
        self.register_buffer("healthy", healthy, persistent=False)
        self.summary = CellSummary(network.layout, fault_set)
        self.moments = ContactMoments(network.layout)

    def complete(self, x: Tensor) -> Tensor:
        """Map the healthy cells' windows ``[N, T, D-k]`` to whole ones ``[N, T, D]``.

        Raises:
            ValueError: windows of another width.
        """
        width = self.fault_set.n_cells - len(self.fault_set)
        if x.dim() != 3 or x.shape[2] != width:
            raise ValueError(
                f"expected windows of the {width} healthy cells [N, T, {width}], got"
                f" {list(x.shape)}"
            )
        return x if self.front is None else self.front(x)

    def views(self, x: Tensor, /, **extra: Tensor) -> Views:
        """Map windows of the healthy cells ``[N, T, D-k]``, and what else the network sees, to the
        input of a head.

        They are the features of the network, the
        :class:`~adaptfault.adaptation.contact_moments.ContactMoments` of the whole windows, and the
        :class:`~adaptfault.adaptation.cell_summary.CellSummary`. Summaries and moments are those of
        loads: the readings above the rest of each cell.
        """
        rest = self.rest if self.head is None else self.head.rest
        whole = self.complete(x)
        smooth, course = self.summary(loads(x, rest[self.healthy]))
        moments = self.moments(loads(whole, rest))
        return Views(self.network.features(whole, **extra), smooth, moments, course)

    def forward(self, x: Tensor, /, **extra: Tensor) -> Tensor:
        """Map windows of the healthy cells ``[N, T, D-k]``, scaled to 0..1, and what else the
        network sees, to logits ``[N, n_classes]``."""
        logits: Tensor
        if self.head is None:
            logits = self.network(self.complete(x), **extra)
        else:
            logits = self.head(self.views(x, **extra))
        return logits


def loads(x: Tensor, rest: Tensor) -> Tensor:
    """Return readings ``[..., D]`` above the rest ``[D]`` of each cell, at least 0."""
    return (x - rest).clamp_min(0.0)


def phi(x: NDArray[Any], fault_set: FaultSet) -> NDArray[Any]:
    """The paper's feature selector: drop the faulty cells from ``[..., D]``, giving ``[..., D-k]``
    (Section IV).

    Raises:
        ValueError: the last axis is not D.
    """
    if x.shape[-1] != fault_set.n_cells:
        raise ValueError(
            f"F is over {fault_set.n_cells} cells, the windows have {x.shape[-1]}: {list(x.shape)}"
        )
    return x[..., fault_set.healthy]


def reduce_windows(windows: Windows, fault_set: FaultSet) -> Windows:
    """Apply :func:`phi` to windows."""
    return replace(windows, x=phi(windows.x, fault_set))
