"""Reads Zarr stores, a folder or a ``.zarr.zip``, of versions 2 and 3; needs the extra
"datasets".

The arrays are those whose descriptions lie in the store, not those that consolidated metadata list:
these stay as they were when frames are appended.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from adaptfault.data.recordings.errors import foreseeing
from adaptfault.data.recordings.facts.declared import is_regular, too_large, too_much
from adaptfault.data.recordings.formats.datasets.contents import Contents, kept
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.datasets.reader import reader

SUFFIXES = (".zarr.zip",)

_BLOSC = 16  # bytes of a chunk's head; the last four are its length
_MARKS = (".zgroup", ".zarray", ".zattrs", "zarr.json")
_LONGEST = 1 << 20  # bytes of a description


def accepts(path: Path) -> bool:
    """Return whether a folder is a store."""
    return any((path / mark).is_file() for mark in _MARKS)


_OPEN: list[Any] = []  # the archive that is open


@kept
def opened(path: Path) -> Contents:
    """Return what a folder or an archive holds; its arrays are read where they are looked at.

    Raises:
        InputError: zarr is not installed, or the store is damaged.
    """
    zarr = imported("zarr", path)
    contents = Contents()
    with foreseeing(path, "is no Zarr store, or is damaged ({}); copy it again"):
        if path.is_dir():
            _collect_folder(zarr, path, contents)
        else:
            while _OPEN:
                _OPEN.pop().close()
            archive = zarr.storage.ZipStore(path, mode="r")
            _collect_archive(zarr, path, archive, contents)
            _OPEN.append(archive)
    return contents


open = reader(opened)


def _is_array(folder: Path) -> bool:
    """Return whether a folder is an array by its description."""
    if (folder / ".zarray").exists():
        return True
    described = folder / "zarr.json"
    if not is_regular(described) or described.stat().st_size > _LONGEST:
        return False
    with described.open("rb") as file:
        return bool(json.load(file).get("node_type") == "array")


def _collect_folder(zarr: Any, path: Path, contents: Contents) -> None:
    """Take in the groups and arrays of a folder."""
    for folder, folders, files in os.walk(path):
        folders.sort()
        name = Path(folder).relative_to(path).as_posix().removeprefix(".")
        described = [Path(folder, file) for file in files if file in _MARKS]
        if not all(map(is_regular, described)):
            contents.left_out[name] = "is described by what is no regular file"
            folders.clear()
        elif described and _is_array(Path(folder)):
            _add(zarr, path, path, name, contents, _stored(Path(folder)))
            folders.clear()
        elif described:
            contents.attributes[name] = _attributes([file.read_bytes() for file in described])


def _attributes(descriptions: Sequence[bytes]) -> dict[str, Any]:
    """Return the attributes of a group from the files that describe it."""
    attributes: dict[str, Any] = {}
    for text in descriptions:
        described = json.loads(text)
        is_third = "node_type" in described
        attributes |= described.get("attributes", {}) if is_third else described
    return attributes


def _stored(folder: Path) -> int:
    """Return the bytes of all chunks of an array."""
    total = 0
    for below, _, files in os.walk(folder):
        for file in files:
            if is_regular(Path(below, file)):
                total += Path(below, file).stat().st_size
    return total


def _collect_archive(zarr: Any, path: Path, archive: Any, contents: Contents) -> None:
    """Take in the groups and arrays of an archive."""
    stored: dict[str, int] = {}
    groups: dict[str, list[bytes]] = {}
    arrays: list[str] = []
    with zipfile.ZipFile(path) as file:
        for about in file.infolist():
            folder, _, last = about.filename.rpartition("/")
            if last in _MARKS and about.file_size <= _LONGEST:
                text = file.read(about)
                if last == ".zarray" or json.loads(text).get("node_type") == "array":
                    arrays.append(folder)
                groups.setdefault(folder, []).append(text)
            for above in _above(folder):
                stored[above] = stored.get(above, 0) + about.compress_size
    for name in arrays:
        _add(zarr, archive, path, name, contents, stored[name])
        del groups[name]
    contents.attributes |= {name: _attributes(texts) for name, texts in groups.items()}


def _above(folder: str) -> Iterator[str]:
    """Yield a folder and those above it; chunks of version 3 lie a few below their array."""
    while folder:
        yield folder
        folder = folder.rpartition("/")[0]
    yield ""


def _add(zarr: Any, store: Any, path: Path, name: str, contents: Contents, stored: int) -> None:
    """Take in an array, or why it cannot be read: the others can."""
    called = name or path.stem
    try:
        array = _array(zarr, store, path, name)
        attributes = dict(array.attrs)
    # a codec that is not installed raises any of a dozen kinds, and a damaged description, too
    except Exception as error:
        what = f"cannot be read ({type(error).__name__}: a codec that is not installed, or damage)"
        contents.left_out[called] = what
        return
    if "_ARRAY_DIMENSIONS" in attributes and array.missing is not None:
        attributes.setdefault("_FillValue", array.missing)
    declared = math.prod(array.shape) * array.dtype.itemsize
    why = too_large(array.chunks, array.dtype.itemsize) or too_much(declared, stored)
    if why is None:
        contents.add(called, array, attributes)
    else:
        contents.left_out[called] = why


def _array(zarr: Any, store: Any, path: Path, name: str) -> _Checked:
    return _Checked(zarr.open_array(store, path=name, mode="r"), path)


class _Checked:
    """An array whose chunks are checked before they are read: a pipe or a device has no end, and
    Blosc reads on behind the end of a chunk that was cut off, and returns what lies there."""

    def __init__(self, stored: Any, store: Path) -> None:
        self._stored = stored
        self._folder = store / stored.path if store.is_dir() else None
        self.shape: tuple[int, ...] = tuple(map(int, stored.shape))
        self.dtype: np.dtype[Any] = stored.dtype
        self.chunks: tuple[int, ...] = getattr(stored, "shards", None) or stored.chunks
        self.attrs = stored.attrs

    @property
    def missing(self) -> Any:
        """What xarray writes for a missing reading in Zarr 2; None where there is nothing."""
        metadata = self._stored.metadata
        return metadata.fill_value if metadata.zarr_format == 2 else None

    def __getitem__(self, part: Any) -> Any:
        if self._folder is not None:
            is_last = isinstance(part, tuple)
            axis = len(self.shape) - 1 if is_last else 0
            chosen = part[-1] if is_last else part
            first, last, _ = chosen.indices(self.shape[axis])
            self._check(axis, first, last)
        return self._stored[part]

    def _check(self, axis: int, first: int, last: int) -> None:
        """Check the chunks that hold some places of one axis."""
        grid = [
            range(math.ceil(size / chunk))
            for size, chunk in zip(self.shape, self.chunks, strict=True)
        ]
        chunk = self.chunks[axis]
        grid[axis] = range(first // chunk, math.ceil(last / chunk))
        assert self._folder is not None  # for the type checker
        for place in itertools.product(*grid):
            key = self._stored.metadata.encode_chunk_key(place)
            held = self._folder / key
            if not held.exists():  # one that is not there holds the fill value alone
                continue
            if not is_regular(held):
                raise ValueError(f"{key} is no regular file")
            if self._is_blosc:
                with held.open("rb") as file:
                    stated = file.read(_BLOSC)[-4:]
                if int.from_bytes(stated, "little") != held.stat().st_size:
                    raise ValueError(f"{key} is cut off")

    @property
    def _is_blosc(self) -> bool:
        """Whether each file of the array is a chunk that Blosc compressed last."""
        last = "".join(type(codec).__name__.lower() for codec in self._stored.compressors[-1:])
        return "blosc" in last and getattr(self._stored, "shards", None) is None
