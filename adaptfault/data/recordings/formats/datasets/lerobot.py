"""Reads LeRobot data sets of versions 2.1 and 3.0, a folder with ``meta/info.json``; needs the
extra "datasets"."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.labels import natural_key
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.datasets.features import Pads, Sizes, choose
from adaptfault.data.recordings.formats.datasets.parquet import Table, blocks_of
from adaptfault.data.recordings.formats.datasets.table import named
from adaptfault.data.recordings.formats.text import read_json_object
from adaptfault.data.recordings.recording import Block, Facts, Recording, Shape

SUFFIXES = ()

_INFO = "meta/info.json"
_NUMBERS = ("float16", "float32", "float64", "int8", "int16", "int32", "int64", "uint8", "uint16")


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
    numbers = {
        name: _sizes(about)
        for name, about in features.items()
        if isinstance(about, Mapping) and about.get("dtype") in _NUMBERS
    }
    _ = named(path, "time-column", time_column, list(features))
    own_label = named(path, "label-column", label_column, list(features))
    names = choose(path, numbers, key)
    pads = Pads.of([numbers[name] for name in names], shape)
    rate = info.get("fps")
    facts = Facts(
        path,
        counts=all("int" in features[name]["dtype"] for name in names),
        shape=pads.shape,
        present=pads.present,
        rate=float(rate) * pads.steps if isinstance(rate, int | float) and rate > 0 else None,
    )
    files = sorted(path.glob("data/**/*.parquet"), key=lambda file: natural_key(str(file)))
    if not files:
        raise InputError.at(path, "holds no data/*.parquet; copy the whole data set")
    tasks = {} if own_label is not None else _tasks(path)
    recordings = []
    for file in files:
        read = partial(Table.read, file, time_column, label_column)
        recordings += list(_episodes(path, file, read, facts, names, pads, tasks))
    if not recordings:
        raise InputError.at(path, "holds no frames; record it again or remove it")
    return recordings


def _sizes(about: Mapping[str, Any]) -> Sizes:
    shape = about.get("shape", ())
    if not isinstance(shape, list) or not all(isinstance(size, int) for size in shape):
        return ()
    return tuple(shape)


def _episodes(
    path: Path,
    file: Path,
    read: Callable[[], Table],
    facts: Facts,
    names: list[str],
    pads: Pads,
    tasks: Mapping[int, str],
) -> Iterator[Recording]:
    """Yield the episodes of a file; one that cannot be read says so when its frames are read."""
    try:
        table = read()
        missing = [name for name in names if name not in table.sizes]
        if missing:
            raise InputError.at(file, f"holds no column {missing[0]!r}")
        episodes = list(table.episodes())
        task = table.column("task_index") if "task_index" in table.columns else None
    except InputError as error:
        yield Recording(facts, _failing(error), file.relative_to(path).as_posix())
        return
    for called, label, rows in episodes:
        if task is not None and tasks:
            label = tasks.get(int(task[rows[0]]), label)
        yield Recording(facts, blocks_of(table, rows, names, pads), called, label)


def _failing(error: InputError) -> Any:
    def blocks() -> Iterator[Block]:
        raise error

    return blocks


def _tasks(path: Path) -> dict[int, str]:
    """Return the name of each task; none where they cannot be read: they are optional."""
    lines = path / "meta/tasks.jsonl"
    table = path / "meta/tasks.parquet"
    try:
        if lines.is_file():
            held = [json.loads(line) for line in lines.read_text("utf-8").splitlines() if line]
            return {int(one["task_index"]): str(one["task"]) for one in held}
        if table.is_file():
            read = imported("pyarrow.parquet", table).read_table(table).to_pydict()
            names = next(column for name, column in read.items() if name != "task_index")
            return dict(zip(map(int, read["task_index"]), map(str, names), strict=True))
    except (OSError, ValueError, KeyError, TypeError, StopIteration):
        pass
    return {}
