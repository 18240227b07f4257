"""A part of a large array that stands for all of it, where something is learned that is the same for every cell.

What evidence is worth differs little from one end of a skin to the other. So it is learned on a few blocks of cells
that were touched often, at a cost that does not grow with the array.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.tiles import MOST_CELLS
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.readings import RecordingBlocks

_SIDE = 24  # rows and columns of a block, at most: nine patches
_CELLS = 1000  # in all, about
_EVERY = 5  # frames looked at to see where an array is touched
_TOUCHED = 0.05  # of full scale, above a cell's lowest reading

Recordings = Sequence[NDArray[np.float64]]


def calibration_subset(recordings: Recordings, layout: SensorLayout) -> tuple[Recordings, SensorLayout]:
    """Return recordings of the blocks of an array that were touched most, as an array of their own; a small one as is.

    Of a large one those recordings are left out in which nothing touches these blocks.

    Args:
        recordings: ``[T, D]`` each.
        layout: the array.
    """
    rows, cols = min(layout.rows, _SIDE), min(layout.cols, _SIDE)
    wanted = max(2, -(-_CELLS // (rows * cols)))
    blocks = [
        (pad, slice(r, r + rows), slice(c, c + cols))
        for pad in range(layout.pads)
        for r in range(0, layout.rows - rows + 1, rows)
        for c in range(0, layout.cols - cols + 1, cols)
    ]
    if layout.present.sum() <= MOST_CELLS or len(blocks) <= wanted:
        return recordings, layout
    readings = RecordingBlocks.of(recordings)
    touched = layout.grid(_touched(readings, layout))
    busiest = np.argsort([-int(touched[block].sum()) for block in blocks], kind="stable")[:wanted]
    chosen = [blocks[i] for i in sorted(busiest.tolist())]
    index = layout.grid(np.arange(layout.n_cells))
    cells = np.concatenate([index[block].ravel() for block in chosen])
    own = SensorLayout(
        wanted, rows, cols, full_scale=layout.full_scale, unit=layout.unit, rate=layout.rate,
        present=layout.present.ravel()[cells],
    )  # fmt: skip
    return _moving(readings, cells, _TOUCHED * layout.full_scale), own


def _moving(readings: RecordingBlocks, cells: NDArray[np.intp], least: float) -> list[NDArray[np.float64]]:
    """Return the recordings, of these cells, in which one of them moves by over ``least``."""
    found = []
    for i in range(len(readings)):
        frames = readings.piece(i, slice(None), cells)
        if np.fmax.reduce(np.fmax.reduce(frames) - np.fmin.reduce(frames)) > least:
            found.append(frames)
    return found


def _touched(readings: RecordingBlocks, layout: SensorLayout) -> NDArray[np.intp]:
    """Return in how many of the frames looked at each cell was touched, ``[D]``."""
    count = np.zeros(layout.n_cells, np.intp)
    for recording in readings:
        load = recording[::_EVERY] - np.fmin.reduce(recording, axis=0)
        count += (load > _TOUCHED * layout.full_scale).sum(axis=0)
    return count
