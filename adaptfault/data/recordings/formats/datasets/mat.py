"""Reads MAT files: version 5 with scipy, version 7.3 with h5py (extra "datasets")."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.datasets import hdf5
from adaptfault.data.recordings.formats.datasets.hierarchy import (
    FULL_SCALES,
    LABELS,
    RATES,
    UNITS,
    Contents,
    Stated,
    recordings_of,
)
from adaptfault.data.recordings.formats.text import read_bytes
from adaptfault.data.recordings.recording import Recording, Shape

SUFFIXES = (".mat",)

_HDF5 = b"\x89HDF"
_HEADER = 512  # bytes that MATLAB writes before the HDF5 file
_SCALARS = (*RATES, *FULL_SCALES, *UNITS, *LABELS)


def open(
    path: Path,
    *,
    shape: Shape | None = None,
    key: str | None = None,
    time_column: str | None = None,
    label_column: str | None = None,
    **stated: Any,
) -> list[Recording]:
    """Return the recordings of a file; fields of structures are named ``structure/field``.

    Args:
        path: the file.
        shape: ``(pads, rows, cols)`` where the user states it.
        key: names of the variables that hold the readings, one a pad; None: found by their names
            (:mod:`adaptfault.data.recordings.formats.datasets.features`).
        time_column, label_column: variables of times and classes; None: found by name.
        stated: what other readers ask for.

    Raises:
        InputError: the file is damaged, or the variables are not clear.
    """
    with path.open("rb") as file:
        head = file.read(_HEADER + len(_HDF5))
    if head.startswith(_HDF5) or head[_HEADER:].startswith(_HDF5):
        return hdf5.open(
            path, shape=shape, key=key, time_column=time_column, label_column=label_column
        )
    _read.cache_clear()  # the file may have changed since
    return recordings_of(
        path, partial(_opened, path), shape=shape, key=key, stated=Stated(time_column, label_column)
    )


@contextmanager
def _opened(path: Path, names: Sequence[str] | None) -> Iterator[Contents]:
    yield _read(path)


@lru_cache(maxsize=1)
def _read(path: Path) -> Contents:
    """Return the content of a file; the last one stays in memory."""
    from io import BytesIO

    from scipy.io import loadmat

    data = read_bytes(path)
    try:
        stored = loadmat(BytesIO(data), simplify_cells=True)  # type: ignore[arg-type]
    # a damaged file raises any of a dozen kinds: scipy's, zlib's, struct's
    except Exception as error:
        what = f"is no MAT file, or is damaged ({type(error).__name__}); save it again"
        raise InputError.at(path, what) from None
    arrays: dict[str, Any] = {}
    texts: dict[str, list[str]] = {}
    attributes: dict[str, dict[str, Any]] = {"": {}}

    def add(name: str, value: Any) -> None:
        if isinstance(value, dict):
            for field, held in value.items():
                if not field.startswith("__"):
                    add(f"{name}/{field}" if name else field, held)
            return
        group, _, last = name.rpartition("/")
        if last.lower() in _SCALARS and np.size(value) == 1:
            attributes.setdefault(group, {})[last] = value
        array = np.asarray(value)
        if array.ndim and array.dtype.kind in "iuf":
            arrays[name] = array
        elif array.ndim == 1 and array.dtype.kind in "UO":
            texts[name] = [str(text) for text in array.tolist()]

    add("", stored)
    return Contents(arrays, attributes, texts)
