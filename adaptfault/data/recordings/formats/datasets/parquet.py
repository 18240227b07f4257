"""Opens Parquet files; needs the extra "datasets".

A column of lists or of Arrow's tensors holds a pad, or each column of numbers a cell. A column
``episode_index`` (or ``episode``, ``recording``, ``trial``) divides the rows into recordings.
"""

from __future__ import annotations

import builtins
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, foreseeing
from adaptfault.data.recordings.facts.declared import too_large, too_much
from adaptfault.data.recordings.facts.sizes import check_kind
from adaptfault.data.recordings.formats.datasets.contents import Contents
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.datasets.features import Sizes, is_touch
from adaptfault.data.recordings.formats.datasets.reader import reader

SUFFIXES = (".parquet", ".pq")

_DAMAGED = "is no Parquet file, or is cut off; copy it again"

# Arrow's names of numbers where numpy has another; its own conversion imports pandas
_NUMBERS = {"halffloat": "float16", "float": "float32", "double": "float64"}


@contextmanager
def opened(path: Path, names: Sequence[str] | None = None) -> Iterator[Contents]:
    """Open a file; ``names``: of the columns that are wanted, None: all it holds.

    What the last files hold stays known, as each of their episodes asks for it; it is read anew
    where all is asked for, as the file may have changed since.

    Raises:
        InputError: pyarrow is not installed, or the file is damaged.
    """
    if names is None:
        _contents.cache_clear()
        _group.cache_clear()
    held = _contents(path, None if names is None else tuple(names))
    yield replace(held, attributes=dict(held.attributes))


@lru_cache(maxsize=2)
def _contents(path: Path, names: tuple[str, ...] | None) -> Contents:
    """Return what a file holds; arguments and errors as for :func:`opened`."""
    parquet = imported("pyarrow.parquet", path)
    contents = Contents(is_table=True)
    check_kind(path)
    with foreseeing(path, _DAMAGED), builtins.open(path, "rb") as file:
        held = parquet.ParquetFile(file, pre_buffer=False)
        about = held.metadata
        groups = tuple(about.row_group(i).num_rows for i in range(about.num_row_groups))
        columns = held.schema_arrow
        every = columns.names
        wanted = tuple(every) if names is None else names
        for field in columns:
            if field.name not in wanted:
                continue
            if every.count(field.name) > 1:
                contents.left_out[field.name] = "stands twice in the file; rename one of them"
                continue
            column = _Column.of(path, held, field, groups, () if names is None else wanted)
            if column is None:
                if is_touch(field.name):
                    contents.left_out[field.name] = f"is {field.type}, no column of numbers"
            else:
                _add(contents, field.name, column, path.stat().st_size)
    return contents


open = reader(opened)


def _add(contents: Contents, name: str, column: _Column, stored: int) -> None:
    row = math.prod(column.shape[1:]) * column.dtype.itemsize
    largest = max(column.groups, default=0)
    why = too_large((largest, row), 1) or too_much(column.shape[0] * row, stored)
    if why is None:
        contents.add(name, column)
    else:
        contents.left_out[name] = why


class _Column:
    """A column of numbers, times or texts, ``[rows, ...]``, read by row groups.

    Args:
        path: the file.
        name: of the column.
        sizes: of one row.
        dtype: of its values.
        groups: rows of each row group.
        beside: columns that are read along with it.
    """

    def __init__(
        self,
        path: Path,
        name: str,
        sizes: Sizes,
        dtype: np.dtype[Any],
        groups: tuple[int, ...],
        beside: tuple[str, ...],
    ) -> None:
        self.path = path
        self.name = name
        self.shape = (sum(groups), *sizes)
        self.dtype = dtype
        self.groups = groups
        self.beside = beside or (name,)

    @classmethod
    def of(
        cls,
        path: Path,
        held: Any,
        field: Any,
        groups: tuple[int, ...],
        beside: tuple[str, ...],
    ) -> _Column | None:
        """Return a column of an open file; None where it holds something else."""
        inner, sizes = _unpacked(path, field.type)
        dtype = _dtype(path, inner)
        if dtype is None:
            return None
        if sizes is None:
            sizes = _first(held, field.name) if groups else (0,)
        return cls(path, field.name, sizes, dtype, groups, beside)

    def __getitem__(self, part: slice) -> NDArray[Any]:
        first, last, _ = part.indices(self.shape[0])
        pieces = [np.empty((0, *self.shape[1:]), self.dtype)]
        begin = 0
        for group, rows in enumerate(self.groups):
            low = max(first - begin, 0)
            high = min(last - begin, rows)
            if low < high:
                table = _group(self.path, group, self.beside)
                column = table.column(self.name).slice(low, high - low).combine_chunks()
                pieces.append(_array(self.path, column, self, begin + low))
            begin += rows
        return np.concatenate(pieces[1:] or pieces)


def _unpacked(path: Path, kind: Any) -> tuple[Any, Sizes | None]:
    """Return the type of the values in a column, and the sizes of a row; None where only its values
    tell them.

    Types of an extension, as those that LeRobot's libraries register, are read as they are stored.
    """
    pa = imported("pyarrow", path)
    sizes: list[int] = []
    stated = True
    while True:
        if isinstance(kind, pa.FixedShapeTensorType):
            sizes += _tensor(kind)
            kind = kind.value_type
        elif isinstance(kind, pa.BaseExtensionType):
            kind = kind.storage_type
        elif pa.types.is_fixed_size_list(kind):
            sizes.append(kind.list_size)
            kind = kind.value_type
        elif pa.types.is_list(kind) or pa.types.is_large_list(kind):
            stated = False
            kind = kind.value_type
        elif pa.types.is_dictionary(kind):
            kind = kind.value_type
        else:
            return kind, tuple(sizes) if stated else None


def _tensor(kind: Any) -> list[int]:
    """Return the sizes of a tensor with its axes in the order in which its writer sees them."""
    order = kind.permutation or range(len(kind.shape))
    return [kind.shape[axis] for axis in order]


def _dtype(path: Path, kind: Any) -> np.dtype[Any] | None:
    """Return numpy's type for the values of a column; None where they are no numbers, truth values,
    times or texts."""
    types = imported("pyarrow.types", path)
    if types.is_integer(kind) or types.is_floating(kind):
        number: np.dtype[Any] = np.dtype(_NUMBERS.get(str(kind), str(kind)))
        return number
    if types.is_decimal(kind):
        return np.dtype(np.float64)
    if types.is_timestamp(kind) or types.is_time(kind) or types.is_date(kind):
        return np.dtype("datetime64[ns]")
    if types.is_duration(kind):
        return np.dtype("timedelta64[ns]")
    if types.is_boolean(kind):
        return np.dtype(np.bool_)
    is_text = types.is_string(kind) or types.is_large_string(kind) or types.is_string_view(kind)
    return np.dtype(object) if is_text else None


def _first(held: Any, name: str) -> Sizes:
    """Return the sizes of the first row in a column of lists that is there."""
    for batch in held.iter_batches(batch_size=64, columns=[name], use_threads=False):
        for value in batch.column(0):
            row = value.as_py()
            if row:
                return np.shape(row)
    return (0,)


@lru_cache(maxsize=2)
def _group(path: Path, group: int, names: tuple[str, ...]) -> Any:
    """Return the columns of a row group; the last ones stay in memory: episodes share them."""
    parquet = imported("pyarrow.parquet", path)
    with foreseeing(path, _DAMAGED), builtins.open(path, "rb") as file:
        return parquet.ParquetFile(file, pre_buffer=False).read_row_group(
            group, columns=list(names), use_threads=False
        )


def _array(path: Path, column: Any, about: _Column, first: int) -> NDArray[Any]:
    """Return rows of a column as an array ``[n, ...]``; missing numbers are NaN.

    Raises:
        InputError: a row holds another number of values than the first of the file.
    """
    pa = imported("pyarrow", path)
    rows = len(column)
    sizes = list(about.shape[1:])
    order = None
    while True:
        kind = column.type
        if isinstance(kind, pa.FixedShapeTensorType):
            order = kind.permutation
            column = column.storage
        elif isinstance(kind, pa.BaseExtensionType):
            column = column.storage
        elif pa.types.is_nested(kind):
            lengths = _lengths(path, column)
            expected = math.prod(sizes) if order else sizes[0]
            wrong = np.flatnonzero(lengths != expected)
            if len(wrong):
                row = first + int(wrong[0]) * rows // max(len(lengths), 1)
                came = "no list" if lengths[wrong[0]] < 0 else f"a list of {lengths[wrong[0]]}"
                what = f"{about.name} holds {came} where the first row has {expected}"
                raise InputError.at(path, f"{what}; give all rows the same", f"row {row}")
            column = _flat(path, column)
            sizes = sizes[1:]
        elif pa.types.is_dictionary(kind):
            column = column.dictionary_decode()
        else:
            break
    values = _numpy(pa, column)
    if order:
        stored = np.argsort(order)
        physical = [about.shape[1:][axis] for axis in stored]
        return values.reshape(rows, *physical).transpose(0, *(axis + 1 for axis in order))
    return values.reshape(rows, *about.shape[1:])


def _has_offsets(path: Path, column: Any) -> bool:
    """Return whether rows are lists that lie one behind the other, none missing."""
    types = imported("pyarrow.types", path)
    return (
        types.is_list(column.type) or types.is_large_list(column.type)
    ) and not column.null_count


def _flat(path: Path, column: Any) -> Any:
    """Return the values of the lists in a column, one behind the other."""
    if not _has_offsets(path, column):
        return column.flatten()
    begin = column.offsets[0].as_py()  # flatten imports pyarrow.compute, which is slow
    return column.values.slice(begin, column.offsets[-1].as_py() - begin)


def _lengths(path: Path, column: Any) -> NDArray[Any]:
    """Return how many values each row of a column of lists has; -1: no list."""
    pa = imported("pyarrow", path)
    if _has_offsets(path, column):
        return np.diff(_numpy(pa, column.offsets))
    compute = imported("pyarrow.compute", path)  # slow to import, and rarely needed
    counts = compute.list_value_length(column)
    return _numpy(pa, counts.fill_null(-1) if counts.null_count else counts)


def _numpy(pa: Any, column: Any) -> NDArray[Any]:
    """Return a flat column; times of day count from midnight."""
    kind = column.type
    if pa.types.is_time(kind):
        whole = column.cast(pa.int32() if kind.bit_width == 32 else pa.int64()).cast(pa.int64())
        column = whole.view(pa.timestamp(kind.unit))
    if pa.types.is_decimal(kind):
        column = column.cast(pa.float64())
    plain = pa.types.is_integer(kind) or pa.types.is_floating(kind)
    if plain and not column.null_count:
        return np.from_dlpack(column)  # the other way imports pandas
    values: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    return values
