"""The standard streams: one may be closed, full, read by nobody any more, or know few characters.

None of this changes what a command does. Its exit code is that of its result, where somebody could
read it.
"""

from __future__ import annotations

import io
import logging
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TextIO

from adaptfault.data.printable import printable
from adaptfault.data.shortage import is_shortage

_STREAMS = ("stdin", "stdout", "stderr")
_LONGEST = 2000  # characters of an error


def prepare() -> None:
    """Open streams that are closed, as another file would get their number, and let every
    character be printed."""
    for number, name in enumerate(_STREAMS):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    if sys.stderr is sys.__stderr__ and isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr = _Messages(sys.stderr.buffer, sys.stderr.encoding)


class _Messages(io.TextIOWrapper):
    """Messages on stderr: what nobody reads any more ends no work."""

    def __init__(self, buffer: Any, encoding: str) -> None:
        super().__init__(buffer, encoding, "backslashreplace", line_buffering=True)

    def write(self, text: str) -> int:
        """Write, or let it vanish."""
        try:
            return super().write(text)
        except OSError:
            _discard(self)
        return len(text)

    def flush(self) -> None:
        """Flush, or let it vanish."""
        try:
            super().flush()
        except OSError:
            _discard(self)


def one_line(error: BaseException) -> str:
    """Return an error as one line that a terminal can show."""
    text = printable(" ".join(str(error).split()))
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    if not is_shortage(error):
        return text
    return f"not enough memory ({text})" if text else "not enough memory"


def above_bars(text: str) -> None:
    """Print on stderr, above a progress bar if one is shown."""
    text = printable(text)
    if "tqdm" in sys.modules:
        from tqdm import tqdm

        tqdm.write(text, file=sys.stderr)
    else:
        print(text, file=sys.stderr, flush=True)


class LogAboveBars(logging.Handler):
    """Prints warnings of the library as commands print steps: a line of its own, above a progress
    bar."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message."""
        above_bars(self.format(record))


def settle() -> None:
    """Empty stdout at the end, so that the interpreter finds nothing that cannot be written."""
    try:
        sys.stdout.flush()
    except ValueError:  # closed
        pass
    except OSError:
        _discard(sys.stdout)


def is_unread(error: BaseException) -> bool:
    """Return whether an error comes from stdout, which nobody reads any more."""
    if not isinstance(error, BrokenPipeError):
        return False
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        _discard(sys.stdout)
        return True
    except (OSError, ValueError):
        pass
    return False


def failure_of(write: Callable[[], None]) -> OSError | None:
    """Write on stdout; returns why it failed. That nobody reads it any more is no failure, and what
    is printed later vanishes."""
    try:
        write()
    except OSError as error:
        _discard(sys.stdout)
        return None if isinstance(error, BrokenPipeError) else error
    return None


def _discard(stream: TextIO) -> None:
    """Let what is still printed on a stream vanish."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
