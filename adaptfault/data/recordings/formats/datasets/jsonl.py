"""Reads JSON lines: an object a line with a list of readings, or the list alone; one frame a
line."""

from __future__ import annotations

import builtins
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.formats.datasets.features import Pads, Sizes, choose
from adaptfault.data.recordings.formats.datasets.table import (
    EPISODES,
    LABELS,
    clock_of,
    first_of,
)
from adaptfault.data.recordings.recording import BLOCK, Block, Facts, Recording, Shape

SUFFIXES = (".jsonl", ".ndjson")

_READINGS = "readings"  # of a line that is a list alone


def open(
    path: Path, *, shape: Shape | None = None, key: str | None = None, **stated: Any
) -> list[Recording]:
    """Return the recordings of a file: one, or one a value of ``episode`` (``episode_index``,
    ``recording``, ``trial``).

    ``null`` is a missing reading. A last line that was cut off is left out with a warning.

    Args:
        path: the file.
        shape: ``(pads, rows, cols)`` where the user states it.
        key: names of the fields that hold the readings, one a pad; None: found by their names
            (:mod:`adaptfault.data.recordings.formats.datasets.features`).
        stated: what other readers ask for.

    Raises:
        InputError: the file holds no frame, a line is no JSON, or the fields are not clear.
    """
    episodes: list[Any] = []
    labels: list[str | None] = []
    first: dict[str, Any] | None = None
    for _, line in _lines(path):
        if first is None:
            first = line
        number = line.get(first_of(EPISODES, list(line)) or "")
        if not episodes or number != episodes[-1]:
            episodes.append(number)
            label = line.get(first_of(LABELS, list(line)) or "")
            labels.append(None if label is None else str(label))
    if first is None:
        raise InputError.at(path, "holds no frames; record it again or remove it")
    fields = {name: _sizes(value) for name, value in first.items()}
    numbers = {name: sizes for name, sizes in fields.items() if sizes is not None}
    names = choose(path, numbers, key)
    sizes = [numbers[name] for name in names]
    pads = Pads.of(sizes, shape)
    facts = Facts(path, shape=pads.shape, present=pads.present, problems=_cut_off(path))

    def blocks(turn: int) -> Callable[[], Iterator[Block]]:
        return lambda: _blocks(path, names, sizes, pads, turn)

    return [
        Recording(
            facts, blocks(turn), None if number is None else f"{path.name}, episode {number}", label
        )
        for turn, (number, label) in enumerate(zip(episodes, labels, strict=True))
    ]


def _sizes(value: Any) -> Sizes | None:
    """Return the sizes of a list of numbers; None for what is none."""
    try:
        array = np.array(value, dtype=np.float64)  # null becomes NaN
    except (TypeError, ValueError):
        return None
    return array.shape if not isinstance(value, str) else None


def _lines(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield number and content of each line; a last one that was cut off is left out."""
    with builtins.open(path, encoding="utf-8-sig", errors="replace") as file:
        for number, text in enumerate(file, 1):
            if not text.strip():
                continue
            try:
                line = json.loads(text)
            except (ValueError, RecursionError):
                if not text.endswith("\n") and number > 1:
                    return
                raise InputError.at(path, "is no JSON; correct it", f"line {number}") from None
            if isinstance(line, list):
                line = {_READINGS: line}
            if not isinstance(line, dict):
                what = "expected an object or a list of readings"
                raise InputError.at(path, what, f"line {number}")
            yield number, line


def _cut_off(path: Path) -> tuple[Problem, ...]:
    with builtins.open(path, "rb") as file:
        lines = file.read().rstrip(b"\r\n").rpartition(b"\n")
    try:
        json.loads(lines[2])
    except (ValueError, RecursionError):
        what = "the last line is cut off: the lines before it are kept"
        return (Problem("warning", located(path, what)),)
    return ()


def _blocks(
    path: Path, names: list[str], sizes: list[Sizes], pads: Pads, turn: int
) -> Iterator[Block]:
    episode: Any = None
    at = -1
    held: list[tuple[int, list[Any], Any]] = []
    clock: str | None = None
    tick: str | None = None
    for number, line in _lines(path):
        this = line.get(first_of(EPISODES, list(line)) or "")
        if at < 0 or this != episode:
            at += 1
            episode = this
            clock, tick = clock_of(list(line))
        if at > turn:
            break
        if at < turn:
            continue
        held.append((number, [line.get(name) for name in names], line.get(clock or "")))
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
