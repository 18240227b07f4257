"""Decides which columns of a table are readings, and which one is the time or the class: by
options, by the header, or by what the first lines hold."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.formats.dialect import (
    Dialect,
    bare,
    is_comment,
    is_written_out,
    numbered,
)
from adaptfault.data.recordings.formats.text import shown

Names = str | Iterable[str | int]

_TIME = re.compile(
    r"[%#]?(?:rosbag[_ ]?)?(?:time(?:[_ ]?stamp)?|stamp|t|epoch|elapsed|zeit|uhrzeit|clock)"
    r"(?:[_ ]?[\[(]?(s|sec|secs|seconds|ms|us|ns)[\])]?)?",
    re.IGNORECASE | re.ASCII,
)
"""Names of a column of times, also as rostopic, plotjuggler and Arduino sketches write them."""

_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "seconds"), "s"),
    **dict.fromkeys(("ms", "millis", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "micros", "microseconds"), "us"),
    "ns": "ns",
}
_ALONE = ("seconds", "secs", "millis", "milliseconds", "micros", "microseconds")
"""Units that name a column of times by themselves."""

_NUMBER = re.compile(r"|unnamed: 0|index|(?:frame|sample)(?:[_ ]?(?:id|no|number))?", re.IGNORECASE)

_RANGE = re.compile(r"(\d+)(?:-(\d+))?", re.ASCII)

_EPOCH = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_YEARS = 1e9, 4.2e9  # seconds since 1970: 2001 to 2103

_LEAST = 5  # lines that show that a column rises
_RISES = 0.95  # share of its steps
_FAR = 10.0  # times the largest reading
_LOOK = 2_000_000  # characters in which that reading is looked for
_LISTED = 12  # columns that a message names


@dataclass(frozen=True)
class Columns:
    """What the columns of a table hold.

    Attributes:
        width: how many there are.
        readings: one a cell, in this order.
        clock: of times; None without one.
        unit: of the times, where it is known.
        label: of the class; None without one.
        has_text: whether columns that are not used hold text or dates.
        problems: warnings.
    """

    width: int
    readings: tuple[int, ...]
    clock: int | None = None
    unit: str | None = None
    label: int | None = None
    has_text: bool = False
    problems: tuple[Problem, ...] = ()

    @property
    def used(self) -> list[int]:
        """The columns of numbers that are read, in the order of the file."""
        clock = () if self.clock is None else (self.clock,)
        return sorted({*self.readings, *clock})


def choose_columns(
    path: Path,
    dialect: Dialect,
    columns: Names | None = None,
    ignore: Names | None = None,
    time_column: str | int | None = None,
    label_column: str | int | None = None,
) -> Columns:
    """Return what the columns of a file hold.

    Args:
        path: the file.
        dialect: of the file.
        columns: the readings: names, patterns, or numbers from 0, such as ``2-33``; None: what is
            neither ignored nor another column.
        ignore: what is no reading, in the same form.
        time_column, label_column: of times and of the class.

    Raises:
        InputError: a column is not there, a reading is text, or no column holds readings.
    """
    table = _Named(path, dialect)
    leading, clock, unit = _leading(table.names)
    if time_column is not None:
        clock = table.one("time-column", time_column)
        unit = _unit(table.names[clock]) if table.names else None
    label = None if label_column is None else table.one("label-column", label_column)
    no_readings = set() if ignore is None else set(table.several("ignore", ignore))
    if label is not None:
        no_readings.add(label)
    if columns is None:
        readings = [i for i in range(dialect.width) if i >= leading and i != clock]
    else:
        readings = table.several("columns", columns)
        if time_column is None and clock in readings:
            clock = None
    if clock in no_readings and time_column is None:
        clock = None
    readings = [i for i in readings if i not in no_readings and i != clock]
    problems: tuple[Problem, ...] = ()
    if columns is None and clock is None and leading == 0 and readings[:1] == [0]:
        ticks = _clock_of(path, dialect, readings)
        if ticks is not None:
            clock = 0
            unit = ticks or None
            readings = readings[1:]
            what = (
                "is the first column a time? it was taken as one; --time-column says which,"
                " --columns says which columns are readings"
            )
            problems = (Problem("warning", located(path, what)),)
    table.refuse_text(readings)
    if not readings:
        held = "numbers of frames" if clock is None else "a column of times"
        raise InputError.at(
            path, f"holds {held} and no readings; add one column a cell", table.first_line
        )
    others = set(range(dialect.width)) - {*readings, clock}
    return Columns(
        dialect.width,
        tuple(readings),
        clock,
        unit,
        label,
        table.has_unreadable(others),
        problems,
    )


def label_of(path: Path, dialect: Dialect, column: int) -> str:
    """Return the most frequent value of a column.

    Raises:
        InputError: the column is empty.
    """
    values: Counter[str] = Counter()
    for at, line in numbered(path):
        if at > dialect.skip and line and not is_comment(line):
            values[(*dialect.split(line), *[""] * dialect.width)[column]] += 1
    del values[""]
    if not values:
        raise InputError.at(path, f"column {column} is empty; --label-column names the class")
    return values.most_common(1)[0][0]


class _Named:
    """The columns of a file, found by the names that a user gives."""

    def __init__(self, path: Path, dialect: Dialect) -> None:
        self.path = path
        self.width = dialect.width
        self.names = dialect.header or _names_of_times(dialect)
        self._dialect = dialect

    @property
    def first_line(self) -> str:
        """The place of the first line of the table, for messages."""
        lines = numbered(self.path)
        at = next((at for at, line in lines if at > self._dialect.skip and line), 1)
        return f"line {at}"

    def several(self, option: str, given: Names) -> list[int]:
        """Return the columns that an option names, each once, in its order."""
        parts = given.split(",") if isinstance(given, str) else [str(part) for part in given]
        found = [column for part in parts for column in self._matching(option, bare(part))]
        return list(dict.fromkeys(found))

    def one(self, option: str, given: str | int) -> int:
        """Return the column that an option names."""
        found = self._matching(option, bare(str(given)))
        if len(found) > 1:
            what = f"--{option} {given}: {len(found)} columns; name one of {self._listed()}"
            raise InputError.at(self.path, what)
        return found[0]

    def _matching(self, option: str, part: str) -> list[int]:
        found = [i for i, name in enumerate(self.names) if name == part]
        if not found and (numbers := _RANGE.fullmatch(part)):
            last = int(numbers[2] or numbers[1])
            if last < self.width:
                found = list(range(int(numbers[1]), last + 1))
        if not found:
            found = [i for i, name in enumerate(self.names) if fnmatchcase(name, part)]
        if not found:
            what = f"--{option} {part}: there is no such column; it has {self._listed()}"
            raise InputError.at(self.path, what)
        return found

    def _listed(self) -> str:
        if not self.names:
            return f"columns 0 to {self.width - 1}, without names"
        more = f", ... ({self.width} in all)" if self.width > _LISTED else ""
        return ", ".join(name or f"{i}" for i, name in enumerate(self.names[:_LISTED])) + more

    def text(self) -> list[int]:
        """Return the columns in which the first lines hold text, and no number."""
        probe = self._dialect.probe
        columns = self._dialect.texts(probe[0]) if probe else []
        if not columns:
            return []
        rows = [self._dialect.split(line) for line in probe]
        numbers = {
            i: [self._dialect.number(row[i]) for row in rows if i < len(row)] for i in columns
        }
        return [i for i in columns if all(n is None or n != n for n in numbers[i])]

    def has_unreadable(self, columns: Collection[int]) -> bool:
        """Return whether the first line holds text or a date in one of some columns."""
        probe = self._dialect.probe[:1]
        return any(i in columns for line in probe for i in self._dialect.unreadable(line))

    def refuse_text(self, readings: Sequence[int]) -> None:
        """Raise InputError where there is text in a column of readings."""
        text = [i for i in self.text() if i in readings]
        if not text:
            return
        cell = self._dialect.split(self._dialect.probe[0])[text[0]]
        named = ",".join(self.names[i] if self.names and self.names[i] else str(i) for i in text)
        what = (
            f"{shown(cell)} is not a number; write the reading, or leave a column"
            f" of text out: --ignore {named}"
        )
        raise InputError.at(self.path, what, f"{self.first_line}, column {text[0] + 1}")


def _names_of_times(dialect: Dialect) -> tuple[str, ...]:
    """Return the names above a table of another width whose first name is that of a time."""
    if not dialect.preamble or not dialect.separator:
        return ()
    above = dialect.preamble[-1]
    cells = dialect.split(above)
    if _leading(cells)[1] is None or len(dialect.texts(above)) < len(cells):
        return ()
    return tuple((*cells, *[""] * dialect.width)[: dialect.width])


def _leading(names: Sequence[str]) -> tuple[int, int | None, str | None]:
    """Return how many of the first columns hold no readings by their names, which of them holds
    times, and the unit of these."""
    count = 0
    clock = None
    unit = None
    for column, name in enumerate(names):
        is_time = _TIME.fullmatch(name) is not None or name.lower() in _ALONE
        if clock is None and is_time:
            count = column + 1
            clock = column
            unit = _unit(name)
        elif _NUMBER.fullmatch(name) and column < 2:
            count = column + 1
        else:
            break
    return count, clock, unit


def _unit(name: str) -> str | None:
    """Return the unit in the name of a column of times."""
    time = _TIME.fullmatch(name)
    return _UNITS.get((name if time is None else time[1] or "").lower())


def _clock_of(path: Path, dialect: Dialect, readings: Sequence[int]) -> str | None:
    """Return the unit of the times in the first column, "" if it is unknown; None where the column
    is a cell's or counts the frames.

    Times rise in 95 % of the steps, and are dates since 1970 or 10 times as far as any reading.
    """
    cells = [dialect.first(line) for line in dialect.probe]
    if len(cells) >= 2 and all(map(is_written_out, cells)):
        return "s"
    numbers = [dialect.number(cell) for cell in cells]
    if None in numbers or len(numbers) < _LEAST or len(readings) < 2:
        return None
    times = np.array(numbers, dtype=np.float64)
    if np.mean(np.diff(times) > 0) < _RISES:
        return None
    for unit, ticks in _EPOCH.items():
        if _YEARS[0] <= times[0] / ticks < _YEARS[1]:
            return unit
    if np.array_equal(times, np.rint(times)) and np.median(np.diff(times)) == 1:
        return None
    values = _first_values(path, dialect)
    largest = np.nanmax(np.abs(values[:, 1:]), initial=0.0)
    rises = np.mean(np.diff(values[:, 0]) > 0) >= _RISES
    return "" if rises and np.nanmax(values[:, 0]) > _FAR * largest else None


def _first_values(path: Path, dialect: Dialect) -> NDArray[np.float64]:
    """Return the numbers in the first part of a table; only its very first lines where it is not
    made of numbers alone."""
    rows: list[str] = []
    size = 0
    for at, line in numbered(path):
        if at > dialect.skip and line and not is_comment(line):
            rows.append(line.replace(",", ".") if dialect.decimal_comma else line)
            size += len(line)
        if size > _LOOK:
            break
    try:
        return np.loadtxt(
            rows, np.float64, delimiter=dialect.separator or None, comments=None, ndmin=2
        )
    except ValueError:
        split = [dialect.split(line) for line in dialect.probe]
        return np.array(
            [
                [np.nan if (n := dialect.number(cell)) is None else n for cell in row]
                for row in split
                if len(row) == dialect.width
            ]
        )
