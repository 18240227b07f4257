"""Errors and warnings about a user's file, one line each: file, place, what came, what was
expected, the remedy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from typing import Literal

from adaptfault.data.printable import printable

NO_FRAMES = "holds no frames; record it again or remove it"
"""What is said of a recording that is empty."""

_UNFORESEEN = (
    "cannot be read ({}): damaged, or another kind than its name says; write it again, or leave it"
    " out"
)


class InputError(ValueError):
    """A file or an option of the user is unusable. One line:
    ``<file>[, where]: what came; the remedy``."""

    @classmethod
    def at(cls, path: str | PathLike[str], what: str, where: str = "") -> InputError:
        """Return the error ``what`` in a file, at the place ``where`` ("line 7", "recording 3,
        frame 12")."""
        return cls(located(path, what, where))


@contextmanager
def foreseeing(
    path: str | PathLike[str], what: str = _UNFORESEEN, where: str = ""
) -> Iterator[None]:
    """Turn any error of a library into an InputError: a damaged file raises any of a dozen kinds.
    The library's words are not passed on.

    Args:
        path: the file.
        what: is wrong with it, and the remedy; ``{}`` stands for the kind of the error.
        where: the place in it.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError.at(path, what.format(type(error).__name__), where) from None


@dataclass(frozen=True)
class Problem:
    """A problem that a reader found: an ``"error"`` left data out, a ``"warning"`` kept them."""

    level: Literal["error", "warning"]
    message: str

    @classmethod
    def warning(cls, path: str | PathLike[str], what: str, where: str = "") -> Problem:
        """Return a warning about a file, at a place in it."""
        return cls("warning", located(path, what, where))

    def __str__(self) -> str:
        return f"{self.level}: {self.message}"


def located(path: str | PathLike[str], what: str, where: str = "") -> str:
    """Return ``<file>[, where]: what`` as one printable line, whatever characters the file's name
    holds."""
    line = f"{path}, {where}: {what}" if where else f"{path}: {what}"
    return printable(line).replace("\n", "\\n")


@contextmanager
def noted(problems: list[Problem]) -> Iterator[None]:
    """Add an InputError to problems, so that the other files are read."""
    try:
        yield
    except InputError as error:
        problems.append(Problem("error", str(error)))
