"""What is given as recordings, and as what the diagnosis takes it: a pad for each axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.preprocessing.array_likes import plain_array
from diagnostics.preprocessing.readings import RecordingBlocks

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout


def axis_planes(layout: SensorLayout) -> tuple[SensorLayout, NDArray[np.intp]]:
    """Return the array in which each axis of a pad is a pad of its own, and which cell each of its
    cells is.

    The neighbours of a cell are then cells of the same axis. With one axis: the layout itself.
    """
    cells = np.arange(layout.n_cells).reshape(layout.pads, layout.rows, layout.cols, layout.axes)
    order = np.moveaxis(cells, 3, 1).ravel()
    if layout.axes == 1:
        return layout, order
    rest = "middle" if layout.rest == "learn" else layout.rest
    present = layout.is_cell[order]
    pads = layout.pads * layout.axes
    return replace(
        layout,
        pads=pads,
        axes=1,
        present=present,
        wiring="bus",
        groups=None,
        rest=rest,
        names=None,
    ), order


def checked_recordings(
    recordings: ArrayLike | Sequence[ArrayLike], layout: SensorLayout
) -> RecordingBlocks:
    """Return the recordings as blocks, each ``[T, D]`` with T >= 1."""
    checked = [
        _checked(r, f"recording {i}", layout) for i, r in enumerate(layout.recordings(recordings))
    ]
    checked = [r for r in checked if len(r)]
    if not checked:
        raise ValueError("no frames: expected recordings [T, D] with T >= 1")
    return RecordingBlocks(checked)


def _checked(recording: ArrayLike, name: str, layout: SensorLayout) -> NDArray[Any]:
    """Return a recording as ``[T, D]``, in its own dtype."""
    given = plain_array(recording)
    if given.dtype.kind in "fiu" and given.shape[1:] in (layout.shape, (layout.n_cells,)):
        return given.reshape(len(given), layout.n_cells)
    return layout.check_recording(recording, name)
