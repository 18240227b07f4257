"""JSON documents with a checksum and a copy, and SHA-256 hashes of other files."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from adaptfault.data.atomic import atomic_write
from adaptfault.models.builders import ModelNotAllowed

_CHECKSUM = "sha256"
_CHUNK = 1 << 20


class Damaged(ValueError):
    """The content of a file differs from what was written: flipped bit, truncation, or a write by another program."""


def write_checksummed(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON document with the SHA-256 of its content, atomically."""
    checksummed = {**document, _CHECKSUM: _hash(document)}
    atomic_write(path, json.dumps(checksummed, indent=1, allow_nan=False).encode())


def read_checksummed(path: Path, schema: str) -> dict[str, Any]:
    """Read what :func:`write_checksummed` wrote.

    Raises:
        FileNotFoundError: the file does not exist.
        Damaged: the checksum does not match, or the schema differs.
    """
    if path.exists() and not path.is_file():  # a pipe or a device may have no end
        raise Damaged(f"{path} is damaged: expected a file")
    data = path.read_bytes()
    try:
        document = json.loads(data)
        checksum = document.pop(_CHECKSUM)
        found = document["schema"]
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        raise Damaged(f"{path} is damaged: not JSON with a checksum") from None
    if (
        checksum != _hash(document)
        or data != json.dumps({**document, _CHECKSUM: checksum}, indent=1, allow_nan=False).encode()
    ):
        raise Damaged(f"{path} is damaged: its content does not match its checksum")
    if found != schema:
        raise Damaged(f"{path} has schema {found!r}, expected {schema!r}")
    return dict(document)


@contextmanager
def decoding(path: Path) -> Iterator[None]:
    """Raise Damaged for any error in decoding the content of ``path``, whose checksum may be right all the same.

    A model whose builder is not allowed is not damaged.
    """
    try:
        yield
    except (OSError, ImportError, Damaged, ModelNotAllowed):
        raise
    except Exception as error:  # a malformed document raises any of a dozen kinds, SafetensorError among them
        raise Damaged(f"{path} is damaged: {type(error).__name__} {error}") from None


def write_with_copy(path: Path, document: Mapping[str, Any]) -> None:
    """Write a checksummed document, then a copy beside it that is read where the document is damaged."""
    write_checksummed(path, document)
    atomic_write(_copy(path), path.read_bytes())


def read_with_copy(path: Path, schema: str) -> dict[str, Any]:
    """Read what :func:`write_with_copy` wrote; read the copy where the document is damaged or missing.

    Raises:
        FileNotFoundError: neither exists.
        Damaged: neither can be read.
    """
    try:
        return read_checksummed(path, schema)
    except (FileNotFoundError, Damaged):
        if not _copy(path).exists():
            raise
    try:
        return read_checksummed(_copy(path), schema)
    except Damaged:
        raise Damaged(f"{path} and its copy are both damaged") from None


def damage(path: Path, schema: str, *, repair: bool) -> list[str]:
    """Return the damage of a document and its copy; repair one from the other."""
    problems = []
    for one, other in ((path, _copy(path)), (_copy(path), path)):
        try:
            read_checksummed(one, schema)
        except (FileNotFoundError, Damaged) as error:
            problems.append(f"{one} is missing" if isinstance(error, FileNotFoundError) else str(error))
            with suppress(FileNotFoundError, Damaged):
                read_checksummed(other, schema)
                if repair:
                    atomic_write(one, other.read_bytes())
    return problems


def _copy(path: Path) -> Path:
    return path.with_suffix(".copy" + path.suffix)


def hash_files(folder: Path, *, without: str = "") -> dict[str, str]:
    """Return the SHA-256 of each file below ``folder``, by relative path, except the file ``without``."""
    files = (p for p in sorted(folder.rglob("*")) if p.is_file())
    return {name: hash_file(p) for p in files if (name := p.relative_to(folder).as_posix()) != without}


def check_files(folder: Path, hashes: Mapping[str, str]) -> None:
    """Compare the files of a folder with recorded hashes.

    Raises:
        Damaged: one is missing or differs.
    """
    for name, expected in hashes.items():
        path = folder / name
        if not path.is_file():
            raise Damaged(f"{path} is missing")
        if hash_file(path) != expected:
            raise Damaged(f"{path} is damaged: its SHA-256 differs from the recorded one")


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file's content."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def sync_tree(folder: Path) -> None:
    """Flush ``folder`` and everything below it to the disk (fsync)."""
    for path in [*folder.rglob("*"), folder]:
        sync(path)


def sync(path: Path) -> None:
    """Flush a file, or the entries of a folder, to the disk (fsync)."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _hash(document: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True, allow_nan=False).encode()).hexdigest()
