"""Parses lines of numbers: fast by numpy's parser, or cell by cell, which accepts missing readings
and names the line and the column of what is no number."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.columns import Columns
from adaptfault.data.recordings.formats.dialect import Dialect
from adaptfault.data.recordings.formats.text import shown


def parse_rows(
    path: Path,
    rows: Sequence[str],
    numbers: Sequence[int],
    dialect: Dialect,
    columns: Columns,
    kind: type,
) -> NDArray[Any]:
    """Return the numbers in the columns that are used, ``[lines, columns]``.

    Args:
        path: of the file.
        rows: lines of its table, at least one.
        numbers: of these lines in the file.
        dialect: of the file.
        columns: those used.
        kind: of the numbers.

    Raises:
        InputError: lines of different lengths, or a cell that is no number.
    """
    try:
        values = _parsed(rows, dialect, columns, kind)
    except ValueError:
        return _read_by_cell(path, rows, numbers, dialect, columns, kind)
    width = values.shape[1]
    if columns.has_text:
        return values
    if width != columns.width:
        raise _other_width(path, width, columns.width, numbers[0])
    used = columns.used
    return values if len(used) == width else values[:, used]


def _parsed(rows: Sequence[str], dialect: Dialect, columns: Columns, kind: type) -> NDArray[Any]:
    """Parse by numpy; ValueError where it is not able to."""
    separator = dialect.separator
    written = [row.replace(",", ".") for row in rows] if dialect.decimal_comma else rows
    if dialect.ends:
        written = [row.removesuffix(separator) for row in written]
    used = None
    if columns.has_text:
        widths = {len(dialect.split(row)) for row in rows}
        if widths != {columns.width} or any('"' in row for row in rows):
            raise ValueError
        used = columns.used
    return np.loadtxt(
        written, kind, delimiter=separator or None, comments=None, ndmin=2, usecols=used
    )


def _other_width(path: Path, came: int, expected: int, line: int) -> InputError:
    what = f"{_values(came)} where the lines before it have {expected}; correct it"
    return InputError.at(path, what, f"line {line}")


def _read_by_cell(
    path: Path,
    rows: Sequence[str],
    numbers: Sequence[int],
    dialect: Dialect,
    columns: Columns,
    kind: type,
) -> NDArray[Any]:
    table = [dialect.split(row) for row in rows]
    width = Counter(len(cells) for cells in table).most_common(1)[0][0]
    for row, number, cells in zip(rows, numbers, table, strict=True):
        if len(cells) != width:
            remedy = "leave a missing reading as an empty cell, between its separators"
            if number == numbers[-1] and len(cells) < width:
                remedy = "the recording was cut off here: remove the line"
            if other := _other_separator(row, dialect, width):
                remedy = f"it is separated by {other}: use one separator in the whole file"
            what = f"{_values(len(cells))} where the other lines have {width}; {remedy}"
            raise InputError.at(path, what, f"line {number}")
    if width != columns.width:
        raise _other_width(path, width, columns.width, numbers[0])
    used = columns.used
    values: NDArray[Any] = np.empty((len(table), len(used)), dtype=kind)
    for frame, (number, cells) in enumerate(zip(numbers, table, strict=True)):
        for i, column in enumerate(used):
            reading = dialect.number(cells[column])
            if reading is None:
                what = _no_number(cells[column], column, columns)
                raise InputError.at(path, what, f"line {number}, column {column + 1}")
            values[frame, i] = reading
    return values


def _other_separator(row: str, dialect: Dialect, width: int) -> str:
    """Return the name of the separator with which a line has as many values as the others."""
    names = {",": "','", ";": "';'", "\t": "tabs", "": "blanks"}
    for separator, name in names.items():
        other = Dialect(separator=separator)
        if separator != dialect.separator and len(other.split(row)) == width:
            return name
    return ""


def _no_number(cell: str, column: int, columns: Columns) -> str:
    if column == columns.clock:
        return f"{shown(cell)} is no time; write a number, or a date as 2025-03-01T12:00:00.05"
    what = (
        f"{shown(cell)} is not a number; write the reading, or leave the cell empty if it is"
        " missing"
    )
    if column == 0 and columns.width > 1:
        what += " (name a column of times in a header line, or remove it)"
    return what


def _values(count: int) -> str:
    return "1 value" if count == 1 else f"{count} values"
