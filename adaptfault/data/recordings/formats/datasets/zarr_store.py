"""Reads Zarr stores, a folder or a ``.zarr.zip``, of versions 2 and 3; needs the extra
"datasets"."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.datasets.hierarchy import Contents, Stated, recordings_of
from adaptfault.data.recordings.recording import Recording, Shape

SUFFIXES = (".zarr.zip",)

_BLOSC = 16  # bytes of a chunk's head; the last four are its length
_MARKS = (".zgroup", ".zarray", ".zattrs", "zarr.json")


def accepts(path: Path) -> bool:
    """Return whether a folder is a store."""
    return any((path / mark).is_file() for mark in _MARKS)


def open(
    path: Path,
    *,
    shape: Shape | None = None,
    key: str | None = None,
    time_column: str | None = None,
    label_column: str | None = None,
    **stated: Any,
) -> list[Recording]:
    """Return the recordings of a store: those that ``episode_ends`` divides, one a group, or one.

    Args:
        path: the folder or the archive.
        shape: ``(pads, rows, cols)`` where the user states it.
        key: names of the arrays that hold the readings, one a pad; None: found by their names
            (:mod:`adaptfault.data.recordings.formats.datasets.features`).
        time_column, label_column: arrays or attributes of times and classes; None: found by name.
        stated: what other readers ask for.

    Raises:
        InputError: zarr is not installed, the store is damaged, or the arrays are not clear.
    """
    return recordings_of(
        path, partial(_opened, path), shape=shape, key=key, stated=Stated(time_column, label_column)
    )


@contextmanager
def _opened(path: Path, names: Sequence[str] | None) -> Iterator[Contents]:
    zarr = imported("zarr", path)
    archive = None
    try:
        archive = None if path.is_dir() else zarr.storage.ZipStore(path, mode="r")
        store = path if archive is None else archive
        root = zarr.open(store, mode="r")
        is_group = isinstance(root, zarr.Group)
        if not is_group:
            members = {path.stem: root}
        elif names is not None:
            members = {name: root[name] for name in names}
        else:
            members = dict(root.members(max_depth=None))
        arrays = {
            name: _Whole(member, path) if _is_blosc(member) and archive is None else member
            for name, member in members.items()
            if isinstance(member, zarr.Array) and member.shape and member.dtype.kind in "iuf"
        }
        attributes = {"": dict(root.attrs)} if is_group else {}
        attributes |= {name: dict(member.attrs) for name, member in members.items()}
        texts = {
            name: [str(value) for value in member[:]]
            for name, member in members.items()
            if isinstance(member, zarr.Array) and member.ndim == 1 and member.dtype.kind in "OUST"
        }
    # a damaged store raises any of a dozen kinds: zarr's, zipfile's, JSON's
    except Exception as error:
        what = f"is no Zarr store, or is damaged ({type(error).__name__}); copy it again"
        raise InputError.at(path, what) from None
    try:
        yield Contents(arrays, attributes, texts)
    finally:
        if archive is not None:
            archive.close()


def _is_blosc(array: Any) -> bool:
    """Return whether each file of an array is a chunk that Blosc compressed last."""
    last = "".join(type(codec).__name__.lower() for codec in array.compressors[-1:])
    return "blosc" in last and getattr(array, "shards", None) is None


class _Whole:
    """An array whose chunks are checked for their length: Blosc reads on behind the end of a chunk
    that was cut off, and returns what lies there."""

    def __init__(self, stored: Any, folder: Path) -> None:
        self._stored = stored
        self._folder = folder / stored.path
        self.shape: tuple[int, ...] = stored.shape
        self.dtype: np.dtype[Any] = stored.dtype

    def __getitem__(self, part: slice) -> Any:
        for key in self._keys(*part.indices(self.shape[0])[:2]):
            chunk = self._folder / key
            if chunk.is_file():  # one that is not there holds the fill value alone
                with chunk.open("rb") as file:
                    stated = file.read(_BLOSC)[-4:]
                if int.from_bytes(stated, "little") != chunk.stat().st_size:
                    raise ValueError(f"{key} is cut off")
        return self._stored[part]

    def _keys(self, first: int, last: int) -> Iterator[str]:
        """Yield the keys of the chunks that hold some rows."""
        size, *others = self._stored.chunks
        rows = range(first // size, math.ceil(last / size))
        grid = [range(math.ceil(n / c)) for n, c in zip(self.shape[1:], others, strict=True)]
        for place in itertools.product(rows, *grid):
            yield self._stored.metadata.encode_chunk_key(place)
