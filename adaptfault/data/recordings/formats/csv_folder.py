"""Reads text files: tables of one frame a line and one cell a column, with any separator, and files
of one matrix a frame.

How a file writes its table is found once, from its first lines (:mod:`.dialect`), and so is what
its columns hold (:mod:`.columns`).

A column that the header names as a time (``time``, ``timestamp``, ``t``, with a unit as in
``time_ms``) is no reading, wherever it stands; it gives the rate. One that numbers the episodes
(``episode_index``, ``trial``) or names the class (``label``, ``task``) divides the lines into
recordings. A first column without a name, or called ``index``, ``frame`` or ``sample``, is no
reading either, nor is a column that is not numbered where most are. A first column without a name
of a time is taken as one, with a warning, where it rises in equal steps, or far beyond all
readings. An empty cell and ``nan`` are missing readings and become NaN. Blank lines and comments
are skipped. A last line that a power failure cut off is left out with a warning, and so is
everything from zero bytes on, which stand for data that did not reach the disk. A cut inside the
last number of a full line cannot be detected.
"""

from __future__ import annotations

import builtins
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from adaptfault.data.recordings.errors import InputError, Problem
from adaptfault.data.recordings.facts.sizes import LONGEST_LINE
from adaptfault.data.recordings.formats import listed
from adaptfault.data.recordings.formats.columns import Columns, Names, choose_columns
from adaptfault.data.recordings.formats.dialect import (
    CLOCK,
    COMMENTS,
    DATE,
    Dialect,
    bare,
    encoding_of,
    find_dialect,
    is_comment,
    is_written_out,
    number,
    numbered,
    unquoted,
)
from adaptfault.data.recordings.formats.matrices import matrices
from adaptfault.data.recordings.formats.rows import parse_rows
from adaptfault.data.recordings.formats.spans import Span, cell_of, pieces, spans_of
from adaptfault.data.recordings.formats.text import (
    LATIN,
    check_text,
    decoded,
    numbered_lines,
    shown,
)
from adaptfault.data.recordings.recording import Block, Facts, Recording, Shape

SUFFIXES = (".csv", ".txt", ".tsv", ".asc", ".asf")

_TABLES = (".csv", ".tsv")
"""Suffixes of files that are tables; others may be notes."""

_HEAD = 4096  # bytes in which zeros show that a file is binary


def open(
    path: Path,
    *,
    shape: Shape | None = None,
    columns: Names | None = None,
    ignore: Names | None = None,
    time_column: str | int | None = None,
    label_column: str | int | None = None,
    **stated: Any,
) -> list[Recording]:
    """Return the recording of a text file of T lines x D readings, separated by commas, semicolons,
    tabs or blanks, with or without a header line and lines of text above it. A file of blocks of
    lines has one matrix a frame, see :mod:`.matrices`.

    Args:
        path: the file. One that may be notes, as ``.txt``, gives no recording if it holds no line
            of numbers.
        shape: ``(pads, rows, cols)`` where the user states it.
        columns, ignore: what is a reading and what is not: names, patterns, or numbers from 0, as
            "2-33"; several are separated by commas.
        time_column, label_column: the column of times, and of the class.
        stated: what other readers ask for.

    Raises:
        InputError: not text, no readings, a column that is not there; once the frames are read,
            lines of different lengths, or a cell that is no number.
    """
    check_text(path)
    if columns is None and listed.accepts(path):
        places = {"time_column": time_column, "label_column": label_column}
        return listed.open(path, shape=shape, **places, **stated)
    try:
        dialect = find_dialect(path)
    except OSError as error:
        raise _unreadable(path, error) from None
    if dialect is None:
        if path.suffix.lower() in _TABLES:
            raise _no_numbers(path)
        return []
    if dialect.rows:
        return matrices(path, dialect)
    held = choose_columns(path, dialect, columns, ignore, time_column, label_column, shape)
    pads = held.pads
    spans, division = spans_of(path, dialect, held)
    lost = (Problem.warning(path, division.lost),) if division.lost else ()
    facts = Facts(
        path,
        text=True,
        shape=held.shape,
        present=None if pads is None else pads.present,
        declared={} if held.axes == 1 else {"axes": held.axes},
        inferred=tuple(filter(None, (*held.inferred, division.inferred))),
        shape_reason=held.shape_reason,
        names=held.names if pads is None else (),
        sizes=() if pads is None else pads.sizes,
        places=None if pads is None else pads.places,
        problems=(*held.problems, *lost),
    )
    blocks = partial(_blocks, path, dialect, held)
    return [Recording(facts, partial(blocks, span), span.name, span.label) for span in spans]


def _no_numbers(path: Path) -> InputError:
    """Return the error for a table without a line of numbers."""
    if encoding_of(path) != "utf-16":
        with builtins.open(path, "rb") as file:
            decoded(path, file.read(_HEAD), latin=True)
    lines = [(at, line) for at, line in numbered(path) if line and not is_comment(line)]
    if len(lines) < 2:
        return InputError.at(path, "holds no readings; record it again or remove it")
    at, line = lines[1]
    cells = [bare(cell) for cell in line.split(",")]
    column, cell = next(
        ((i, cell) for i, cell in enumerate(cells) if cell and number(cell) is None), (0, "")
    )
    what = f"{shown(cell)} is not a number; write one line of numbers a frame, or remove the file"
    return InputError.at(path, what, f"line {at}, column {column + 1}")


def _unreadable(path: Path, error: OSError) -> InputError:
    what = f"cannot be read ({error.strerror}); check the path and its permissions"
    return InputError.at(path, what)


@dataclass(frozen=True)
class _Before:
    """The lines before a piece of a file: how many, and the last one."""

    lines: int = 0
    last: str = ""

    def behind(self, piece: bytes) -> _Before:
        last = piece.rstrip(b"\r\n").rpartition(b"\n")[2]
        return _Before(self.lines + piece.count(b"\n"), last.decode("utf-8", LATIN))


def _blocks(path: Path, dialect: Dialect, columns: Columns, span: Span) -> Iterator[Block]:
    before = _Before(span.lines)
    rest = b""
    length = 0
    try:
        for data, is_last in pieces(path, dialect, span.begin, span.end):
            rest += data
            cut = len(rest) if is_last else rest.rfind(b"\n") + 1
            piece = rest[:cut]
            rest = rest[cut:]
            if len(rest) > LONGEST_LINE:
                what = f"has a line of over {LONGEST_LINE:,} bytes, so it is no table"
                raise InputError.at(path, f"{what}; remove it")
            if piece:
                block = _parse(path, piece, before, dialect, columns)
                length += len(block.values)
                yield block
                before = before.behind(piece)
    except OSError as error:
        raise _unreadable(path, error) from None
    if not length:
        raise InputError.at(path, "holds no readings; record it again or remove it")


def _parse(path: Path, data: bytes, before: _Before, dialect: Dialect, columns: Columns) -> Block:
    whole, zeros, _ = data.partition(b"\0")
    is_text = data.isascii() and (
        b"\n" in whole or before.lines or not data.rstrip(b"\0").count(b"\0")
    )
    # else the file is binary
    written = whole if (whole or before.lines) and zeros and is_text else data
    text = decoded(path, written, latin=True)
    rows, numbers = numbered_lines(text)
    if '"' in text:
        rows = [unquoted(row) for row in rows]
    problems: tuple[Problem, ...] = ()
    above = rows[-2] if len(rows) > 1 else before.last
    if (
        rows
        and above
        and not text.endswith("\n")
        and (len(written) < len(data) or _is_cut(rows[-1], above, dialect))
    ):
        what = "cut off in this line: the lines before it are kept"
        problems = (Problem.warning(path, what, f"line {before.lines + numbers[-1]}"),)
        rows = rows[:-1]
        numbers = numbers[:-1]
    has_comments = any(mark in text for mark in COMMENTS)
    if before.lines < dialect.skip or has_comments:
        kept = [
            (row, number)
            for row, number in zip(rows, numbers, strict=True)
            if number + before.lines > dialect.skip and not (has_comments and is_comment(row))
        ]
        rows = [row for row, _ in kept]
        numbers = [number for _, number in kept]
    lines = np.array(numbers, dtype=np.intp) + before.lines
    if not rows:
        nothing = np.empty((0, len(columns.readings)), dtype=np.float32)
        return Block(nothing, lines, problems=problems)
    unit = columns.unit
    clock = columns.clock
    if clock is not None and is_written_out(cell_of(rows[0], clock, dialect)):
        rows = [_in_seconds(row, clock, dialect) for row in rows]
        unit = "s"
    kind = np.float32 if clock is None else np.float64  # float32 holds a unix time to two minutes
    values = parse_rows(path, rows, lines.tolist(), dialect, columns, kind)
    used = columns.used
    times = None if clock is None else values[:, used.index(clock)].astype(np.float64)
    scan = None
    if columns.scan is not None:
        scan = values[:, used.index(columns.scan)].astype(np.float64)
    if used != list(columns.readings):
        values = values[:, [used.index(column) for column in columns.readings]]
    # a reading that float32 cannot hold becomes infinite, and is missing
    with np.errstate(all="ignore"):
        readings = values.astype(np.float32, copy=False)
    if columns.pads is not None:
        readings = columns.pads.frames([readings[:, part] for part in columns.parts])
    return Block(readings, lines, times, unit, problems, scan)


def _in_seconds(row: str, column: int, dialect: Dialect) -> str:
    """Return a line with the date in a column as seconds; what is no date stays, for the parser to
    name."""
    cells = row.split(dialect.separator or None, column + 1)
    written = cell_of(row, column, dialect)
    if clock := CLOCK.fullmatch(written):
        seconds = float(clock[3].replace(",", "."))
        cells[column] = repr(3600 * int(clock[1]) + 60 * int(clock[2]) + seconds)
    elif date := DATE.fullmatch(written):
        with suppress(ValueError):  # the 45th of a month
            day = np.datetime64(date[1].replace(",", "."), "ns")
            cells[column] = repr(int(day.astype(np.int64)) / 1e9)
    return (dialect.separator or " ").join(cells)


def _is_cut(line: str, before: str, dialect: Dialect) -> bool:
    """Return whether a line stops short, compared with the line before it."""
    cells = dialect.split(line)
    cells_before = dialect.split(unquoted(before))
    last = cells[-1]
    stops = len(cells) < len(cells_before) or dialect.number(last) is None
    return stops and dialect.number(cells_before[-1]) is not None
