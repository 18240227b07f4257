"""A lock between processes that a crash releases: the kernel's, on a file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class Busy(OSError):
    """Another process holds the lock."""


@contextmanager
def locked(path: Path, *, wait: bool) -> Iterator[None]:
    """Hold the lock on a file, which is made if need be and stays.

    Raises:
        Busy: another process holds it, and ``wait`` is False.
    """
    import fcntl  # POSIX only, as robots are

    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            raise Busy(f"{path.parent} is being maintained by another process; let it end") from None
        yield
    finally:
        os.close(descriptor)
