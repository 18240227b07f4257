"""Limits between what a file declares and what it stores: a few bytes may declare more numbers than
any memory holds, or more than can be gone through in hours."""

from __future__ import annotations

import math
import stat
from collections.abc import Sequence
from pathlib import Path

MOST_AT_ONCE = 1 << 30
"""Bytes that may have to be in memory at once, as a chunk or a row group."""

_FREE = 1 << 29  # bytes that a file may declare, whatever it stores: an untouched sensor's zeros
_RATIO = 2000  # of declared to stored bytes beyond that; deflate reaches 1,032


def too_much(declared: int, stored: int) -> str | None:
    """Return why an array is not read that declares so many bytes and stores so many; None where
    it is."""
    if declared <= max(_FREE, _RATIO * stored):
        return None
    return (
        f"declares {declared:,} bytes and stores {stored:,}; write it again with the data that it"
        " holds"
    )


def too_large(sizes: Sequence[int], itemsize: int) -> str | None:
    """Return why chunks of some sizes are not read; None where they are."""
    size = math.prod(sizes) * itemsize
    if size <= MOST_AT_ONCE:
        return None
    return f"has chunks of {size:,} bytes, more than {MOST_AT_ONCE:,}; write it in smaller chunks"


def is_regular(path: Path) -> bool:
    """Return whether a path is a file that ends: no pipe, no device, nor a link to one."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except OSError:
        return False
