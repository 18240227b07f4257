"""JSON documents that know when they were damaged, and the hashes of the files beside them."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from adaptfault.data.atomic import atomic_write

_SEAL = "sha256"
_CHUNK = 1 << 20


class Damaged(ValueError):
    """A file is not what was written: a flipped bit, a truncation, another program."""


def write_sealed(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON document with the hash of its content; what was there is replaced whole or not at all."""
    sealed = {**document, _SEAL: _hash(document)}
    atomic_write(path, json.dumps(sealed, indent=1, allow_nan=False).encode())


def read_sealed(path: Path, schema: str) -> dict[str, Any]:
    """Read what :func:`write_sealed` wrote.

    Raises:
        FileNotFoundError: there is none.
        Damaged: its content is not the one that was sealed, or it has another schema.
    """
    data = path.read_bytes()
    try:
        document = json.loads(data)
        seal = document.pop(_SEAL)
        found = document["schema"]
    except (ValueError, TypeError, KeyError, AttributeError):
        raise Damaged(f"{path} is damaged: no sealed JSON") from None
    if seal != _hash(document) or data != json.dumps({**document, _SEAL: seal}, indent=1, allow_nan=False).encode():
        raise Damaged(f"{path} is damaged: its content is not the one that was sealed")
    if found != schema:
        raise Damaged(f"{path} has schema {found!r}, expected {schema!r}")
    return dict(document)


def write_twice(path: Path, document: Mapping[str, Any]) -> None:
    """Write a sealed document, then a copy beside it: the document itself is what counts, the copy is a spare."""
    write_sealed(path, document)
    atomic_write(_spare(path), path.read_bytes())


def read_either(path: Path, schema: str) -> dict[str, Any]:
    """Read what :func:`write_twice` wrote, from the copy where the document itself is damaged or missing.

    Raises:
        FileNotFoundError: neither is there.
        Damaged: neither can be read.
    """
    try:
        return read_sealed(path, schema)
    except (FileNotFoundError, Damaged):
        if not _spare(path).exists():
            raise
    try:
        return read_sealed(_spare(path), schema)
    except Damaged:
        raise Damaged(f"{path} and its copy are both damaged") from None


def damage(path: Path, schema: str, *, mend: bool) -> list[str]:
    """Return what is wrong with a document or its copy; mend the one by the other."""
    problems = []
    for one, other in ((path, _spare(path)), (_spare(path), path)):
        try:
            read_sealed(one, schema)
        except (FileNotFoundError, Damaged) as error:
            problems.append(f"{one} is missing" if isinstance(error, FileNotFoundError) else str(error))
            with suppress(FileNotFoundError, Damaged):
                read_sealed(other, schema)
                if mend:
                    atomic_write(one, other.read_bytes())
    return problems


def _spare(path: Path) -> Path:
    return path.with_suffix(".copy" + path.suffix)


def hash_files(folder: Path, *, without: str = "") -> dict[str, str]:
    """Return the SHA-256 of each file below ``folder``, by relative path, except the file ``without``."""
    files = (p for p in sorted(folder.rglob("*")) if p.is_file())
    return {name: hash_file(p) for p in files if (name := p.relative_to(folder).as_posix()) != without}


def check_files(folder: Path, hashes: Mapping[str, str]) -> None:
    """Compare the files of a folder with the hashes that were noted.

    Raises:
        Damaged: one is missing or differs.
    """
    for name, expected in hashes.items():
        path = folder / name
        if not path.is_file():
            raise Damaged(f"{path} is missing")
        if hash_file(path) != expected:
            raise Damaged(f"{path} is damaged: its hash is not the one that was noted")


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file's content."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def sync_tree(folder: Path) -> None:
    """Bring every file and folder below ``folder``, and itself, to the disk."""
    for path in [*folder.rglob("*"), folder]:
        sync(path)


def sync(path: Path) -> None:
    """Bring a file, or the names in a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _hash(document: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True, allow_nan=False).encode()).hexdigest()
