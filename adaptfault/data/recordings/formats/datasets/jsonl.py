"""Opens JSON lines: an object a line with a list of readings, or the list alone; one frame a line.

The values of an object in it are fields behind its name, as ``hand.index``. ``null`` is a missing
reading. A last line that was cut off is left out with a warning.
"""

from __future__ import annotations

import builtins
import json
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import NO_FRAMES, InputError
from adaptfault.data.recordings.formats.datasets.contents import Contents, kept
from adaptfault.data.recordings.formats.datasets.reader import reader
from adaptfault.data.recordings.recording import BLOCK

SUFFIXES = (".jsonl", ".ndjson")

_READINGS = "readings"  # of a line that is a list alone


@kept
def opened(path: Path) -> Contents:
    """Return what the lines of a file hold; a field is read where it is looked at.

    Raises:
        InputError: the file holds no frame, or a line is no JSON.
    """
    contents = Contents(is_table=True)
    places = []
    first: dict[str, Any] = {}
    with builtins.open(path, "rb") as file:
        for number, begin, line in _parsed(path, file, contents.told):
            places.append((number, begin))
            first |= {name: value for name, value in line.items() if first.get(name) is None}
    if not places:
        raise InputError.at(path, NO_FRAMES)
    lines = _Lines(path, np.array(places))
    for name, value in first.items():
        contents.add(name, _Field(lines, name, value))
    return contents


open = reader(opened)


def _parsed(path: Path, file: Any, told: list[str]) -> Iterator[tuple[int, int, dict[str, Any]]]:
    """Yield number, first byte and content of each line; a last one that was cut off is left out,
    which is ``told``."""
    end = 0
    for number, data in enumerate(file, 1):
        begin = end
        end += len(data)
        text = data.decode("utf-8-sig", "replace")
        if not text.strip():
            continue
        try:
            line = json.loads(text)
        except (ValueError, RecursionError):
            if not text.endswith("\n") and number > 1:
                told.append("the last line is cut off: the lines before it are kept")
                return
            raise InputError.at(path, "is no JSON; correct it", f"line {number}") from None
        if isinstance(line, list):
            line = {_READINGS: line}
        if not isinstance(line, dict):
            what = "expected an object or a list of readings"
            raise InputError.at(path, what, f"line {number}")
        yield number, begin, _flat(line)


def _flat(line: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a line; those of an object in it behind its name, as ``hand.index``."""
    if not any(isinstance(value, dict) for value in line.values()):
        return line
    found: dict[str, Any] = {}
    for name, value in line.items():
        if isinstance(value, dict):
            found |= {f"{name}.{inner}": one for inner, one in _flat(value).items()}
        else:
            found[name] = value
    return found


class _Lines:
    """The lines of a file.

    Args:
        path: the file.
        places: int ``[n, 2]``, number and first byte of each line.
    """

    def __init__(self, path: Path, places: NDArray[np.int64]) -> None:
        self.path = path
        self.places = places
        self._held: tuple[int, int, list[dict[str, Any]]] = (0, 0, [])

    def between(self, first: int, last: int) -> list[dict[str, Any]]:
        """Return some lines; the last ones stay in memory: fields share them."""
        if self._held[:2] != (first, last):
            with builtins.open(self.path, "rb") as file:
                file.seek(self.places[first, 1])
                some = islice(_parsed(self.path, file, []), last - first)
                self._held = first, last, [line for _, _, line in some]
        return self._held[2]


class _Field:
    """The values of a field, ``[lines, ...]``; a slice of it is read.

    Args:
        lines: of the file.
        name: of the field.
        first: its first value, which tells the sizes of all.
    """

    def __init__(self, lines: _Lines, name: str, first: Any) -> None:
        self._lines = lines
        self._name = name
        sizes: tuple[int, ...] = ()
        self.dtype: np.dtype[Any] = np.dtype(object)
        with suppress(TypeError, ValueError):
            sizes = np.array(first, np.float64).shape
            self.dtype = np.dtype(np.float64)
        if isinstance(first, str):
            self.dtype = np.dtype(object)
        self.shape = (len(lines.places), *sizes)

    def __getitem__(self, part: slice) -> NDArray[Any]:
        first, last, _ = part.indices(len(self._lines.places))
        values = np.empty((last - first, *self.shape[1:]), self.dtype)
        for begin in range(first, last, BLOCK):
            some = self._lines.between(begin, min(begin + BLOCK, last))
            for row, line in enumerate(some, begin):
                values[row - first] = self._value(row, line.get(self._name))
        return values

    def _value(self, row: int, value: Any) -> Any:
        """Return the value of a line; one that is missing is NaN."""
        if self.dtype.kind == "O":
            return value
        sizes = self.shape[1:]
        try:
            return np.asarray(value, dtype=np.float64).reshape(sizes)
        except (TypeError, ValueError):
            what = f"{self._name} holds no {list(sizes)} numbers; correct it, or remove the line"
            number = self._lines.places[row, 0]
            raise InputError.at(self._lines.path, what, f"line {number}") from None
