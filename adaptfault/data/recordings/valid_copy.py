"""Writes a copy of a data set with which readings are valid in it, beside each array of readings.

The data set itself is only read. ``<array>.valid`` is a bool a reading, with the shape of its
array, in the same group or table: a column of Parquet and LeRobot, an array of HDF5 and Zarr. A
reading that was not checked, as of a recording that was left out, is not valid. Readings stay as
they are.

- LeRobot 2.1, 3.0: the whole folder; ``info.json`` lists the new features, and the statistics of
  touch are those of valid readings (:mod:`adaptfault.data.recordings.formats.datasets.statistics`)
- Parquet: the file
- HDF5: the file
- Zarr: the folder
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.atomic import atomic_file, atomic_folder
from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.datasets import lerobot, lerobot_copy, zarr_store
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.datasets.features import VALID
from adaptfault.data.recordings.formats.datasets.valid_rows import ValidRows
from adaptfault.data.recordings.recording import Recording
from adaptfault.data.recordings.valid import Masks, Places
from diagnostics import SensorLayout

_OF_DATASET = 1 << 16  # bytes of a new array beside its readings
_FORMS = "a LeRobot data set, a Parquet or HDF5 file, or a Zarr store"

Writer = Callable[[Path, Path, Masks, Places], None]


def write_copy(
    path: str | PathLike[str],
    source: str | PathLike[str],
    masks: Masks,
    layout: SensorLayout,
    origins: Sequence[Recording],
) -> None:
    """Write a copy of a data set with masks of its readings.

    Args:
        path: of the copy, which is not there yet.
        source: the data set.
        masks: bool ``[T, D]`` of each recording.
        layout: the array.
        origins: the recordings as they were read.

    Raises:
        InputError: the copy is there already, or the data set is none of these formats, has no
            names of arrays, or frames that are no rows of it.
        OSError: the copy cannot be written; nothing is left behind.
    """
    writer_of(path, source)(Path(path), Path(source), masks, Places(origins, layout))


def writer_of(path: str | PathLike[str], source: str | PathLike[str]) -> Writer:
    """Return what writes a copy of a data set, before anything is read.

    Raises:
        InputError: as :func:`write_copy`.
    """
    path = Path(path)
    source = Path(source)
    if path.exists():
        raise InputError.at(path, "is there already; name a copy that is not")
    if lerobot.accepts(source):
        return _lerobot
    if source.is_dir() and zarr_store.accepts(source):
        return _zarr
    writer = _WRITERS.get(source.suffix.lower())
    if writer is None or not source.is_file():
        what = f"is nothing that --write-copy copies; expected {_FORMS}"
        raise InputError.at(source, f"{what}: --write-valid writes masks of any recordings")
    return writer


def _lerobot(path: Path, source: Path, masks: Masks, places: Places) -> None:
    with atomic_folder(path, replaces=False) as place:
        lerobot_copy.write(place, source, ValidRows(masks, places, source))


def _parquet(path: Path, source: Path, masks: Masks, places: Places) -> None:
    rows = ValidRows(masks, places, source)
    with atomic_file(path) as place:
        lerobot_copy.write_table(place, source, rows)


def _hdf5(path: Path, source: Path, masks: Masks, places: Places) -> None:
    h5py = imported("h5py", source)
    with atomic_file(path) as place:
        shutil.copyfile(source, place)
        with h5py.File(place, "r+") as file:
            by_array = _by_array(masks, places, source, file)
            _require_room(place, by_array)
            for name, mask in by_array.items():
                file.create_dataset(f"{name}{VALID}", data=mask, compression="gzip")


def _require_room(place: Path, masks: Mapping[str, NDArray[np.bool_]]) -> None:
    """Raise OSError where a disk has no room for masks: HDF5 does not survive that it fills."""
    needed = sum(mask.nbytes + _OF_DATASET for mask in masks.values())
    if shutil.disk_usage(place.parent).free < needed:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(place))


def _zarr(path: Path, source: Path, masks: Masks, places: Places) -> None:
    zarr = imported("zarr", source)
    with atomic_folder(path, replaces=False) as place:
        shutil.copytree(source, place, dirs_exist_ok=True)
        root = zarr.open_group(place, mode="r+", use_consolidated=False)
        consolidated = root.metadata.consolidated_metadata is not None
        consolidated |= (place / ".zmetadata").exists()
        for name, mask in _by_array(masks, places, source, root).items():
            root.create_array(f"{name}{VALID}", data=mask)
        if consolidated:
            zarr.consolidate_metadata(place, zarr_format=root.metadata.zarr_format)


def _by_array(
    masks: Masks, places: Places, source: Path, held: Any
) -> Mapping[str, NDArray[np.bool_]]:
    """Return the mask of each array; ``held``: the arrays by name."""
    if not places.arrays:
        raise InputError.at(source, "holds readings without names; a copy needs them")
    found: dict[str, NDArray[np.bool_]] = {}
    for name, whole in places.by_array(masks).items():
        if whole.size != held[name].size:
            what = f"{name} holds {held[name].size} readings, of which {whole.size} were read"
            raise InputError.at(source, f"{what}; a copy needs all of them, in their order")
        found[name] = whole.reshape(held[name].shape)
    return found


_WRITERS: Mapping[str, Writer] = {
    ".parquet": _parquet,
    ".pq": _parquet,
    ".h5": _hdf5,
    ".hdf5": _hdf5,
    ".hdf": _hdf5,
}
