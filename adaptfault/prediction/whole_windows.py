"""Adapted models as functions of whole windows, for the export: what a dropped cell reads cannot
reach the output."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from adaptfault.adaptation.cell_summary import COURSE, CellSummary
from adaptfault.adaptation.reduced_model import ReducedModel, loads
from adaptfault.imputation.linear import AffineFill
from adaptfault.imputation.tiled_statistics import LARGE
from adaptfault.models.heads import Head
from adaptfault.models.kernels import Views
from diagnostics import FaultSet


class Selected(nn.Module):
    """Selects the healthy cells first; the shapes of its tensors depend on F.

    Args:
        model: adapted to F.
        values: its outputs are values, not logits.
    """

    healthy: Tensor

    def __init__(self, model: ReducedModel, *, values: bool = False) -> None:
        super().__init__()
        self.model = model
        self.values = values
        self.register_buffer("healthy", torch.from_numpy(model.fault_set.healthy.copy()))

    def forward(self, x: Tensor) -> Tensor:
        """Map windows ``[N, T, D]`` to probabilities ``[N, n_classes]`` or values ``[N, k]``."""
        outputs: Tensor = self.model(x[..., self.healthy])
        return outputs if self.values else torch.softmax(outputs, dim=1)


class Masked(nn.Module):
    """A model with a head in closed form, on all D cells: no shape and no constant depends on F,
    only its state does.

    A dropped cell reads 0.

    Args:
        model: with a linear front end or none, and a :class:`~adaptfault.models.heads.Head`;
            see :meth:`suits`.
        values: its outputs are values, not logits.
    """

    used: Tensor
    weight: Tensor
    bias: Tensor

    def __init__(self, model: ReducedModel, *, values: bool = False) -> None:
        super().__init__()
        self.values = values
        layout = model.network.layout
        faults = model.fault_set
        d = layout.n_cells
        missing = np.flatnonzero(faults.mask)
        present = layout.is_cell
        weight = torch.zeros(d, d)
        bias = torch.zeros(d)
        if isinstance(model.front, AffineFill):
            with torch.no_grad():
                weight[np.ix_(missing, faults.healthy)] = model.front.weight
                bias[missing] = model.front.bias
        self.register_buffer("used", torch.from_numpy(present & ~faults.mask))
        self.register_buffer("weight", weight)
        self.register_buffer("bias", bias)
        self.network = model.network
        self.summary = CellSummary(layout, FaultSet((), d))
        self.moments = model.moments
        assert isinstance(model.head, Head)
        own = np.flatnonzero(~faults.mask[present])
        course = np.concatenate([own + i * int(present.sum()) for i in range(COURSE)])
        self.head = model.head.with_forest(model.head.forest.reading(course))

    @staticmethod
    def suits(model: ReducedModel) -> bool:
        """Return whether the model has parts of these kinds, and not too many cells for a matrix of
        them."""
        small = model.fault_set.n_cells <= LARGE
        return small and isinstance(model.head, Head) and isinstance(model.front, AffineFill | None)

    def forward(self, x: Tensor) -> Tensor:
        """Map windows ``[N, T, D]`` to probabilities ``[N, n_classes]`` or values ``[N, k]``."""
        known = torch.where(self.used, x, 0.0)
        filled = nn.functional.linear(known, self.weight, self.bias).clamp(0.0, 1.0)
        whole = torch.where(self.used, x, filled)
        rest = self.head.rest
        smooth, course = self.summary(torch.where(self.used, loads(x, rest), 0.0))
        features = self.network.features(whole)
        moments = self.moments(loads(whole, rest))
        outputs: Tensor = self.head(Views(features, smooth, moments, course))
        return outputs if self.values else torch.softmax(outputs, dim=1)
