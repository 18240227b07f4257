"""A recording of a file: what the file states of its array, and its frames, read when asked for.

A reader of any format returns these; small and large files take the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.printable import printable
from adaptfault.data.recordings.errors import InputError, Problem

Shape = tuple[int, int, int]

DECLARED = "wiring", "groups", "axes", "rest", "device"
"""What readings do not show of a layout."""

_LONGEST_NAME = 60  # letters of the name of a device

BLOCK = 4096
"""Frames that are read at once."""


@dataclass(frozen=True, eq=False)
class Block:
    """Some frames of a recording.

    Attributes:
        values: ``[t, D]`` as stored: counts keep their integer type; NaN = missing.
        lines: int ``[t]``, the line of each frame in a text file; None for other files.
        times: float64 ``[t]``, of the clock that the file holds; None where it holds none.
        tick: unit of these times: "s", "ms", "us" or "ns"; None where the file does not state it.
        problems: warnings about these frames.
        scan: float64 ``[t]``, share of the drive where a frame is of a scan of the read-out; NaN:
            it is a reading. None: there is no scan.
    """

    values: NDArray[Any]
    lines: NDArray[np.intp] | None = None
    times: NDArray[np.float64] | None = None
    tick: str | None = None
    problems: tuple[Problem, ...] = ()
    scan: NDArray[np.float64] | None = None


def device_name(stated: object) -> str | None:
    """Return how a device is called, from what a file states; None where that is no name."""
    if isinstance(stated, bool) or not isinstance(stated, str | int):
        return None
    return printable(str(stated).strip())[:_LONGEST_NAME].replace("\n", " ") or None


@dataclass(frozen=True, eq=False)
class Facts:
    """What a file states about the array; None = it does not.

    Attributes:
        path: the file.
        counts: whether the readings are stored as whole numbers; else their values tell.
        text: whether it is a text file, whose lines are named in messages.
        class_names: the order of the classes, if the file gives one.
        numbered: the class names are the numbers of the labels, because the file gives no names.
        shape: ``(pads, rows, cols)``.
        present: bool ``[pads, rows, cols]``, False = no sensing element.
        full_scale, unit, rate: as in SensorLayout.
        declared: those of :data:`DECLARED` that the file gives, as in SensorLayout.
        names: what the file calls each cell; empty where it does not.
        stored: shape of the array in the file, where it holds one.
        shape_reason: what the shape was inferred from; "" where the file states it.
        inferred: one sentence for each other thing that the reader inferred, with the option that
            states it.
        problems: warnings of the reader.
        sizes: of a frame in each array that holds readings, in the order in which these stand in a
            frame.
        places: int ``[n]``, where in a frame the readings of all arrays belong; None: one after
            the other.
    """

    path: Path
    counts: bool = False
    text: bool = False
    class_names: tuple[str, ...] = ()
    numbered: bool = False
    shape: Shape | None = None
    present: NDArray[np.bool_] | None = None
    full_scale: float | None = None
    unit: str | None = None
    rate: float | None = None
    declared: Mapping[str, Any] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    stored: tuple[int, ...] = ()
    shape_reason: str = ""
    inferred: tuple[str, ...] = ()
    problems: tuple[Problem, ...] = ()
    sizes: tuple[tuple[int, ...], ...] = ()
    places: NDArray[np.intp] | None = None

    @property
    def device(self) -> str | None:
        """Which specimen it is, as a name of its own or a number."""
        return device_name(self.declared.get("device"))


@dataclass(frozen=True, eq=False)
class Recording:
    """One recording of a file.

    Attributes:
        facts: what its file states; the same object for all recordings of a file.
        blocks: reads its frames from the first to the last, each time it is called.
        name: how the file calls it.
        label: its class.
        arrays: of the file that hold its readings.
        number: how the file numbers it; None: it does not.
        row: how a table numbers its first row; None: the file is no table.
        device: which specimen recorded it, as a name of its own or a number.
    """

    facts: Facts
    blocks: Callable[[], Iterator[Block]]
    name: str | None = None
    label: str | None = None
    arrays: tuple[str, ...] = ()
    number: int | None = None
    row: int | None = None
    device: str | None = None

    @property
    def frames(self) -> NDArray[Any]:
        """All frames, ``[T, D]``, as stored.

        Raises:
            InputError: the file is damaged, or holds no frame.
        """
        values = [block.values for block in self.blocks()]
        if not values:
            raise InputError.at(self.facts.path, "holds no frames; record it again or remove it")
        return np.concatenate(values)
