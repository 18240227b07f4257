"""Tiles: a large array is divided into tiles of 8 x 8 cells with a halo of 4, each with its own
contact events.

On an array of thousands of cells some contact always changes somewhere, and distant cells are
independent. The cells of a tile (outputs) are tested given all cells within the halo (inputs), as
in domain decomposition with overlap. Time and memory are linear in the number of cells. An array of
up to 400 cells is one tile.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import SensorLayout

# cells: side of a tile, width of its halo
TILE = 8
HALO = 4
MOST_CELLS = 400  # of a single tile: a size

Cells = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Tile:
    """Some neighbouring cells of one pad.

    Attributes:
        inputs, outputs: int, cell indices, ascending; the inputs include the outputs.
    """

    inputs: Cells
    outputs: Cells

    @cached_property
    def place(self) -> Cells:
        """Position of each output among the inputs, int ``[outputs]``."""
        return np.searchsorted(self.inputs, self.outputs)

    def rectangle(self, layout: SensorLayout) -> Rectangle:
        """Return the bounding rectangle of the inputs."""
        row = self.inputs // layout.cols % layout.rows
        col = self.inputs % layout.cols
        row = row - row.min()
        col = col - col.min()
        present = np.zeros((1, int(row.max()) + 1, int(col.max()) + 1), bool)
        present[0, row, col] = True
        own = SensorLayout(*present.shape, full_scale=layout.full_scale, present=present)
        return Rectangle(own, np.flatnonzero(present))


@dataclass(frozen=True)
class Rectangle:
    """The bounding rectangle of the inputs of a tile, as an array.

    Attributes:
        layout: its only cells are the inputs.
        cells: int ``[inputs]``, index of each input in this layout.
    """

    layout: SensorLayout
    cells: Cells

    @property
    def full(self) -> bool:
        """Whether no cell of it is absent."""
        return len(self.cells) == self.layout.n_cells

    def on(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values ``[..., inputs]`` at all positions of the rectangle, 0 where there is no
        cell."""
        if self.full:
            return values
        out = np.zeros((*values.shape[:-1], self.layout.n_cells), values.dtype)
        out[..., self.cells] = values
        return out


def tiles(layout: SensorLayout) -> tuple[Tile, ...]:
    """Return the tiles of a layout; each cell is an output of exactly one."""
    cells = layout.grid(np.arange(layout.n_cells))
    present = layout.present
    if present.sum() <= MOST_CELLS:
        return (Tile(cells.ravel(), cells.ravel()),)
    found = []
    for pad in range(layout.pads):
        for r in range(0, layout.rows, TILE):
            for c in range(0, layout.cols, TILE):
                core = pad, slice(r, r + TILE), slice(c, c + TILE)
                halo = (
                    pad,
                    slice(max(0, r - HALO), r + TILE + HALO),
                    slice(max(0, c - HALO), c + TILE + HALO),
                )
                if present[core].any():
                    found.append(Tile(cells[halo][present[halo]], cells[core][present[core]]))
    return tuple(found)
