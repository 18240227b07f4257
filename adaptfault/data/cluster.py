"""A Dask cluster, whose workers see the same paths as this machine."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from distributed import Client

WAIT = 60  # s to wait for a cluster's first worker, and without any worker later
_ADDRESS = re.compile(r"(\w+://)?[^\s/]+:\d+")


@contextmanager
def connected(dask: str) -> Iterator[Client]:
    """Return the client of a Dask scheduler that has a worker.

    Args:
        dask: its address, as ``tcp://host:8786``.

    Raises:
        ValueError: Dask is not installed, or the address has no port.
        OSError: no scheduler answers at the address, or it has no worker.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ValueError("a Dask cluster needs Dask: pip install 'dask[distributed]'") from None
    # a client of a wrong address waits for a minute before it fails
    if not _ADDRESS.fullmatch(dask):
        raise ValueError(f"{dask!r}: expected the address of a Dask scheduler, as tcp://host:8786")
    with Client(dask, set_as_default=False) as client:
        try:
            client.wait_for_workers(1, timeout=WAIT)
        except Exception as error:  # its own TimeoutError, which differs between versions
            raise OSError(
                f"the Dask scheduler at {dask} has no worker after {WAIT} s ({error})"
            ) from None
        yield client
