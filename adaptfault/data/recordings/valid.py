"""Writes which readings are valid, a bool a cell and frame, beside a data set: never into it.

A reading is valid where its cell exists, is not in F (from the onset of its fault on), and is not
missing. No published contract of data sets has such a field; the names here are

- NPZ: ``valid`` bool ``[n, T, pads, rows, cols]``, ``lengths``, ``names``
- Parquet: ``episode_index``, ``frame_index``, and a column ``observation.tactile.<pad>.valid`` of
  lists for each pad, in the order of the rows of a LeRobot data set
- Zarr: ``data/valid`` ``[N, pads, rows, cols]``, ``meta/episode_ends``
- HDF5: ``episode_<i>/valid`` ``[T, pads, rows, cols]``
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.atomic import atomic_file, atomic_folder
from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.datasets.extra import imported
from diagnostics import Fault, SensorLayout

_SCHEMA = "adaptfault.valid/1"
_IN_STORE = {".zgroup", ".zattrs", ".zmetadata", "data", "meta"}

Masks = Iterator[NDArray[np.bool_]]


def valid_masks(
    recordings: Iterable[NDArray[Any]], faults: Sequence[Fault], layout: SensorLayout
) -> Masks:
    """Yield bool ``[T, D]`` of each recording of a log, in time order."""
    onset = np.full(layout.n_cells, np.iinfo(np.int64).max)
    for fault in faults:
        cells = list(fault.cells)
        onset[cells] = np.minimum(onset[cells], fault.onset or 0)
    present = layout.present.ravel()
    before = 0
    for frames in recordings:
        at = before + np.arange(len(frames))[:, None]
        yield present & (at < onset) & np.isfinite(frames)
        before += len(frames)


def write_valid(
    path: str | PathLike[str], masks: Masks, names: Sequence[str], layout: SensorLayout
) -> None:
    """Write masks into a file of the format that its name ends in.

    Args:
        path: ``.npz``, ``.parquet``, ``.zarr`` or ``.h5``.
        masks: bool ``[T, D]`` of each recording.
        names: of the recordings.
        layout: the array.

    Raises:
        InputError: another ending, the package of the format is not installed, or the path is a
            folder that holds other things than masks.
        OSError: the file cannot be written.
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        what = f"expected a name that ends in {', '.join(_WRITERS)}"
        raise InputError.at(path, what)
    refuse_foreign(path)
    writer(path, masks, names, layout)


def refuse_foreign(path: str | PathLike[str]) -> None:
    """Refuse a folder that :func:`write_valid` did not write, or that holds more than it wrote.

    Raises:
        InputError: with the folder.
    """
    path = Path(path)
    if not path.is_dir() or not any(path.iterdir()) or _is_ours(path):
        return
    raise InputError.at(path, "is a folder that holds other things than masks; choose another name")


def _is_ours(path: Path) -> bool:
    """Return whether a folder is a store of masks, and holds nothing else."""
    try:
        about = json.loads((path / ".zattrs").read_bytes())
        names = {entry.name for entry in path.iterdir()}
    except (OSError, ValueError, RecursionError):
        return False
    ours = isinstance(about, dict) and about.get("schema") == _SCHEMA
    return ours and names <= _IN_STORE


def _npz(path: Path, masks: Masks, names: Sequence[str], layout: SensorLayout) -> None:
    every = list(masks)
    lengths = np.array([len(mask) for mask in every])
    padded = np.zeros((len(every), int(lengths.max()), layout.n_cells), dtype=bool)
    for i, mask in enumerate(every):
        padded[i, : len(mask)] = mask
    with atomic_file(path) as name, name.open("wb") as file:
        np.savez_compressed(
            file,
            valid=padded.reshape(*padded.shape[:2], *layout.shape),
            lengths=lengths,
            names=np.array(names, dtype=np.str_),
        )


def _parquet(path: Path, masks: Masks, names: Sequence[str], layout: SensorLayout) -> None:
    pa = imported("pyarrow", path)
    parquet = imported("pyarrow.parquet", path)
    cells = layout.n_cells // layout.pads
    kinds = pa.list_(pa.bool_(), cells)
    pads = [f"observation.tactile.{pad}.valid" for pad in range(layout.pads)]
    schema = pa.schema(
        [("episode_index", pa.int64()), ("frame_index", pa.int64())]
        + [(name, kinds) for name in pads]
    )
    with atomic_file(path) as place, parquet.ParquetWriter(place, schema) as writer:
        for episode, mask in enumerate(masks):
            by_pad = np.split(mask, layout.pads, axis=1)
            columns = [pa.array(np.full(len(mask), episode)), pa.array(np.arange(len(mask)))]
            columns += [
                pa.FixedSizeListArray.from_arrays(pa.array(part.ravel()), cells) for part in by_pad
            ]
            writer.write_table(pa.table(columns, schema=schema))


def _zarr(path: Path, masks: Masks, names: Sequence[str], layout: SensorLayout) -> None:
    zarr = imported("zarr", path)
    every = list(masks)
    joined = np.concatenate(every).reshape(-1, *layout.shape)
    ends = np.cumsum([len(mask) for mask in every])
    with atomic_folder(path, replaces=_is_ours(path)) as place:
        root = zarr.open_group(place, mode="w", zarr_format=2)
        root.attrs["schema"] = _SCHEMA
        root.create_group("data").create_array("valid", data=joined)
        root.create_group("meta").create_array("episode_ends", data=ends)


def _hdf5(path: Path, masks: Masks, names: Sequence[str], layout: SensorLayout) -> None:
    h5py = imported("h5py", path)
    with atomic_file(path) as place, h5py.File(place, "w") as file:
        for episode, (mask, name) in enumerate(zip(masks, names, strict=True)):
            group = file.create_group(f"episode_{episode}")
            group.attrs["name"] = name
            group.create_dataset("valid", data=mask.reshape(-1, *layout.shape), compression="gzip")


_WRITERS: Mapping[str, Callable[[Path, Masks, Sequence[str], SensorLayout], None]] = {
    ".npz": _npz,
    ".parquet": _parquet,
    ".zarr": _zarr,
    ".h5": _hdf5,
}
