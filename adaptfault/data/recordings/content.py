"""The content of one file, before the array it was recorded from is decided: every format's reader returns it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, Problem

Shape = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Content:
    """The recordings of one file and what the file itself states about them; None = the file does not state it.

    Attributes:
        path: the file.
        frames: one array ``[T, D]`` a recording, as stored: counts keep their integer type.
        counts: True where the readings are stored as whole numbers.
        lines: int ``[T]``, the line of each frame in a text file that holds one recording.
        labels: the class name of each recording.
        class_names: the order of the classes, if the file gives one.
        numbered: the class names are the numbers of the labels, because the file gives no names.
        names: a name for each recording, if the file gives them.
        shape: ``(pads, rows, cols)``.
        present: bool ``[pads, rows, cols]``, False = no sensing element.
        full_scale, unit, rate: as in SensorLayout.
        rate_reason: what the rate was measured from; empty where the file states it.
        stored: shape of the array in the file, where it holds one.
        problems: errors and warnings of the reader.
    """

    path: Path
    frames: tuple[NDArray[Any], ...]
    counts: bool
    lines: NDArray[np.intp] | None = None
    labels: tuple[str, ...] | None = None
    class_names: tuple[str, ...] = ()
    numbered: bool = False
    names: tuple[str, ...] | None = None
    shape: Shape | None = None
    present: NDArray[np.bool_] | None = None
    full_scale: float | None = None
    unit: str | None = None
    rate: float | None = None
    rate_reason: str = ""
    stored: tuple[int, ...] = ()
    problems: tuple[Problem, ...] = ()

    @property
    def width(self) -> int:
        """D, the number of readings in a frame."""
        return int(self.frames[0].shape[1])

    def read_as(self, shape: Shape) -> Content:
        """Return the content for an array of this ``shape``: one recording instead of several if only that fits."""
        if self.shape == shape or grid_shape(self.stored, shape) != shape:
            return self
        if len({len(frames) for frames in self.frames}) != 1:
            return self
        frames = np.stack(self.frames).reshape(self.stored[0], -1)
        return replace(self, frames=(frames,), shape=shape, stored=())

    def where(self, recording: int, frame: int | None = None) -> str:
        """Return the place of a recording or a frame in this file as text; empty for the whole file."""
        if self.lines is not None:
            return "" if frame is None else f"line {self.lines[frame]}"
        parts = [f"recording {recording}"] if len(self.frames) > 1 else []
        return ", ".join(parts if frame is None else [*parts, f"frame {frame}"])

    def error(self, what: str, recording: int = 0, frame: int | None = None) -> InputError:
        """Return the error for something wrong at a place in this file."""
        return InputError.at(self.path, what, self.where(recording, frame))


def grid_shape(sizes: Sequence[int], given: Shape | None = None) -> Shape | None:
    """Return ``(pads, rows, cols)`` of stored frames; None where they are flat.

    Frames of four axes are ``[n, T, rows, cols]``, recordings of one pad. They are one recording
    ``[T, pads, rows, cols]`` if T would be 1, or if the ``given`` shape has those pads, rows and columns. Frames of
    three axes are ``[n, T, D]``, or ``[T, rows, cols]`` if the given shape has those rows and columns.
    """
    sizes = tuple(int(size) for size in sizes)
    if given is not None and len(sizes) == 4 and given[0] > 1 and sizes[1:] == given:
        return given
    if given is not None and len(sizes) == 3 and (1, *sizes[1:]) == given and sizes[2] != math.prod(given):
        return given
    if len(sizes) < 4:
        return None
    return (sizes[-3] if len(sizes) == 5 else 1), sizes[-2], sizes[-1]
