"""Large skins, patch by patch: each patch has touches of its own, and its cells are judged by what surrounds it.

On a skin of thousands of cells something is touched somewhere all the time, so "a touch of the skin" means nothing, and
what happens at one end tells nothing of the other. So a large array is cut into patches that overlap: the cells of a
patch (outputs) are judged by all cells within a few rows and columns (inputs). A patch in which nothing moves costs
nothing; time and memory grow with the cells, never with their square. A small array is a single patch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import SensorLayout

TILE, HALO = 8, 4  # cells: a patch, and how far what surrounds it reaches
MOST_CELLS = 400  # that are judged as one; beyond that, patches

Cells = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Tile:
    """Some neighbouring cells of one pad.

    Attributes:
        inputs, outputs: cell indices, ascending; the inputs hold the outputs.
    """

    inputs: Cells
    outputs: Cells

    @cached_property
    def place(self) -> Cells:
        """Where the outputs lie among the inputs."""
        return np.searchsorted(self.inputs, self.outputs)

    def rectangle(self, layout: SensorLayout) -> Rectangle:
        """Return the patch as an array of its own."""
        row, col = self.inputs // layout.cols % layout.rows, self.inputs % layout.cols
        row, col = row - row.min(), col - col.min()
        present = np.zeros((1, int(row.max()) + 1, int(col.max()) + 1), bool)
        present[0, row, col] = True
        own = SensorLayout(*present.shape, full_scale=layout.full_scale, present=present)
        return Rectangle(own, np.flatnonzero(present))


@dataclass(frozen=True)
class Rectangle:
    """The rectangle that the inputs of a patch lie in.

    Attributes:
        layout: of an array that has no cells but the inputs; cells: int ``[inputs]``, where these are in it.
    """

    layout: SensorLayout
    cells: Cells

    @property
    def full(self) -> bool:
        """Whether no cell of it is absent."""
        return len(self.cells) == self.layout.n_cells

    def on(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return ``values [..., inputs]`` as those of all positions of the rectangle, 0 where no cell is."""
        if self.full:
            return values
        out = np.zeros((*values.shape[:-1], self.layout.n_cells), values.dtype)
        out[..., self.cells] = values
        return out


def tiles(layout: SensorLayout) -> tuple[Tile, ...]:
    """Return the patches of a layout, each cell an output of exactly one; a single one if the cells are few."""
    cells, present = layout.grid(np.arange(layout.n_cells)), layout.present
    if present.sum() <= MOST_CELLS:
        return (Tile(cells.ravel(), cells.ravel()),)
    found = []
    for pad in range(layout.pads):
        for r in range(0, layout.rows, TILE):
            for c in range(0, layout.cols, TILE):
                core = pad, slice(r, r + TILE), slice(c, c + TILE)
                neighbourhood = pad, slice(max(0, r - HALO), r + TILE + HALO), slice(max(0, c - HALO), c + TILE + HALO)
                if present[core].any():
                    found.append(Tile(cells[neighbourhood][present[neighbourhood]], cells[core][present[core]]))
    return tuple(found)
