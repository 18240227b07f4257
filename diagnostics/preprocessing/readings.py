"""Recordings in their own dtype, converted to float64 where they are read: large ones are never
copied whole."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.transport import invalid

Recording = NDArray[np.float64]

SEGMENT = 32  # frames processed together: a size
_MOST_VALUES = 1 << 23  # in a block of frames: a size
# in a sample, about, and frames of each recording: sizes
_RECORDINGS = 200
CELLS = 2000
_FRAMES = 20


class RecordingBlocks(Sequence[Recording]):
    """A sequence of recordings; each item is converted to float64 ``[T, D]``.

    Args:
        given: arrays ``[T, D]`` of numbers, not copied; kept in their own dtype.
    """

    def __init__(self, given: Sequence[NDArray[Any]]) -> None:
        self.given = list(given)

    def __len__(self) -> int:
        return len(self.given)

    @overload
    def __getitem__(self, which: int) -> Recording: ...
    @overload
    def __getitem__(self, which: slice) -> RecordingBlocks: ...
    def __getitem__(self, which: int | slice) -> Recording | RecordingBlocks:
        if isinstance(which, slice):
            return RecordingBlocks(self.given[which])
        return np.asarray(self.given[which], dtype=np.float64)

    def piece(self, which: int, frames: slice, cells: NDArray[np.intp] | slice) -> Recording:
        """Return some frames of some cells of one recording."""
        return np.asarray(self.given[which][frames][:, cells], dtype=np.float64)

    def blocks(self) -> Iterator[Recording]:
        """Yield all frames in order, in blocks of limited size."""
        for given in self.given:
            step = max(1, _MOST_VALUES // given.shape[1])
            for first in range(0, len(given), step):
                yield np.asarray(given[first : first + step], dtype=np.float64)

    @property
    def some(self) -> range:
        """Evenly spread recordings."""
        return range(0, len(self), max(1, len(self) // _RECORDINGS))

    def thinned(self, cells: NDArray[np.intp]) -> Recording:
        """Return evenly spread readings of some cells, ``[n, cells]``."""
        steps = ((i, max(1, len(self.given[i]) // _FRAMES)) for i in self.some)
        return np.concatenate([self.piece(i, slice(None, None, step), cells) for i, step in steps])

    def extremes(self) -> tuple[Recording, Recording]:
        """Return the lowest and the highest reading of each cell, ``[D]``; NaN for a cell without
        any reading."""
        low = high = np.full(self.given[0].shape[1], np.nan)
        for frames in self.blocks():
            low = np.fmin(low, np.fmin.reduce(frames))
            high = np.fmax(high, np.fmax.reduce(frames))
        return low, high

    def valid(self, full_scale: float, present: NDArray[np.bool_]) -> RecordingBlocks:
        """Return the recordings with some readings as missing.

        These are readings that no converter gives, see ``transport.invalid``, and those of
        positions without a cell, not ``present`` (bool ``[D]``): they may read anything.
        """
        checked = []
        for given in self.given:
            if given[:, ~present].any():
                given = np.where(present, given, np.nan)
            wrong = invalid(given, full_scale) if len(given) else None
            checked.append(given if wrong is None else np.where(wrong, np.nan, given))
        return RecordingBlocks(checked)

    def whole(self, present: NDArray[np.bool_]) -> RecordingBlocks:
        """Return the recordings without lost frames, each missing reading replaced by the last one
        of the cell.

        NaN remains before the first reading. Recordings that miss no reading of a ``present`` cell
        (bool ``[D]``) are not copied.

        Raises:
            ValueError: no frame with a reading.
        """
        whole = [
            recording
            for recording in (_whole(given, present) for given in self.given)
            if len(recording)
        ]
        if not whole:
            raise ValueError("the recordings hold no frame with a reading: nothing to learn from")
        return RecordingBlocks(whole)

    @classmethod
    def of(cls, recordings: Sequence[NDArray[Any]]) -> RecordingBlocks:
        """Return ``recordings`` as blocks."""
        return recordings if isinstance(recordings, RecordingBlocks) else cls(recordings)


def spread(cells: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return about 2000 of the cells, evenly spread."""
    return cells[:: max(1, len(cells) // CELLS)]


def held(frames: NDArray[Any], last: NDArray[Any]) -> NDArray[Any]:
    """Return the last reading of each cell, before ``frames`` and at each of them, ``[1 + t, D]``;
    NaN: none yet.

    Args:
        frames: ``[t, D]``; NaN = missing.
        last: ``[D]``, the last reading before them.
    """
    whole = np.concatenate([last[None], frames])
    missing = np.isnan(whole)
    if missing.any():
        at = np.maximum.accumulate(np.where(missing, 0, np.arange(len(whole))[:, None]), axis=0)
        whole = np.take_along_axis(whole, at, axis=0)
    return whole


def _whole(given: NDArray[Any], present: NDArray[np.bool_]) -> NDArray[Any]:
    if not np.isnan(given.min(axis=0)[present]).any():
        return given
    received = given[~np.isnan(given).all(axis=1, where=present)]
    return held(received, np.full(given.shape[1], np.nan))[1:]


def complete(
    recordings: Iterable[NDArray[Any]], otherwise: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Return the recordings ``[T, D]`` with the last reading where one is missing, ``otherwise``
    ``[D]`` before the first, without those that have no reading."""
    each = [np.asarray(recording, dtype=np.float64) for recording in recordings]
    return [held(frames, otherwise)[1:] for frames in each if np.isfinite(frames).any()]
