"""A lock between processes (flock), which the kernel releases when its holder dies."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class Busy(OSError):
    """Another process holds the lock."""


@contextmanager
def locked(path: Path, *, wait: bool) -> Iterator[None]:
    """Hold the lock on a file; the file is created where missing and stays.

    Raises:
        Busy: another process holds it, and ``wait`` is False.
    """
    import fcntl  # POSIX only, as robots are

    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            raise Busy(f"{path.parent} is being maintained by another process; wait until it ends") from None
        yield
    finally:
        os.close(descriptor)
