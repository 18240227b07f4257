"""What can be wrong with a user's file, said in one line: which file, where, what came, what was expected, the mend."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import Literal


class InputError(ValueError):
    """A file or an option of the user is unusable. One line: ``<file>[, where]: what came; the mend``."""

    @classmethod
    def at(cls, path: str | PathLike[str], what: str, where: str = "") -> InputError:
        """Return the error for ``what`` is wrong in a file, ``where`` being "line 7" or "recording 3, frame 12"."""
        return cls(located(path, what, where))


@dataclass(frozen=True)
class Problem:
    """Something a reader noticed. What an ``"error"`` names was left out; a ``"warning"`` tells what is odd."""

    level: Literal["error", "warning"]
    message: str

    def __str__(self) -> str:
        return f"{self.level}: {self.message}"


def located(path: str | PathLike[str], what: str, where: str = "") -> str:
    """Return ``<file>[, where]: what`` as one printable line, whatever characters the file's name holds."""
    line = f"{path}, {where}: {what}" if where else f"{path}: {what}"
    line = line.replace("\n", "\\n").replace("\r", "\\r")
    return line.encode("utf-8", "backslashreplace").decode("utf-8")  # names that are not UTF-8 could not be printed
