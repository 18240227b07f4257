"""Reads tables of labels, and orders class names."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable
from pathlib import Path

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


def read_label_table(path: Path) -> tuple[dict[Path, str], list[Problem]]:
    """Read a table of the columns ``file`` and ``label``; files are relative to the table's folder.

    Returns the label of each file, by resolved path, and what is wrong with single lines (they are
    left out).

    Raises:
        InputError: the table cannot be read, or its header lacks a column.
    """
    first, lines = table_lines(path)
    header = [name.casefold() for name in first]
    if not {"file", "label"} <= set(header):
        raise InputError.at(
            path, "expected a first line 'file,label', separated by commas; add it", "line 1"
        )
    file_column = header.index("file")
    label_column = header.index("label")
    labels: dict[Path, str] = {}
    conflicts: set[Path] = set()
    problems: list[Problem] = []

    def note(number: int, what: str, warning: bool = False) -> None:
        problems.append(
            Problem("warning" if warning else "error", located(path, what, f"line {number}"))
        )

    for number, row in lines:
        if len(row) != len(header):
            note(
                number,
                f"{len(row)} cells where the header has {len(header)}; give a file and its label",
            )
            continue
        name = row[file_column]
        label = row[label_column]
        if not name or not label:
            note(number, f"the {'label' if name else 'file'} is empty; give both")
            continue
        file = existing_file(path.parent, name)
        if file is None:
            note(number, f"names {name!r}, which is not there; correct the path or remove the line")
        elif file not in labels:
            labels[file] = label
        elif labels[file] == label:
            note(number, f"{name!r} stands in the table twice; remove one line", warning=True)
        else:
            note(
                number,
                f"{name!r} is labelled {label!r} here and {labels[file]!r} before; left out, keep"
                " one line",
            )
            conflicts.add(file)
    return {file: label for file, label in labels.items() if file not in conflicts}, problems


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
