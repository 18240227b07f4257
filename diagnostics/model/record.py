"""The record of a log: lowest, highest and mean reading of each cell in short pieces.

This is the only code that a frame passes. A piece never crosses the edge of a recording, and a
unit, in which a healthy cell may be odd, is a few successive pieces of one recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]
Cells = NDArray[np.intp]

LONGEST = 8  # frames of a piece
UNIT = 8  # pieces of a unit
_PIECES = 6  # of a short recording


@dataclass(frozen=True)
class Record:
    """Pieces of a log, in order.

    Attributes:
        low, high, mean: readings of each piece, float32 ``[n, D]``; where nothing was received,
            those of the piece before.
        received: bool ``[n, D]``, whether anything was.
        recording: int ``[n]``, from 0.
        begins: int ``[n]``, number of the first frame of each.
        n_frames: of the log.
    """

    low: Array
    high: Array
    mean: Array
    received: Mask
    recording: Cells
    begins: Cells
    n_frames: int

    def __len__(self) -> int:
        return len(self.begins)

    @cached_property
    def first(self) -> Mask:
        """Whether a recording begins with a piece, bool ``[n]``."""
        found: Mask = np.diff(self.recording, prepend=-1) != 0
        return found

    @cached_property
    def of_unit(self) -> Cells:
        """Unit of each piece, int ``[n]``, from 0."""
        first = np.flatnonzero(self.first)
        pieces = np.diff(np.append(first, len(self)))
        within = np.arange(len(self)) - np.repeat(first, pieces)
        found: Cells = np.cumsum(within % UNIT == 0) - 1
        return found

    @cached_property
    def units(self) -> Cells:
        """First piece of each unit, int ``[units]``."""
        return np.flatnonzero(np.diff(self.of_unit, prepend=-1))

    def sum_of_units(self, values: Array) -> Array:
        """Return the sums over the pieces of each unit, ``[units, D]`` of ``[n, D]``."""
        found: Array = np.add.reduceat(values, self.units, axis=0)
        return found

    def ends(self) -> Cells:
        """Return the number of the frame behind each piece, int ``[n]``."""
        return np.append(self.begins[1:], self.n_frames)


def frames_of_piece(recordings: Sequence[NDArray[np.floating]]) -> int:
    """Return the frames of a piece: a recording has some pieces, however short it is."""
    typical = float(np.median([len(one) for one in recordings]))
    return int(np.clip(typical // _PIECES, 1, LONGEST))


def record_of(recordings: Sequence[NDArray[np.floating]], length: int) -> Record:
    """Return the record of recordings ``[T, D]`` each, with about ``length`` frames a piece; NaN:
    missing."""
    starts = []
    number = []
    frame = 0
    for i, one in enumerate(recordings):
        n = max(1, round(len(one) / length))
        starts.append(frame + np.arange(n) * len(one) // n)
        number.append(np.full(n, i))
        frame += len(one)
    begins = np.concatenate(starts)
    x = np.concatenate(recordings).astype(np.float32)
    missing = np.isnan(x)
    low = np.fmin.reduceat(x, begins, axis=0)
    high = np.fmax.reduceat(x, begins, axis=0)
    count = np.diff(np.append(begins, frame))[:, None].astype(np.float32)
    received = np.ones(low.shape, bool)
    if missing.any():
        count = np.add.reduceat((~missing).astype(np.float32), begins, axis=0)
        received = count > 0
        x = np.nan_to_num(x)
    mean = (np.add.reduceat(x, begins, axis=0) / np.maximum(count, 1)).astype(np.float32)
    recording = np.concatenate(number)
    if not received.all():
        last = _last_received(received, recording)
        low = np.take_along_axis(low, last, 0)
        high = np.take_along_axis(high, last, 0)
        mean = np.take_along_axis(mean, last, 0)
        mean[:, ~received.any(axis=0)] = np.nan
    return Record(low, high, mean, received, recording, begins, frame)


def _last_received(received: Mask, recording: Cells) -> Cells:
    """Return the last piece of the same recording in which each cell was received, or the piece
    itself, int ``[n, D]``."""
    piece = np.broadcast_to(np.arange(len(received))[:, None], received.shape)
    last = np.maximum.accumulate(np.where(received, piece, -1), axis=0)
    same = (last >= 0) & (recording[last] == recording[:, None])
    return np.where(same, last, piece)
