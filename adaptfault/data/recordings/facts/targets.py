"""Gives each recording the values that a regression learns, from a table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, Problem, noted
from adaptfault.data.recordings.facts.labels import FileTable
from adaptfault.data.recordings.survey import Content

_WHOLE = "-1"  # stands for the frame where a line holds the values of a whole recording


class TargetTable:
    """A table of the columns ``file``, maybe ``frame``, and one for each value; files are relative
    to the table's folder, frames are counted from 0.

    Attributes:
        path: of the table.
        names: of the values.
        problems: what is wrong with single lines.

    Raises:
        InputError: the table cannot be read, its header lacks a column, or holds one twice.
    """

    def __init__(self, path: Path) -> None:
        table = FileTable(path)
        self.path = path
        self.problems = table.problems
        self.names = tuple(n for n in table.header if n.casefold() not in ("file", "frame"))
        columns = table.columns
        if "file" not in columns or not self.names or not all(self.names):
            expected = "'file,force' or 'file,frame,force' with the names of your values"
            what = f"expected a first line as {expected}, separated by commas; add it"
            raise InputError.at(path, what, "line 1")
        twice = [name for name in columns if columns.count(name) > 1]
        if twice:
            what = f"the column {twice[0]!r} stands there twice; rename one of them"
            raise InputError.at(path, what, "line 1")
        self._of_frames = "frame" in columns
        self._values: dict[Path, dict[int, tuple[float, ...]]] = {}
        self._faulty: set[Path] = set()
        for number, file, cells in table.rows("give a cell a column"):
            what = self._add(file, cells)
            if what:
                table.note(number, what)
                self._faulty.add(file)

    def _add(self, file: Path, cells: Mapping[str, str]) -> str:
        """Take in the values of a line; return what is wrong with it."""
        text = cells.get("frame", _WHOLE)
        if self._of_frames and not (text.isascii() and text.isdigit()):
            return f"the frame is {text!r}; expected a whole number, 0 for the first frame"
        values = []
        for column in self.names:
            value = _number(cells[column.casefold()])
            if value is None:
                given = cells[column.casefold()]
                return f"{column} is {given!r}; expected a number with a decimal point"
            values.append(value)
        known = self._values.setdefault(file, {})
        before = known.get(int(text))
        known[int(text)] = tuple(values)
        if before in (None, tuple(values)):
            return ""
        return f"{cells['file']!r} has other values before; left out, keep one line"

    def of(self, file: Path, frames: Sequence[int]) -> NDArray[np.float32]:
        """Return the values of a file with one recording: ``[k]``, or ``[T, k]`` of each frame.

        Args:
            file: of the recording.
            frames: number of frames of each recording in it.

        Raises:
            InputError: it has none, or not for each frame, or holds several recordings.
        """
        place = file.resolve()
        if place in self._faulty:
            raise InputError.at(
                file, f"has a line in {self.path} that cannot be used: left out; correct the line"
            )
        known = self._values.get(place)
        if known is None:
            raise InputError.at(
                file, f"is not in the table {self.path}: left out; add a line for it"
            )
        if len(frames) != 1:
            raise InputError.at(
                file,
                f"holds {len(frames)} recordings, and a line of {self.path} is for one: left out;"
                " store each recording in a file of its own",
            )
        if not self._of_frames:
            return np.array(known[int(_WHOLE)], np.float32)
        missing = sorted(set(range(frames[0])) - set(known))
        beyond = sorted(set(known) - set(range(frames[0])))
        if missing or beyond:
            lacking = (
                f"frame {missing[0]} has no values"
                if missing
                else f"there are values of frame {beyond[0]}"
            )
            raise InputError.at(
                file,
                f"has {frames[0]} frames, but {lacking} in {self.path}: left out; give one line for"
                f" each frame from 0 to {frames[0] - 1}",
            )
        return np.array([known[frame] for frame in range(frames[0])], np.float32)


def target_files(
    contents: Sequence[Content], table: TargetTable, problems: list[Problem]
) -> list[Content]:
    """Return the files with targets, which have no classes then; a file without is left out."""
    problems += table.problems
    kept = []
    for content in contents:
        lengths = [survey.length for survey in content.surveys]
        with noted(problems):
            targets = table.of(content.path, lengths)
            kept.append(replace(content, targets=targets, labels=None))
    return kept


def _number(text: str) -> float | None:
    """Return a finite number of single precision; None where the text is none."""
    try:
        value = float(text)
    except ValueError:
        return None
    with np.errstate(over="ignore"):
        return value if math.isfinite(np.float32(value)) else None
