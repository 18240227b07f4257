"""A lock between processes (flock), which the kernel releases when its holder dies.

By hand, where there is filelock: that one takes a dozen calls for a lock, other ones in each
version, and the tests of power cuts and of failing disks go through every call.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

PATIENCE = 2.0
"""Seconds that a robot waits for another process, which may be stopped while it holds a lock."""

_BETWEEN = 0.02  # seconds between two attempts


class Busy(OSError):
    """Another process holds the lock."""


@contextmanager
def locked(path: Path, *, patience: float = PATIENCE, needed: bool = True) -> Iterator[None]:
    """Hold the lock on a file; the file is created where missing and stays.

    Args:
        path: of the lock file.
        patience: seconds to wait for another process to release it.
        needed: False, for who only reads: go on without the lock where the file cannot be opened
            for writing (a read-only disk), or another process does not release it.

    Raises:
        Busy: another process still holds the lock, and it is needed.
        OSError: the file cannot be opened, and the lock is needed.
    """
    with ExitStack() as stack:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            stack.callback(os.close, descriptor)
            _wait_for(descriptor, path, patience)
        except OSError:
            if needed:
                raise
        yield


def _wait_for(descriptor: int, path: Path, patience: float) -> None:
    """Lock an open file; raises Busy where another process still holds it after ``patience``
    seconds."""
    import fcntl  # POSIX only, as robots are

    end = time.monotonic() + patience
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() >= end:
                break
        time.sleep(_BETWEEN)
    raise Busy(
        f"{path.parent} is being maintained by another process ({path.name} is locked); wait until"
        " it ends"
    )
