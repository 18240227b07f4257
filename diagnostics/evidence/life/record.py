"""The record of a log for the proof of life: mean root loads of short pieces, in constant memory.

A piece is a quarter of a segment. Segments in which no cell is loaded tell nothing about how cells
depend on each other and are not kept; of the others the last ones are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.readings import SEGMENT
from diagnostics.preprocessing.scale import Array

if TYPE_CHECKING:
    from diagnostics.evidence.life.life_model import GroupModel

PIECE = SEGMENT // 4  # frames
KEPT = 128  # segments: a size


@dataclass(frozen=True)
class LifeRecord:
    """Pieces of the last segments with load.

    Attributes:
        root: mean root loads of each segment, ``[pieces, D]``.
        readings: mean readings of the same pieces, ``[pieces, D]``.
        flat: bool ``[pieces, D]``, cells whose readings did not change within the piece.
        ends_as_one: int ``[pieces, G]``, frames at the end of the piece in which a group reads as
            one.
        number: number of each segment.
    """

    root: tuple[Array, ...] = ()
    readings: tuple[Array, ...] = ()
    flat: tuple[NDArray[np.bool_], ...] = ()
    ends_as_one: tuple[NDArray[np.uint8], ...] = ()
    number: tuple[int, ...] = ()

    def extend(
        self,
        root: Array,
        frames: NDArray[np.float64],
        number: int,
        groups: GroupModel | None = None,
    ) -> LifeRecord:
        """Return the record after one more segment.

        Args:
            root: root loads ``[t, D]``.
            frames: readings ``[t, D]``.
            number: of the segment.
            groups: whose frames as one are recorded; None: none.
        """
        if not root.any():
            return self
        begins = np.arange(0, len(root), PIECE)
        # too short for a piece of its own
        if len(begins) > 1 and len(root) - begins[-1] < PIECE // 2:
            begins = begins[:-1]
        length = np.diff(np.append(begins, len(root)))[:, None].astype(np.float32)
        mean_root: Array = (np.add.reduceat(root, begins, axis=0) / length).astype(np.float32)
        mean_reading: Array = (np.add.reduceat(frames, begins, axis=0) / length).astype(np.float32)
        highest = np.maximum.reduceat(frames, begins, axis=0)
        lowest = np.minimum.reduceat(frames, begins, axis=0)
        return LifeRecord(
            (*self.root, mean_root)[-KEPT:],
            (*self.readings, mean_reading)[-KEPT:],
            (*self.flat, highest == lowest)[-KEPT:],
            (*self.ends_as_one, _ends_as_one(root, frames, begins, groups))[-KEPT:],
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
    def constant(self) -> NDArray[np.bool_]:
        """Cells whose readings did not change, of all pieces, bool ``[n, D]``."""
        return np.concatenate(self.flat)

    @property
    def frames_as_one(self) -> NDArray[np.uint8]:
        """Frames at the end of each piece in which a group reads as one, int ``[n, G]``."""
        return np.concatenate(self.ends_as_one)

    @property
    def piece(self) -> NDArray[np.intp]:
        """Number of each piece, counted from the begin of the log, int ``[n]``."""
        first = np.array(self.number, np.intp) * (SEGMENT // PIECE)
        return np.concatenate(
            [begin + np.arange(len(root)) for begin, root in zip(first, self.root, strict=True)]
        )


def _ends_as_one(
    root: Array,
    frames: NDArray[np.float64],
    begins: NDArray[np.intp],
    groups: GroupModel | None,
) -> NDArray[np.uint8]:
    """Return the frames at the end of each piece in which each group reads as one, ``[pieces,
    G]``; ``begins``: int ``[pieces]``, first frame of each."""
    if groups is None:
        return np.zeros((len(begins), 0), np.uint8)
    as_one = groups.as_one(root, frames)
    ends = np.append(begins[1:], len(frames))
    found = [
        np.logical_and.accumulate(as_one[begin:end][::-1]).sum(axis=0)
        for begin, end in zip(begins.tolist(), ends.tolist(), strict=True)
    ]
    return np.asarray(found, np.uint8)
