"""Reads HDF5 files (ACT, robomimic, laboratories) and MAT files of version 7.3; needs the extra
"datasets"."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.datasets.hierarchy import (
    Array,
    Contents,
    Stated,
    recordings_of,
)
from adaptfault.data.recordings.recording import Recording, Shape

SUFFIXES = (".h5", ".hdf5", ".hdf", ".he5")

_MATLAB = "MATLAB_class"  # attribute of every array that MATLAB wrote


def open(
    path: Path,
    *,
    shape: Shape | None = None,
    key: str | None = None,
    time_column: str | None = None,
    label_column: str | None = None,
    **stated: Any,
) -> list[Recording]:
    """Return the recordings of a file: one, one a group (``demo_0``, ``episode_3``), or those that
    ``episode_ends`` divides.

    Args:
        path: the file.
        shape: ``(pads, rows, cols)`` where the user states it.
        key: names of the arrays that hold the readings, one a pad; None: found by their names
            (:mod:`adaptfault.data.recordings.formats.datasets.features`).
        time_column, label_column: arrays or attributes of times and classes; None: found by name.
        stated: what other readers ask for.

    Raises:
        InputError: h5py is not installed, the file is damaged or being written, or the arrays are
            not clear.
    """
    return recordings_of(
        path, partial(opened, path), shape=shape, key=key, stated=Stated(time_column, label_column)
    )


@contextmanager
def opened(path: Path, names: Sequence[str] | None = None) -> Iterator[Contents]:
    """Open a file for reading; ``names``: of the arrays that are wanted, None: all it holds.

    Raises:
        InputError: as :func:`open`.
    """
    h5py = imported("h5py", path)
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise InputError.at(path, _unreadable(str(error))) from None
    with file:
        if names is not None:
            yield Contents({name: _array(file[name]) for name in names}, {}, {})
            return
        arrays: dict[str, Array] = {}
        texts: dict[str, list[str]] = {}
        attributes = {"": dict(file.attrs)}

        def add(name: str, found: Any) -> None:
            if len(found.attrs):
                attributes[name] = dict(found.attrs)
            if not isinstance(found, h5py.Dataset) or not found.shape:
                return
            if found.dtype.kind in "iuf":
                arrays[name] = _array(found)
            elif found.dtype.kind in "OS" and found.ndim == 1:
                texts[name] = [_text(value) for value in found[:]]

        file.visititems(add)
        yield Contents(arrays, attributes, texts)


def _unreadable(error: str) -> str:
    """Return what a message of HDF5 means, and what to do."""
    if "unable to lock" in error:
        return "is being written by another program; wait until it has closed the file"
    if "consistency flags" in error:
        what = "is being written, or its writer was killed"
        return f"{what}; wait until it is closed, or run h5clear -s on a copy"
    reason = error.split("(")[-1].rstrip(")")
    return f"is no HDF5 file, or is cut off ({reason}); copy it again"


def _array(stored: Any) -> Array:
    """Return an array of a file, with its axes as its writer saw them."""
    array: Array = Reversed(stored) if _MATLAB in stored.attrs else stored
    return array


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


class Reversed:
    """An array that MATLAB wrote: its axes are stored in reverse order."""

    def __init__(self, stored: Any) -> None:
        self._stored = stored

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the axes as MATLAB shows them."""
        return tuple(reversed(self._stored.shape))

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the numbers."""
        kind: np.dtype[Any] = self._stored.dtype
        return kind

    def __getitem__(self, part: slice) -> Any:
        return np.asarray(self._stored[..., part]).T
