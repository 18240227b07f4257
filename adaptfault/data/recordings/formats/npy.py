"""Reads recordings as single NumPy arrays (.npy), piece by piece."""

from __future__ import annotations

import builtins
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.datasets.axes import is_time_last, time_first
from adaptfault.data.recordings.formats.npz import as_recordings, open_numpy
from adaptfault.data.recordings.recording import (
    BLOCK,
    Block,
    Facts,
    Recording,
    Shape,
    cut,
    grid_shape,
)

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
    stored = _Stored.read(path)
    if stored is None or is_time_last(path, {"the array": stored.mapped()}, shape):
        return _whole(path, shape)
    grid = grid_shape(stored.sizes, shape)
    width = math.prod(grid) if grid else stored.sizes[-1]
    frames = math.prod(stored.sizes) // width
    is_one = len(stored.sizes) == 2 or frames == stored.sizes[0]
    recordings = 1 if is_one else stored.sizes[0]
    length = frames // recordings
    facts = Facts(path, counts=stored.kind.kind in "iu", shape=grid, stored=stored.sizes)

    def blocks(i: int) -> Callable[[], Iterator[Block]]:
        return lambda: stored.blocks(i * length, length, width)

    return [Recording(facts, blocks(i)) for i in range(recordings)]


@dataclass(frozen=True)
class _Stored:
    """Where the readings of a file begin, and how they are stored."""

    path: Path
    start: int
    sizes: tuple[int, ...]
    kind: np.dtype[Any]

    @classmethod
    def read(cls, path: Path) -> _Stored | None:
        """Return None where only the reader of whole files can read it, or say what is wrong."""
        try:
            with builtins.open(path, "rb") as file:
                version = np.lib.format.read_magic(file)
                header = {
                    (1, 0): np.lib.format.read_array_header_1_0,
                    (2, 0): np.lib.format.read_array_header_2_0,
                }[version]
                sizes, by_column, kind = header(file)
                start = file.tell()
        # a damaged header raises any of a dozen kinds: numpy's, tokenize's, Python's
        except Exception:
            return None
        if by_column or kind.kind not in "iuf" or not 2 <= len(sizes) <= 5 or 0 in sizes:
            return None
        if path.stat().st_size < start + math.prod(sizes) * kind.itemsize:
            return None
        return cls(path, start, tuple(sizes), kind)

    def mapped(self) -> NDArray[Any]:
        """Return the array, which is read where it is looked at."""
        return np.memmap(self.path, self.kind, "r", self.start, self.sizes)

    def blocks(self, first: int, length: int, width: int) -> Iterator[Block]:
        """Yield ``length`` frames from frame ``first`` on."""
        with builtins.open(self.path, "rb") as file:
            file.seek(self.start + first * width * self.kind.itemsize)
            for at in range(0, length, BLOCK):
                few = min(BLOCK, length - at)
                yield Block(np.fromfile(file, self.kind, few * width).reshape(few, width))


def _whole(path: Path, given: Shape | None) -> list[Recording]:
    array = open_numpy(path)
    if isinstance(array, NpzFile):
        array.close()
        raise InputError.at(path, "is an archive; name it .npz")
    array, problems = time_first(path, "the array", array, given)
    frames, shape = as_recordings(path, array, None, given)
    counts = array.dtype.kind in "iu"
    facts = Facts(path, counts=counts, shape=shape, stored=array.shape, problems=problems)

    def blocks(recording: NDArray[Any]) -> Callable[[], Iterator[Block]]:
        return lambda: cut(recording)

    return [Recording(facts, blocks(recording)) for recording in frames]
