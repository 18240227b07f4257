"""Opens text tables with lists in their cells, ``"[0.1, 0.2]"``, as a data frame with arrays is
written; blanks may divide the numbers, as numpy prints them."""

from __future__ import annotations

import builtins
import csv
import re
from pathlib import Path
from typing import Any

import numpy as np

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.sizes import check_file
from adaptfault.data.recordings.formats.datasets.contents import Contents, kept
from adaptfault.data.recordings.formats.datasets.reader import reader

_LIST = re.compile(r"\s*[\[(].*[\])]\s*", re.DOTALL)
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|[-+]?(?:nan|inf)", re.IGNORECASE)
_TYPED = re.compile(r"np\.\w+\(([^()]*)\)")  # as numpy 2 writes a list of its numbers
_QUOTED = re.compile(r'(?:^|,)"\s*[\[(]\s*(?:np\.\w+\()?[-+.\d]', re.MULTILINE)
_HEAD = 1 << 16  # bytes in which lists are looked for
_LONGEST = 1 << 20  # letters of a cell


def is_listed(cell: str) -> bool:
    """Return whether a cell holds a list of numbers."""
    return _LIST.fullmatch(cell) is not None and _NUMBER.search(cell) is not None


def accepts(path: Path) -> bool:
    """Return whether a list in quotation marks stands in the first lines of a table."""
    try:
        with builtins.open(path, "rb") as file:
            head = file.read(_HEAD).decode("utf-8-sig", "replace")
    except OSError:  # told by who reads it
        return False
    return _QUOTED.search(head) is not None


@kept
def opened(path: Path) -> Contents:
    """Return the columns of a table: of lists, numbers and texts.

    Raises:
        InputError: a list has another number of values than the first of its column.
    """
    check_file(path)
    csv.field_size_limit(_LONGEST)
    contents = Contents(is_table=True)
    with builtins.open(path, encoding="utf-8-sig", newline="") as file:
        rows = [row for row in csv.reader(file) if any(map(str.strip, row))]
    names = rows[0]
    for column, name in enumerate(names):
        cells = [row[column] if column < len(row) else "" for row in rows[1:]]
        if name and any(map(str.strip, cells)):
            contents.add(name, _column(path, name, cells))
    return contents


open = reader(opened)


def _column(path: Path, name: str, cells: list[str]) -> Any:
    """Return a column of lists ``[rows, n]``, of numbers, or of texts."""
    if any(map(is_listed, cells)):
        found = [_numbers(cell) for cell in cells]
        width = next(len(one) for one in found if one)
        for row, one in enumerate(found):
            if one and len(one) != width:
                what = f"{name} holds a list of {len(one)} where the first row has {width}"
                raise InputError.at(path, f"{what}; give all rows the same", f"row {row}")
        return np.array([one or [np.nan] * width for one in found])
    try:
        return np.array([float(cell) if cell.strip() else np.nan for cell in cells])
    except ValueError:
        return np.array(cells)


def _numbers(cell: str) -> list[float]:
    """Return the numbers of a list; none where there is no list."""
    if not is_listed(cell):
        return []
    return [float(one) for one in _NUMBER.findall(_TYPED.sub(r"\1", cell))]
