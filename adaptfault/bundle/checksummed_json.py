"""JSON documents with a checksum and a copy, and SHA-256 hashes of other files."""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from adaptfault.data.atomic import atomic_write
from adaptfault.models.builders import ModelNotAllowed

_CHECKSUM = "sha256"
_CHUNK = 1 << 20


PASSING = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EAGAIN, errno.EINTR})
"""Errors of the process or the machine, not of the disk: a file that cannot be read now may be
whole."""

_log = logging.getLogger(__name__)


class Damaged(ValueError):
    """The content of a file is not what was written: flipped bit, truncation, another program, or a
    read error."""


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Raise Damaged for an error of the disk while ``path`` is read, as of a worn SD card, or of
    wrong permissions.

    A file that is missing, and an error that passes, as too many open files, are raised as they
    are.
    """
    try:
        yield
    except FileNotFoundError:
        raise
    except OSError as error:
        if error.errno in PASSING:
            raise
        raise Damaged(f"{path} cannot be read: {error.strerror or error}") from None


def write_checksummed(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON document with the SHA-256 of its content, atomically."""
    checksummed = {**document, _CHECKSUM: _hash(document)}
    atomic_write(path, json.dumps(checksummed, indent=1, allow_nan=False).encode())


def read_checksummed(path: Path, schema: str) -> dict[str, Any]:
    """Read what :func:`write_checksummed` wrote.

    Raises:
        FileNotFoundError: the file does not exist.
        Damaged: it cannot be read, the checksum does not match, or the schema differs.
    """
    return _checked(path, schema)[0]


def _checked(path: Path, schema: str) -> tuple[dict[str, Any], bytes]:
    """Return a document and the content of its file; see :func:`read_checksummed`."""
    with reading(path):
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
    return dict(document), data


@contextmanager
def decoding(path: Path) -> Iterator[None]:
    """Raise Damaged for any error in reading or decoding ``path``, whose checksum may be right all
    the same.

    A model whose builder is not allowed is not damaged, nor is one that the memory does not hold
    now.
    """
    try:
        with reading(path):
            yield
    except (OSError, MemoryError, ImportError, Damaged, ModelNotAllowed):
        raise
    except (
        Exception
    ) as error:  # a malformed document raises any of a dozen kinds, SafetensorError among them
        raise Damaged(f"{path} is damaged: {type(error).__name__} {error}") from None


def write_with_copy(path: Path, document: Mapping[str, Any]) -> None:
    """Write a checksummed document, then a copy beside it that is read where the document is
    damaged.

    The document counts once it is written. A copy that cannot be written is logged, and
    :func:`damage` mends it.
    """
    write_checksummed(path, document)
    try:
        atomic_write(_copy(path), path.read_bytes())
    except OSError as error:
        _log.warning("%s cannot be written: %s", _copy(path), error)


def read_with_copy(path: Path, schema: str) -> dict[str, Any]:
    """Read what :func:`write_with_copy` wrote; read the copy where the document is damaged or
    missing.

    Raises:
        FileNotFoundError: neither exists.
        Damaged: neither can be read.
    """
    try:
        return read_checksummed(path, schema)
    except (FileNotFoundError, Damaged) as error:
        first = error
    try:
        return read_checksummed(_copy(path), schema)
    except FileNotFoundError:
        raise first from None
    except Damaged as error:
        raise Damaged(f"{path} and its copy are both damaged ({first}; {error})") from None


def damage(path: Path, schema: str, *, repair: bool) -> list[str]:
    """Return the damage of a document and its copy; repair one from the other.

    A whole copy of an earlier document, as a crash between the two writes leaves it, is brought up
    to date.
    """
    problems = []
    whole: dict[Path, bytes] = {}
    for one in (path, _copy(path)):
        try:
            whole[one] = _checked(one, schema)[1]
        except FileNotFoundError:
            problems.append(f"{one} is missing")
        except Damaged as error:
            problems.append(str(error))
    right = whole.get(path, whole.get(_copy(path)))
    if not repair or right is None:
        return problems
    for one in (path, _copy(path)):
        if whole.get(one) != right:
            atomic_write(one, right)
    return problems


def _copy(path: Path) -> Path:
    return path.with_suffix(".copy" + path.suffix)


def hash_files(folder: Path, *, without: str = "") -> dict[str, str]:
    """Return the SHA-256 of each file below ``folder``, by relative path, except the file
    ``without``."""
    files = (p for p in sorted(folder.rglob("*")) if p.is_file())
    return {
        name: hash_file(p) for p in files if (name := p.relative_to(folder).as_posix()) != without
    }


def check_files(folder: Path, hashes: Mapping[str, str]) -> None:
    """Compare the files of a folder with recorded hashes.

    Raises:
        Damaged: one is missing, differs, or cannot be read.
    """
    for name, expected in hashes.items():
        path = folder / name
        with reading(path):
            if not path.is_file():
                raise Damaged(f"{path} is missing")
            found = hash_file(path)
        if found != expected:
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
    return hashlib.sha256(
        json.dumps(document, sort_keys=True, allow_nan=False).encode()
    ).hexdigest()
