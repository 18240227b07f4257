"""Size limits: what a file declares is refused before it is read into memory."""

from __future__ import annotations

import io
import math
import stat
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np

from adaptfault.data.recordings.errors import InputError

MOST_BYTES = 2 << 30
"""Bytes that a file may take which has to be read whole."""

LONGEST_LINE = 64 << 20
"""Bytes of a line of text: a million cells of 64 digits."""

MOST_CELLS = 1_000_000
"""Numbers of a frame; more is damage, or an attack on the memory."""

_MOST_TEXT = 4096  # bytes of one text in an array of texts


def check_file(path: Path) -> None:
    """Check that a path is a regular file of a size that can be read whole.

    Raises:
        InputError: a device, a pipe or a folder, or over :data:`MOST_BYTES`.
        OSError: there is no such file.
    """
    size = check_kind(path)
    if size > MOST_BYTES:
        raise InputError.at(
            path,
            f"has {size:,} bytes, more than {MOST_BYTES:,}; split it into several files",
        )


def check_kind(path: Path) -> int:
    """Return the bytes of a regular file.

    Raises:
        InputError: a device, a pipe or a folder.
        OSError: there is no such file.
    """
    about = path.stat()
    if not stat.S_ISREG(about.st_mode):
        raise InputError.at(path, "is not a regular file; copy its content into one")
    return about.st_size


def check_archive(path: Path, archive: zipfile.ZipFile, arrays: tuple[str, ...]) -> None:
    """Check the sizes that the arrays of an NPZ file declare, in the directory of the archive and
    in their headers.

    Raises:
        InputError: they take more than :data:`MOST_BYTES` in all, or one holds texts of over 4096
            bytes.
    """
    total = 0
    for name in arrays:
        try:
            about = archive.getinfo(f"{name}.npy")
        except KeyError:
            continue
        with archive.open(about) as file:
            shape, kind = _header(file)
        if kind.kind in "US" and kind.itemsize > 4 * _MOST_TEXT:
            raise InputError.at(
                path, f"array {name!r} declares texts of {kind.itemsize:,} bytes; shorten them"
            )
        total += max(about.file_size, math.prod(shape) * kind.itemsize)
    if total > MOST_BYTES:
        raise InputError.at(
            path,
            f"declares {total:,} bytes of arrays, more than {MOST_BYTES:,}; split it into several"
            " files",
        )


def check_array(path: Path, data: bytes) -> None:
    """Check that an NPY file holds the bytes that its header declares, so that no larger array is
    allocated.

    Raises:
        InputError: it declares more.
        ValueError: the header cannot be read.
    """
    shape, kind = _header(io.BytesIO(data))
    if (declared := math.prod(shape) * kind.itemsize) > len(data):
        raise InputError.at(
            path,
            f"declares {declared:,} bytes and holds {len(data):,}: it is cut off; write it again",
        )


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return the shape and the type that the header of an array declares."""
    is_first = np.lib.format.read_magic(file) == (1, 0)
    read = np.lib.format.read_array_header_1_0
    if not is_first:
        read = np.lib.format.read_array_header_2_0
    shape, _, kind = read(file)
    return shape, kind
