"""Writes which readings are valid, a bool a cell and frame, beside a data set: never into it.

A reading is valid where its cell exists, is not in F (in the recordings in which its fault shows,
or from the onset of the fault on), and is not missing. No published contract of data sets has such
a field; the names here are

- NPZ: ``valid`` bool ``[n, T, pads, rows, cols]``, ``lengths``, ``names``
- Parquet: ``episode_index``, ``frame_index`` and ``index`` as in the data set, and
  ``<feature>.valid``
- Zarr: ``<array>.valid`` ``[N, ...]`` and ``meta/episode_ends``; of groups as in HDF5
- HDF5: ``<array>.valid`` in the groups of the data set (``data/demo_7/obs/tactile.valid``), or in
  ``episode_<i>`` where it has none

Each mask has the shape of the frames of its feature. A data set without names of features, as CSV,
gets ``observation.tactile.<pad>.valid``, ``data/valid`` or ``valid``, ``[..., pads, rows, cols]``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.atomic import atomic_file, atomic_folder
from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.datasets.features import VALID, common_features
from adaptfault.data.recordings.recording import Recording
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
        if fault.recordings is None:
            cells = list(fault.cells)
            onset[cells] = np.minimum(onset[cells], fault.onset or 0)
    present = layout.is_cell
    before = 0
    for number, frames in enumerate(recordings):
        at = before + np.arange(len(frames))[:, None]
        works = present.copy()
        for fault in faults:
            if fault.recordings is not None and number in fault.recordings:
                works[list(fault.cells)] = False
        yield works & (at < onset) & np.isfinite(frames)
        before += len(frames)


def write_valid(
    path: str | PathLike[str],
    masks: Masks,
    names: Sequence[str],
    layout: SensorLayout,
    origins: Sequence[Recording] = (),
) -> None:
    """Write masks into a file of the format that its name ends in.

    Args:
        path: ``.npz``, ``.parquet``, ``.zarr`` or ``.h5``.
        masks: bool ``[T, D]`` of each recording.
        names: of the recordings.
        layout: the array.
        origins: the recordings as they were read, whose arrays give the masks their names.

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
    writer(path, masks, names, Places(origins, layout))


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
        held = set(about.get("holds", ())) | _IN_STORE
    except (OSError, ValueError, RecursionError, AttributeError, TypeError):
        return False
    return about.get("schema") == _SCHEMA and names <= held


class Places:
    """How the masks of recordings are called: as the arrays that hold the readings, where these
    have names.

    Args:
        origins: the recordings as they were read; () = nothing has names.
        layout: the array.

    Attributes:
        arrays: names of the arrays of each recording; empty where one has none.
        features: the names that all recordings have in common, without those of episodes; empty
            where there are none.
        are_own: whether each recording has arrays of its own.
    """

    def __init__(self, origins: Sequence[Recording], layout: SensorLayout) -> None:
        self.layout = layout
        self._origins = origins
        named = bool(origins) and all(one.arrays for one in origins)
        self.arrays = [one.arrays for one in origins] if named else []
        every = [name for names in self.arrays for name in names]
        self.are_own = named and len(set(every)) == len(every)
        self.features = common_features(self.arrays)
        numbers = [one.number for one in origins]
        are_numbered = None not in numbers and len(set(numbers)) == len(numbers)
        self._numbers = numbers if are_numbered else []
        self._of_number = set(self._numbers)

    @property
    def sizes(self) -> tuple[tuple[int, ...], ...]:
        """Of a frame in each array."""
        return self._origins[0].facts.sizes

    def is_read(self, number: int) -> bool:
        """Return whether a recording has this number."""
        return number in self._of_number

    def number(self, i: int) -> int:
        """Return the number of a recording in its data set, else its place."""
        number = self._numbers[i] if self._numbers else None
        return i if number is None else number

    def rows(self, i: int, before: int) -> int:
        """Return how a table numbers the first row of a recording; ``before``: rows of those before
        it."""
        row = self._origins[i].row if self._numbers else None
        return before if row is None else row

    def parts(self, i: int, mask: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
        """Return the mask ``[T, D]`` of a recording as one ``[T, ...]`` for each of its arrays."""
        facts = self._origins[i].facts
        stored = mask if facts.places is None else mask[:, facts.places]
        ends = np.cumsum([math.prod(sizes) for sizes in facts.sizes])[:-1]
        parts = np.split(stored, ends, axis=1)
        return [
            part.reshape(len(mask), *sizes) for part, sizes in zip(parts, facts.sizes, strict=True)
        ]

    def by_array(self, masks: Masks) -> dict[str, NDArray[np.bool_]]:
        """Return the mask of each array, those of its recordings one behind the other."""
        parts: dict[str, list[NDArray[np.bool_]]] = {}
        for i, mask in enumerate(masks):
            for name, part in zip(self.arrays[i], self.parts(i, mask), strict=True):
                parts.setdefault(name, []).append(part)
        return {name: np.concatenate(each) for name, each in parts.items()}

    def grid(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a mask as ``[T, pads, rows, cols]``."""
        return mask.reshape(-1, *self.layout.shape)


def _npz(path: Path, masks: Masks, names: Sequence[str], places: Places) -> None:
    every = list(masks)
    lengths = np.array([len(mask) for mask in every])
    padded = np.zeros((len(every), int(lengths.max()), places.layout.n_cells), dtype=bool)
    for i, mask in enumerate(every):
        padded[i, : len(mask)] = mask
    with atomic_file(path) as name, name.open("wb") as file:
        np.savez_compressed(
            file,
            valid=padded.reshape(*padded.shape[:2], *places.layout.shape),
            lengths=lengths,
            names=np.array(names, dtype=np.str_),
        )


def _parquet(path: Path, masks: Masks, names: Sequence[str], places: Places) -> None:
    pa = imported("pyarrow", path)
    parquet = imported("pyarrow.parquet", path)
    features = places.features or [f"observation.tactile.{p}" for p in range(places.layout.pads)]
    writer = None
    before = 0
    with atomic_file(path) as place:
        for i, mask in enumerate(masks):
            parts = np.split(mask, places.layout.pads, axis=1)
            if places.features:
                parts = places.parts(i, mask)
            frames = np.arange(len(mask))
            columns = {
                "episode_index": pa.array(np.full(len(mask), places.number(i))),
                "frame_index": pa.array(frames),
                "index": pa.array(frames + places.rows(i, before)),
            }
            for name, part in zip(features, parts, strict=True):
                columns[f"{name}{VALID}"] = column_of(pa, part)
            table = pa.table(columns)
            writer = writer or parquet.ParquetWriter(place, table.schema)
            writer.write_table(table)
            before += len(mask)
        if writer is not None:
            writer.close()


def column_of(pa: Any, mask: NDArray[np.bool_]) -> Any:
    """Return a mask ``[T, ...]`` as a column of lists."""
    column = pa.array(mask.ravel())
    sizes = mask.shape[1:]
    for size in reversed(sizes if sizes != (1,) else ()):
        column = pa.FixedSizeListArray.from_arrays(column, size)
    return column


def _zarr(path: Path, masks: Masks, names: Sequence[str], places: Places) -> None:
    zarr = imported("zarr", path)
    every = list(masks)
    arrays: dict[str, NDArray[Any]] = {}
    if places.are_own or len(set(places.arrays)) == 1:
        by_array = places.by_array(iter(every))
        arrays |= {f"{name}{VALID}": mask for name, mask in by_array.items()}
    else:
        arrays["data/valid"] = places.grid(np.concatenate(every))
    if not places.are_own or len(set(places.arrays)) == 1:
        arrays["meta/episode_ends"] = np.cumsum([len(mask) for mask in every])
    with atomic_folder(path, replaces=_is_ours(path)) as place:
        root = zarr.open_group(place, mode="w", zarr_format=2)
        root.attrs["schema"] = _SCHEMA
        root.attrs["holds"] = sorted({name.partition("/")[0] for name in arrays})
        for name, values in arrays.items():
            root.create_array(name, data=values)


def _hdf5(path: Path, masks: Masks, names: Sequence[str], places: Places) -> None:
    h5py = imported("h5py", path)
    # in memory: HDF5 does not survive a disk that fills
    written = BytesIO()
    with h5py.File(written, "w") as file:
        for i, (mask, name) in enumerate(zip(masks, names, strict=True)):
            if places.are_own:
                for array, part in zip(places.arrays[i], places.parts(i, mask), strict=True):
                    held = file.create_dataset(f"{array}{VALID}", data=part, compression="gzip")
                    held.parent.attrs["name"] = name
                continue
            group = file.create_group(f"episode_{places.number(i)}")
            group.attrs["name"] = name
            if not places.arrays:
                group.create_dataset("valid", data=places.grid(mask), compression="gzip")
                continue
            for array, part in zip(places.arrays[i], places.parts(i, mask), strict=True):
                group.create_dataset(f"{array}{VALID}", data=part, compression="gzip")
    with atomic_file(path) as place:
        place.write_bytes(written.getbuffer())


_WRITERS: Mapping[str, Callable[[Path, Masks, Sequence[str], Places], None]] = {
    ".npz": _npz,
    ".parquet": _parquet,
    ".zarr": _zarr,
    ".h5": _hdf5,
}
