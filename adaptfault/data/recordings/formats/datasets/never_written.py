"""Which parts of an array in HDF5 were written: the library reads the others as 0, though they hold
no readings."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Written:
    """A mask of an array ``[T, ...]``: where it was written.

    Attributes:
        shape: of the array.
        dtype: bool.
        ends: along each axis, the place behind the last that was written.
    """

    def __init__(self, shape: tuple[int, ...], chunks: tuple[int, ...], held: NDArray[np.bool_]):
        self.shape = shape
        self.dtype = held.dtype
        self._chunks = chunks
        self._held = held
        self.ends = tuple(self._end(axis) for axis in range(len(shape)))

    @classmethod
    def of(cls, stored: Any) -> Written | None:
        """Return the mask of an array of h5py; None where all of it was written, or where nothing
        tells."""
        chunks = stored.chunks
        if chunks is None:
            return None
        shape = tuple(map(int, stored.shape))
        grid = tuple(math.ceil(size / chunk) for size, chunk in zip(shape, chunks, strict=True))
        if stored.id.get_num_chunks() >= math.prod(grid):
            return None
        held = np.zeros(grid, bool)

        def note(chunk: Any) -> None:
            place = tuple(np.floor_divide(chunk.chunk_offset, chunks))
            if np.less(place, grid).all():  # an array that was made smaller keeps its chunks
                held[place] = True

        stored.id.chunk_iter(note)
        return None if held.all() else cls(shape, chunks, held)

    def _end(self, axis: int) -> int:
        others = tuple(other for other in range(len(self.shape)) if other != axis)
        places = np.flatnonzero(self._held.any(axis=others))
        if not len(places):
            return 0
        return min((int(places[-1]) + 1) * self._chunks[axis], self.shape[axis])

    def __getitem__(self, part: Any) -> NDArray[np.bool_]:
        is_last = isinstance(part, tuple)
        chosen = part[-1] if is_last else part
        sliced = len(self.shape) - 1 if is_last else 0
        mask = self._held
        for axis, size in enumerate(self.shape):
            places = np.arange(size)
            if axis == sliced:
                places = places[chosen]
            mask = mask.take(places // self._chunks[axis], axis)
        return mask
