"""Large skins, patch by patch: each patch has touches of its own, and its cells are judged by what surrounds it.

On a skin of thousands of cells something is touched somewhere all the time, so "a touch of the skin" means nothing, and
what happens at one end tells nothing of the other. So a large array is cut into patches that overlap: the cells of a
patch (outputs) are judged by all cells within a few rows and columns (inputs). A patch in which nothing moves costs
nothing; time and memory grow with the cells, never with their square. A small array is a single patch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.contact_events import EventLog
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.scale import Array

TILE, HALO = 8, 4  # cells: a patch, and how far what surrounds it reaches
MOST_CELLS = 400  # that are judged as one; beyond that, patches

CellState = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Tile:
    """Some neighbouring cells of one pad.

    Attributes:
        inputs, outputs: cell indices, ascending; the inputs hold the outputs.
    """

    inputs: CellState
    outputs: CellState

    @cached_property
    def place(self) -> CellState:
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
    cells: CellState

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


@dataclass(frozen=True, eq=False)
class _Inputs:
    """The inputs of all patches, one after the other: ``cells[starts[i]:starts[i + 1]]`` are those of patch i."""

    cells: CellState
    starts: CellState

    @classmethod
    def of(cls, all_tiles: Sequence[Tile]) -> _Inputs:
        sizes = [len(tile.inputs) for tile in all_tiles]
        return cls(np.concatenate([p.inputs for p in all_tiles]), np.concatenate([[0], np.cumsum(sizes)]))

    def with_any(self, mask: NDArray[np.bool_]) -> list[int]:
        """Return the patches that have an input in ``mask`` (bool ``[D]``)."""
        found: list[int] = np.flatnonzero(np.logical_or.reduceat(mask[self.cells], self.starts[:-1])).tolist()
        return found


@dataclass(frozen=True, eq=False)
class TiledEvents:
    """The touches of each patch so far.

    Attributes:
        patches: of the array; of: the touches of each, over its inputs.
    """

    tiles: tuple[Tile, ...]
    of: tuple[EventLog, ...]
    _inputs: _Inputs
    _needed: tuple[bool, ...]

    @classmethod
    def begin(cls, all_tiles: tuple[Tile, ...], needed: NDArray[np.bool_] | None = None) -> TiledEvents:
        """Nothing seen yet. Patches without an output that is ``needed`` (bool ``[D]``; None: all) stay so."""
        of_each = tuple(needed is None or bool(needed[tile.outputs].any()) for tile in all_tiles)
        return cls(all_tiles, (EventLog(),) * len(all_tiles), _Inputs.of(all_tiles), of_each)

    def extend(
        self,
        root: Array,
        numbers: CellState,
        root_near: float,
        start: CellState,
        jumped: NDArray[np.bool_],
    ) -> TiledEvents:
        """Return the events after more frames, see ``EventLog.extend``; a still tile stays as it is."""
        if len(self.tiles) == 1:
            return self.replaced([self.of[0].extend(root, numbers, root_near, start, jumped)])
        of = list(self.of)
        for i in self._inputs.with_any(start > numbers[0]):
            if self._needed[i]:
                cells = self.tiles[i].inputs
                of[i] = of[i].extend(root[:, cells], numbers, root_near, start[cells], jumped[cells])
        return self.replaced(of)

    def split(self, most: int, keep: int) -> tuple[TiledEvents, TiledEvents]:
        """Return (the events to drop, those to keep): in tiles with more than ``most``, the last ``keep`` stay."""
        none = EventLog()
        parts = [events.split(keep) if len(events.kept) > most else (none, events) for events in self.of]
        return self.replaced([old for old, _ in parts]), self.replaced([kept for _, kept in parts])

    def replaced(self, of: Sequence[EventLog]) -> TiledEvents:
        """Return the same patches with other touches."""
        return replace(self, of=tuple(of))

    def holding(self, cells: NDArray[np.bool_]) -> Iterator[int]:
        """Yield the patches that are needed and have one of the ``cells`` (bool ``[D]``) among their outputs."""
        for i in self._inputs.with_any(cells):
            if self._needed[i] and cells[self.tiles[i].outputs].any():
                yield i

    def kept(self) -> Iterator[tuple[int, EventLog]]:
        """Yield the patches that were touched, and their touches."""
        return ((i, events) for i, events in enumerate(self.of) if events.kept)
