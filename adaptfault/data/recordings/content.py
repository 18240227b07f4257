"""What one file holds, before it is known which array it was recorded from: what every format's reader returns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, Problem

Shape = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Content:
    """The recordings of one file and what the file itself says about them; None = the file does not say.

    Attributes:
        path: the file.
        frames: one array ``[T, D]`` a recording, as stored: counts keep their integer type.
        counts: True where the readings are whole numbers by the way they were written.
        lines: int ``[T]``, the line of each frame in a text file that holds one recording.
        labels: the class name of each recording.
        class_names: the order of the classes, if the file gives one.
        names: a name for each recording, if the file gives them.
        shape: ``(pads, rows, cols)``.
        present: bool ``[pads, rows, cols]``, False = no sensing element.
        full_scale, unit, rate: as in SensorLayout.
        problems: what the reader noticed.
    """

    path: Path
    frames: tuple[NDArray[Any], ...]
    counts: bool
    lines: NDArray[np.intp] | None = None
    labels: tuple[str, ...] | None = None
    class_names: tuple[str, ...] = ()
    names: tuple[str, ...] | None = None
    shape: Shape | None = None
    present: NDArray[np.bool_] | None = None
    full_scale: float | None = None
    unit: str | None = None
    rate: float | None = None
    problems: tuple[Problem, ...] = ()

    @property
    def width(self) -> int:
        """D, the number of readings in a frame."""
        return int(self.frames[0].shape[1])

    def where(self, recording: int, frame: int | None = None) -> str:
        """Return the place of a recording or a frame in this file, in words; empty where it is the whole file."""
        if self.lines is not None:
            return "" if frame is None else f"line {self.lines[frame]}"
        parts = [f"recording {recording}"] if len(self.frames) > 1 else []
        return ", ".join(parts if frame is None else [*parts, f"frame {frame}"])

    def error(self, what: str, recording: int = 0, frame: int | None = None) -> InputError:
        """Return the error for something wrong at a place in this file."""
        return InputError.at(self.path, what, self.where(recording, frame))
