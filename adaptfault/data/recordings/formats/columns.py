"""Decides which columns of a table are readings, and which one is the time or the class: by
options, by the header, or by what the first lines hold."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import accumulate, pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, Problem
from adaptfault.data.recordings.facts.rates import TICKS
from adaptfault.data.recordings.facts.roles import (
    EPISODES,
    LABELS,
    SCAN,
    axes_of,
    clock_of,
    first_of,
    in_order,
    is_clock,
    is_summary,
    left_out,
    no_readings,
    reordered,
    shape_of,
    sizes_of,
    unit_of,
)
from adaptfault.data.recordings.facts.roles import readings as readings_of
from adaptfault.data.recordings.formats.datasets.features import Pads
from adaptfault.data.recordings.formats.dialect import (
    Dialect,
    bare,
    is_comment,
    is_written_out,
    numbered,
)
from adaptfault.data.recordings.formats.text import shown as quoted
from adaptfault.data.recordings.recording import Shape

Names = str | Iterable[str | int]

_RANGE = re.compile(r"(\d+)(?:-(\d+))?", re.ASCII)

_YEARS = 1e9, 4.2e9  # seconds since 1970: 2001 to 2103

_LEAST = 5  # lines that show that a column rises
_RISES = 0.95  # share of its steps
_EVEN = 1e-3  # of a step, by which equal ones differ
_FAR = 10.0  # times the largest reading
_LOOK = 2_000_000  # characters in which that reading is looked for
_TAKEN = (
    "is the first column a time? it was taken as one; --time-column says which, --columns says"
    " which columns are readings"
)
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
        episode: of the number of the episode; None without one.
        scan: of the levels of a scan of the read-out; None without one.
        names: of the readings; empty where the file has none.
        shape: ``(pads, rows, cols)`` that the names of the readings show; None: they show none.
        shape_reason: how they show it.
        inferred: what was chosen by names, with the option that states it.
        has_text: whether columns that are not used hold text or dates.
        problems: warnings.
        pads: of different sizes, as the names show them; None: all have the same.
        axes: readings of one position, as the names show them; they stand together.
    """

    width: int
    readings: tuple[int, ...]
    clock: int | None = None
    unit: str | None = None
    label: int | None = None
    episode: int | None = None
    scan: int | None = None
    names: tuple[str, ...] = ()
    shape: Shape | None = None
    shape_reason: str = ""
    inferred: tuple[str, ...] = ()
    has_text: bool = False
    problems: tuple[Problem, ...] = ()
    pads: Pads | None = None
    axes: int = 1

    @property
    def parts(self) -> list[slice]:
        """The readings of each pad, where pads differ in size."""
        sizes = () if self.pads is None else self.pads.sizes
        ends = list(accumulate(map(math.prod, sizes), initial=0))
        return [slice(*pair) for pair in pairwise(ends)]

    @property
    def aside(self) -> set[int | None]:
        """The columns that are no readings, but say something of them."""
        return {self.clock, self.label, self.episode, self.scan}

    @property
    def used(self) -> list[int]:
        """The columns of numbers that are read, in the order of the file."""
        aside = {column for column in (self.clock, self.scan) if column is not None}
        return sorted({*self.readings, *aside})


def choose_columns(
    path: Path,
    dialect: Dialect,
    columns: Names | None = None,
    ignore: Names | None = None,
    time_column: str | int | None = None,
    label_column: str | int | None = None,
    shape: Shape | None = None,
) -> Columns:
    """Return what the columns of a file hold.

    Args:
        path: the file.
        dialect: of the file.
        columns: the readings: names, patterns, or numbers from 0, such as ``2-33``; None: what is
            neither ignored nor another column.
        ignore: what is no reading, in the same form.
        time_column, label_column: of times and of the class.
        shape: ``(pads, rows, cols)`` where the user states it.

    Raises:
        InputError: a column is not there, a reading is text, or no column holds readings.
    """
    table = _Named(path, dialect)
    ignored = set() if ignore is None else set(table.several("ignore", ignore))
    wanted = None if columns is None else table.several("columns", columns)
    roles = _by_names(table, {*ignored, *(wanted or ())}, time_column, label_column)
    aside = {*no_readings(table.names), *roles.aside}
    readings = [i for i in range(dialect.width) if i not in aside] if wanted is None else wanted
    if roles.clock is None and 0 not in ignored and (0 in readings) == (wanted is None):
        fills = shape is not None and math.prod(shape) == len(readings)
        ticks = _clock_of(path, dialect, even=wanted is not None or not fills)
        if ticks is not None:
            warned = (Problem.warning(path, _TAKEN),)
            roles = replace(roles, clock=0, unit=ticks or None, problems=warned)
    aside = {*ignored, *roles.aside}
    readings = [i for i in readings if i not in aside]
    inferred: tuple[str, ...] = ()
    if wanted is None:
        readings, inferred = _numbered(table.names, readings, shape)
    table.check(readings, roles.clock)
    names = tuple(table.names[i] for i in readings) if table.names else ()
    if columns is None:
        _refuse_summaries(path, names)
    axes, order = axes_of(names)
    readings = [readings[i] for i in order] or readings
    names = tuple(names[i] for i in order)
    shown, reason, pads = _shown(names, axes, shape)
    others = set(range(dialect.width)) - {*readings, roles.clock, roles.scan}
    return replace(
        roles,
        readings=tuple(readings),
        names=names,
        shape=shown,
        shape_reason=reason,
        inferred=inferred,
        has_text=table.has_unreadable(others),
        pads=pads,
        axes=axes,
    )


def _shown(
    names: Sequence[str], axes: int, shape: Shape | None
) -> tuple[Shape | None, str, Pads | None]:
    """Return the shape that the names of readings show where it is not stated, how they show it,
    and the pads where these differ in size."""
    if axes > 1:
        positions = len(names) // axes
        stands = shape or (1, 1, len(names))
        if math.prod(stands) == positions:
            stands = stands[0], stands[1], stands[2] * axes
        return stands, f"{positions} positions of {axes} axes, {names[0]} to {names[-1]}", None
    shown = None if shape else shape_of(names)
    if shown is not None:
        return *shown, None
    unequal = sizes_of(names) if shape is None or math.prod(shape) != len(names) else None
    if unequal is None:
        return None, "", None
    pads = Pads.of(unequal[0])
    if shape is None:
        return pads.shape, unequal[1], pads
    return (shape, "", pads) if pads.shape == shape else (None, "", None)


def _refuse_summaries(path: Path, names: Sequence[str]) -> None:
    """Raise InputError where most readings are named as values of a whole grasp or step, a row
    each."""
    found = [name for name in names if is_summary(name)]
    if 2 * len(found) <= len(names):
        return
    what = (
        f"{found[0]} to {found[-1]} are values of a whole grasp or step, as their names say, and a"
        " row is one of them: no frames, so nothing tells how a cell moves; give the recordings"
        " themselves, or name frames with --columns"
    )
    raise InputError.at(path, what)


def _by_names(
    table: _Named,
    taken: Collection[int],
    time_column: str | int | None,
    label_column: str | int | None,
) -> Columns:
    """Return the columns that are no readings, but say something of them: by options, or by names
    among the columns that are not ``taken``."""
    free = ["" if i in taken else name for i, name in enumerate(table.names)]
    clock = _at(free, clock_of(free))
    if time_column is not None:
        clock = table.one("time-column", time_column)
    label = _at(free, first_of(LABELS, free))
    if label_column is not None:
        label = table.one("label-column", label_column)
    unit = None if clock is None or not table.names else unit_of(table.names[clock])
    episode = _at(free, first_of(EPISODES, free))
    scan = _at(free, first_of((SCAN,), free))
    return Columns(table.width, (), clock, unit, label, episode, scan)


def _at(names: Sequence[str], name: str | None) -> int | None:
    """Return the column with a name."""
    return None if name is None else names.index(name)


def _numbered(
    names: Sequence[str], columns: list[int], shape: Shape | None
) -> tuple[list[int], tuple[str, ...]]:
    """Return which of some columns are readings by their names, in the order of the cells, and
    sentences on the others and on the order."""
    if not names:
        return columns, ()
    cells = None if shape is None else math.prod(shape)
    kept = [columns[i] for i in readings_of([names[i] for i in columns], cells)]
    others = [names[i] or str(i) for i in sorted(set(columns) - set(kept))]
    told = [left_out(others, [names[i] for i in kept], "columns")]
    ordered = [kept[i] for i in in_order([names[i] for i in kept], shape)]
    told.append(reordered([names[i] for i in kept], [names[i] for i in ordered], "columns"))
    return ordered, tuple(filter(None, told))


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

    def has_unreadable(self, columns: Collection[int]) -> bool:
        """Return whether the first line holds text or a date in one of some columns."""
        probe = self._dialect.probe[:1]
        return any(i in columns for line in probe for i in self._dialect.unreadable(line))

    def check(self, readings: Sequence[int], clock: int | None) -> None:
        """Raise InputError where there is no reading, or the first lines hold text, and no number,
        in a column of readings."""
        if not readings:
            held = "numbers of frames" if clock is None else "a column of times"
            what = f"holds {held} and no readings; add one column a cell"
            raise InputError.at(self.path, what, self.first_line)
        probe = self._dialect.probe
        text = [i for line in probe[:1] for i in self._dialect.texts(line) if i in readings]
        for row in map(self._dialect.split, probe):
            numbers = {i: self._dialect.number(row[i]) for i in text if i < len(row)}
            text = [i for i in text if (n := numbers.get(i)) is None or n != n]
        if not text:
            return
        cell = self._dialect.split(probe[0])[text[0]]
        named = ",".join(self.names[i] if self.names and self.names[i] else str(i) for i in text)
        what = (
            f"{quoted(cell)} is not a number; write the reading, or leave a column"
            f" of text out: --ignore {named}"
        )
        raise InputError.at(self.path, what, f"{self.first_line}, column {text[0] + 1}")


def _names_of_times(dialect: Dialect) -> tuple[str, ...]:
    """Return the names above a table of another width whose first name is that of a time."""
    if not dialect.preamble or not dialect.separator:
        return ()
    above = dialect.preamble[-1]
    cells = dialect.split(above)
    if not is_clock(cells[0]) or len(dialect.texts(above)) < len(cells):
        return ()
    return tuple((*cells, *[""] * dialect.width)[: dialect.width])


def _clock_of(path: Path, dialect: Dialect, *, even: bool) -> str | None:
    """Return the unit of the times in the first column, "" if it is unknown; None where the column
    is a cell's or counts the frames.

    Times rise in 95 % of the steps, and are dates since 1970, or reach 10 times as far as any
    reading, or, with ``even``, rise in equal steps as no other column does.
    """
    cells = [dialect.first(line) for line in dialect.probe]
    if len(cells) >= 2 and all(map(is_written_out, cells)):
        return "s"
    numbers = [dialect.number(cell) for cell in cells]
    if None in numbers or len(numbers) < _LEAST or dialect.width < 3:
        return None
    times = np.array(numbers, dtype=np.float64)
    if np.mean(np.diff(times) > 0) < _RISES:
        return None
    for unit, ticks in TICKS.items():
        if _YEARS[0] <= times[0] / ticks < _YEARS[1]:
            return unit
    if np.array_equal(times, np.rint(times)) and np.median(np.diff(times)) == 1:
        return None
    values = _first_values(path, dialect)
    if even and _is_even(values[:, 0]) and not any(map(_is_even, values.T[1:])):
        return ""
    largest = np.nanmax(np.abs(values[:, 1:]), initial=0.0)
    rises = np.mean(np.diff(values[:, 0]) > 0) >= _RISES
    return "" if rises and np.nanmax(values[:, 0]) > _FAR * largest else None


def _is_even(column: NDArray[np.float64]) -> bool:
    """Return whether numbers rise in equal steps, as far as their decimals tell."""
    steps = np.diff(column)
    return bool(len(steps) >= _LEAST and steps.min() > 0 and np.ptp(steps) <= _EVEN * steps.mean())


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
