"""Gives each recording the values that a regression learns, from a table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.facts.labels import existing_file, table_lines
from adaptfault.data.recordings.survey import Content

_WHOLE = -1  # stands for the frame where a line holds the values of a whole recording


@dataclass(frozen=True, eq=False)
class TargetTable:
    """A table of targets.

    Attributes:
        path: of the table.
        names: of the values.
        of_frames: whether a line holds the values of a frame, not of a recording.
        values: of each file, by resolved path, and frame.
        faulty: files with a line that cannot be used.
        problems: what is wrong with single lines.
    """

    path: Path
    names: tuple[str, ...]
    of_frames: bool
    values: dict[Path, dict[int, tuple[float, ...]]] = field(default_factory=dict)
    faulty: set[Path] = field(default_factory=set)
    problems: list[Problem] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> TargetTable:
        """Read a table of the columns ``file``, maybe ``frame``, and one for each value.

        Files are relative to the table's folder, frames are counted from 0.

        Raises:
            InputError: the table cannot be read, its header lacks a column, or holds one twice.
        """
        header, lines = table_lines(path)
        folded = [name.casefold() for name in header]
        names = tuple(
            name
            for name, lower in zip(header, folded, strict=True)
            if lower not in ("file", "frame")
        )
        if "file" not in folded or not names or not all(names):
            expected = "'file,force' or 'file,frame,force' with the names of your values"
            raise InputError.at(
                path, f"expected a first line as {expected}, separated by commas; add it", "line 1"
            )
        if len(set(folded)) < len(folded):
            twice = next(name for name in folded if folded.count(name) > 1)
            raise InputError.at(
                path, f"the column {twice!r} stands there twice; rename one of them", "line 1"
            )
        table = cls(path, names, "frame" in folded)
        for number, row in lines:
            table._add(number, row, folded)
        return table

    def _add(self, number: int, row: list[str], header: list[str]) -> None:
        if len(row) != len(header):
            what = f"{len(row)} cells where the header has {len(header)}; give a cell a column"
            self._note(number, what)
            return
        cells = dict(zip(header, row, strict=True))
        name = cells["file"]
        file = existing_file(self.path.parent, name)
        if file is None:
            self._note(
                number, f"names {name!r}, which is not there; correct the path or remove the line"
            )
            return
        frame = _WHOLE
        if self.of_frames:
            text = cells["frame"]
            if not (text.isascii() and text.isdigit()):
                what = f"the frame is {text!r}; expected a whole number, 0 for the first frame"
                self._note(number, what, file)
                return
            frame = int(text)
        values = []
        for column in self.names:
            value = _number(cells[column.casefold()])
            if value is None:
                given = cells[column.casefold()]
                what = f"{column} is {given!r}; expected a number with a decimal point"
                self._note(number, what, file)
                return
            values.append(value)
        known = self.values.setdefault(file, {})
        if frame in known and known[frame] != tuple(values):
            what = f"{name!r} has other values before; left out, keep one line"
            self._note(number, what, file)
        known[frame] = tuple(values)

    def _note(self, number: int, what: str, file: Path | None = None) -> None:
        self.problems.append(Problem("error", located(self.path, what, f"line {number}")))
        if file is not None:
            self.faulty.add(file)

    def of(self, file: Path, frames: Sequence[int]) -> NDArray[np.float32]:
        """Return the values of a file with one recording: ``[k]``, or ``[T, k]`` of each frame.

        Args:
            file: of the recording.
            frames: number of frames of each recording in it.

        Raises:
            InputError: it has none, or not for each frame, or holds several recordings.
        """
        place = file.resolve()
        if place in self.faulty:
            raise InputError.at(
                file, f"has a line in {self.path} that cannot be used: left out; correct the line"
            )
        known = self.values.get(place)
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
        if not self.of_frames:
            return np.array(known[_WHOLE], np.float32)
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
        try:
            targets = table.of(content.path, lengths)
        except InputError as error:
            problems.append(Problem("error", str(error)))
        else:
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
