"""A lock between processes (flock), which the kernel releases when its holder dies."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class Busy(OSError):
    """Another process holds the lock."""


@contextmanager
def locked(path: Path, *, wait: bool, optional: bool = False) -> Iterator[None]:
    """Hold the lock on a file; the file is created where missing and stays.

    Args:
        path: of the lock file.
        wait: for another process to release it.
        optional: continue without the lock where the file cannot be opened for writing (a read-only disk).

    Raises:
        Busy: another process holds it, and ``wait`` is False.
        OSError: the file cannot be opened, and the lock is not ``optional``.
    """
    import fcntl  # POSIX only, as robots are

    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError:
        if not optional:
            raise
        yield
        return
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            raise Busy(f"{path.parent} is being maintained by another process; wait until it ends") from None
        yield
    finally:
        os.close(descriptor)
