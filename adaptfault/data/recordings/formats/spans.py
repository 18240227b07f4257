"""Which lines of a text file are one recording: all of them, or those of an episode or a class that
a column names."""

from __future__ import annotations

import builtins
import codecs
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.episodes import (
    Division,
    Episode,
    divide,
    refuse_a_row_each,
)
from adaptfault.data.recordings.facts.episodes import numbered as by_number
from adaptfault.data.recordings.formats.columns import Columns
from adaptfault.data.recordings.formats.dialect import Dialect, bare, is_comment, unquoted
from adaptfault.data.recordings.formats.text import LATIN

PIECE = 2_000_000
"""Bytes of text that are read at once."""


@dataclass(frozen=True)
class Span:
    """Some lines of a file.

    Attributes:
        lines: how many are before it.
        begin: the byte at which it begins, in the text as UTF-8.
        end: the byte behind it; None: the end of the file.
        name: of the episode.
        label: its class.
    """

    lines: int = 0
    begin: int = 0
    end: int | None = None
    name: str | None = None
    label: str | None = None


def spans_of(path: Path, dialect: Dialect, columns: Columns) -> tuple[list[Span], Division]:
    """Return the recordings of a file, and how they were divided.

    Raises:
        InputError: the column of classes is empty, or each row is another episode.
    """
    if columns.episode is None and columns.label is None:
        return [Span()], Division(())
    places: list[tuple[int, int]] = []
    numbers: list[str] = []
    classes: list[str] = []
    for at, begin, line in _rows(path, dialect):
        places.append((at - 1, begin))
        if columns.episode is not None:
            numbers.append(cell_of(line, columns.episode, dialect))
        if columns.label is not None:
            classes.append(cell_of(line, columns.label, dialect))
    if columns.label is not None and not any(classes):
        what = f"column {columns.label} is empty; --label-column names the class"
        raise InputError.at(path, what)
    episodes = by_number(numbers) if numbers else [Episode(0, len(places))]
    refuse_a_row_each(path, episodes)
    division = divide(episodes, classes) if classes else Division(tuple(episodes))
    begins = [places[episode.first] for episode in division.episodes]
    ends = [*(begin for _, begin in begins[1:]), None]
    begins[0] = (0, 0)
    spans = []
    for (lines, begin), end, episode in zip(begins, ends, division.episodes, strict=True):
        name = None if episode.name is None else f"{path.name}, {episode.name}"
        spans.append(Span(lines, begin, end, name, episode.label))
    return spans, division


def pieces(
    path: Path, dialect: Dialect, begin: int = 0, end: int | None = None
) -> Iterator[tuple[bytes, bool]]:
    """Yield the bytes of a file from ``begin`` to ``end``, as UTF-8, and whether they are the last:
    behind zero bytes nothing is data."""
    is_wide = dialect.encoding == "utf-16"
    decoder = codecs.getincrementaldecoder("utf-16")("replace")
    with builtins.open(path, "rb") as file:
        at = 0 if is_wide else file.seek(begin)
        while True:
            data = file.read(PIECE)
            is_last = len(data) < PIECE
            if is_wide:
                data = decoder.decode(data).encode("utf-8", "replace")
            before = at
            at += len(data)
            if end is not None and at >= end:
                data = data[: end - before]
                is_last = True
            data = data[max(0, begin - before) :]
            is_last = is_last or b"\0" in data
            yield data, is_last
            if is_last:
                break


def cell_of(line: str, column: int, dialect: Dialect) -> str:
    """Return the value in a column of a line; "" where there is none."""
    if dialect.separator and '"' not in line:  # splits no further than needed
        cells = line.split(dialect.separator, column + 1)
        return cells[column].strip() if column < len(cells) else ""
    return (*dialect.split(line), *[""] * (column + 1))[column]


def _rows(path: Path, dialect: Dialect) -> Iterator[tuple[int, int, str]]:
    """Yield the number of each line of the table, the byte at which it begins, and its text."""
    number = 0
    begin = 0
    rest = b""
    for data, is_last in pieces(path, dialect):
        *lines, rest = (rest + data.partition(b"\0")[0]).split(b"\n")
        if is_last:
            lines.append(rest)
        for line in lines:
            number += 1
            text = line.decode("utf-8", LATIN)
            if number > dialect.skip and bare(text) and not is_comment(text):
                yield number, begin, unquoted(text.rstrip("\r"))
            begin += len(line) + 1
