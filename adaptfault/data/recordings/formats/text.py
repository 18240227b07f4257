"""Reads text and JSON files; the error names in one line what is wrong with a file."""

from __future__ import annotations

import codecs
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.sizes import check_file, check_kind

LATIN = "adaptfault.latin"
"""Name of the error handler that takes bytes that are not UTF-8 as latin-1."""


def _as_latin(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeDecodeError):
        raise error
    return error.object[error.start : error.end].decode("latin-1"), error.end


codecs.register_error(LATIN, _as_latin)


def check_text(path: Path) -> None:
    """Raise InputError where a file cannot be read in pieces, or is empty."""
    _opened(path, lambda: b" " if check_kind(path) else b"")


def read_bytes(path: Path) -> bytes:
    """Return the content of a file; InputError where it cannot be read or is empty."""

    def read() -> bytes:
        check_file(path)
        return path.read_bytes()

    return _opened(path, read)


def _opened(path: Path, read: Callable[[], bytes]) -> bytes:
    """Return what ``read`` returns; errors say what is wrong with the file."""
    try:
        data = read()
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError.at(
            path, f"cannot be read ({reason}); check the path and its permissions"
        ) from None
    except InputError:
        raise
    except ValueError:  # a null character in the path
        raise InputError.at(repr(str(path)), "is not a path; check its name") from None
    if not data:
        raise InputError.at(
            path, "is empty (0 bytes); the recording was not written: record it again or remove it"
        )
    return data


def read_text(path: Path) -> str:
    """Return a UTF-8 file (with or without byte order mark) with every line end replaced by a
    newline.

    Raises:
        InputError: the file cannot be read, is empty, binary, or encoded in another way.
    """
    return decoded(path, read_bytes(path))


def decoded(path: Path, data: bytes, *, latin: bool = False) -> str:
    """Return the content ``data`` of a file as :func:`read_text` does; with ``latin``, what is not
    UTF-8 is latin-1."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError.at(path, "is UTF-16 text; save it as UTF-8")
    if b"\0" in data:
        raise InputError.at(path, "is not a text file (it holds zero bytes); save it as UTF-8 text")
    try:
        text = data.decode("utf-8-sig", LATIN if latin else "strict")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        what = f"is not UTF-8 text (byte 0x{data[error.start]:02x}); save it as UTF-8"
        raise InputError.at(path, what, f"line {line}") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def numbered_lines(text: str) -> tuple[list[str], list[int]]:
    """Return the lines that are not blank and their numbers in the file, counted from 1."""
    held = [(line, number) for number, line in enumerate(text.split("\n"), 1) if line.strip()]
    return [line for line, _ in held], [number for _, number in held]


def read_json_object(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; InputError names the line where the file is not JSON."""
    text = read_text(path)
    try:
        document = json.loads(text)
    except json.JSONDecodeError as error:
        what = f"is not JSON ({error.msg} at column {error.colno}); correct it"
        raise InputError.at(path, what, f"line {error.lineno}") from None
    except (ValueError, RecursionError):
        raise InputError.at(path, "is not JSON that can be read; write it again") from None
    if not isinstance(document, dict):
        raise InputError.at(
            path,
            f"holds a JSON {type(document).__name__} where an object {{...}} was expected;"
            " correct it",
        )
    return document


def shown(text: str) -> str:
    """Return the user's text, quoted and shortened to fit a message."""
    return repr(text if len(text) <= 30 else text[:27] + "...")
