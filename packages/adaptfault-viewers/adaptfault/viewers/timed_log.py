"""A log, and what devices send, as viewers show them: readings by pad, the time of each frame, the
state of each cell."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics import Diagnosis, SensorLayout, Verdict

ROOT = "/tactile"
"""What the names of all topics and entities begin with."""

PAUSE = 1.0
"""Seconds between two recordings."""


class State(IntEnum):
    """State of a position, as the files number it."""

    NO_CELL = 0
    ALIVE = 1
    FAULTY = 2
    UNTESTED = 3

    def __str__(self) -> str:
        return self.name.lower().replace("_", " ")


COLOURS = {
    State.NO_CELL: (0, 0, 0, 0),
    State.ALIVE: (143, 191, 143, 255),
    State.FAULTY: (192, 57, 43, 255),
    State.UNTESTED: (217, 217, 217, 255),
}
"""Red, green, blue and alpha of each state, 0 to 255."""

_OF_VERDICT = {
    Verdict.ALIVE: State.ALIVE,
    Verdict.FAULTY: State.FAULTY,
    Verdict.UNTESTED: State.UNTESTED,
}


@dataclass(frozen=True, eq=False)
class Piece:
    """Frames of one recording.

    Attributes:
        recording: its number, from 0.
        times: float ``[t]``, seconds.
        readings: float32 ``[t, pads, rows, cols]``; NaN where a reading is missing, or no cell is.
        restored: the same frames with faulty and missing cells restored; None: nothing restores
            them.
    """

    recording: int
    times: NDArray[np.float64]
    readings: NDArray[np.float32]
    restored: NDArray[np.float32] | None = None


def on_grid(frames: NDArray[Any], layout: SensorLayout) -> NDArray[np.float32]:
    """Return frames ``[t, D]`` as float32 ``[t, pads, rows, cols]``, NaN where no cell is."""
    readings = np.array(frames, dtype=np.float32)
    readings[:, ~layout.is_cell] = np.nan
    return layout.grid(readings)


def states_of(diagnosis: Diagnosis) -> NDArray[np.uint8]:
    """Return the :class:`State` of each position, uint8 ``[pads, rows, cols]``."""
    layout = diagnosis.layout
    states = np.array([_OF_VERDICT[v] for v in diagnosis.verdicts], dtype=np.uint8)
    states[~layout.is_cell] = State.NO_CELL
    return layout.grid(states)


@dataclass(frozen=True, eq=False)
class TimedLog:
    """Recordings that follow one another at the rate of the layout, with a pause of one second.

    Args:
        diagnosis: of the log.
        names: of the recordings.
        lengths: frames of each recording.
        pieces: yields ``[t, D]`` in time order, a piece of one recording at a time.
    """

    diagnosis: Diagnosis
    names: Sequence[str]
    lengths: Sequence[int]
    pieces: Callable[[], Iterable[NDArray[Any]]]

    @property
    def layout(self) -> SensorLayout:
        """The array."""
        return self.diagnosis.layout

    @cached_property
    def starts(self) -> NDArray[np.float64]:
        """float ``[n]``: the time of the first frame of each recording."""
        return self._first / self.layout.rate + PAUSE * np.arange(len(self.lengths))

    @property
    def seconds(self) -> float:
        """When the last recording ends."""
        return float(self.starts[-1] + self.lengths[-1] / self.layout.rate)

    @cached_property
    def _first(self) -> NDArray[np.int64]:
        """The number of the first frame of each recording, counted over the log."""
        return np.cumsum([0, *self.lengths[:-1]], dtype=np.int64)

    @cached_property
    def states(self) -> NDArray[np.uint8]:
        """uint8 ``[pads, rows, cols]``: the :class:`State` of each position."""
        return states_of(self.diagnosis)

    def place(self, frame: int) -> tuple[int, float]:
        """Return the recording and the time of a frame, counted over the log."""
        recording = int(np.searchsorted(self._first, frame, side="right")) - 1
        after = (frame - self._first[recording]) / self.layout.rate
        return recording, float(self.starts[recording] + after)

    def __iter__(self) -> Iterator[Piece]:
        before = 0
        for piece in self.pieces():
            recording, start = self.place(before)
            times = start + np.arange(len(piece)) / self.layout.rate
            yield Piece(recording, times, on_grid(piece, self.layout))
            before += len(piece)
