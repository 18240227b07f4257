"""Errors that say that the machine has too little memory, whichever library raises them."""

from __future__ import annotations

import errno
import re

_WORDS = re.compile(
    r"allocat|bad.alloc|out of memory|not enough memory|can't start new thread"
    r"|failed to map segment",
    re.IGNORECASE,
)


def is_shortage(error: BaseException | None) -> bool:
    """Return whether an error, or one that it comes from, is one of too little memory."""
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        if isinstance(error, OSError) and error.errno == errno.ENOMEM:
            return True
        # torch, ONNX Runtime and the loader of libraries have no kind of their own
        if isinstance(error, RuntimeError | ImportError) and _WORDS.search(str(error)):
            return True
        error = error.__cause__ or error.__context__
    return False
