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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

TICKS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Ticks a second of each unit of time."""

_SLOWEST = 2.0  # Hz: of a clock whose unit is not stated
_FASTEST = 2000.0
_PAUSE = 20.0  # median periods: a longer one is a pause and tells nothing
_MOST_TICKS = 1e30  # frames a tick: no clock
_FEW = 20  # frames, behind which a frame in the wrong order is no longer looked for
_TURNS = 3  # of p and n_i
_NEAR = 0.2  # a multiple of the period is whole
_MOST = 0.9  # share of the steps that are whole multiples, where frames may be lost


@dataclass(frozen=True)
class Clock:
    """What the times of the frames tell.

    Attributes:
        jitter: robust standard deviation of the period, as a share of it; None without times.
        lost: frames that are missing between two times; 0 where the jitter hides them.
        falls: how often the clock falls back.
        late: frames that come behind a later one.
        pairs: whether each of these is exchanged with its neighbour.
    """

    jitter: float | None = None
    lost: int = 0
    falls: int = 0
    late: int = 0
    pairs: bool = False

    @property
    def disorder(self) -> str:
        """A sentence on frames in the wrong order; "" where there are none."""
        if not self.late:
            return ""
        what = "pair" if self.pairs else "frame"
        verb = " of frames" * self.pairs + (" is" if self.late == 1 else " are")
        return f"{self.late} {what}{'s' * (self.late != 1)}{verb} in the wrong order"


@dataclass(frozen=True)
class _Order:
    """The times of one recording in their order.

    Attributes:
        stretches: between falls of the clock, each sorted.
        first_fall, first_late: place of the first fall, and of the first frame in the wrong order.
        late, pairs: as in :class:`Clock`.
    """

    stretches: tuple[NDArray[np.float64], ...]
    first_fall: int = 0
    first_late: int = 0
    late: int = 0
    pairs: bool = False


class Elapsed:
    """The times of one recording or of several, in the ticks of their clock."""

    def __init__(self) -> None:
        self._parts: list[Elapsed] = [self]
        self._times: list[NDArray[np.float64]] = []
        self._places: list[NDArray[np.intp]] = []
        self._frames = 0
        self._order: _Order | None = None

    @classmethod
    def of_all(cls, several: Iterable[Elapsed | None]) -> Elapsed | None:
        """Return the times of several recordings together; None where there are none."""
        given = [one for one in several if one is not None]
        if not given:
            return None
        every = cls()
        every._parts = [part for one in given for part in one._parts]
        return every

    def add(self, times: NDArray[np.float64], lines: NDArray[np.intp] | None = None) -> None:
        """Take in the times of the next frames; what is not finite tells nothing."""
        known = np.isfinite(times)
        places = np.arange(self._frames, self._frames + len(times)) if lines is None else lines
        self._times.append(times[known])
        self._places.append(places[known])
        self._frames += len(times)
        self._order = None

    @property
    def falls(self) -> int:
        """How often the clock falls back."""
        return sum(max(0, len(part._ordered().stretches) - 1) for part in self._parts)

    @property
    def first_fall(self) -> int:
        """The line of the first fall, or its frame."""
        return next((p._ordered().first_fall for p in self._parts if p.falls), 0)

    @property
    def first_late(self) -> int:
        """The line of the first frame in the wrong order, or its number."""
        found = (part._ordered() for part in self._parts)
        return next((order.first_late for order in found if order.late), 0)

    def _ordered(self) -> _Order:
        """Return the times of this recording, each stretch between two falls of the clock
        sorted."""
        if self._order is None:
            times = np.concatenate([np.empty(0), *self._times])
            places = np.concatenate([np.empty(0, np.intp), *self._places])
            self._order = _in_order(times, places)
        return self._order

    def seconds(self, tick: str) -> float:
        """Return how long the recordings took by their times, whose unit is ``tick``: pauses and
        lost frames count."""
        with np.errstate(all="ignore"):
            per_tick = self._per_tick()
            stretches = [one for part in self._parts for one in part._ordered().stretches]
            spans = sum(float(one[-1] - one[0]) for one in stretches if len(one))
            period = 0.0 if per_tick is None else 1 / per_tick
            return (spans + period * len(stretches)) / TICKS[tick]

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
        unit = self.unit()
        return None if unit is None else _rounded(per_tick * TICKS[unit])

    def unit(self) -> str | None:
        """Return the first of s, ms, us and ns with which the rate is 2 to 2000 Hz; None: none."""
        with np.errstate(all="ignore"):
            per_tick = self._per_tick() or 0.0
        for tick, ticks in TICKS.items():
            if _SLOWEST <= per_tick * ticks <= _FASTEST:
                return tick
        return None

    def _pooled(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return all rises between times that differ, and how many frames have the earlier one."""
        steps = [np.empty(0)]
        shared = [np.empty(0)]
        for part in self._parts:
            for times in part._ordered().stretches:
                begins = np.flatnonzero(np.r_[True, times[1:] != times[:-1]])
                with np.errstate(all="ignore"):  # a time may be anything that a file can hold
                    rises = np.diff(times[begins])
                usable = np.isfinite(rises) & (rises > 0)
                steps.append(rises[usable])
                shared.append(np.diff(begins)[usable].astype(np.float64))
        return np.concatenate(steps), np.concatenate(shared)

    @property
    def disorder(self) -> str:
        """A sentence on frames in the wrong order; "" where there are none."""
        return self._disorder.disorder

    @property
    def _disorder(self) -> Clock:
        """What the order of the times tells of the clock."""
        orders = [part._ordered() for part in self._parts]
        late = sum(order.late for order in orders)
        pairs = all(order.pairs for order in orders if order.late)
        return Clock(None, 0, self.falls, late, pairs)

    def clock(self) -> Clock:
        """Return how regular the times are."""
        steps, shared = self._pooled()
        order = self._disorder
        if not len(steps):
            return order
        with np.errstate(all="ignore"):  # a time may be anything that a file can hold
            periods = steps / shared
            period = float(np.median(periods))
            jitter = float(1.4826 * np.median(np.abs(periods - period)) / period)
            multiples = periods[periods <= _PAUSE * period] / period
            whole = np.maximum(1, np.rint(multiples))
            regular = np.mean(np.abs(multiples - whole) < _NEAR) >= _MOST
        lost = int((whole - 1).sum()) if regular else 0
        return replace(order, jitter=jitter if np.isfinite(jitter) else None, lost=lost)

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


def _in_order(times: NDArray[np.float64], places: NDArray[np.intp]) -> _Order:
    """Return the times of a recording in order.

    A frame is late that comes behind later ones, is followed within a few frames by one that is
    later than all, or by the end, and whose time no other frame has. Any other fall is one of the
    clock.
    """
    falls = np.flatnonzero(times[1:] < times[:-1]) + 1
    late: list[int] = []
    pairs: list[bool] = []
    cuts: list[int] = []
    begin = 0
    seen = 0
    latest = -np.inf
    for fall in falls.tolist():
        latest = max(latest, float(times[seen:fall].max()))
        seen = fall
        near = times[fall : fall + _FEW]
        back = np.flatnonzero(near > latest)
        behind = int(back[0]) if len(back) else len(near)
        before = times[max(begin, fall - _FEW) : fall]
        around = np.concatenate([before, near[:behind]])
        ends = fall + _FEW > len(times) and near.min() > before.min()
        if (len(back) or ends) and len(np.unique(around)) == len(around):
            late.append(fall)
            pairs.append(behind == np.count_nonzero(before > times[fall]) == 1)
        else:
            cuts.append(fall)
            begin = fall
            latest = -np.inf
    stretches = np.split(times, cuts) if len(times) else []
    return _Order(
        tuple(np.sort(one) for one in stretches),
        int(places[cuts[0]]) if cuts else 0,
        int(places[late[0]]) if late else 0,
        len(late),
        bool(late) and all(pairs),
    )


def _rounded(rate: float) -> float:
    """Return a rate to three digits: a clock is not more exact."""
    return float(f"{rate:.3g}")
