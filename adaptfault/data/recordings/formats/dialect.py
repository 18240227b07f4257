"""Finds how a text file writes its table: encoding, separator, decimal sign, header, and whether a
line or a block of lines is one frame.

The table begins at the first line most of whose values are numbers, if the next line has as many of
them. What is above it is a preamble; its last line is the header, if it has as many names.
"""

from __future__ import annotations

import builtins
import csv
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import dropwhile
from pathlib import Path

import numpy as np

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.sizes import LONGEST_LINE, MOST_CELLS
from adaptfault.data.recordings.formats.text import LATIN

COMMENTS = ("#", "%", "//")

MISSING = frozenset(("", "n/a", "na", "nan", "null", "-"))
"""Cells without a reading, in lower case."""

CLOCK = re.compile(r"(\d{1,2}):([0-5]\d):([0-5]\d(?:[.,]\d+)?)", re.ASCII)  # of a day

DATE = re.compile(
    r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:[.,]\d+)?) ?(?:Z|[+-]\d\d:?\d\d)?", re.ASCII
)

_LARGEST = float(np.finfo(np.float32).max)

TEKSCAN = "ASCII_DATA"
"""Begins the line of a Tekscan file behind which the frames are."""

_FRAME = re.compile(r"\W*frame[\s:#=_-]*\d+\b(?!.*frame).*", re.IGNORECASE)

_SEPARATORS = (";", "\t", ",", "")
_EMPTY = " ,;\t"  # all that a line of empty cells holds
_PROBE = 100  # lines of the table that are kept
_HIGHEST = 1024  # rows of a frame
_BLOCKS = 3  # as many show that blank lines divide frames
_CHUNK = 1 << 16  # letters that are read at once


@dataclass(frozen=True)
class Dialect:
    """How a text file writes its table.

    Attributes:
        encoding: "utf-8-sig", in which invalid bytes are latin-1, or "utf-16".
        separator: of values; "" = blanks.
        skip: lines above the table, the header included.
        width: values in a line of the table.
        header: names of the columns; empty without a header.
        ends: each line ends with a separator, behind which there is no value.
        rows: lines of a frame; 0 = each line is a frame.
        marker: of the line that begins a frame, without its digits; "" = a blank line.
        probe: first lines of the table.
        preamble: lines above the table.
        no_cell: value of a position without a cell; empty without such a value.
    """

    encoding: str = "utf-8-sig"
    separator: str = ","
    skip: int = 0
    width: int = 0
    header: tuple[str, ...] = ()
    ends: bool = False
    rows: int = 0
    marker: str = ""
    probe: tuple[str, ...] = ()
    preamble: tuple[str, ...] = ()
    no_cell: str = ""

    @property
    def decimal_comma(self) -> bool:
        """Whether a comma inside a value is the decimal sign."""
        return self.separator != ","

    def split(self, line: str) -> list[str]:
        """Return the values of a line, without blanks and quotes around them."""
        cells = line.split(self.separator or None)
        if '"' in line:
            with suppress(csv.Error):  # a cell of more than 128 KB
                cells = next(
                    csv.reader([line], delimiter=self.separator or " ", skipinitialspace=True)
                )
            cells = [bare(cell) for cell in cells]
        elif self.separator and (" " in line or "\t" in line):
            cells = [cell.strip() for cell in cells]
        return cells[:-1] if self.ends and len(cells) > 1 and not cells[-1] else cells

    def first(self, line: str) -> str:
        """Return the first value of a line."""
        return bare(line.split(self.separator or None, 1)[0])

    def number(self, cell: str) -> float | None:
        """Return the number in a cell, NaN where it is missing; None where it is text."""
        if cell.lower() in MISSING:
            return float("nan")
        return number(cell.replace(",", ".") if self.decimal_comma else cell)

    def texts(self, line: str) -> list[int]:
        """Return the columns in which a line holds neither a number, a date nor a time of day, and
        is not without a value."""
        cells = self.split(line)
        if _are_floats(cells):
            return []
        return [i for i, cell in enumerate(cells) if self._kind(cell) == "text"]

    def is_numbers(self, line: str) -> bool:
        """Return whether most values of a line are numbers."""
        cells = self.split(line)
        if _are_floats(cells):
            return True
        kinds = [self._kind(cell) for cell in cells if cell]
        return len(kinds) > 2 * kinds.count("text")

    def begins_with_numbers(self, line: str) -> bool:
        """Return whether a line is one of numbers: its first value is one, or most of them are."""
        if is_frame(line):
            return False
        return self._kind(self.first(line)) == "number" or self.is_numbers(line)

    def _kind(self, cell: str) -> str:
        """Return whether a cell is a "number", "missing" or "text"; dates are numbers."""
        if cell.lower() in MISSING:
            return "missing"
        is_number = self.number(cell) is not None or is_written_out(cell)
        return "number" if is_number else "text"

    def unreadable(self, line: str) -> list[int]:
        """Return the columns in which a line holds text or a date."""
        cells = self.split(line)
        if _are_floats(cells):
            return []
        return [i for i, cell in enumerate(cells) if self.number(cell) is None]


_PLAIN = tuple(Dialect(separator=separator) for separator in _SEPARATORS)
"""What may separate the values of a line, in the order in which it is tried."""


def number(cell: str) -> float | None:
    """Return the number in a cell, or None; what float32 cannot hold becomes infinite, as in
    numpy's parser."""
    try:
        value = float(cell)
    except ValueError:
        return None
    if "_" in cell:  # Python's float accepts 1_000, which no file means
        return None
    return value if abs(value) <= _LARGEST or value != value else float("inf")


def bare(cell: str) -> str:
    """Return a cell without blanks and quotes around it."""
    return cell.strip().strip('"').strip()


def is_comment(line: str) -> bool:
    """Return whether a line is a comment."""
    return line.lstrip().startswith(COMMENTS)


def unquoted(line: str) -> str:
    """Return a line without the double quotes that some loggers write around it as a whole."""
    written = line.strip()
    if written.count('"') < 2 or not (written[0] == written[-1] == '"'):
        return line
    within = written[1:-1].replace('""', "")
    is_whole = '"' not in within and any(one in within for one in _SEPARATORS if one)
    return written[1:-1].replace('""', '"') if is_whole else line


def is_written_out(cell: str) -> bool:
    """Return whether a cell holds a date, or a time of day."""
    return DATE.fullmatch(cell) is not None or CLOCK.fullmatch(cell) is not None


def is_frame(line: str) -> bool:
    """Return whether a line begins a frame, as ``Frame 12``."""
    return _FRAME.fullmatch(line) is not None


def marker_of(line: str) -> str:
    """Return a line without digits: what all lines that begin a frame have in common."""
    return re.sub(r"\d+", "", line).strip(" \t.,;")


def encoding_of(path: Path) -> str:
    """Return the encoding that the first bytes of a file state."""
    with builtins.open(path, "rb") as file:
        return "utf-16" if file.read(2) in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"


def numbered(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of each line of a file, "" for a blank line, up to a zero byte:
    behind it nothing is data, nor is the line that holds it.

    Raises:
        InputError: a line is longer than any frame, or holds more numbers.
    """
    at = 0
    parts: list[str] = []  # of the line that the last chunk cut
    with builtins.open(path, encoding=encoding_of(path), errors=LATIN) as file:
        for chunk in iter(partial(file.read, _CHUNK), ""):
            *lines, rest = chunk.partition("\0")[0].split("\n")
            for line in lines:
                at += 1
                whole = "".join([*parts, line])
                parts = []
                _check_width(path, at, whole)
                yield at, unquoted(whole) if whole.strip() else ""
            if "\0" in chunk:
                return
            parts.append(rest)
            if sum(map(len, parts)) > LONGEST_LINE:
                what = f"is over {LONGEST_LINE:,} bytes long, so it is no frame"
                raise InputError.at(path, f"{what}; remove it", f"line {at + 1}")
    whole = "".join(parts)
    if whole:
        _check_width(path, at + 1, whole)
        yield at + 1, unquoted(whole) if whole.strip() else ""


def _check_width(path: Path, at: int, line: str) -> None:
    """Raise InputError where a line holds more numbers than any frame."""
    if len(line) > MOST_CELLS and max(map(line.count, ",;\t |")) > MOST_CELLS:
        what = f"holds over {MOST_CELLS:,} numbers, so it is no frame"
        raise InputError.at(path, f"{what}; remove it", f"line {at}")


def find_dialect(path: Path) -> Dialect | None:
    """Return how a file writes its table; None where it holds no line of numbers.

    Raises:
        OSError: the file cannot be read.
    """
    above: list[str] = []
    held: tuple[int, str] | None = None  # a line of numbers that the next one may confirm
    for at, line in numbered(path):
        if not line.strip(_EMPTY) or (held is not None and is_comment(line)):
            continue
        if line.startswith(TEKSCAN):
            return _tekscan(path, at, above)
        if held is not None:
            if _confirms(held[1], line):
                break
            above.append(held[1])
            held = None
        if _dialect_of(line) is None:
            above.append(line)
        else:
            held = at, line
    return None if held is None else _found(path, above, *held)


def _tekscan(path: Path, skip: int, preamble: list[str]) -> Dialect | None:
    """Return the dialect of an ASCII file of Tekscan, whose rows follow lines ``Frame 1``."""
    rows: list[str] = []
    for at, line in numbered(path):
        if at > skip and line and not is_frame(line):
            rows.append(line)
        elif rows:
            break
    if not rows:
        return None
    dialect = next(one for one in _PLAIN if one.separator in rows[0])
    return replace(
        dialect,
        encoding=encoding_of(path),
        skip=skip,
        width=len(dialect.split(rows[0])),
        rows=len(rows),
        marker=marker_of("Frame 1"),
        probe=tuple(rows),
        preamble=tuple(preamble),
        no_cell="B",
    )


def _confirms(line: str, after: str) -> bool:
    """Return whether the line ``after`` shows that ``line`` begins the table.

    A line of several numbers alone does: where the others have another width, it is to be named,
    not passed over.
    """
    dialect = _dialect_of(line) or _PLAIN[-1]
    width = len(dialect.split(line))
    if width > 1 and not dialect.texts(line):
        return True
    return _dialect_of(after) == dialect and len(dialect.split(after)) == width


def _found(path: Path, above: list[str], first: int, line: str) -> Dialect:
    """Return the dialect of a file whose table begins at its line ``first``."""
    dialect = _dialect_of(line) or _PLAIN[-1]
    separator = dialect.separator
    runs, markers, probe = _runs(path, first, dialect)
    rows, marker = _frames(runs, markers, above[-1] if above else "")
    skip = first - 1
    if not rows and _counts_columns(dialect.split(line)):
        above = [*above, line]
        probe = probe[1:]
        skip = first
    ends = separator not in ("", ",") and all(text.endswith(separator) for text in probe)
    dialect = replace(dialect, encoding=encoding_of(path), ends=ends)
    width = len(dialect.split(probe[0] if probe else line))
    header = _header(above[-1], dialect, width) if above else ()
    if rows and not marker and header:  # blank lines inside a table
        rows = 0
    return replace(
        dialect,
        skip=skip,
        width=width,
        header=() if rows else header,
        rows=rows,
        marker=marker,
        probe=tuple(probe),
        preamble=tuple(above),
    )


def _runs(path: Path, first: int, dialect: Dialect) -> tuple[list[int], list[str], list[str]]:
    """Return the lengths of the first blocks of lines of numbers, the lines between them, and the
    first lines of numbers."""
    runs = [0]
    markers: list[str] = []
    probe: list[str] = []
    between: str | None = None
    for at, line in numbered(path):
        if at < first:
            continue
        is_row = line[:1].isdigit()  # a shortcut for nearly every line
        if not is_row and is_comment(line) and not is_frame(line):
            continue
        if not line or not (is_row or dialect.begins_with_numbers(line)):
            between = line or between or ""
            continue
        if between is not None:
            if len(runs) == _BLOCKS:
                break
            runs.append(0)
            markers.append(between)
            between = None
        runs[-1] += 1
        if len(probe) < _PROBE:
            probe.append(line)
        if runs[-1] > _HIGHEST:
            break
    return runs, markers, probe


def _frames(runs: Sequence[int], markers: Sequence[str], above: str) -> tuple[int, str]:
    """Return the lines of a frame and what begins one; 0 where each line is a frame."""
    if runs[0] > _HIGHEST:
        return 0, ""
    if is_frame(above):
        return runs[0], marker_of(above)
    between = markers[0] if markers else ""
    if is_frame(between):
        return runs[0], marker_of(between)
    marker = marker_of(between)
    is_numbered = any(map(str.isdigit, between)) and any(map(str.isalpha, marker))
    if is_numbered and marker_of(above) == marker:
        return runs[0], marker
    is_regular = len(runs) == _BLOCKS and runs[0] == runs[1] > 1 and not any(markers)
    return (runs[0] if is_regular else 0), ""


def _header(line: str, dialect: Dialect, width: int) -> tuple[str, ...]:
    """Return the names of so many columns, where a line holds them; empty where it does not."""
    written = line.lstrip().lstrip("#%/") if is_comment(line) else line
    for one in (replace(dialect, ends=False), *_PLAIN):
        cells = one.split(written)
        while len(cells) > width and not cells[-1]:
            cells = cells[:-1]
        if len(cells) == width < 2 * sum(map(bool, cells)):
            return tuple(cells)
    return ()


def _dialect_of(line: str) -> Dialect | None:
    """Return how the values of a line are separated, most of which are numbers; None where they are
    not."""
    if is_comment(line) or is_frame(line):
        return None
    found = (one for one in _PLAIN if one.separator in line and one.is_numbers(line))
    return next(found, None)


def _are_floats(cells: Sequence[str]) -> bool:
    """Return whether all cells are numbers, without a call for each."""
    try:
        list(map(float, cells))
    except ValueError:
        return False
    return True


def _counts_columns(cells: Sequence[str]) -> bool:
    """Return whether cells are a header that counts the columns (0, 1, 2, ...), as pandas writes it
    by default, behind the names of the first columns; no array reads exactly that."""
    first = number(cells[0])
    if first not in (None, 0.0, 1.0) and number(cells[-1]) is not None:
        return False  # a shortcut for nearly every file
    numbers = [number(cell) for cell in cells if cell]
    counted = list(dropwhile(lambda value: value is None, numbers))
    return len(counted) > 3 and any(
        counted == list(range(start, start + len(counted))) for start in (0, 1)
    )
