"""Calibration subset: blocks of a large array with much contact, on which the calibration is
fitted.

Calibration differs little between places of one array, so a subset of about 1000 cells suffices and
the cost does not grow with the array. The blocks are those with the most loaded readings;
differences between places are not seen.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.tiles import MOST_CELLS
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import LIGHT
from diagnostics.preprocessing.readings import CELLS, RecordingBlocks

_SIDE = 24  # rows and columns of a block, at most: nine tiles
_CELLS = 1000  # in all, about: a size

Recordings = Sequence[NDArray[np.float64]]


def calibration_subset(
    recordings: Recordings, layout: SensorLayout
) -> tuple[Recordings, SensorLayout]:
    """Return recordings of the blocks with the most contact, and their layout; a small array is
    returned as it is.

    Recordings without any load on these blocks are left out.

    Args:
        recordings: ``[T, D]`` each.
        layout: the array.
    """
    rows = min(layout.rows, _SIDE)
    cols = min(layout.cols, _SIDE)
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
    loaded = layout.grid(_loaded_frames(readings, layout))
    busiest = np.argsort([-int(loaded[block].sum()) for block in blocks], kind="stable")[:wanted]
    chosen = [blocks[i] for i in sorted(busiest.tolist())]
    index = layout.grid(np.arange(layout.n_cells))
    cells = np.concatenate([index[block].ravel() for block in chosen])
    own = SensorLayout(
        wanted,
        rows,
        cols,
        full_scale=layout.full_scale,
        unit=layout.unit,
        rate=layout.rate,
        present=layout.present.ravel()[cells],
    )
    return _moving(readings, cells, LIGHT * layout.full_scale), own


def _moving(
    readings: RecordingBlocks, cells: NDArray[np.intp], least: float
) -> list[NDArray[np.float64]]:
    """Return the recordings of ``cells`` in which at least one of them moves by more than
    ``least``."""
    found = []
    for i in range(len(readings)):
        frames = readings.piece(i, slice(None), cells)
        if np.fmax.reduce(np.fmax.reduce(frames) - np.fmin.reduce(frames)) > least:
            found.append(frames)
    return found


def _loaded_frames(readings: RecordingBlocks, layout: SensorLayout) -> NDArray[np.intp]:
    """Return in how many of some frames each cell is loaded, int ``[D]``."""
    count = np.zeros(layout.n_cells, np.intp)
    for cells in np.split(np.arange(layout.n_cells), range(CELLS, layout.n_cells, CELLS)):
        frames = readings.thinned(cells)
        count[cells] = (frames - np.fmin.reduce(frames) > LIGHT * layout.full_scale).sum(axis=0)
    return count
