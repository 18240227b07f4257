"""Summaries of the healthy cells of a window: cells with their neighbours, and the course of each
cell over time."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from diagnostics import FaultSet, SensorLayout

COURSE = 5  # numbers of a cell's course
_REACH = 3  # cells on each side that smoothing with a Gaussian of standard deviation 1 uses


class CellSummary(nn.Module):
    """Maps windows of the healthy cells to what does not depend on imputation.

    The first, for kernels, holds the roots of the mean and the maximum over time of smoothed
    readings. The root stabilises the variance: it raises the weight of light contact. A window that
    is shifted by a cell is far from the original in the readings of the cells, but near to it after
    smoothing. The second, for trees, is the course of each cell: mean, maximum, minimum, standard
    deviation and mean step from frame to frame, which texture and noise raise.

    Args:
        layout: the array.
        fault_set: F; its cells are left out.
    """

    seen: Tensor
    source: Tensor
    present: Tensor
    along_rows: Tensor
    along_columns: Tensor

    def __init__(self, layout: SensorLayout, fault_set: FaultSet) -> None:
        super().__init__()
        self.pads, self.rows, self.cols = layout.shape
        present = layout.is_cell
        healthy = fault_set.healthy
        # Where each position of the grid is found in the healthy cells, with a zero behind them for
        # those that lack.
        source = np.full(layout.n_cells, len(healthy))
        source[healthy] = np.where(present[healthy], np.arange(len(healthy)), len(healthy))
        for name, values in (
            ("seen", torch.from_numpy(np.flatnonzero(present[healthy]))),
            ("source", torch.from_numpy(source)),
            ("present", torch.from_numpy(np.flatnonzero(present))),
            ("along_rows", _gauss(self.cols)),
            ("along_columns", _gauss(self.rows)),
        ):
            self.register_buffer(name, values, persistent=False)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map windows ``[N, T, D-k]`` to ``[N, 2 (P + pads)]``, and to ``[N, 5 H]`` of the H
        healthy cells in double precision.

        The first summary has the readings of all P positions of the array, smoothed with a
        Gaussian of one cell (dead cells count as 0), and the sum of each pad.
        """
        n, t = x.shape[:2]
        grid = F.pad(x, (0, 1))[..., self.source].reshape(n, t, self.pads, self.rows, self.cols)
        turned = (grid @ self.along_rows).mT.contiguous()
        smooth = (turned @ self.along_columns).mT.flatten(2)[..., self.present]
        totals = grid.sum((3, 4))
        return _over_time(torch.cat([smooth, totals], dim=2)), _course(x[..., self.seen])


def _gauss(n: int) -> Tensor:
    """Return ``[n, n]``, the weights of n cells in a line in the smoothed value of each."""
    apart = torch.arange(n, dtype=torch.float32)[:, None] - torch.arange(n)
    weights = torch.exp(-apart.square() / 2) * (apart.abs() <= _REACH)
    steps = torch.arange(-_REACH, _REACH + 1, dtype=torch.float32)
    return weights / torch.exp(-steps.square() / 2).sum()


def _over_time(x: Tensor) -> Tensor:
    """Map ``[N, T, p]`` to ``[N, 2 p]``: the roots of mean and maximum."""
    return torch.cat([x.mean(1), x.amax(1)], dim=1).clamp_min(0.0).sqrt()


def _course(x: Tensor) -> Tensor:
    """Map ``[N, T, p]`` to ``[N, 5 p]``: mean, maximum, minimum, standard deviation, mean step."""
    x = x.double()
    mean = x.mean(1)
    spread = (x - mean[:, None]).square().mean(1).sqrt()
    steps = (x[:, 1:] - x[:, :-1]).abs().sum(1) / max(1, x.shape[1] - 1)
    return torch.cat([mean, x.amax(1), x.amin(1), spread, steps], dim=1)
