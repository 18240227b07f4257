"""Data sets at an address, as ``hf://datasets/me/touch`` or ``s3://bucket/touch``: what readers
need of one is copied into a cache, through fsspec (extra "remote").

Videos, pictures and whatever else no reader takes stay where they are. Of a Parquet file or a Zarr
store only the columns or arrays are copied that may hold touch, times, episodes or classes: lists
that are no readings of touch, and bytes, are not. Other files are copied as they are. A file that
was copied before is not read again, unless it changed, so that a run that was killed goes on.
Credentials are those that fsspec finds in the environment.

Not detected: a file that changed while its file system shows the same size, time and checksum.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

from adaptfault.data.atomic import atomic_file, atomic_write
from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.datasets.features import VALID, choose
from adaptfault.data.recordings.readers import Reader, suffixes

_TABLES = (".parquet", ".pq")
_TEXTS = (".json", ".jsonl", ".toml", ".csv")  # what describes recordings, whatever readers take
_ARRAYS = (".zarray", "zarr.json")  # what describes an array of a Zarr store
_STORES = (*_ARRAYS, ".zgroup", ".zattrs", ".zmetadata")
_PICTURES = re.compile(r"image|rgb|depth|video|camera|pixel", re.IGNORECASE)
_SAME = ".same"  # ends the name of what says which version of a file was copied
_CACHE = "ADAPTFAULT_CACHE"
_PIECE = 1 << 22  # bytes that are copied at once: a size
_MISSING = "no file system reads this address: pip install 'adaptfault[remote]'"


def fetched(
    address: str, known: Mapping[str, Reader], key: str | None, problems: list[Problem]
) -> Path:
    """Return the copy of what is at an address.

    Args:
        address: of a file or a folder, as fsspec takes it.
        known: the readers.
        key: names of the arrays that hold the readings; None: found by their names.
        problems: gets what could not be copied.

    Raises:
        InputError: fsspec is not installed, or nothing is there, or nobody answers.
    """
    fsspec = imported("fsspec", address, _MISSING)
    try:
        files, root = fsspec.url_to_fs(address)
        listed = files.find(root, detail=True)
        if not listed and files.isfile(root):
            listed = {root: files.info(root)}
    except (ImportError, ValueError) as error:
        raise InputError.at(address, f"{_MISSING} ({_line(error)})") from None
    except Exception as error:  # of a dozen libraries
        what = f"cannot be read ({_line(error)}); check the address and the connection"
        raise InputError.at(address, what) from None
    if not listed:
        raise InputError.at(address, "is not there; check the address")
    copy = _cache() / _safe(address) / PurePosixPath(root).name
    is_file = list(listed) == [root]
    wanted = [name for name in listed if _is_wanted(name, known)]
    folders = {str(PurePosixPath(name).parent) for name in wanted if _last(name) in _STORES}
    pieces = [name for name in listed if name not in wanted and _is_below(name, folders)]
    kept: dict[Path, str] = {}
    arrays: list[str] = []
    for some in (wanted, pieces):
        for name in sorted(some):
            if some is pieces and not _is_below(name, arrays):
                continue
            place = copy if is_file else copy / PurePosixPath(name).relative_to(root)
            try:
                _copied(files, name, listed[name], place, key)
            except Exception as error:
                what = f"cannot be read ({_line(error)}): left out"
                problems.append(Problem("error", located(f"{address}: {name}", what)))
                continue
            kept[place] = name
        if some is wanted:
            arrays = _arrays(kept, key)
    if not kept:
        first = f"; {problems[0].message}" if problems else ""
        raise InputError.at(address, f"is no recording, or holds none that can be read{first}")
    if not is_file:
        _forget_others(copy, set(kept))
    return copy


def _last(name: str) -> str:
    return PurePosixPath(name).name.lower()


def _is_wanted(name: str, known: Mapping[str, Reader]) -> bool:
    """Return whether a reader takes a file by its name, or it describes a Zarr store."""
    return name.lower().endswith((*suffixes(known), *_TEXTS)) or _last(name) in _STORES


def _is_below(name: str, folders: Collection[str]) -> bool:
    """Return whether a file lies in one of some folders, or below it."""
    return any(str(folder) in folders for folder in PurePosixPath(name).parents)


def _arrays(copied: Mapping[Path, str], key: str | None) -> list[str]:
    """Return the folders of those arrays of Zarr stores that a reader may need.

    Args:
        copied: what was copied, and what it is called at the address.
        key: as for :func:`fetched`.
    """
    sizes: dict[str, tuple[int, ...]] = {}
    for place, name in copied.items():
        if _last(name) in _ARRAYS:
            with suppress(ValueError):
                shape = json.loads(place.read_text()).get("shape")
                if isinstance(shape, list):
                    sizes[str(PurePosixPath(name).parent)] = tuple(shape[1:])
    return _needed(sizes, key)


def _copied(files: Any, name: str, about: Any, place: Path, key: str | None) -> None:
    """Copy a file, unless this version of it is there."""
    same = place.with_name(f".{place.name}{_SAME}")
    version = hashlib.sha256(repr((sorted(_version(about).items()), key)).encode()).hexdigest()
    with suppress(OSError):
        if place.is_file() and same.read_text() == version:
            return
    place.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(place) as new:
        if name.lower().endswith(_TABLES):
            # without a cache that reads ahead: what lies between the columns is not wanted
            with files.open(name, "rb", cache_type="none") as file:
                _copy_columns(file, new, key)
        else:
            with files.open(name, "rb") as file, new.open("wb") as written:
                while piece := file.read(_PIECE):
                    written.write(piece)
    atomic_write(same, version.encode())


def _version(about: Mapping[str, Any]) -> dict[str, str]:
    """Return what a file system says of a file that changes with its content."""
    told = ("size", "mtime", "created", "LastModified", "ETag", "etag", "blob_id", "md5Hash")
    return {name: str(about[name]) for name in told if about.get(name) is not None}


def _copy_columns(file: Any, new: Path, key: str | None) -> None:
    """Copy the columns of a Parquet file that a reader may need."""
    parquet = imported("pyarrow.parquet", new)
    held = parquet.ParquetFile(file, pre_buffer=True)  # neighbouring columns in one request
    columns = held.schema_arrow
    wanted = needed(columns, key)
    kept = [field for field in columns if field.name in wanted]
    names = [field.name for field in kept]
    schema = imported("pyarrow", new).schema(kept)
    with parquet.ParquetWriter(new, schema) as written:
        for group in range(held.metadata.num_row_groups):
            table = held.read_row_group(group, columns=names)
            written.write_table(table.select(names))


def needed(columns: Any, key: str | None) -> list[str]:
    """Return which columns of a Parquet file a reader may need.

    Args:
        columns: its schema, of pyarrow.
        key: as for :func:`fetched`.
    """
    types = imported("pyarrow.types", "")
    sizes: dict[str, tuple[int, ...]] = {}
    for field in columns:
        kind = field.type
        if types.is_struct(kind) or types.is_binary(kind) or types.is_large_binary(kind):
            continue
        is_single = not types.is_nested(kind) and not hasattr(kind, "storage_type")
        sizes[field.name] = () if is_single else (2,)  # how many there are does not matter here
    return _needed(sizes, key)


def _needed(sizes: Mapping[str, tuple[int, ...]], key: str | None) -> list[str]:
    """Return which of some arrays a reader may need, of the sizes of a frame in each."""
    try:
        chosen = choose(Path(), sizes, key)
    except InputError:  # several may be meant, or none: told by the reader
        return [name for name, one in sizes.items() if len(one) < 2 or not _PICTURES.search(name)]
    masks = [name for name in sizes if name.removesuffix(VALID) in chosen]
    single = [name for name, one in sizes.items() if not one]
    return list(dict.fromkeys([*chosen, *masks, *single]))


def _forget_others(copy: Path, kept: set[Path]) -> None:
    """Remove copies of files that are no longer at the address."""
    for place in copy.rglob("*"):
        if place.is_file() and place not in kept and not place.name.endswith(_SAME):
            place.unlink()


def _cache() -> Path:
    """Return the folder of the copies."""
    stated = os.environ.get(_CACHE) or os.environ.get("XDG_CACHE_HOME")
    folder = Path(stated) if stated else Path.home() / ".cache"
    return folder / "adaptfault" / "remote"


def _safe(address: str) -> str:
    """Return a name of a folder that stands for an address."""
    told = re.sub(r"[^A-Za-z0-9.-]+", "_", address).strip("_")[-60:]
    return f"{told}-{hashlib.sha256(address.encode()).hexdigest()[:8]}"


def _line(error: BaseException) -> str:
    """Return what an error says, in one short line."""
    said = " ".join(str(error).split())
    return f"{type(error).__name__}: {said[:120]}" if said else type(error).__name__
