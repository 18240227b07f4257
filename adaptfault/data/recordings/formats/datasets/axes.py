"""Arrays whose first axis is not the time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.infer import sides
from adaptfault.data.recordings.formats.datasets.contents import Array
from adaptfault.data.recordings.recording import Shape

TURNED = "{} has the time as its last axis: read as frames of cells"
"""What is said of such an array."""

DOUBTED = (
    "frames have shape {}, and readings change less along the last axis than along any other: is"
    " the last axis time? Expected [n, T, rows, cols]"
)
"""What is said where the axes of an array are those of recordings, and its last one looks like the
time."""

_SMOOTHER = 3.0  # times, that readings change less along the time than along any other axis
_LONGEST = 40_000_000  # numbers that are looked at to find the time
_SAMPLE = 1_000_000  # of them, where there are more rows
_FRAMES = 10  # fewer do not show how readings change


def is_time_last(
    path: Path, arrays: Mapping[str, Array], shape: Shape | None, times: Sequence[int] = ()
) -> bool:
    """Return whether the last axis of arrays, one a pad, is the time, as MATLAB programs store it:
    only all axes before it together hold the cells of the ``shape`` that the user states, or there
    is a time for each place of the last axis and for none of the first.

    Args:
        path: of the file, for messages.
        arrays: of the readings.
        shape: ``(pads, rows, cols)`` where the user states it.
        times: how many times each array of times beside them holds.

    Raises:
        InputError: no shape is stated, and the last axis looks like the time.
    """
    sizes = [tuple(map(int, array.shape)) for array in arrays.values()]
    if any(len(one) < 2 for one in sizes):
        return False
    if shape is None:
        if times and all(one[-1] in times and one[0] not in times for one in sizes):
            return True
        if all(map(is_smoothest_along_last, arrays.values())):
            raise InputError.at(path, _doubt(arrays))
        return False
    cells = math.prod(shape)
    rest = sum(math.prod(one[1:]) for one in sizes)
    is_one = len(sizes) == 1 and len(sizes[0]) > 2
    has_windows = is_one and rest % cells == 0 and sizes[0][1] == rest // cells
    is_recordings = len(sizes[0]) > 2 and math.prod(sizes[0][2:]) == cells
    is_first = rest == cells or has_windows or is_recordings
    return sum(math.prod(one[:-1]) for one in sizes) == cells and not is_first


def is_smoothest_along_last(array: Array) -> bool:
    """Return whether readings change far less along the last axis, the longest one, than along any
    other: so they do from frame to frame."""
    sizes = tuple(map(int, array.shape))
    row = math.prod(sizes[1:])
    if sizes[-1] < max(_FRAMES, *sizes[:-1]) or row > _LONGEST:
        return False
    try:
        values = np.asarray(array[: max(2, _SAMPLE // row)], dtype=np.float64)
    # a damaged part raises any of a dozen kinds; it is told when it is read
    except Exception:
        return False
    changes = [_change(values, axis) for axis, size in enumerate(values.shape) if size > 1]
    *others, last = changes
    return bool(others) and last > 0 and min(others) > _SMOOTHER * last


def _change(values: NDArray[np.float64], axis: int) -> float:
    """Return the mean change from one reading to the next along an axis."""
    steps = np.abs(np.diff(values, axis=axis))
    steps = steps[np.isfinite(steps)]
    return float(steps.mean()) if steps.size else 0.0


def _doubt(arrays: Mapping[str, Array]) -> str:
    """Return the question whether the last axis is the time, with the options that answer it."""
    name, array = next(iter(arrays.items()))
    *others, frames = map(int, array.shape)
    cells = math.prod(others)
    pads = f"{len(arrays)}x" if len(arrays) > 1 else ""
    grid = "x".join(map(str, others)) if len(others) in (2, 3) else sides(cells)
    stored = "rows x columns x time" if len(others) > 1 else "cells x time"
    first = math.prod(array.shape[1:])
    along = "x".join(map(str, array.shape[1:])) if len(others) in (2, 3) else sides(first)
    return (
        f"{name} is {[*others, frames]}, and readings change least along the last axis: stored as"
        f" {stored}? Then give the array, --shape {pads}{grid} for {frames} frames; if not,"
        f" --shape {pads}{along} for {others[0]} frames"
    )


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
