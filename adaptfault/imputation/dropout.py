"""Training augmentation: random cells are removed and imputed, so that the model tolerates imputed
cells."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from adaptfault.data.windows import Windows
from adaptfault.imputation.linear import AffineFill
from adaptfault.imputation.statistics import CellStatistics
from diagnostics import FaultSet, SensorLayout

_WHOLE = 0.2  # share of batch parts that keep all cells
_PARTS = 2  # of a batch, one fault set each
_MOST = 0.9  # largest share of scattered missing cells
_VALIDATED = 16  # fault sets of validation, each applied to a share of the recordings


def random_fault_set(layout: SensorLayout, rng: np.random.Generator) -> FaultSet:
    """Draw a fault set of any shape and size: scattered cells, lines, a block or a whole pad.

    Lines are rows or columns, up to half of them, at random or adjacent, of one pad or at the same
    index on all pads (as a broken address wire does). A whole pad is lost only if there are
    several. At least one cell stays healthy.
    """
    pads, rows, cols = layout.shape
    lost = np.zeros(layout.shape, dtype=bool)
    which = slice(None) if rng.random() < 0.5 else slice(pad := int(rng.integers(pads)), pad + 1)
    match rng.choice(["cells", "lines", "band", "block"] + ["pad"] * (pads > 1)):
        case "cells":
            lost = rng.random(layout.shape) < rng.uniform(0, _MOST)
        case "lines" | "band" as shape:
            axis = int(rng.integers(1, 3))
            n = layout.shape[axis]
            many = int(rng.integers(1, max(2, n // 2 + 1)))
            first = int(rng.integers(n - many + 1))
            lines = (
                np.arange(first, first + many)
                if shape == "band"
                else rng.choice(n, many, replace=False)
            )
            np.moveaxis(lost[which], axis, 0)[lines] = True
        case "block":
            top, bottom = np.sort(rng.choice(rows + 1, 2, replace=False))
            left, right = np.sort(rng.choice(cols + 1, 2, replace=False))
            lost[which, top:bottom, left:right] = True
        case "pad":
            lost[rng.integers(pads)] = True
    cells = np.flatnonzero(lost.ravel() & layout.is_cell)
    if len(cells) == layout.present.sum():
        cells = rng.permutation(cells)[1:]
    return FaultSet(tuple(cells.tolist()), layout.n_cells)


class RandomRepairs:
    """The ``augment`` of training: each part of a batch loses a random fault set, imputed by the
    conditional mean.

    Args:
        layout: the array.
        statistics: of its fault-free frames.
    """

    def __init__(self, layout: SensorLayout, statistics: CellStatistics) -> None:
        self.layout = layout
        self.statistics = statistics

    def __call__(self, x: Tensor, generator: torch.Generator) -> Tensor:
        """Map windows ``[B, T, D]`` on the 0..1 scale to windows of the same shape."""
        rng = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator)))
        return torch.cat(
            [x if rng.random() < _WHOLE else self._repair(x, rng) for x in torch.chunk(x, _PARTS)]
        )

    def beside(self, windows: Windows, seed: int) -> Windows:
        """Return windows twice: as they are, and imputed after random losses; the same for each
        seed."""
        rng = np.random.default_rng(seed)
        group = np.unique(windows.recording, return_inverse=True)[1] % _VALIDATED
        repaired = windows.x.copy()
        for i in range(min(_VALIDATED, group.max() + 1)):
            repaired[group == i] = self._repair(torch.from_numpy(repaired[group == i]), rng).numpy()
        return Windows(
            np.concatenate([windows.x, repaired]),
            np.concatenate([windows.y, windows.y]),
            np.tile(windows.recording, 2),
            {name: np.concatenate([values, values]) for name, values in windows.extra.items()},
        )

    @torch.no_grad()
    def _repair(self, x: Tensor, rng: np.random.Generator) -> Tensor:
        faults = random_fault_set(self.layout, rng)
        filled: Tensor = AffineFill(faults, *self.statistics.conditional_mean(faults))(
            x[..., faults.healthy]
        )
        return filled
