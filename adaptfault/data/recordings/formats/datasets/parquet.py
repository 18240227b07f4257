"""Reads Parquet files; needs the extra "datasets".

A column of lists holds a pad, or each column of numbers a cell. A column ``episode_index`` (or
``episode``, ``recording``, ``trial``) divides the rows into recordings.
"""

from __future__ import annotations

import builtins
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.datasets.features import Pads, Sizes, choose
from adaptfault.data.recordings.formats.datasets.table import (
    EPISODES,
    LABELS,
    clock_of,
    first_of,
    named,
    unit_of,
)
from adaptfault.data.recordings.recording import BLOCK, Block, Facts, Recording, Shape

SUFFIXES = (".parquet", ".pq")


def open(
    path: Path,
    *,
    shape: Shape | None = None,
    key: str | None = None,
    time_column: str | None = None,
    label_column: str | None = None,
    **stated: Any,
) -> list[Recording]:
    """Return the recordings of a file, one an episode.

    Args:
        path: the file.
        shape: ``(pads, rows, cols)`` where the user states it.
        key: names of the columns that hold the readings; None: found by their names
            (:mod:`adaptfault.data.recordings.formats.datasets.features`).
        time_column, label_column: columns of times and classes; None: found by name.
        stated: what other readers ask for.

    Raises:
        InputError: pyarrow is not installed, the file is damaged, or the columns are not clear.
    """
    table = Table.read(path, time_column, label_column)
    names = table.cells(key)
    sizes = [table.sizes[name] for name in names]
    if not any(sizes):  # each column is a cell
        sizes = [(len(names),)]
    pads = Pads.of(sizes, shape)
    counts = all(table.whole[name] for name in names)
    facts = Facts(path, counts=counts, shape=pads.shape, present=pads.present)
    if not sum(table.group_rows):
        raise InputError.at(path, "holds no frames; record it again or remove it")
    return [
        Recording(
            facts,
            blocks_of(table, rows, names, pads),
            None if called is None else f"{path.name}, {called}",
            label,
        )
        for called, label, rows in table.episodes()
    ]


@dataclass(frozen=True, eq=False)
class Table:
    """The columns of a file.

    Attributes:
        path: the file.
        sizes: of a frame in each column of numbers; ``()`` for a single number.
        whole: whether its numbers are whole by their type.
        columns: all names.
        group_rows: rows of each row group.
        clock, tick: the column of times, and its unit.
        label: the column of classes.
    """

    path: Path
    sizes: dict[str, Sizes]
    whole: dict[str, bool]
    columns: tuple[str, ...]
    group_rows: tuple[int, ...]
    clock: str | None = None
    tick: str | None = None
    label: str | None = None

    @classmethod
    def read(
        cls, path: Path, time_column: str | None = None, label_column: str | None = None
    ) -> Table:
        """Read the head of a file.

        Raises:
            InputError: it is damaged, or does not have a column that is named.
        """
        parquet = imported("pyarrow.parquet", path)
        types = imported("pyarrow.types", path)
        sizes: dict[str, Sizes] = {}
        whole: dict[str, bool] = {}
        try:
            with builtins.open(path, "rb") as file:
                opened = parquet.ParquetFile(file, pre_buffer=False)
                schema = opened.schema_arrow
                about = opened.metadata
                groups = tuple(about.row_group(i).num_rows for i in range(about.num_row_groups))
                for field in schema:
                    inner, stated = _unpacked(field.type)
                    if not (types.is_integer(inner) or types.is_floating(inner)):
                        continue
                    whole[field.name] = types.is_integer(inner)
                    sizes[field.name] = _first(opened, field.name) if stated is None else stated
        # a damaged file raises any of pyarrow's kinds
        except Exception as error:
            raise _damaged(path, error) from None
        columns = tuple(schema.names)
        clock, tick = clock_of(columns)
        own_clock = named(path, "time-column", time_column, columns)
        if own_clock is not None:
            clock = own_clock
            tick = unit_of(own_clock)
        label = named(path, "label-column", label_column, columns) or first_of(LABELS, columns)
        return cls(path, sizes, whole, columns, groups, clock, tick, label)

    def cells(self, key: str | None) -> list[str]:
        """Return the columns that hold the readings.

        Raises:
            InputError: they are not clear.
        """
        aside = {*EPISODES, "frame_index", "index", "task_index", self.clock, self.label}
        listed = {name: sizes for name, sizes in self.sizes.items() if name not in aside}
        if key is not None or (any(map(math.prod, listed.values())) and any(listed.values())):
            return choose(self.path, listed, key)
        if not listed:
            raise InputError.at(self.path, f"holds no numbers; its columns: {self.columns}")
        return list(listed)

    def episodes(self) -> Iterator[tuple[str | None, str | None, tuple[int, int]]]:
        """Yield name, class and first and last row of each episode."""
        number = first_of(EPISODES, self.columns)
        rows = sum(self.group_rows)
        if not rows:
            return
        classes = None if self.label is None else self.column(self.label)
        if number is None:
            yield None, None if classes is None else _most(classes), (0, rows)
            return
        numbers = self.column(number)
        begins = np.flatnonzero(numbers[1:] != numbers[:-1]) + 1
        bounds = [0, *begins.tolist(), rows]
        for first, last in pairwise(bounds):
            of_it = None if classes is None else _most(classes[first:last])
            yield f"episode {numbers[first]}", of_it, (first, last)

    def column(self, name: str) -> NDArray[Any]:
        """Return a whole column of numbers or text.

        Raises:
            InputError: the file is damaged.
        """
        parquet = imported("pyarrow.parquet", self.path)
        try:
            read = parquet.read_table(
                self.path, columns=[name], partitioning=None, use_threads=False
            )
        except Exception as error:
            raise _damaged(self.path, error) from None
        values: NDArray[Any] = read.column(0).to_numpy()
        if values.dtype.kind == "O" and len(values) and np.shape(values[0]) == (1,):
            values = np.concatenate(values)  # LeRobot writes numbers as lists of one, too
        return values


def _unpacked(kind: Any) -> tuple[Any, Sizes | None]:
    """Return the type of the numbers in a column, and the sizes of a frame; None where only its
    values tell them."""
    sizes: list[int] = []
    stated = True
    while hasattr(kind, "value_type"):
        if hasattr(kind, "list_size"):
            sizes.append(kind.list_size)
        else:
            stated = False
        kind = kind.value_type
    return kind, tuple(sizes) if stated else None


def _first(opened: Any, name: str) -> Sizes:
    """Return the sizes of the first frame in a column of lists."""
    batches = opened.iter_batches(batch_size=1, row_groups=[0], columns=[name], use_threads=False)
    first = next(batches, None)
    value = None if first is None or not len(first) else first.column(0)[0].as_py()
    return () if value is None else np.shape(value)


def _most(classes: NDArray[Any]) -> str | None:
    """Return the most frequent class."""
    counts = Counter(str(value) for value in classes.tolist() if value is not None)
    return max(sorted(counts), key=counts.__getitem__, default=None)


def blocks_of(
    table: Table, rows: tuple[int, int], names: Sequence[str], pads: Pads
) -> Callable[[], Iterator[Block]]:
    """Return what reads the rows of one episode."""
    return lambda: _blocks(table, rows, names, pads)


def _blocks(
    table: Table, rows: tuple[int, int], names: Sequence[str], pads: Pads
) -> Iterator[Block]:
    clock = table.clock
    begin = 0
    for group, size in enumerate(table.group_rows):
        first = max(rows[0] - begin, 0)
        last = min(rows[1] - begin, size)
        begin += size
        if first >= last:
            continue
        held = _group(table.path, group, tuple(names), clock)
        for low in range(first, last, BLOCK):
            part = slice(low, min(low + BLOCK, last))
            features = [held[name][part] for name in names]
            if not any(table.sizes[name] for name in names):
                features = [np.stack(features, axis=1)]
            values = pads.frames(features)
            times = None
            unit = table.tick
            if clock is not None and pads.steps == 1:
                times = held[clock][part].ravel()
                if times.dtype.kind == "M":
                    times = times.astype("datetime64[ns]").astype(np.float64)
                    unit = "ns"
            yield Block(values, None, None if times is None else times.astype(np.float64), unit)


@lru_cache(maxsize=2)
def _group(
    path: Path, group: int, names: tuple[str, ...], clock: str | None
) -> dict[str, NDArray[Any]]:
    """Return the columns of a row group; the last ones stay in memory: episodes share them."""
    wanted = [*names, *([] if clock is None else [clock])]
    parquet = imported("pyarrow.parquet", path)
    try:
        with builtins.open(path, "rb") as file:
            table = parquet.ParquetFile(file, pre_buffer=False).read_row_group(
                group, columns=wanted, use_threads=False
            )
    except Exception as error:
        raise _damaged(path, error) from None
    held = {name: _array(path, table.column(name).combine_chunks(), name) for name in wanted}
    for name in names:
        if held[name].dtype.kind == "f":
            held[name] = held[name].astype(np.float32)
    return held


def _array(path: Path, column: Any, name: str) -> NDArray[Any]:
    """Return a column as an array ``[n, ...]``; missing numbers are NaN."""
    sizes = []
    while hasattr(column.type, "value_type") and hasattr(column, "flatten"):
        n = len(column)
        if column.null_count:
            raise InputError.at(path, f"rows without {name}; leave them out")
        flat = column.flatten()
        if n and len(flat) % n:
            raise InputError.at(path, f"{name} has lists of different lengths; give all the same")
        sizes.append(len(flat) // n if n else 0)
        column = flat
    values: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    if sizes:
        values = values.reshape(-1, *sizes)
    return values


def _damaged(path: Path, error: Exception) -> InputError:
    reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
    return InputError.at(path, f"is no Parquet file, or is cut off ({reason}); copy it again")
