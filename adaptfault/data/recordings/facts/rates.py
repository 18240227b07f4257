"""The rate of a recording, from the times of its frames.

Estimates the number of frames a second, from all times of all files together::

    d_i   difference of successive times that differ;  c_i  how many frames have the earlier one
    p     median of d_i / c_i,    m_i = d_i / (c_i p),    steps with m_i > 20 are pauses
    n_i = c_i max(1, round(m_i))      frames in d_i, lost ones included, where nine in ten
                                      m_i are within .2 of a whole number; else n_i = c_i
    rate = sum n_i / sum d_i

Robust to times in whole milliseconds (8, 8, 9 ms are 120 Hz, where the median says 125), to clocks
that repeat, to pauses and to jitter. Not detected: a clock that runs fast or slow, and lost frames
where the times jitter by more than a fifth of the period.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

TICKS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Ticks a second of each unit of time."""

_SLOWEST = 2.0  # Hz: of a clock whose unit is not stated
_FASTEST = 2000.0
_PAUSE = 20.0  # median periods: a longer one is a pause and tells nothing
_MOST_TICKS = 1e30  # frames a tick: no clock
_TURNS = 3  # of p and n_i
_NEAR = 0.2  # a multiple of the period is whole
_MOST = 0.9  # share of the steps that are whole multiples, where frames may be lost


@dataclass(frozen=True)
class Clock:
    """What the times of the frames tell.

    Attributes:
        jitter: robust standard deviation of the period, as a share of it; None without times.
        lost: frames that are missing between two times; 0 where the jitter hides them.
        falls: how often a time is before the one before it.
    """

    jitter: float | None = None
    lost: int = 0
    falls: int = 0


class Elapsed:
    """The times of one recording or of several, in the ticks of their clock.

    Attributes:
        falls: how often a time is before the one before it.
        first_fall: the line of the first, or its frame.
    """

    def __init__(self) -> None:
        self.falls = 0
        self.first_fall = 0
        self._steps: list[NDArray[np.float64]] = []
        self._shared: list[NDArray[np.float64]] = []
        self._last: tuple[float, int] | None = None
        self._frames = 0

    @classmethod
    def of_all(cls, several: Iterable[Elapsed | None]) -> Elapsed | None:
        """Return the times of several recordings together; None where there are none."""
        given = [one for one in several if one is not None]
        if not given:
            return None
        every = cls()
        for one in given:
            if one.falls and not every.falls:
                every.first_fall = one.first_fall
            every.falls += one.falls
            every._steps += one._steps
            every._shared += one._shared
        return every

    def add(self, times: NDArray[np.float64], lines: NDArray[np.intp] | None = None) -> None:
        """Take in the times of the next frames; what is not finite tells nothing."""
        known = np.isfinite(times)
        at = np.flatnonzero(known)
        values = times[known]
        if not len(values):
            self._frames += len(times)
            return
        carried = 1
        if self._last is not None:
            values = np.concatenate([[self._last[0]], values])
            at = np.concatenate([[-1], at])
            carried = self._last[1]
        begins = np.concatenate([[0], np.flatnonzero(values[1:] != values[:-1]) + 1])
        shared = np.diff(np.concatenate([begins, [len(values)]])).astype(np.float64)
        shared[0] += carried - 1
        distinct = values[begins]
        with np.errstate(all="ignore"):  # a time may be anything that a file can hold
            steps = np.diff(distinct)
        falling = np.flatnonzero(steps < 0)
        if len(falling):
            frame = int(at[begins[falling[0] + 1]])
            if not self.falls:
                self.first_fall = self._frames + frame if lines is None else int(lines[frame])
            self.falls += len(falling)
        rises = np.isfinite(steps) & (steps > 0)
        self._steps.append(steps[rises])
        self._shared.append(shared[:-1][rises])
        self._last = (float(distinct[-1]), int(shared[-1]))
        self._frames += len(times)

    def rate(self, tick: str | None) -> float | None:
        """Return frames a second; None where no time rises, or no unit gives 2 to 2000 Hz.

        Args:
            tick: unit of the times; None: the first of s, ms, us and ns that gives such a rate.
        """
        with np.errstate(all="ignore"):  # a time may be anything that a file can hold
            per_tick = self._per_tick()
        if per_tick is None or not 0 < per_tick < _MOST_TICKS:
            return None
        if tick is not None:
            return _rounded(per_tick * TICKS[tick])
        rates = [per_tick * ticks for ticks in TICKS.values()]
        return next((_rounded(rate) for rate in rates if _SLOWEST <= rate <= _FASTEST), None)

    def _pooled(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return all rises between times that differ, and how many frames have the earlier one."""
        steps = np.concatenate([np.empty(0), *self._steps])
        return steps, np.concatenate([np.empty(0), *self._shared])

    def clock(self) -> Clock:
        """Return how regular the times are."""
        steps, shared = self._pooled()
        if not len(steps):
            return Clock(None, 0, self.falls)
        with np.errstate(all="ignore"):  # a time may be anything that a file can hold
            periods = steps / shared
            period = float(np.median(periods))
            jitter = float(1.4826 * np.median(np.abs(periods - period)) / period)
            multiples = periods[periods <= _PAUSE * period] / period
            whole = np.maximum(1, np.rint(multiples))
            regular = np.mean(np.abs(multiples - whole) < _NEAR) >= _MOST
        lost = int((whole - 1).sum()) if regular else 0
        return Clock(jitter if np.isfinite(jitter) else None, lost, self.falls)

    def _per_tick(self) -> float | None:
        """Return frames a tick."""
        steps, shared = self._pooled()
        if not len(steps):
            return None
        period = float(np.median(steps / shared))
        usual = steps / shared <= _PAUSE * period
        steps = steps[usual]
        shared = shared[usual]
        for _ in range(_TURNS):
            multiples = steps / (shared * period)
            whole = np.maximum(1, np.rint(multiples))
            if np.mean(np.abs(multiples - whole) < _NEAR) < _MOST:
                return float(shared.sum() / steps.sum())
            period = float(steps.sum() / (shared * whole).sum())
        return 1 / period


def _rounded(rate: float) -> float:
    """Return a rate to three digits: a clock is not more exact."""
    return float(f"{rate:.3g}")
