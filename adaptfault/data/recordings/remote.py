"""Data sets at an address, as ``hf://datasets/me/touch`` or ``s3://bucket/touch``: what readers
need of one is copied into a cache, through fsspec (extra "remote").

Videos, pictures and whatever else no reader takes stay where they are. Of a Parquet file only the
columns are copied that may hold touch, times, episodes or classes: lists that are no readings of
touch, and bytes, are not. A file that was copied before is not read again, unless it changed, so
that a run that was killed goes on. Credentials are those that fsspec finds in the environment.

Not detected: a file that changed while its file system shows the same size, time and checksum.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping
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
_STORES = (".zarray", ".zgroup", ".zattrs", ".zmetadata", "zarr.json")
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
    wanted = {name: about for name, about in listed.items() if _is_wanted(name, root, known)}
    kept = set()
    for name in sorted(wanted):
        place = copy if is_file else copy / PurePosixPath(name).relative_to(root)
        try:
            _copied(files, name, wanted[name], place, key)
        except Exception as error:
            what = f"cannot be read ({_line(error)}): left out"
            problems.append(Problem("error", located(f"{address}: {name}", what)))
            continue
        kept.add(place)
    if not kept:
        first = f"; {problems[0].message}" if problems else ""
        raise InputError.at(address, f"is no recording, or holds none that can be read{first}")
    if not is_file:
        _forget_others(copy, kept)
    return copy


def _is_wanted(name: str, root: str, known: Mapping[str, Reader]) -> bool:
    """Return whether a reader takes a file: by its name, or as a piece of a Zarr store."""
    inner = name.removeprefix(root).lower()
    last = PurePosixPath(name).name.lower()
    if inner.endswith((*suffixes(known), *_TEXTS)) or last in _STORES:
        return True
    return ".zarr/" in f"{PurePosixPath(root).name.lower()}/{inner}"


def _copied(files: Any, name: str, about: Any, place: Path, key: str | None) -> None:
    """Copy a file, unless this version of it is there."""
    same = place.with_name(f".{place.name}{_SAME}")
    version = hashlib.sha256(repr((sorted(_version(about).items()), key)).encode()).hexdigest()
    with suppress(OSError):
        if place.is_file() and same.read_text() == version:
            return
    place.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(place) as new, files.open(name, "rb") as file:
        if name.lower().endswith(_TABLES):
            _copy_columns(file, new, key)
        else:
            with new.open("wb") as written:
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
    held = parquet.ParquetFile(file)
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
    single: list[str] = []
    sizes: dict[str, tuple[int, ...]] = {}
    for field in columns:
        kind = field.type
        if types.is_struct(kind) or types.is_binary(kind) or types.is_large_binary(kind):
            continue
        is_single = not types.is_nested(kind) and not hasattr(kind, "storage_type")
        sizes[field.name] = () if is_single else (2,)  # how many there are does not matter here
        if is_single:
            single.append(field.name)
    try:
        chosen = choose(Path(), sizes, key)
    except InputError:  # several may be meant, or none: told by the reader
        return list(sizes)
    masks = [name for name in sizes if name.removesuffix(VALID) in chosen]
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
