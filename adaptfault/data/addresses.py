"""Addresses of data that lie on another machine, beside paths."""

from __future__ import annotations

import re

_ADDRESS = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)


def is_address(path: object) -> bool:
    """Return whether a path is an address that fsspec may read, as ``s3://bucket/set``."""
    return isinstance(path, str) and _ADDRESS.match(path) is not None
