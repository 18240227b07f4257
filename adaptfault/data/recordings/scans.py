"""Frames of a read-out scan among the frames of a recording: taken out, and kept apart.

A column or an array ``scan`` holds the share of the drive in each frame, 0 to 1, where it is one of
a scan, and nothing (NaN, an empty cell) where it is a reading. The values of a scan are shares of
the converter's range, 0 to 1. What is none of this is no scan, and left alone with a warning.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import Problem
from adaptfault.data.recordings.recording import Block, Recording

if TYPE_CHECKING:
    from diagnostics import Scan, SensorLayout

_NO_SCAN = (
    "column or array 'scan' is ignored: expected the share of the drive, 0 to 1, in frames of a"
    " scan whose values are 0 to 1, and nothing in others"
)

Floats = NDArray[np.float64]


class Scans:
    """The frames of scans of all files, in their order.

    Attributes:
        frames: level and values ``[D]`` of each.
    """

    def __init__(self) -> None:
        self.frames: list[tuple[float, Floats]] = []

    def of(self, layout: SensorLayout, problems: list[Problem]) -> Scan | None:
        """Return the scan of an array, None where there is none; what is of another array is told
        as a problem."""
        fitting = [one for one in self.frames if len(one[1]) == layout.n_cells]
        other = len(self.frames) - len(fitting)
        if other:
            what = f"{other} frames of a scan are of another array than {layout}: left out"
            problems.append(Problem("warning", what))
        if not fitting:
            return None
        from diagnostics import Scan  # takes scipy along, which most recordings do not need

        return Scan.of(fitting)


def without_scan(block: Block) -> Block:
    """Return the readings of a block."""
    chosen = _of_scan(block)
    if chosen is None:
        return replace(block, scan=None)
    rest = ~chosen
    lines = None if block.lines is None else block.lines[rest]
    times = None if block.times is None else block.times[rest]
    return replace(block, values=block.values[rest], lines=lines, times=times, scan=None)


def scan_of(block: Block) -> list[tuple[float, Floats]]:
    """Return level and values of each frame of a scan in a block."""
    chosen = _of_scan(block)
    if chosen is None or block.scan is None:
        return []
    values = block.values[chosen].astype(np.float64)
    return list(zip(block.scan[chosen].tolist(), values, strict=True))


def doubt_of(block: Block, path: Path) -> tuple[Problem, ...]:
    """Return a warning where what is called a scan is none."""
    called = block.scan is not None and bool(np.isfinite(block.scan).any())
    if not called or _of_scan(block) is not None:
        return ()
    return (Problem.warning(path, _NO_SCAN),)


def readings_of(recording: Recording) -> Recording:
    """Return a recording without the frames of scans."""

    def blocks() -> Iterator[Block]:
        return map(without_scan, recording.blocks())

    return replace(recording, blocks=blocks)


def with_levels(recording: Recording, levels: Floats) -> Recording:
    """Return a recording whose frames have these levels, ``[T]`` or longer; NaN: readings."""
    return replace(recording, blocks=_levelled(recording.blocks, levels))


def levels_of(scan: Floats, lengths: Sequence[int] | None, number: int) -> Floats:
    """Return the levels of one recording.

    Args:
        scan: ``[n, T]``, or ``[T]`` of one recording or of all, one behind the other.
        lengths: of the recordings; None: one recording.
        number: of the recording.
    """
    if scan.ndim == 2:
        row: Floats = scan[number]
        return row
    first = 0 if lengths is None else int(sum(lengths[:number]))
    return scan[first:]


def _levelled(
    given: Callable[[], Iterator[Block]], levels: Floats
) -> Callable[[], Iterator[Block]]:
    def blocks() -> Iterator[Block]:
        first = 0
        for block in given():
            behind = first + len(block.values)
            yield replace(block, scan=levels[first:behind])
            first = behind

    return blocks


def _of_scan(block: Block) -> NDArray[np.bool_] | None:
    """Return which frames are of a scan, bool ``[t]``; None: there is none."""
    if block.scan is None:
        return None
    chosen: NDArray[np.bool_] = np.isfinite(block.scan)
    if len(chosen) != len(block.values) or not chosen.any():
        return None
    levels = block.scan[chosen]
    values = np.asarray(block.values[chosen], np.float64)
    known = values[np.isfinite(values)]
    shares = (levels >= 0).all() and (levels <= 1).all()
    return chosen if shares and (known >= 0).all() and (known <= 1).all() else None
