"""Reads recordings as single NumPy arrays (.npy), piece by piece."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.datasets.contents import Contents, kept
from adaptfault.data.recordings.formats.npz import array_recordings, frames_of, open_numpy
from adaptfault.data.recordings.recording import Recording, Shape

SUFFIXES = (".npy",)


def open(path: Path, *, shape: Shape | None = None, **stated: Any) -> list[Recording]:
    """Return the recordings of one array with the axes of ``frames`` in an archive
    (:func:`adaptfault.data.recordings.formats.npz.open`), or one recording ``[T, D]``.

    Args:
        path: the array.
        shape: ``(pads, rows, cols)`` where the user states it.
        stated: what other readers ask for.

    Raises:
        InputError: the file is damaged, or the array is of another kind or shape.
    """
    return array_recordings(path, partial(_opened, path), shape)


@kept
def _opened(path: Path) -> Contents:
    try:
        return frames_of(path, _Stored(path))
    # a damaged header raises any of a dozen kinds: numpy's, tokenize's, Python's
    except Exception:
        array = open_numpy(path)  # which says what is wrong
    if isinstance(array, NpzFile):
        array.close()
        raise InputError.at(path, "is an archive; name it .npz")
    return frames_of(path, array)


class _Stored:
    """The array of a file, mapped anew for each slice: what was read does not stay in memory."""

    def __init__(self, path: Path) -> None:
        self._path = path
        stored = self._mapped()
        self.shape: tuple[int, ...] = stored.shape
        self.dtype: np.dtype[Any] = stored.dtype

    def __getitem__(self, part: slice) -> NDArray[Any]:
        return self._mapped()[part]

    def _mapped(self) -> NDArray[Any]:
        stored: NDArray[Any] = np.load(self._path, mmap_mode="r")
        return stored
