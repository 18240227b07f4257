"""Reads text files in which a block of lines is one frame, a line one row of the array: divided by
blank lines, by lines such as ``Frame 12``, or as Tekscan's ASCII files are."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, Problem
from adaptfault.data.recordings.formats.columns import Columns
from adaptfault.data.recordings.formats.dialect import (
    Dialect,
    is_comment,
    is_frame,
    marker_of,
    number,
    numbered,
)
from adaptfault.data.recordings.formats.rows import parse_rows
from adaptfault.data.recordings.formats.spans import PIECE
from adaptfault.data.recordings.recording import Block, Facts, Recording

_END = "@@"
_LONGEST_UNIT = 16

Lines = list[tuple[int, str]]


def matrices(path: Path, dialect: Dialect) -> list[Recording]:
    """Return the recording of a file whose frames are blocks of lines.

    A preamble as Tekscan's (``SECONDS_PER_FRAME 0.01``, ``UNITS kPa``) states rate and unit. A
    position that reads ``B`` in its first frame has no cell.

    Raises:
        InputError: the preamble states another number of rows or columns than the first frame has.
    """
    stated = dict(_stated(line) for line in dialect.preamble)
    shape = 1, dialect.rows, dialect.width
    for name, came in (("ROWS", dialect.rows), ("COLS", dialect.width)):
        expected = number(stated.get(name, ""))
        if dialect.no_cell and expected not in (None, float(came)):
            what = f"{name} {expected:g}, but the first frame has {came}; correct it"
            raise InputError.at(path, what)
    seconds = number(stated.get("SECONDS_PER_FRAME", "").replace(",", "."))
    facts = Facts(
        path,
        text=True,
        shape=shape,
        present=_present(dialect),
        unit=_unit(stated.get("UNITS", "")),
        rate=float(f"{1 / seconds:.6g}") if seconds and seconds > 0 else None,
    )
    return [Recording(facts, lambda: matrix_blocks(path, dialect))]


def _stated(line: str) -> tuple[str, str]:
    """Return the key and the value of a line ``KEY value``."""
    key, _, value = line.strip(" \t,;").replace("\t", " ").partition(" ")
    return key.upper(), value.strip()


def _present(dialect: Dialect) -> NDArray[np.bool_] | None:
    if not dialect.no_cell:
        return None
    rows = [dialect.split(line) for line in dialect.probe]
    absent = [
        [cell == dialect.no_cell for cell in (*row, *[""] * dialect.width)[: dialect.width]]
        for row in rows
    ]
    return None if not np.any(absent) else ~np.array([absent])


def _unit(written: str) -> str | None:
    """Return the unit of a file; raw readings are counts, and long texts are none."""
    if written.lower().startswith("raw"):
        return "count"
    return written if 0 < len(written) <= _LONGEST_UNIT and len(written.split()) == 1 else None


def matrix_blocks(path: Path, dialect: Dialect) -> Iterator[Block]:
    """Yield the frames of a file, about :data:`.spans.PIECE` characters of text at a time.

    Raises:
        InputError: a frame has another number of lines than the first, or a line another number of
            values; a value is no number; there is no whole frame.
    """
    held: Lines = []
    length = 0
    problems: tuple[Problem, ...] = ()
    for whole, (frame, is_last) in enumerate(_with_end(_grouped(path, dialect))):
        at = f"line {frame[0][0]}"
        is_short = len(frame) < dialect.rows or len(dialect.split(frame[-1][1])) < dialect.width
        if is_last and whole and is_short:
            what = "cut off in this frame: the frames before it are kept"
            problems = (Problem.warning(path, what, at),)
            break
        if len(frame) != dialect.rows:
            what = (
                f"{len(frame)} lines in this frame where the first has {dialect.rows}; add what is"
                " missing, or remove the frame"
            )
            raise InputError.at(path, what, at)
        held += frame
        length += sum(len(line) for _, line in frame)
        if length > PIECE:
            yield _block(path, held, dialect)
            held = []
            length = 0
    if held:
        yield _block(path, held, dialect, problems)
    elif problems:
        nothing = np.empty((0, dialect.rows * dialect.width), dtype=np.float32)
        yield Block(nothing, np.empty(0, dtype=np.intp), problems=problems)


def _grouped(path: Path, dialect: Dialect) -> Iterator[Lines]:
    """Yield the lines of each frame."""
    frame: Lines = []
    for at, line in numbered(path):
        if at <= dialect.skip:
            continue
        if line.strip() == _END:
            break
        is_marker = bool(line) and (is_frame(line) or marker_of(line) == dialect.marker != "")
        if is_marker or (not line and not dialect.marker):
            if frame:
                yield frame
            frame = []
        elif line and not is_comment(line):
            frame.append((at, line))
    if frame:
        yield frame


def _with_end(frames: Iterator[Lines]) -> Iterator[tuple[Lines, bool]]:
    """Yield each frame and whether it is the last."""
    before = next(frames, None)
    for frame in frames:
        if before is not None:
            yield before, False
        before = frame
    if before is not None:
        yield before, True


def _block(path: Path, held: Lines, dialect: Dialect, problems: tuple[Problem, ...] = ()) -> Block:
    rows = [line for _, line in held]
    if dialect.no_cell:
        rows = [row.replace(dialect.no_cell, "nan") for row in rows]
    lines = [at for at, _ in held]
    columns = Columns(dialect.width, tuple(range(dialect.width)))
    values = parse_rows(path, rows, lines, dialect, columns, np.float32)
    frames = values.reshape(-1, dialect.rows * dialect.width)
    return Block(frames, np.array(lines[:: dialect.rows], dtype=np.intp), problems=problems)
