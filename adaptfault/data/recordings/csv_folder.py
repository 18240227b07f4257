"""Reads CSV files: one recording a file, one frame a line, one cell a column."""

from __future__ import annotations

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

from adaptfault.data.recordings.content import Content
from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.sizes import LONGEST_LINE
from adaptfault.data.recordings.text import decoded, numbered_lines, read_bytes, shown

_TICKS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}  # a second

_TIME = re.compile(
    r"(?:time(?:[_ ]?stamp)?|stamp|t)(?:[_ ]?[\[(]?(s|sec|seconds|ms|us|ns)[\])]?)?", re.IGNORECASE | re.ASCII
)

_NUMBER = re.compile(r"|unnamed: 0|index|(?:frame|sample)(?:[_ ]?(?:id|no|number))?", re.IGNORECASE)

_DATE = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?) ?(?:Z|[+-]\d\d:?\d\d)?", re.ASCII)

_LARGEST = float(np.finfo(np.float32).max)


def read_csv(path: Path) -> Content:
    """Read a CSV file of T lines x D readings, comma separated, with or without a header line.

    A first column that the header names as a time (``time``, ``timestamp``, ``t``, with a unit as in ``time_ms``) is no
    reading; it gives the rate. One without a name, or called ``index``, ``frame`` or ``sample``, is none either. An
    empty cell and ``nan`` are missing readings and become NaN. Blank lines are skipped.
    A last line that a power failure cut off is left out with a warning, and so is everything from zero bytes on, which
    stand for data that did not reach the disk. A cut inside the last number of a full line cannot be detected.

    Raises:
        InputError: not text, no readings, lines of different lengths, a cell that is no number.
    """
    parsed = _parse(path, read_bytes(path), _Before())
    if parsed.values is None:
        raise InputError.at(path, "holds no readings; record it again or remove it")
    with np.errstate(invalid="ignore"):
        counts = bool(np.all((parsed.values == np.rint(parsed.values)) | np.isnan(parsed.values)))
    rate = parsed.rate
    return Content(
        path,
        (parsed.values,),
        counts,
        lines=parsed.lines,
        rate=rate,
        rate_reason="" if rate is None else f"time column of {path.name}",
        problems=parsed.problems,
    )


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
            if leading.clock is None and (time := _TIME.fullmatch(name)):
                unit = (time[1] or "").lower() or None
                leading = cls(column + 1, column, "s" if unit in ("sec", "seconds") else unit)
            elif _NUMBER.fullmatch(name) and column < 2:
                leading = replace(leading, columns=column + 1)
            else:
                break
        return leading


@dataclass(frozen=True, eq=False)
class Piece:
    """Some lines of a file.

    Attributes:
        values: float32 ``[t, D]``; None where the lines hold no frame.
        lines: int ``[t]``, their numbers.
        problems: errors and warnings.
        times: float64 ``[t]``, of a time column; None where there is none.
        leading: the columns that hold no readings; its unit is "s", "ms", "us", "ns" or None.
    """

    values: NDArray[np.float32] | None
    lines: NDArray[np.intp]
    problems: tuple[Problem, ...] = ()
    times: NDArray[np.float64] | None = None
    leading: _Leading = _Leading()

    @property
    def rate(self) -> float | None:
        """Frames per second from the median period of the times; None where there are none that rise.

        Without a unit in the header, the times are in the first of s, ms, us and ns that gives 0.5 to 2000 Hz.
        """
        if self.times is None or len(self.times) < 2:
            return None
        with np.errstate(all="ignore"):  # a time may be anything that a file can hold
            periods = np.diff(self.times)
        periods = periods[np.isfinite(periods)]
        period = float(np.median(periods)) if periods.size else 0.0
        if not period > 0:
            return None
        stated = self.leading.unit
        rates = [_TICKS[unit] / period for unit in ([stated] if stated else _TICKS)]
        return next((float(f"{rate:.3g}") for rate in rates if stated or 0.5 <= rate <= 2000), None)


def csv_pieces(path: Path, size: int) -> Iterator[Piece]:
    """Yield a file as :func:`read_csv` reads it, about ``size`` bytes at a time.

    Raises:
        InputError: as :func:`read_csv`, once the place is reached.
    """
    before, rest, width = _Before(), b"", 0
    try:
        with open(path, "rb") as file:
            while True:
                data = file.read(size)
                cut = data.rfind(b"\n") + 1 if data else 0
                piece, rest = (rest + data[:cut], data[cut:]) if cut or not data else (b"", rest + data)
                if len(rest) > LONGEST_LINE:
                    raise InputError.at(
                        path, f"has a line of over {LONGEST_LINE:,} bytes, so it is no CSV file; remove it"
                    )
                if piece:
                    parsed = _parse(path, piece, before)
                    here = width if parsed.values is None else parsed.values.shape[1]
                    width = width or here
                    if here != width:
                        what = f"{_values(here)} where the lines before it have {width}; correct it"
                        raise InputError.at(path, what, f"line {parsed.lines[0]}")
                    yield parsed
                    if b"\0" in piece:
                        return  # cut off here
                    before = before.behind(piece, parsed)
                if not data:
                    return
    except OSError as error:
        raise InputError.at(path, f"cannot be read ({error.strerror}); check the path and its permissions") from None


@dataclass(frozen=True)
class _Before:
    """The lines before a piece of a file: how many, the last one, and the columns that hold no readings."""

    lines: int = 0
    last: str = ""
    leading: _Leading = _Leading()

    def behind(self, piece: bytes, parsed: Piece) -> _Before:
        last = piece.rstrip(b"\r\n").rpartition(b"\n")[2]
        return _Before(self.lines + piece.count(b"\n"), last.decode("utf-8", "replace"), parsed.leading)


def _parse(path: Path, data: bytes, before: _Before) -> Piece:
    whole, zeros, _ = data.partition(b"\0")
    is_text = data.isascii() and (b"\n" in whole or before.lines or not data.rstrip(b"\0").count(b"\0"))
    written = whole if (whole or before.lines) and zeros and is_text else data  # else the file is binary
    text = decoded(path, written)
    rows, numbers = numbered_lines(text)
    problems: tuple[Problem, ...] = ()
    above = rows[-2] if len(rows) > 1 else before.last
    if rows and above and not text.endswith("\n") and (len(written) < len(data) or _is_cut(rows[-1], above)):
        what = "cut off in this line: the lines before it are kept"
        problems = (Problem("warning", located(path, what, f"line {before.lines + numbers[-1]}")),)
        rows, numbers = rows[:-1], numbers[:-1]
    leading = before.leading
    if rows and not before.lines and _is_header(rows[0]):
        leading = _Leading.of(rows[0])
        rows, numbers = rows[1:], numbers[1:]
    lines = np.array(numbers, dtype=np.intp) + before.lines
    if not rows:
        return Piece(None, lines, problems, leading=leading)
    if leading.clock is not None and _DATE.fullmatch(_cell(rows[0], leading.clock)):
        rows, leading = [_in_seconds(row, leading.clock) for row in rows], replace(leading, unit="s")
    kind = np.float64 if leading.columns else np.float32  # float32 holds a unix time to two minutes
    try:
        values = np.loadtxt(rows, dtype=kind, delimiter=",", comments=None, ndmin=2)
    except ValueError:  # numpy's parser is fast, but does not name the cell
        values = _read_by_cell(path, rows, lines.tolist(), kind, leading)
    if not leading.columns:
        return Piece(values.astype(np.float32, copy=False), lines, problems)
    if values.shape[1] <= leading.columns:
        held = "a column of times" if leading.clock is not None else "numbers of frames"
        raise InputError.at(path, f"holds {held} and no readings; add one column a cell", f"line {lines[0]}")
    times = None if leading.clock is None else values[:, leading.clock].astype(np.float64)
    with np.errstate(all="ignore"):  # a reading that float32 cannot hold becomes infinite, and is missing
        return Piece(values[:, leading.columns :].astype(np.float32), lines, problems, times, leading)


def _cell(row: str, column: int) -> str:
    return _bare((*row.split(",", column + 1), "")[column])


def _in_seconds(row: str, column: int) -> str:
    """Return a line with the date in a column as seconds; what is no date stays, for the parser to name."""
    cells = row.split(",", column + 1)
    if date := _DATE.fullmatch(_cell(row, column)):
        with suppress(ValueError):  # the 45th of a month
            cells[column] = repr(int(np.datetime64(date[1], "ns").astype(np.int64)) / 1e9)
    return ",".join(cells)


def _is_cut(line: str, before: str) -> bool:
    """Return whether a line stops short, compared with the line before it."""
    last, last_before = (_bare(row.rpartition(",")[2]) for row in (line, before))
    stops = line.count(",") < before.count(",") or (last != "" and _number(last) is None)
    return stops and (last_before == "" or _number(last_before) is not None)


def _is_header(line: str) -> bool:
    """Return whether a line is a header: most cells are no numbers, or they count the columns (0, 1, 2, ...)."""
    cells = [_bare(cell) for cell in re.split("[,;\t]", line)]
    if len(cells) == 1:
        cells = line.split()  # numbers with a wrong separator are a frame too, which the parser refuses
    first = _number(cells[0])
    if first not in (None, 0.0, 1.0) and _number(cells[-1]) is not None:
        return False  # a shortcut for nearly every frame
    numbers = [_number(cell) for cell in cells if cell]
    if 2 * numbers.count(None) > len(numbers):
        return True
    counted = list(dropwhile(lambda number: number is None, numbers))  # behind the names of the first columns
    # pandas writes such a header by default; no array reads exactly that
    return len(counted) > 3 and any(counted == list(range(start, start + len(counted))) for start in (0, 1))


def _read_by_cell(
    path: Path, rows: Sequence[str], numbers: Sequence[int], kind: type, leading: _Leading
) -> NDArray[Any]:
    """Parse cell by cell: accepts missing readings, and names the line and column of a cell that is no number."""
    for separator, name in ((";", "';'"), ("\t", "tabs")):
        if separator in rows[0]:
            raise InputError.at(path, f"separated by {name}? use commas, and a point in decimals", f"line {numbers[0]}")
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
                what = f"{shown(cell)} is not a number; write the reading, or leave the cell empty if it is missing"
                if column == leading.clock:
                    what = f"{shown(cell)} is no time; write a number, or a date as 2025-03-01T12:00:00.05"
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
    """Return the number in a cell, or None; readings that float32 cannot hold become infinite, as in numpy's parser."""
    try:
        number = float(cell)
    except ValueError:
        return None
    if "_" in cell:  # Python's float accepts 1_000, which no CSV file means
        return None
    return number if abs(number) <= _LARGEST or number != number else float("inf")
