"""Reads recordings larger than memory block by block, for code that needs each frame once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.bag import STORAGES, bag_messages
from adaptfault.data.recordings.check import check_width
from adaptfault.data.recordings.content import Content, Shape, grid_shape
from adaptfault.data.recordings.csv_folder import csv_pieces
from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.files import Found, find
from adaptfault.data.recordings.infer import SLACK
from adaptfault.data.recordings.layout_file import layout_beside
from adaptfault.data.recordings.load import READERS, PathName, nothing_left
from adaptfault.data.recordings.resolve import check_agreement, given_array, resolve_layout
from diagnostics import SensorLayout

if TYPE_CHECKING:
    from adaptfault.data.calibration import Calibration

LARGE = 200_000_000
"""Bytes of files above which they are read in blocks: loaded, they take up to ten times as much memory."""

_BLOCK = 4096  # frames
_CSV = 2_000_000  # bytes of text
_RATED = 1000  # messages of a bag from which its rate is taken

Blocks = Callable[[], Iterator[NDArray[Any]]]


@dataclass(frozen=True, eq=False)
class Source:
    """One file.

    Attributes:
        about: its statements about the array, with a sample of the frames.
        blocks: reads its frames, ``[t, D]`` at a time.
        recordings: how many it holds.
    """

    about: Content
    blocks: Blocks
    recordings: int


def is_large(paths: Sequence[PathName]) -> bool:
    """Return whether these files and folders hold too much to be loaded at once."""
    found, _ = find([Path(path) for path in paths], (*READERS, *STORAGES), set())
    return sum(_size(file.path) for file in found) > LARGE


class Stream:
    """Recordings as one stream of blocks, float64 ``[t, D]`` in the layout's unit, in constant memory.

    CSV and .npy files and bags are read piece by piece, archives (.npz) whole, one after the other. A missing reading
    is NaN, and so is one that is infinite. May be iterated more than once.

    Args:
        paths, layout, calibration, full_scale, unit, rate, topic, field: as for :func:`adaptfault.load`.

    Attributes:
        layout: the array.
        inferred: as in :class:`~adaptfault.data.recordings.load.Loaded`.
        problems: errors and warnings; complete after an iteration.

    Raises:
        InputError: as :func:`adaptfault.load`.
    """

    def __init__(
        self,
        paths: PathName | Iterable[PathName],
        *,
        layout: SensorLayout | Shape | PathName | None = None,
        calibration: Calibration | PathName | None = None,
        full_scale: float | None = None,
        unit: str | None = None,
        rate: float | None = None,
        topic: str | None = None,
        field: str | None = None,
    ) -> None:
        given = [Path(paths)] if isinstance(paths, str | PathLike) else [Path(path) for path in paths]
        array = given_array(layout) if layout is not None else layout_beside(given)
        shape = array.shape if isinstance(array, SensorLayout) else array
        self._tables = _tables(calibration)
        aside = {Path(p).resolve() for p in (layout, calibration) if isinstance(p, str | PathLike)}
        found, problems = find(given, (*READERS, *STORAGES), aside)
        if not found:
            raise InputError(problems[0].message if problems else "no path given; name a recording")
        self.problems: list[Problem] = problems
        known = full_scale is not None or isinstance(array, SensorLayout) or self._tables is not None
        sources = []
        for file in found:
            try:
                sources.append(_open(file, shape, topic, field, problems, largest=not known))
            except InputError as error:
                problems.append(Problem("error", str(error)))
        if not sources:
            raise nothing_left(problems)
        heads = [source.about for source in sources]
        resolved = resolve_layout(heads, array, full_scale, unit, rate, self._tables)
        self.layout, self.inferred = resolved.layout, resolved.inferred
        problems += resolved.problems
        self._sources = []
        for source in sources:
            try:
                check_agreement(source.about, heads, self._tables is not None)
                check_width(source.about, self.layout)
            except InputError as error:
                problems.append(Problem("error", str(error)))
            else:
                self._sources.append(source)
        if not self._sources:
            raise nothing_left(problems)
        if self._tables is not None:
            self._tables.check(self.layout)

    def __len__(self) -> int:
        """The number of recordings."""
        return sum(source.recordings for source in self._sources)

    def __iter__(self) -> Iterator[NDArray[np.float64]]:
        frames = 0
        for source in self._sources:
            try:
                for block in self._checked(source):
                    frames += len(block)
                    yield block
            except InputError as error:  # the blocks before it count
                self.problems.append(Problem("error", str(error)))
        if not frames:
            raise nothing_left(self.problems)

    def _checked(self, source: Source) -> Iterator[NDArray[np.float64]]:
        present, full = self.layout.present.ravel(), self.layout.full_scale
        missing = infinite = outside = 0
        for block in source.blocks():
            values = block if self._tables is None else self._tables.apply(block)[0]
            frames = np.array(values, dtype=np.float64)
            endless = np.isinf(frames)
            frames[endless] = np.nan
            infinite += int(endless[:, present].sum())
            missing += int(np.isnan(frames[:, present]).sum())
            with np.errstate(invalid="ignore"):
                beyond = (frames < -(SLACK - 1) * full) | (frames > SLACK * full)
            outside += int(beyond[:, present].sum())
            yield frames
        counted = {
            f"{infinite} infinite readings: taken as missing": infinite,
            f"{missing - infinite} missing readings: kept as missing": missing - infinite,
            f"{outside} readings outside 0..{full:g} {self.layout.unit}: kept; if they are real, the full scale is"
            " wrong": outside,
        }
        path = source.about.path
        self.problems += (Problem("warning", located(path, text)) for text, count in counted.items() if count)


def _open(
    file: Found, shape: Shape | None, topic: str | None, field: str | None, problems: list[Problem], *, largest: bool
) -> Source:
    """Return a file; with ``largest``, the sample of its frames holds the largest reading of each cell."""
    suffix = file.path.suffix.lower()
    if file.path.is_dir() or suffix in STORAGES:
        return _bag(file.path, topic, field, problems, largest)
    if suffix == ".csv":
        return _csv(file.path, problems, largest)
    if suffix == ".npy" and (pieces := _npy(file.path, shape, largest)) is not None:
        return pieces

    def read() -> Content:
        content = READERS[suffix](file.path)
        return content if shape is None else content.read_as(shape)

    content = read()
    problems += content.problems
    lengths, sample = len(content.frames), _sample(_cut(content.frames))
    lines = None if content.lines is None else content.lines[: len(sample)]
    head = replace(content, frames=(sample,), lines=lines, names=None, labels=None, problems=())
    return Source(head, lambda: _cut(read().frames), lengths)


def _bag(path: Path, topic: str | None, field: str | None, problems: list[Problem], largest: bool) -> Source:
    def blocks(problems_found: list[Problem]) -> Iterator[NDArray[Any]]:
        messages = bag_messages(path, problems_found, topic=topic, field=field)
        width, left_out = 0, 0
        while some := list(islice(messages, _BLOCK)):
            width = width or len(some[0].values)
            whole = [message.values for message in some if len(message.values) == width]
            left_out += len(some) - len(whole)
            if whole:
                yield np.stack(whole)
        if left_out:
            what = f"{left_out} messages hold another number of readings than the first, {width}: left out"
            problems_found.append(Problem("warning", located(path, what)))

    first = list(islice(bag_messages(path, [], topic=topic, field=field), _RATED))
    if not first:
        raise InputError.at(path, "holds no message that can be read; record it again")
    period = float(np.median(np.diff([message.time for message in first]))) / 1e9 if len(first) > 1 else 0.0
    sample = _sample(blocks([])) if largest else first[0].values[None]
    rate = float(f"{1 / period:.3g}") if period > 0 else None
    head = Content(path, (sample,), counts=first[0].counts, shape=first[0].shape, rate=rate)
    return Source(head, lambda: blocks(problems), 1)


def _csv(path: Path, problems: list[Problem], largest: bool) -> Source:
    def blocks(problems_found: list[Problem]) -> Iterator[NDArray[Any]]:
        for piece in csv_pieces(path, _CSV):
            problems_found += piece.problems
            if piece.values is not None:
                yield piece.values

    first = next((piece for piece in csv_pieces(path, _CSV) if piece.values is not None), None)
    if first is None or first.values is None:
        raise InputError.at(path, "holds no readings; record it again or remove it")
    sample, counts = first.values[:1], False
    if largest:
        pairs = [(_sample([block]), np.array_equal(block, np.rint(block), equal_nan=True)) for block in blocks([])]
        sample, counts = np.concatenate([one for one, _ in pairs]), all(whole for _, whole in pairs)
    lines = np.resize(first.lines, len(sample))
    reason = "" if first.rate is None else f"time column of {path.name}"
    head = Content(path, (sample,), counts, lines=lines, rate=first.rate, rate_reason=reason)
    return Source(head, lambda: blocks(problems), 1)


def _npy(path: Path, given: Shape | None, largest: bool) -> Source | None:
    """Return an array that can be read in pieces; None where only the reader of whole files can read it."""
    try:
        with open(path, "rb") as file:
            version = np.lib.format.read_magic(file)
            header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
            sizes, by_column, kind = header(file)
            start = file.tell()
    except (ValueError, KeyError, OSError):
        return None
    if by_column or kind.kind not in "iuf" or not 2 <= len(sizes) <= 5 or 0 in sizes:
        return None
    if path.stat().st_size < start + int(np.prod(sizes, dtype=object)) * kind.itemsize:
        return None
    shape = grid_shape(sizes, given)
    width = int(np.prod(shape)) if shape else sizes[-1]
    frames = int(np.prod(sizes)) // width

    def blocks() -> Iterator[NDArray[Any]]:
        with open(path, "rb") as file:
            file.seek(start)
            for first in range(0, frames, _BLOCK):
                yield np.fromfile(file, kind, min(_BLOCK, frames - first) * width).reshape(-1, width)

    sample = _sample(blocks()) if largest else next(blocks())[:1]
    head = Content(path, (sample,), counts=kind.kind in "iu", shape=shape, stored=sizes)
    return Source(head, blocks, 1 if frames == sizes[0] else sizes[0])


def _sample(blocks: Iterable[NDArray[Any]]) -> NDArray[Any]:
    """Return the largest finite reading of each cell in each block, ``[blocks, D]``."""
    return np.stack([np.max(block, axis=0, initial=0, where=np.isfinite(block)) for block in blocks])


def _cut(recordings: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    for frames in recordings:
        for first in range(0, len(frames), _BLOCK):
            yield frames[first : first + _BLOCK]


def _tables(calibration: Calibration | PathName | None) -> Calibration | None:
    if not isinstance(calibration, str | PathLike):
        return calibration
    from adaptfault.data.calibration import Calibration

    return Calibration.read(calibration)


def _size(path: Path) -> int:
    return sum(file.stat().st_size for file in path.iterdir()) if path.is_dir() else path.stat().st_size
