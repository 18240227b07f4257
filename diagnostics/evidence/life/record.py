"""The record of a log for the proof of life: mean root loads of short pieces, in constant memory.

A piece is a quarter of a segment. Segments in which no cell is loaded tell nothing about how cells
depend on each other and are not kept; of the others the last ones are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.readings import SEGMENT
from diagnostics.preprocessing.scale import Array

PIECE = SEGMENT // 4  # frames
KEPT = 128  # segments: a size


@dataclass(frozen=True)
class LifeRecord:
    """Pieces of the last segments with load.

    Attributes:
        root: mean root loads of each segment, ``[pieces, D]``.
        readings: mean readings of the same pieces, ``[pieces, D]``.
        number: number of each segment.
    """

    root: tuple[Array, ...] = ()
    readings: tuple[Array, ...] = ()
    number: tuple[int, ...] = ()

    def extend(self, root: Array, frames: NDArray[np.float64], number: int) -> LifeRecord:
        """Return the record after one more segment: root loads and readings ``[t, D]``, and its
        number."""
        if not root.any():
            return self
        begins = np.arange(0, len(root), PIECE)
        # too short for a piece of its own
        if len(begins) > 1 and len(root) - begins[-1] < PIECE // 2:
            begins = begins[:-1]
        length = np.diff(np.append(begins, len(root)))[:, None].astype(np.float32)
        mean_root: Array = (np.add.reduceat(root, begins, axis=0) / length).astype(np.float32)
        mean_reading: Array = (np.add.reduceat(frames, begins, axis=0) / length).astype(np.float32)
        return LifeRecord(
            (*self.root, mean_root)[-KEPT:],
            (*self.readings, mean_reading)[-KEPT:],
            (*self.number, number)[-KEPT:],
        )

    @property
    def loads(self) -> Array:
        """Mean root loads of all pieces, ``[n, D]``."""
        return np.concatenate(self.root)

    @property
    def means(self) -> Array:
        """Mean readings of all pieces, ``[n, D]``."""
        return np.concatenate(self.readings)

    @property
    def piece(self) -> NDArray[np.intp]:
        """Number of each piece, counted from the begin of the log, int ``[n]``."""
        first = np.array(self.number, np.intp) * (SEGMENT // PIECE)
        return np.concatenate(
            [begin + np.arange(len(root)) for begin, root in zip(first, self.root, strict=True)]
        )
