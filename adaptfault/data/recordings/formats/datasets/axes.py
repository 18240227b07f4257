"""Arrays whose first axis is not the time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.formats.datasets.contents import Array
from adaptfault.data.recordings.recording import Shape


def is_time_last(sizes: tuple[int, ...], shape: Shape | None) -> bool:
    """Return whether the last axis of an array is the time, as MATLAB programs store it: only all
    axes before it together hold the cells of the ``shape`` that the user states."""
    if shape is None or len(sizes) < 2:
        return False
    cells = math.prod(shape)
    rest = math.prod(sizes[1:])
    has_windows = rest % cells == 0 and sizes[1] == rest // cells
    is_recordings = len(sizes) > 2 and math.prod(sizes[2:]) == cells
    is_first = rest == cells or has_windows or is_recordings
    return math.prod(sizes[:-1]) == cells and not is_first


class TimeLast:
    """An array with its last axis as its first."""

    def __init__(self, stored: Any) -> None:
        self._stored = stored
        self.shape = (stored.shape[-1], *stored.shape[:-1])
        self.dtype = stored.dtype

    def __getitem__(self, part: slice) -> NDArray[Any]:
        return np.moveaxis(np.asarray(self._stored[..., part]), -1, 0)


class Vector:
    """An array of one value a frame, ``[T]``, stored as a row or a column, too."""

    def __init__(self, stored: Array) -> None:
        self._stored = stored
        self._is_row = len(stored.shape) == 2 and stored.shape[0] == 1 != stored.shape[1]

    def __getitem__(self, part: slice) -> NDArray[Any]:
        if self._is_row:
            return np.asarray(self._stored[0:1]).ravel()[part]
        return np.asarray(self._stored[part]).ravel()
