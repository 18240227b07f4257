"""When to record: always, on command, at certain hours, or while something is touched."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, time

import numpy as np
from numpy.typing import NDArray

from diagnostics import SensorLayout

Rule = Callable[[NDArray[np.float64], NDArray[np.bool_], datetime], bool]
"""Says of a frame ``[D]``, the cells not to be trusted (bool ``[D]``) and the local time whether to record it."""

_SHARE = 0.05  # of full scale, from which on a cell counts as touched
_CELLS = 3  # so many at once: a single one may be noise, or broken
_AFTER = 1.0  # seconds for which a recording goes on after the last touch
_HOURS = re.compile(r"([01]?\d|2[0-3]):([0-5]\d)-([01]?\d|2[0-3]):([0-5]\d)", re.ASCII)


@dataclass(frozen=True)
class Contact:
    """While at least ``cells`` cells that are not known to be faulty read more than ``threshold``."""

    threshold: float
    cells: int = _CELLS

    def __call__(self, values: NDArray[np.float64], faulty: NDArray[np.bool_], clock: datetime) -> bool:
        """Judge one frame."""
        return int(np.count_nonzero((values > self.threshold) & ~faulty)) >= self.cells


@dataclass(frozen=True)
class Daily:
    """From ``start`` to ``end`` every day, over midnight too."""

    start: time
    end: time

    def __call__(self, values: NDArray[np.float64], faulty: NDArray[np.bool_], clock: datetime) -> bool:
        """Judge one frame."""
        now = clock.time()
        if self.start <= self.end:
            return self.start <= now < self.end
        return now >= self.start or now < self.end


@dataclass(frozen=True)
class Constant:
    """Always, or only when told."""

    on: bool

    def __call__(self, values: NDArray[np.float64], faulty: NDArray[np.bool_], clock: datetime) -> bool:
        """Judge one frame."""
        return self.on


def parse_when(text: str, layout: SensorLayout) -> Rule:
    """Read a rule: "always", "command", "contact", "contact:0.5" or "08:00-17:30".

    Raises:
        ValueError: none of these.
    """
    name, _, number = text.partition(":")
    if text in ("always", "command"):
        return Constant(text == "always")
    if name == "contact":
        cells = min(_CELLS, int(layout.present.sum()))
        try:
            threshold = float(number) if number else _SHARE * layout.full_scale
        except ValueError:
            threshold = -1.0
        if 0 <= threshold < layout.full_scale:
            return Contact(threshold, cells)
        raise ValueError(f"--when {text}: expected a threshold from 0 to {layout.full_scale:g} {layout.unit}")
    if match := _HOURS.fullmatch(text):
        first, second, third, fourth = (int(part) for part in match.groups())
        return Daily(time(first, second), time(third, fourth))
    raise ValueError(f"--when {text}: expected always, command, contact, contact:X or HH:MM-HH:MM")


class Switch:
    """Follows a rule, until a command says otherwise.

    Attributes:
        command: True: record; False: do not; None: as the rule says.
    """

    def __init__(self, rule: Rule) -> None:
        self.rule = rule
        self.command: bool | None = None
        self._until = -np.inf

    def __call__(self, values: NDArray[np.float64], faulty: NDArray[np.bool_], at: float, clock: datetime) -> bool:
        """Say whether to record the frame ``values`` ``[D]``, taken at ``at`` (seconds), by local time ``clock``."""
        if self.command is not None:
            self._until = -np.inf
            return self.command
        if self.rule(values, faulty, clock):
            self._until = at + _AFTER if isinstance(self.rule, Contact) else -np.inf
            return True
        return bool(at <= self._until)
