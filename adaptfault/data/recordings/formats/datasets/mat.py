"""Reads MAT files: version 5 with scipy, version 7.3 with h5py (extra "datasets")."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from adaptfault.data.recordings.errors import InputError, foreseeing
from adaptfault.data.recordings.facts.roles import is_clock
from adaptfault.data.recordings.facts.sizes import MOST_BYTES
from adaptfault.data.recordings.formats.datasets import hdf5
from adaptfault.data.recordings.formats.datasets.contents import Contents, element, kept
from adaptfault.data.recordings.formats.datasets.reader import reader
from adaptfault.data.recordings.formats.text import read_bytes

SUFFIXES = (".mat",)

_HDF5 = b"\x89HDF"
_HEADER = 512  # bytes that MATLAB writes before the HDF5 file
_HEAD = 128  # bytes before the first element of version 5
_COMPRESSED = 15  # type of an element
_FRAMES = 10  # structures, that they may be frames
_PIECE = 1 << 20  # bytes that are unpacked at once, to count them


@contextmanager
def opened(path: Path, names: Sequence[str] | None = None) -> Iterator[Contents]:
    """Open a file; fields of structures are named ``structure/field``, elements of an array of
    structures or of a cell array ``array/0``, ``array/1``.

    Raises:
        InputError: the file is damaged.
    """
    with path.open("rb") as file:
        head = file.read(_HEADER + len(_HDF5))
    is_hdf5 = head.startswith(_HDF5) or head[_HEADER:].startswith(_HDF5)
    with (hdf5.opened if is_hdf5 else _read)(path, names) as contents:
        yield contents


open = reader(opened)


@kept
def _read(path: Path) -> Contents:
    """Return the content of a file of version 5."""
    from io import BytesIO

    from scipy.io import loadmat

    data = read_bytes(path)
    contents = Contents()
    with foreseeing(path, "is no MAT file, or is damaged ({}); save it again"):
        if _unpacked(data) > MOST_BYTES:
            what = f"unpacks to more than {MOST_BYTES:,} bytes; split it into several files"
            raise InputError.at(path, what)
        stored = loadmat(BytesIO(data), chars_as_strings=True)  # type: ignore[arg-type]
        for name, value in stored.items():
            if not name.startswith("__"):
                _add(contents, name, value)
    return contents


def _unpacked(data: bytes) -> int:
    """Return the bytes of all elements of a file of version 5, unpacked; counting ends above
    :data:`MOST_BYTES`."""
    total = len(data)
    at = _HEAD
    order = "big" if data[126:128] == b"MI" else "little"
    while at + 8 <= len(data) and total <= MOST_BYTES:
        kind = int.from_bytes(data[at : at + 4], order)  # type: ignore[arg-type]
        size = int.from_bytes(data[at + 4 : at + 8], order)  # type: ignore[arg-type]
        at += 8
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            rest = data[at : at + size]
            while rest and not unpacker.eof and total <= MOST_BYTES:
                total += len(unpacker.decompress(rest, _PIECE))
                rest = unpacker.unconsumed_tail
        at += size
    return total


def _are_frames(array: Any) -> bool:
    """Return whether an array of structures has one frame each: a field of times holds one number
    in each."""
    if array.size < _FRAMES:
        return False
    clocks = [field for field in array.dtype.names if is_clock(field)]
    return any(all(np.size(one) == 1 for one in array[field].ravel()) for field in clocks)


def _add(contents: Contents, name: str, value: Any) -> None:
    """Take in a variable: fields of structures and elements of cell arrays one by one."""
    array = np.asarray(value)
    if array.dtype.names and _are_frames(array):
        for field in array.dtype.names:
            held = [np.asarray(one) for one in array[field].ravel()]
            if len({one.shape for one in held}) == 1 and held[0].dtype.kind in "biuf":
                stacked = np.stack(held)
                contents.add(f"{name}/{field}", stacked.squeeze() if held[0].size == 1 else stacked)
    elif array.dtype.names:
        for field in array.dtype.names:
            for place, one in enumerate(array[field].ravel()):
                number = "" if array.size == 1 else f"/{place}"
                _add(contents, f"{name}{number}/{field}", one)
    elif array.dtype.kind == "O" and array.shape:  # without axes: a sparse matrix, a handle
        held = [np.asarray(one) for one in array.ravel()]
        if held and all(one.dtype.kind == "U" for one in held):
            contents.add(name, np.array(["".join(one.ravel()) for one in held]))
            return
        for place, one in enumerate(held):
            _add(contents, name if len(held) == 1 else element(name, place), one)
    elif array.dtype.kind == "U":
        texts = np.char.rstrip(array.ravel())
        contents.add(name, texts.reshape(()) if texts.size == 1 else texts)
    else:
        contents.add(name, array)
