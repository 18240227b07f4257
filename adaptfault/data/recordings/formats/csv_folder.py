"""Reads CSV files: one recording a file, one frame a line, one cell a column."""

from __future__ import annotations

import builtins
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import dropwhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.facts.sizes import LONGEST_LINE
from adaptfault.data.recordings.formats.text import check_text, decoded, numbered_lines, shown
from adaptfault.data.recordings.recording import Block, Facts, Recording

SUFFIXES = (".csv",)

PIECE = 2_000_000
"""Bytes of text that are parsed at once."""

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

_CLOCK = re.compile(r"(\d{1,2}):([0-5]\d):([0-5]\d(?:\.\d+)?)", re.ASCII)  # of a day

_DATE = re.compile(
    r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?) ?(?:Z|[+-]\d\d:?\d\d)?", re.ASCII
)

_LARGEST = float(np.finfo(np.float32).max)


def open(path: Path, **stated: Any) -> list[Recording]:
    """Return the recording of a CSV file of T lines x D readings, comma separated, with or without
    a header line.

    A first column that the header names as a time (``time``, ``timestamp``, ``t``, with a unit as
    in ``time_ms``) is no reading; it gives the rate. One without a name, or called ``index``,
    ``frame`` or ``sample``, is none either. An empty cell and ``nan`` are missing readings and
    become NaN. Blank lines are skipped. A last line that a power failure cut off is left out with a
    warning, and so is everything from zero bytes on, which stand for data that did not reach the
    disk. A cut inside the last number of a full line cannot be detected.

    Raises:
        InputError: once its frames are read: not text, no readings, lines of different lengths, a
            cell that is no number.
    """
    return [Recording(Facts(path, text=True), lambda: csv_blocks(path))]


@dataclass(frozen=True)
class _Leading:
    """The first columns, which hold no readings.

    Attributes:
        columns: how many.
        clock: which of them holds times; None where none does.
        unit: of the times, where the header states it.
    """

    columns: int = 0
    clock: int | None = None
    unit: str | None = None

    @classmethod
    def of(cls, header: str) -> _Leading:
        """Read the header line of a file."""
        leading = cls()
        for column, name in enumerate(map(_bare, header.split(","))):
            time = _TIME.fullmatch(name)
            is_unit = name.lower() in _ALONE
            if leading.clock is None and (time or is_unit):
                unit = name if time is None else time[1] or ""
                leading = cls(column + 1, column, _UNITS.get(unit.lower()))
            elif _NUMBER.fullmatch(name) and column < 2:
                leading = replace(leading, columns=column + 1)
            else:
                break
        return leading


@dataclass(frozen=True, eq=False)
class _Piece:
    """Some lines of a file: the frames in them, and the columns that hold no readings."""

    block: Block
    leading: _Leading = _Leading()

    @property
    def first_line(self) -> int:
        """The line of the first frame."""
        return 0 if self.block.lines is None else int(self.block.lines[0])


def csv_blocks(path: Path, size: int = PIECE) -> Iterator[Block]:
    """Yield the frames of a file, about ``size`` bytes of text at a time.

    Raises:
        InputError: as :func:`open`, once the place is reached.
    """
    check_text(path)
    before = _Before()
    rest = b""
    width = 0
    try:
        with builtins.open(path, "rb") as file:
            while True:
                data = file.read(size)
                rest += data
                # behind zero bytes nothing is data
                is_last = len(data) < size or b"\0" in data
                cut = len(rest) if is_last else rest.rfind(b"\n") + 1
                piece = rest[:cut]
                rest = rest[cut:]
                if len(rest) > LONGEST_LINE:
                    what = f"has a line of over {LONGEST_LINE:,} bytes, so it is no CSV file"
                    raise InputError.at(path, f"{what}; remove it")
                if piece:
                    parsed = _parse(path, piece, before)
                    here = _width(parsed.block)
                    width = width or here
                    if here not in (0, width):
                        what = f"{_values(here)} where the lines before it have {width}; correct it"
                        raise InputError.at(path, what, f"line {parsed.first_line}")
                    yield parsed.block
                    before = before.behind(piece, parsed)
                if is_last:
                    break
    except OSError as error:
        what = f"cannot be read ({error.strerror}); check the path and its permissions"
        raise InputError.at(path, what) from None
    if not width:
        raise InputError.at(path, "holds no readings; record it again or remove it")


def _width(block: Block) -> int:
    """Return the number of readings in its frames; 0 where it holds no frame."""
    return int(block.values.shape[1]) if len(block.values) else 0


@dataclass(frozen=True)
class _Before:
    """The lines before a piece of a file: how many, the last one, and the columns that hold no
    readings."""

    lines: int = 0
    last: str = ""
    leading: _Leading = _Leading()

    def behind(self, piece: bytes, parsed: _Piece) -> _Before:
        last = piece.rstrip(b"\r\n").rpartition(b"\n")[2]
        return _Before(
            self.lines + piece.count(b"\n"), last.decode("utf-8", "replace"), parsed.leading
        )


def _parse(path: Path, data: bytes, before: _Before) -> _Piece:
    whole, zeros, _ = data.partition(b"\0")
    is_text = data.isascii() and (
        b"\n" in whole or before.lines or not data.rstrip(b"\0").count(b"\0")
    )
    # else the file is binary
    written = whole if (whole or before.lines) and zeros and is_text else data
    text = decoded(path, written)
    rows, numbers = numbered_lines(text)
    problems: tuple[Problem, ...] = ()
    above = rows[-2] if len(rows) > 1 else before.last
    if (
        rows
        and above
        and not text.endswith("\n")
        and (len(written) < len(data) or _is_cut(rows[-1], above))
    ):
        what = "cut off in this line: the lines before it are kept"
        problems = (Problem("warning", located(path, what, f"line {before.lines + numbers[-1]}")),)
        rows = rows[:-1]
        numbers = numbers[:-1]
    leading = before.leading
    if rows and not before.lines and _is_header(rows[0]):
        leading = _Leading.of(rows[0])
        rows = rows[1:]
        numbers = numbers[1:]
    lines = np.array(numbers, dtype=np.intp) + before.lines
    if not rows:
        nothing = np.empty((0, 0), dtype=np.float32)
        return _Piece(Block(nothing, lines, problems=problems), leading)
    if leading.clock is not None and _is_written_out(_cell(rows[0], leading.clock)):
        rows = [_in_seconds(row, leading.clock) for row in rows]
        leading = replace(leading, unit="s")
    kind = np.float64 if leading.columns else np.float32  # float32 holds a unix time to two minutes
    try:
        values = np.loadtxt(rows, dtype=kind, delimiter=",", comments=None, ndmin=2)
    except ValueError:  # numpy's parser is fast, but does not name the cell
        values = _read_by_cell(path, rows, lines.tolist(), kind, leading)
    if not leading.columns:
        return _Piece(Block(values.astype(np.float32, copy=False), lines, problems=problems))
    if values.shape[1] <= leading.columns:
        held = "a column of times" if leading.clock is not None else "numbers of frames"
        raise InputError.at(
            path, f"holds {held} and no readings; add one column a cell", f"line {lines[0]}"
        )
    times = None if leading.clock is None else values[:, leading.clock].astype(np.float64)
    # a reading that float32 cannot hold becomes infinite, and is missing
    with np.errstate(all="ignore"):
        readings = values[:, leading.columns :].astype(np.float32)
    return _Piece(Block(readings, lines, times, leading.unit, problems), leading)


def _cell(row: str, column: int) -> str:
    return _bare((*row.split(",", column + 1), "")[column])


def _is_written_out(cell: str) -> bool:
    """Return whether a cell holds a date, or a time of day."""
    return _DATE.fullmatch(cell) is not None or _CLOCK.fullmatch(cell) is not None


def _in_seconds(row: str, column: int) -> str:
    """Return a line with the date in a column as seconds; what is no date stays, for the parser to
    name."""
    cells = row.split(",", column + 1)
    written = _cell(row, column)
    if clock := _CLOCK.fullmatch(written):
        cells[column] = repr(3600 * int(clock[1]) + 60 * int(clock[2]) + float(clock[3]))
    elif date := _DATE.fullmatch(written):
        with suppress(ValueError):  # the 45th of a month
            cells[column] = repr(int(np.datetime64(date[1], "ns").astype(np.int64)) / 1e9)
    return ",".join(cells)


def _is_cut(line: str, before: str) -> bool:
    """Return whether a line stops short, compared with the line before it."""
    last, last_before = (_bare(row.rpartition(",")[2]) for row in (line, before))
    stops = line.count(",") < before.count(",") or (last != "" and _number(last) is None)
    return stops and (last_before == "" or _number(last_before) is not None)


def _is_header(line: str) -> bool:
    """Return whether a line is a header: most cells are no numbers, or they count the columns (0,
    1, 2, ...)."""
    cells = [_bare(cell) for cell in re.split("[,;\t]", line)]
    if len(cells) == 1:
        # numbers with a wrong separator are a frame too, which the parser refuses
        cells = line.split()
    first = _number(cells[0])
    if first not in (None, 0.0, 1.0) and _number(cells[-1]) is not None:
        return False  # a shortcut for nearly every frame
    numbers = [_number(cell) for cell in cells if cell]
    if 2 * numbers.count(None) > len(numbers):
        return True
    # behind the names of the first columns
    counted = list(dropwhile(lambda number: number is None, numbers))
    # pandas writes such a header by default; no array reads exactly that
    return len(counted) > 3 and any(
        counted == list(range(start, start + len(counted))) for start in (0, 1)
    )


def _read_by_cell(
    path: Path, rows: Sequence[str], numbers: Sequence[int], kind: type, leading: _Leading
) -> NDArray[Any]:
    """Parse cell by cell: accepts missing readings, and names the line and column of a cell that is
    no number."""
    for separator, name in ((";", "';'"), ("\t", "tabs")):
        if separator in rows[0]:
            raise InputError.at(
                path,
                f"separated by {name}? use commas, and a point in decimals",
                f"line {numbers[0]}",
            )
    table = [row.split(",") for row in rows]
    if len(table[0]) == 1 and " " in rows[0].strip():
        raise InputError.at(path, "separated by spaces? use commas", f"line {numbers[0]}")
    width = Counter(len(cells) for cells in table).most_common(1)[0][0]
    for number, cells in zip(numbers, table, strict=True):
        if len(cells) != width:
            remedy = "leave a missing reading as an empty cell, between its commas"
            if number == numbers[-1] and len(cells) < width:
                remedy = "the recording was cut off here: remove the line"
            what = f"{_values(len(cells))} where the other lines have {width}; {remedy}"
            raise InputError.at(path, what, f"line {number}")
    values: NDArray[Any] = np.empty((len(table), width), dtype=kind)
    for frame, (number, cells) in enumerate(zip(numbers, table, strict=True)):
        for column, cell in enumerate(cells):
            reading = _number(_bare(cell)) if cell.strip() else np.nan
            if reading is None:
                what = (
                    f"{shown(cell)} is not a number; write the reading, or leave the cell empty if"
                    " it is missing"
                )
                if column == leading.clock:
                    what = (
                        f"{shown(cell)} is no time; write a number, or a date as"
                        " 2025-03-01T12:00:00.05"
                    )
                elif column == 0 and len(cells) > 1:
                    what += " (name a column of times in a header line, or remove it)"
                raise InputError.at(path, what, f"line {number}, column {column + 1}")
            values[frame, column] = reading
    return values


def _values(count: int) -> str:
    return "1 value" if count == 1 else f"{count} values"


def _bare(cell: str) -> str:
    return cell.strip().strip('"').strip()


def _number(cell: str) -> float | None:
    """Return the number in a cell, or None; readings that float32 cannot hold become infinite, as
    in numpy's parser."""
    try:
        number = float(cell)
    except ValueError:
        return None
    if "_" in cell:  # Python's float accepts 1_000, which no CSV file means
        return None
    return number if abs(number) <= _LARGEST or number != number else float("inf")
