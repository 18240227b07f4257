"""Writes that survive a power failure: a file holds its old content or the new, a new folder is
there."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def atomic_write(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a file so that after any crash, power loss included, it holds the old content or the
    new, never a part.

    A device or a pipe is written to, not replaced.

    Raises:
        OSError: the folder does not exist or cannot be written; nothing is left behind.
    """
    path = Path(path)
    # renaming a file to /dev/null would end it
    if path.exists() and not path.is_file() and not path.is_dir():
        path.write_bytes(data)
        return
    with atomic_file(path) as new:
        new.write_bytes(data)


def atomic_figure(path: str | os.PathLike[str], figure: Any, *, dpi: int) -> None:
    """Write a figure of matplotlib in the format that the name ends in, as :func:`atomic_write`.

    Raises:
        OSError: the folder does not exist or cannot be written.
        ValueError: matplotlib knows no such format.
    """
    picture = io.BytesIO()
    figure.savefig(picture, format=Path(path).suffix[1:] or "png", dpi=dpi)
    atomic_write(path, picture.getvalue())


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield the name of a new file in the same folder, which takes the place of ``path`` at the
    end: for files that are written piece by piece.

    Raises:
        OSError: the folder does not exist or cannot be written; nothing is left behind, as after
            any other error.
    """
    path = Path(path)
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(descriptor)
    try:
        yield Path(name)
        with open(name, "rb+") as file:
            os.fsync(file.fileno())
        os.chmod(name, 0o644)  # mkstemp's 0600 would hide it from the robot's other users
        os.replace(name, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise
    sync(path.parent)  # the rename is durable once the folder is synchronised


@contextlib.contextmanager
def atomic_folder(path: str | os.PathLike[str], *, replaces: bool) -> Iterator[Path]:
    """Yield a new folder beside ``path``, which takes its place at the end, after all of it is
    synchronised.

    Two renames replace a folder: a kill between them leaves none of this name, never a part.

    Args:
        path: of the folder.
        replaces: whether the folder that is there goes; the caller knows that it may.

    Raises:
        OSError: the folder above does not exist or cannot be written, or ``path`` is there and may
            not go; nothing is left behind.
    """
    path = Path(path)
    new = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    old = new / "old"
    whole = new / "new"
    whole.mkdir()
    try:
        yield whole
        sync_tree(whole)
        if replaces and path.exists():
            os.rename(path, old)
        try:
            os.rename(whole, path)
        except OSError:
            if old.exists():
                os.rename(old, path)
            raise
        sync(path.parent)
    finally:
        shutil.rmtree(new, ignore_errors=True)


def make_folder(path: str | os.PathLike[str]) -> None:
    """Create a folder and the missing ones above it, so that they are there after a power cut.

    Raises:
        OSError: a folder cannot be created.
    """
    path = Path(path)
    if path.is_dir():
        return
    if path.exists():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(path))
    make_folder(path.parent)
    path.mkdir(exist_ok=True)
    sync(path.parent)


def sync_tree(folder: Path) -> None:
    """Flush ``folder`` and everything below it to the disk."""
    for path in [*folder.rglob("*"), folder]:
        sync(path)


def sync(path: str | os.PathLike[str]) -> None:
    """Flush a file, or the entries of a folder, to the disk (fsync)."""
    if os.name != "posix":
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
