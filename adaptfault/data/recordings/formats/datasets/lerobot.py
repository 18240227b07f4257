"""Reads LeRobot data sets of versions 2.1 and 3.0, a folder with ``meta/info.json``; needs the
extra "datasets"."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from adaptfault.data.recordings.errors import NO_FRAMES, InputError
from adaptfault.data.recordings.facts.labels import natural_key
from adaptfault.data.recordings.facts.roles import named
from adaptfault.data.recordings.formats.datasets import parquet
from adaptfault.data.recordings.formats.datasets.beside import Stated
from adaptfault.data.recordings.formats.datasets.contents import Contents, Opener
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.datasets.features import Sizes, choose
from adaptfault.data.recordings.formats.datasets.reader import recordings_of
from adaptfault.data.recordings.formats.text import read_json_object
from adaptfault.data.recordings.recording import Block, Facts, Recording, Shape

SUFFIXES = ()

_INFO = "meta/info.json"
_TASK = "task_index"
_NUMBERS = re.compile(r"u?int(8|16|32|64)|float(16|32|64)")


def accepts(path: Path) -> bool:
    """Return whether a folder is a data set."""
    return (path / _INFO).is_file()


def open(
    path: Path,
    *,
    shape: Shape | None = None,
    key: str | None = None,
    time_column: str | None = None,
    label_column: str | None = None,
    **stated: Any,
) -> list[Recording]:
    """Return the episodes of a data set; the task of an episode is its class.

    Args:
        path: the folder.
        shape: ``(pads, rows, cols)`` where the user states it. Touch that is faster than the other
            features comes in windows ``[5, n]``: with the shape of the n cells, they are 5 frames
            each.
        key: names of the features that hold the readings, one a pad; None: found by their names
            (:mod:`adaptfault.data.recordings.formats.datasets.features`).
        time_column, label_column: features of times and classes; None: found by name.
        stated: what other readers ask for.

    Raises:
        InputError: pyarrow is not installed, ``info.json`` or all data are damaged, or no feature
            holds touch.
    """
    info = read_json_object(path / _INFO)
    features = info.get("features")
    if not isinstance(features, Mapping):
        raise InputError.at(path / _INFO, "lists no features; expected a LeRobot data set")
    numbers = {}
    for name, about in features.items():
        sizes = _sizes(about)
        if sizes is not None:
            numbers[name] = sizes
    _ = named(path, "time-column", time_column, list(features))
    own_label = named(path, "label-column", label_column, list(features))
    chosen = {name: numbers[name] for name in choose(path, numbers, key)}
    files = sorted(path.glob("data/**/*.parquet"), key=lambda file: natural_key(str(file)))
    if not files:
        raise InputError.at(path, "holds no data/*.parquet; copy the whole data set")
    tasks = {} if own_label is not None else _tasks(path)
    places = Stated(time_column, _TASK if tasks else own_label)
    opened = partial(_opened, info.get("fps"))
    recordings = []
    for file in files:
        for recording in _episodes(path, file, opened, shape, places, chosen):
            task = tasks.get(recording.label or "", recording.label)
            recordings.append(replace(recording, label=task))
    if not recordings:
        raise InputError.at(path, NO_FRAMES)
    read = [one.facts for one in recordings if one.arrays]
    facts = replace(read[0], path=path) if read else Facts(path)
    return [replace(one, facts=facts) for one in recordings]


@contextmanager
def _opened(fps: object, file: Path, names: Sequence[str] | None) -> Iterator[Contents]:
    """Open a file, with the rate that the data set states."""
    with parquet.opened(file, names) as contents:
        contents.attributes[""] = {"fps": fps}
        yield contents


def _sizes(about: object) -> Sizes | None:
    """Return the sizes of a frame of a feature; None where it is none of numbers."""
    if not isinstance(about, Mapping) or not _NUMBERS.fullmatch(str(about.get("dtype"))):
        return None
    shape = about.get("shape", ())
    if not isinstance(shape, list) or not all(isinstance(size, int) for size in shape):
        return None
    return () if shape == [1] else tuple(shape)


def _episodes(
    path: Path,
    file: Path,
    opened: Opener,
    shape: Shape | None,
    stated: Stated,
    chosen: Mapping[str, Sizes],
) -> Iterator[Recording]:
    """Yield the episodes of a file; one that cannot be read says so when its frames are read."""
    opening = partial(opened, file)
    try:
        with opening(None) as contents:
            if stated.label == _TASK and _TASK not in contents.arrays:
                stated = replace(stated, label=None)
        recordings = recordings_of(
            file, opening, shape=shape, key=",".join(chosen), stated=stated, known=chosen
        )
    except InputError as error:
        if str(error).endswith(NO_FRAMES):
            return
        yield Recording(Facts(path), _failing(error), file.relative_to(path).as_posix())
        return
    for recording in recordings:
        name = None if recording.number is None else f"episode {recording.number}"
        yield replace(recording, name=name)


def _failing(error: InputError) -> Any:
    def blocks() -> Iterator[Block]:
        raise error

    return blocks


def _tasks(path: Path) -> dict[str, str]:
    """Return the name of each task; none where they cannot be read: they are optional."""
    lines = path / "meta/tasks.jsonl"
    table = path / "meta/tasks.parquet"
    try:
        if lines.is_file():
            held = [json.loads(line) for line in lines.read_text("utf-8").splitlines() if line]
            return {str(int(one[_TASK])): str(one["task"]) for one in held}
        if table.is_file():
            read = imported("pyarrow.parquet", table).ParquetFile(table).read().to_pydict()
            names = next(column for name, column in read.items() if name != _TASK)
            numbers = [str(int(number)) for number in read[_TASK]]
            return dict(zip(numbers, map(str, names), strict=True))
    except (OSError, ValueError, KeyError, TypeError, StopIteration):
        pass
    return {}
