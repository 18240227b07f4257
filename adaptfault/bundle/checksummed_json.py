"""JSON documents with a checksum and a copy, and SHA-256 hashes of other files."""

from __future__ import annotations

import errno
import hashlib
import json
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
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


def write_checksummed(path: Path, document: Mapping[str, Any]) -> str:
    """Write a JSON document with the SHA-256 of its content, atomically; return the SHA-256 of the
    file."""
    checksummed = {**document, _CHECKSUM: _hash(document)}
    data = json.dumps(checksummed, indent=1, allow_nan=False).encode()
    atomic_write(path, data)
    return hashlib.sha256(data).hexdigest()


def read_checksummed(path: Path, schema: str) -> dict[str, Any]:
    """Read what :func:`write_checksummed` wrote.

    Raises:
        FileNotFoundError: the file does not exist.
        Damaged: it cannot be read, the checksum does not match, or the schema differs.
    """
    return read_hashed(path, schema)[0]


def read_hashed(path: Path, schema: str) -> tuple[dict[str, Any], str]:
    """Return a document as :func:`read_checksummed`, and the SHA-256 of the bytes that it was
    decoded from."""
    document, data = _checked(path, schema)
    return document, hashlib.sha256(data).hexdigest()


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
    except (OSError, MemoryError) as error:
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


def write_files(folder: Path, files: Mapping[str, bytes]) -> dict[str, str]:
    """Write files into a new folder, by their paths below it; return the SHA-256 of each."""
    hashes = {}
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, data)
        hashes[name] = hashlib.sha256(data).hexdigest()
    return hashes


@dataclass(frozen=True)
class Sealed:
    """A folder of which the hash of each file was recorded: what is read is what was recorded.

    Each read hashes the bytes that it returns, so that nobody can exchange a file between a check
    and its use. A file that was not recorded is not there.

    Attributes:
        folder: on the disk.
        hashes: SHA-256 of each file, by its path below the folder.
    """

    folder: Path
    hashes: Mapping[str, str]

    @property
    def name(self) -> str:
        """The name of the folder."""
        return self.folder.name

    def __contains__(self, name: str) -> bool:
        return name in self.hashes

    def __str__(self) -> str:
        return str(self.folder)

    def below(self, name: str) -> Sealed:
        """Return a folder in this one."""
        inside = f"{name}/"
        hashes = {
            file.removeprefix(inside): digest
            for file, digest in self.hashes.items()
            if file.startswith(inside)
        }
        return Sealed(self.folder / name, hashes)

    def read(self, name: str) -> bytes:
        """Return the content of a file.

        Raises:
            FileNotFoundError: it was not recorded.
            Damaged: it is missing, differs, or cannot be read.
        """
        path = self.folder / name
        if name not in self.hashes:
            raise FileNotFoundError(f"{path} is none of the recorded files")
        with reading(path):
            if not path.is_file():
                raise Damaged(f"{path} is missing")
            data = path.read_bytes()
        self._compare(name, hashlib.sha256(data).hexdigest())
        return data

    def check(self) -> None:
        """Compare all files with their hashes; raises Damaged."""
        for name in self.hashes:
            path = self.folder / name
            with reading(path):
                if not path.is_file():
                    raise Damaged(f"{path} is missing")
                found = hash_file(path)
            self._compare(name, found)

    def write(self, name: str, data: bytes) -> None:
        """Refuse: recorded files are written once."""
        raise PermissionError(f"{self.folder / name} is recorded, and is not written again")

    def remove(self, name: str) -> None:
        """Refuse, as :meth:`write`."""
        self.write(name, b"")

    def _compare(self, name: str, found: str) -> None:
        if found != self.hashes[name]:
            path = self.folder / name
            raise Damaged(f"{path} is damaged: its SHA-256 differs from the recorded one")


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file's content."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def _hash(document: Mapping[str, Any]) -> str:
    return hashlib.sha256(
        json.dumps(document, sort_keys=True, allow_nan=False).encode()
    ).hexdigest()
