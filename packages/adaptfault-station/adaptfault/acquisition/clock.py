"""Compares a device's time stamps with the receiver's clock: do they count in the stated unit?"""

from __future__ import annotations

import math

_SECONDS = 2.0  # of the receiver's clock, for one comparison
_PACKETS = 5  # fewest of one comparison
_AGREE = 2  # comparisons with the same result, because a clock that is set jumps once
_FACTORS = (1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9)  # between units of time
_TOLERANCE = math.log(3)

UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Ticks in a second of time stamps in these units."""

_NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}


class ClockCheck:
    """Finds time stamps of one device that count in another unit than ``ticks`` states.

    Args:
        ticks: ticks of the time stamps in a second.
    """

    def __init__(self, ticks: float) -> None:
        self.ticks = ticks
        self._begun: tuple[float, float] | None = None  # time stamp and arrival of the first packet
        self._packets = 0
        self._factor: float | None = None
        self._agreed = 0
        self._told = False

    def push(self, time: float, now: float) -> str | None:
        """Add a packet with this time stamp (seconds, as ``ticks`` states) that arrived at ``now``.

        Returns:
            What is wrong with the unit, once; otherwise None.
        """
        if self._told:
            return None
        if self._begun is None:
            self._begun = (time, now)
            return None
        self._packets += 1
        first, arrived = self._begun
        passed = now - arrived
        if passed < _SECONDS or self._packets < _PACKETS:
            return None
        factor = _factor((time - first) / passed)
        self._agreed = self._agreed + 1 if factor is not None and factor == self._factor else 1
        self._factor = factor
        self._begun = (time, now)
        self._packets = 0
        if factor is None or self._agreed < _AGREE:
            return None
        self._told = True
        return self._text(factor)

    def _text(self, factor: float) -> str:
        slow = factor < 1
        times = f"{1 / factor if slow else factor:,.0f}"
        unit = next(
            (
                unit
                for unit, ticks in UNITS.items()
                if math.isclose(ticks, self.ticks * factor, rel_tol=1e-6)
            ),
            None,
        )
        expected = (
            f"; are they {_NAMES[unit]}? --ticks {unit}"
            if unit is not None
            else f", expected {self.ticks:g} ticks a second; --ticks states another number"
        )
        return f"time stamps advance {times} times too {'slowly' if slow else 'fast'}{expected}"


def _factor(ratio: float) -> float | None:
    """Return the factor between units that the ratio is near to; None: none."""
    if ratio <= 0:
        return None
    return next(
        (one for one in _FACTORS if abs(math.log(ratio) - math.log(one)) < _TOLERANCE), None
    )
