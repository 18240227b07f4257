"""Reads tables of labels, and orders class names."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal

from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.formats.text import read_text

TABLE = "labels.csv"
"""The name of the table of labels that is read from a folder without an option."""

TARGETS = "targets.csv"
"""The name of a table of targets, which is no recording where it lies in a folder of recordings."""


def natural_key(text: str) -> tuple[tuple[int, int, str], ...]:
    """Return the key of natural order: numbers by value ("9" before "10"), before letters."""
    parts = re.findall(r"[0-9]{1,18}|[^0-9]+|[0-9]", text)
    return (
        *((0, int(p), "") if p.isascii() and p.isdigit() else (1, 0, p.casefold()) for p in parts),
        (1, 0, text),
    )


def natural_order(names: Iterable[str]) -> tuple[str, ...]:
    """Return each name once, in natural order."""
    return tuple(sorted(set(names), key=natural_key))


class FileTable:
    """A table with a column ``file``, relative to its folder; lines that cannot be used are noted.

    Attributes:
        path: of the table.
        header: as it is written.
        columns: the same in lower case.
        problems: what is wrong with single lines.

    Raises:
        InputError: the table cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.header, self._lines = table_lines(path)
        self.columns = [name.casefold() for name in self.header]
        self.problems: list[Problem] = []

    def rows(self, remedy: str) -> Iterator[tuple[int, Path, dict[str, str]]]:
        """Yield the number of each line, its file, resolved, and its cells by column; ``remedy``:
        of a line with another number of cells."""
        for number, row in self._lines:
            if len(row) != len(self.columns):
                what = f"{len(row)} cells where the header has {len(self.columns)}"
                self.note(number, f"{what}; {remedy}")
                continue
            cells = dict(zip(self.columns, row, strict=True))
            name = cells["file"]
            file = existing_file(self.path.parent, name)
            if file is None:
                what = f"names {name!r}, which is not there; correct the path or remove the line"
                self.note(number, what)
            else:
                yield number, file, cells

    def note(self, number: int, what: str, level: Literal["error", "warning"] = "error") -> None:
        """Note what is wrong with a line."""
        self.problems.append(Problem(level, located(self.path, what, f"line {number}")))


def read_label_table(path: Path) -> tuple[dict[Path, str], list[Problem]]:
    """Read a table of the columns ``file`` and ``label``; files are relative to the table's folder.

    Returns the label of each file, by resolved path, and what is wrong with single lines (they are
    left out).

    Raises:
        InputError: the table cannot be read, or its header lacks a column.
    """
    table = FileTable(path)
    if not {"file", "label"} <= set(table.columns):
        raise InputError.at(
            path, "expected a first line 'file,label', separated by commas; add it", "line 1"
        )
    labels: dict[Path, str] = {}
    conflicts: set[Path] = set()
    for number, file, cells in table.rows("give a file and its label"):
        name = cells["file"]
        label = cells["label"]
        before = labels.get(file, label)
        if not label:
            table.note(number, "the label is empty; give both")
            continue
        if before != label:
            what = f"{name!r} is labelled {label!r} here and {before!r} before; left out, keep"
            table.note(number, f"{what} one line")
            conflicts.add(file)
        elif file in labels:
            table.note(number, f"{name!r} stands in the table twice; remove one line", "warning")
        labels[file] = before
    known = {file: label for file, label in labels.items() if file not in conflicts}
    return known, table.problems


def table_lines(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the header of a table, and its other lines that are not empty with their numbers.

    Raises:
        InputError: the table cannot be read.
    """
    reader = csv.reader(read_text(path).split("\n"), strict=False)
    try:
        lines = [
            (reader.line_num, [cell.strip() for cell in row])
            for row in reader
            if any(map(str.strip, row))
        ]
    except csv.Error as error:
        raise InputError.at(
            path, f"is no table ({error}); correct it", f"line {reader.line_num}"
        ) from None
    return (lines[0][1], lines[1:]) if lines else ([], [])


def existing_file(folder: Path, name: str) -> Path | None:
    """Return the file that a table names, resolved; tables written on Windows separate folders by a
    backslash."""
    for spelling in (name, name.replace("\\", "/")):
        try:
            if (folder / spelling).is_file():
                return (folder / spelling).resolve()
        except (OSError, ValueError):  # a name too long, or with a null character, is no file's
            continue
    return None
