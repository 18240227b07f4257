"""The monitor for the microcontroller, in Python: what ``monitor.c`` computes, integer by integer.

A reading is a whole count, or missing. For each frame and cell, with ``d`` the dither, ``w`` the
number of predictors that have to move::

    run       frames since the readings of the cell left a range of ``d`` last
    seen      fresh frames of the run in which ``w`` of the cell's predictors left theirs
    silent    frames since its last reading
    STUCK     seen > stuck_after        OUTSIDE  run >= settled and all of it beyond lowest, highest
    SILENT    silent > silent_after     FROZEN   one frame more than ``patience`` times in a row,
                                                 with three cells or more away from rest

A predictor is a cell that moves when this cell does: in fault-free recordings ``seen`` never came
near ``stuck_after``. A frame that repeats the one before it tells nothing of a cell.

Not detected: a cell that moves but is wrong; one whose predictors are dead, too, all but one; one
that its predictors hardly told of in the reference (``stuck_after`` 0: never stuck). A wire is not
named; the diagnosis on the robot does both.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

MISSING = -32768
"""The count of a reading that is missing."""

TOP = 32767
"""The highest count."""

PREDICTORS = 4
"""Predictors of each cell."""

TELL = 2
"""Predictors that have to move in one frame."""

SETTLED = 32
"""Frames of a run that lies outside the range."""

AWAY = 3
"""Cells away from rest in a frame that is frozen."""

_MOST = 65535

Counts = NDArray[np.int16]
Numbers = NDArray[np.int64]


class CellState(IntEnum):
    """What the monitor tells of a cell; the first that holds."""

    OK = 0
    SILENT = 1
    OUTSIDE = 2
    STUCK = 3


@dataclass(frozen=True)
class Limits:
    """What healthy cells keep to, in counts and frames.

    Attributes:
        per_unit: counts of one unit of the layout.
        dither: range of the readings of a constant cell.
        near: readings this far from rest are no load.
        patience: how many times in a row a frame may repeat, at most 65534.
        silent_after: fresh frames without a reading, at most 65534.
        rest, lowest, highest: int16 ``[D]``, reading without a load, and the healthy range.
        stuck_after: uint16 ``[D]``; 0: nothing tells of the cell, or there is none.
        predictors: uint16 ``[D, 4]``.
    """

    per_unit: float
    dither: int
    near: int
    patience: int
    silent_after: int
    rest: Counts
    lowest: Counts
    highest: Counts
    stuck_after: NDArray[np.uint16]
    predictors: NDArray[np.uint16]

    def counts(self, frames: NDArray[np.floating]) -> Counts:
        """Return readings ``[..., D]`` in the layout's unit as counts; NaN, infinite: missing."""
        scaled = np.rint(np.asarray(frames, np.float64) * self.per_unit)
        known = np.isfinite(scaled)
        clipped = np.clip(np.where(known, scaled, 0.0), -TOP, TOP)
        return np.where(known, clipped, MISSING).astype(np.int16)


class CountingMonitor:
    """The monitor, frame by frame; ``monitor.c`` has the same state, 12 bytes a cell.

    Attributes:
        last, low, high: int64 ``[D]``, last reading, range of the run.
        run, seen, silent: int64 ``[D]``, see the module; at most 65535.
        repeats: how many times in a row the last frame was received again.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        cells = len(limits.rest)
        self.last = np.full(cells, MISSING, np.int64)
        self.low = np.full(cells, TOP, np.int64)
        self.high = np.full(cells, MISSING, np.int64)
        self.run = np.zeros(cells, np.int64)
        self.seen = np.zeros(cells, np.int64)
        self.silent = np.zeros(cells, np.int64)
        self.repeats = 0
        self._before = np.full(cells, MISSING, np.int16)

    def update(self, frame: Counts) -> None:
        """Take in one frame, int16 ``[D]``; -32768: missing."""
        repeated = np.array_equal(self._before, frame)
        self._before = frame.copy()
        if repeated:
            self.repeats = min(self.repeats + 1, _MOST)
            return
        self.repeats = 0
        reading = frame.astype(np.int64)
        received = reading != MISSING
        low = np.where(received, np.minimum(self.low, reading), self.low)
        high = np.where(received, np.maximum(self.high, reading), self.high)
        moved = received & (high - low > self.limits.dither)
        self.low = np.where(moved, reading, low)
        self.high = np.where(moved, reading, high)
        self.last = np.where(received, reading, self.last)
        self.run = np.where(moved, 0, np.minimum(self.run + 1, _MOST))
        self.silent = np.where(received, 0, np.minimum(self.silent + 1, _MOST))
        tell = moved[self.limits.predictors].sum(axis=1) >= TELL
        self.seen = np.where(moved, 0, np.minimum(self.seen + tell, _MOST))

    @property
    def states(self) -> NDArray[np.uint8]:
        """What is told of each cell, uint8 ``[D]`` of :class:`CellState`."""
        limits = self.limits
        beyond = (self.low > limits.highest) | (self.high < limits.lowest)
        received = self.last != MISSING
        stuck = (limits.stuck_after > 0) & (self.seen > limits.stuck_after)
        found = np.select(
            [
                self.silent > limits.silent_after,
                received & beyond & (self.run >= SETTLED),
                received & stuck,
            ],
            [CellState.SILENT, CellState.OUTSIDE, CellState.STUCK],
            CellState.OK,
        )
        return found.astype(np.uint8)

    @property
    def frozen(self) -> bool:
        """Whether the stream is frozen."""
        if self.repeats <= self.limits.patience:
            return False
        reading = self._before.astype(np.int64)
        away = np.abs(reading - self.limits.rest) > self.limits.near
        return bool((away & (reading != MISSING)).sum() >= AWAY)
