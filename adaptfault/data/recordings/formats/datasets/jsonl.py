"""Reads JSON lines: an object a line with a list of readings, or the list alone; one frame a
line."""

from __future__ import annotations

import builtins
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adaptfault.data.recordings.errors import NO_FRAMES, InputError, Problem, located
from adaptfault.data.recordings.facts.episodes import Division, Episode, divide, numbered
from adaptfault.data.recordings.facts.roles import (
    EPISODES,
    LABELS,
    clock_of,
    first_of,
    named,
    unit_of,
)
from adaptfault.data.recordings.formats.datasets.features import Pads, Sizes, choose
from adaptfault.data.recordings.recording import BLOCK, Block, Facts, Recording, Shape

SUFFIXES = (".jsonl", ".ndjson")

_READINGS = "readings"  # of a line that is a list alone


def open(
    path: Path,
    *,
    shape: Shape | None = None,
    key: str | None = None,
    time_column: str | None = None,
    label_column: str | None = None,
    **stated: Any,
) -> list[Recording]:
    """Return the recordings of a file: one, or one a value of ``episode`` (``episode_index``,
    ``recording``, ``trial``).

    ``null`` is a missing reading. A last line that was cut off is left out with a warning.

    Args:
        path: the file.
        shape: ``(pads, rows, cols)`` where the user states it.
        key: names of the fields that hold the readings, one a pad; None: found by their names
            (:mod:`adaptfault.data.recordings.formats.datasets.features`).
        time_column, label_column: fields of times and classes; None: found by name.
        stated: what other readers ask for.

    Raises:
        InputError: the file holds no frame, a line is no JSON, or the fields are not clear.
    """
    problems: list[Problem] = []
    parts, first, division = _parts(path, problems, label_column)
    own_clock = named(path, "time-column", time_column, list(first))
    clock = own_clock or clock_of(list(first))
    tick = None if clock is None else unit_of(clock)
    if division.lost:
        problems.append(Problem("warning", located(path, division.lost)))
    fields = {name: _sizes(value) for name, value in first.items()}
    numbers = {name: sizes for name, sizes in fields.items() if sizes is not None}
    if own_clock is not None:
        numbers.pop(own_clock, None)
    names = choose(path, numbers, key)
    sizes = [numbers[name] for name in names]
    pads = Pads.of(sizes, shape)
    facts = Facts(
        path,
        shape=pads.shape,
        present=pads.present,
        inferred=tuple(filter(None, [division.inferred])),
        problems=tuple(problems),
    )

    def blocks(part: _Part) -> Callable[[], Iterator[Block]]:
        return lambda: _blocks(path, names, sizes, pads, part, clock, tick)

    return [Recording(facts, blocks(part), part.name, part.label) for part in parts]


@dataclass(frozen=True)
class _Place:
    """A line of a file: its number, from 1, and the byte at which it begins."""

    number: int = 1
    byte: int = 0


@dataclass(frozen=True)
class _Part:
    """The lines of one recording, which begin at ``first`` and end before ``end``; None: the last
    one."""

    name: str | None
    label: str | None
    first: _Place
    end: _Place | None


def _parts(
    path: Path, problems: list[Problem], label_column: str | None
) -> tuple[list[_Part], dict[str, Any], Division]:
    """Return the recordings of a file, its first line, and how it is divided.

    Raises:
        InputError: it holds no frame, a line is no JSON, or the field of the class is not there.
    """
    places: list[_Place] = []
    numbers: list[Any] = []
    classes: list[Any] = []
    first: dict[str, Any] = {}
    for place, line in _lines(path, _Place(), problems):
        first = first or line
        places.append(place)
        numbers.append(line.get(first_of(EPISODES, list(line)) or ""))
        stated = named(path, "label-column", label_column, list(line))
        classes.append(line.get(stated or first_of(LABELS, list(line)) or ""))
    if not places:
        raise InputError.at(path, NO_FRAMES)
    has_numbers = any(number is not None for number in numbers)
    episodes = numbered(numbers) if has_numbers else [Episode(0, len(places))]
    division = divide(episodes, classes)
    parts = []
    for episode in division.episodes:
        name = None if episode.name is None else f"{path.name}, {episode.name}"
        end = places[episode.last] if episode.last < len(places) else None
        parts.append(_Part(name, episode.label, places[episode.first], end))
    return parts, first, division


def _sizes(value: Any) -> Sizes | None:
    """Return the sizes of a list of numbers; None for what is none."""
    try:
        array = np.array(value, dtype=np.float64)  # null becomes NaN
    except (TypeError, ValueError):
        return None
    return array.shape if not isinstance(value, str) else None


def _lines(
    path: Path, begin: _Place, problems: list[Problem]
) -> Iterator[tuple[_Place, dict[str, Any]]]:
    """Yield place and content of each line from ``begin`` on; a last one that was cut off is left
    out, with a warning in ``problems``."""
    with builtins.open(path, "rb") as file:
        file.seek(begin.byte)
        byte = begin.byte
        for number, data in enumerate(file, begin.number):
            place = _Place(number, byte)
            byte += len(data)
            text = data.decode("utf-8-sig", "replace")
            if not text.strip():
                continue
            try:
                line = json.loads(text)
            except (ValueError, RecursionError):
                if not text.endswith("\n") and number > 1:
                    what = "the last line is cut off: the lines before it are kept"
                    problems.append(Problem("warning", located(path, what)))
                    return
                raise InputError.at(path, "is no JSON; correct it", f"line {number}") from None
            if isinstance(line, list):
                line = {_READINGS: line}
            if not isinstance(line, dict):
                what = "expected an object or a list of readings"
                raise InputError.at(path, what, f"line {number}")
            yield place, line


def _blocks(
    path: Path,
    names: list[str],
    sizes: list[Sizes],
    pads: Pads,
    part: _Part,
    clock: str | None,
    tick: str | None,
) -> Iterator[Block]:
    held: list[tuple[int, list[Any], Any]] = []
    for place, line in _lines(path, part.first, []):
        if part.end is not None and place.byte >= part.end.byte:
            break
        held.append((place.number, [line.get(name) for name in names], line.get(clock or "")))
        if len(held) == BLOCK:
            yield _block(path, held, sizes, names, pads, tick)
            held = []
    if held:
        yield _block(path, held, sizes, names, pads, tick)


def _block(
    path: Path,
    held: list[tuple[int, list[Any], Any]],
    sizes: list[Sizes],
    names: list[str],
    pads: Pads,
    tick: str | None,
) -> Block:
    features = [np.empty((len(held), *size), np.float32) for size in sizes]
    for row, (number, values, _) in enumerate(held):
        for feature, value, name in zip(features, values, names, strict=True):
            try:
                feature[row] = np.asarray(value, dtype=np.float64).reshape(feature.shape[1:])
            except (TypeError, ValueError):
                expected = list(feature.shape[1:])
                what = f"{name} holds no {expected} numbers; correct it, or remove the line"
                raise InputError.at(path, what, f"line {number}") from None
    times = [time for _, _, time in held]
    known = all(isinstance(time, int | float) for time in times) and pads.steps == 1
    return Block(
        pads.frames(features),
        None,
        np.array(times, dtype=np.float64) if known else None,
        tick,
    )
