"""The parts of arrays that are one recording, and their frames, read piece by piece."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, Problem, foreseeing
from adaptfault.data.recordings.formats.datasets.axes import TimeLast, Vector
from adaptfault.data.recordings.formats.datasets.contents import (
    TEXTS,
    TIMES,
    Array,
    Opened,
    Packing,
    texts,
)
from adaptfault.data.recordings.formats.datasets.features import VALID, Pads, Sizes, shown
from adaptfault.data.recordings.recording import BLOCK, Block

_ROOM = 64 << 20  # bytes of readings that are read at once


@dataclass(frozen=True)
class Part:
    """Where the frames of one recording are.

    Attributes:
        names: of its arrays, one a pad.
        first, last: its frames in them, ``last`` excluded.
        clock: the array of its times.
        outer: which recording of an array ``[n, T, ...]`` it is.
        label: its class.
        group: the group that is this episode; "" for the file.
        number: how the file numbers it.
    """

    names: tuple[str, ...]
    first: int
    last: int
    clock: str | None = None
    outer: int | None = None
    label: str | None = None
    group: str = ""
    number: int | str | None = None

    @property
    def name(self) -> str | None:
        """How the file calls it."""
        if self.number is not None:
            return f"episode {self.number}"
        return self.group or None


@dataclass(frozen=True)
class Readings:
    """What is read of one recording.

    Attributes:
        part: where its frames are.
        packings: of its arrays.
        masks: of those arrays that say which of their readings are valid.
        turned: whether the time is their last axis.
        tick: unit of its times.
    """

    part: Part
    packings: tuple[Packing, ...]
    masks: tuple[str, ...]
    turned: bool
    tick: str | None


def refused(
    path: Path, part: Part, came: Sequence[Sizes], expected: Sequence[Sizes]
) -> Iterator[Block]:
    """Raise that frames of one recording have other sizes than those of the others."""
    each = [(one, other) for one, other in zip(came, expected, strict=True) if one != other]
    one, other = each[0]
    cells = f"{math.prod(one)} values a frame, {shown(one)}, where the others have {shown(other)}"
    raise InputError.at(path, f"{cells}; load it apart", part.name or part.names[0])


def blocks(path: Path, opened: Opened, held: Readings, pads: Pads) -> Iterator[Block]:
    """Yield the frames of one recording.

    Raises:
        InputError: they are damaged or cut off.
    """
    part = held.part
    # times of rows are none of frames
    clock = part.clock if pads.steps == 1 else None
    wanted = [*part.names, *(f"{name}{VALID}" for name in held.masks)]
    wanted += [] if clock is None else [clock]
    with opened(wanted) as contents:
        arrays = _arrays(held, contents.arrays, part.names)
        valid = dict(zip(held.masks, _arrays(held, contents.valid, held.masks), strict=True))
        masks = [valid.get(name) for name in part.names]
        times = None if clock is None else Vector(contents.arrays[clock])
        for first, last in _pieces(part, arrays, pads):
            where = f"{part.name or part.names[0]}, frames {first} to {last - 1}"
            damaged = "cannot be read ({}): damaged, or cut off; copy it again"
            with foreseeing(path, damaged, where):
                values = [np.array(array[first:last]) for array in arrays]
                checked = [None if mask is None else np.array(mask[first:last]) for mask in masks]
                stamps = None if times is None else np.asarray(times[first:last])
            if any(len(value) != last - first for value in values):
                raise InputError.at(path, "is cut off; copy it again", where)
            packed = zip(held.packings, values, strict=True)
            readings = [packing.unpacked(value) for packing, value in packed]
            frames = pads.frames(list(map(_valid, readings, checked)))
            yield _block(path, frames, stamps, held)


def _arrays(held: Readings, arrays: Mapping[str, Array], names: Sequence[str]) -> list[Any]:
    """Return arrays of one recording, whose first axis is the time."""
    found: list[Any] = [arrays[name] for name in names]
    if held.turned:
        found = [TimeLast(array) for array in found]
    if held.part.outer is not None:
        outer = held.part.outer
        found = [array[outer : outer + 1][0] for array in found]
    return found


def _valid(readings: NDArray[Any], mask: NDArray[np.bool_] | None) -> NDArray[Any]:
    """Return readings of which those that are not valid are missing."""
    if mask is None or mask.all():
        return readings
    return np.where(mask, readings, np.nan)


def _pieces(part: Part, arrays: Sequence[Any], pads: Pads) -> Iterator[tuple[int, int]]:
    """Yield first and last frame of what is read at once: about a block, but never a part of a
    chunk, which would be unpacked again for each of its parts."""
    row = sum(math.prod(sizes) for sizes in pads.sizes) * pads.steps * 8
    step = max(1, min(BLOCK, _ROOM // max(row, 1)))
    chunks = [getattr(array, "chunks", None) for array in arrays]
    step = max([step, *(sizes[0] for sizes in chunks if sizes)])
    for first in range(part.first, part.last, step):
        yield first, min(first + step, part.last)


def _block(path: Path, frames: NDArray[Any], stamps: NDArray[Any] | None, held: Readings) -> Block:
    """Return frames with their times; times of numpy, and written ones, count in nanoseconds."""
    tick = held.tick
    if stamps is None:
        return Block(frames)
    if stamps.dtype.kind in TEXTS:
        try:
            stamps = np.array(texts(stamps), dtype="datetime64[ns]")
        except ValueError:
            what = f"{held.part.clock} holds texts that are no times, as {texts(stamps)[0]!r}"
            problem = Problem.warning(path, f"{what}: passed over")
            return Block(frames, problems=(problem,))
    if stamps.dtype.kind in TIMES:
        unset = np.isnat(stamps)
        kind = f"{'datetime64' if stamps.dtype.kind == 'M' else 'timedelta64'}[ns]"
        stamps = np.where(unset, np.nan, stamps.astype(kind).astype(np.int64).astype(np.float64))
        tick = "ns"
    return Block(frames, None, stamps.astype(np.float64), tick)
