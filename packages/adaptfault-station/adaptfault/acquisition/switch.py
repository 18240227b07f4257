"""Recording rules: always, on command, at certain hours, or during contact."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, time

import numpy as np
from numpy.typing import NDArray

from diagnostics import SensorLayout
from diagnostics.preprocessing.load import LoadDirection

Rule = Callable[[NDArray[np.float64], NDArray[np.bool_], datetime], bool]
"""Returns whether to record a frame ``[D]``, given the faulty cells (bool ``[D]``) and the local
time."""

_SHARE = 0.05  # of full scale: threshold above which a cell is loaded
_CELLS = 3  # loaded cells that make a contact; a single one may be noise or a fault
_AFTER = 1.0  # seconds for which a recording continues after the last contact
_HOURS = re.compile(r"([01]?\d|2[0-3]):([0-5]\d)-([01]?\d|2[0-3]):([0-5]\d)", re.ASCII)


@dataclass(frozen=True)
class Contact:
    """Record while at least ``cells`` cells without a known fault are loaded by more than
    ``threshold``."""

    threshold: float
    cells: int = _CELLS
    load: LoadDirection | None = None

    def __call__(
        self, values: NDArray[np.float64], faulty: NDArray[np.bool_], clock: datetime
    ) -> bool:
        """Return whether to record this frame."""
        loads = values if self.load is None else self.load.loads(values)
        return int(np.count_nonzero((loads > self.threshold) & ~faulty)) >= self.cells


@dataclass(frozen=True)
class Daily:
    """Record from ``start`` to ``end`` every day, also across midnight."""

    start: time
    end: time

    def __call__(
        self, values: NDArray[np.float64], faulty: NDArray[np.bool_], clock: datetime
    ) -> bool:
        """Return whether to record this frame."""
        now = clock.time()
        if self.start <= self.end:
            return self.start <= now < self.end
        return now >= self.start or now < self.end


@dataclass(frozen=True)
class Constant:
    """Record always, or only on command."""

    on: bool

    def __call__(
        self, values: NDArray[np.float64], faulty: NDArray[np.bool_], clock: datetime
    ) -> bool:
        """Return whether to record this frame."""
        return self.on


def parse_when(text: str, layout: SensorLayout) -> Rule:
    """Parse a rule: "always", "command", "contact", "contact:0.5" or "08:00-17:30".

    Raises:
        ValueError: an unknown rule.
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
            return Contact(threshold, cells, LoadDirection.declared(layout))
        raise ValueError(
            f"--when {text}: expected a threshold from 0 to {layout.full_scale:g} {layout.unit}"
        )
    if match := _HOURS.fullmatch(text):
        first, second, third, fourth = (int(part) for part in match.groups())
        return Daily(time(first, second), time(third, fourth))
    raise ValueError(f"--when {text}: expected always, command, contact, contact:X or HH:MM-HH:MM")


class Switch:
    """Applies a rule unless a command overrides it.

    Attributes:
        command: True: record; False: do not; None: follow the rule.
    """

    def __init__(self, rule: Rule) -> None:
        self.rule = rule
        self.command: bool | None = None
        self._until = -np.inf

    def __call__(
        self, values: NDArray[np.float64], faulty: NDArray[np.bool_], at: float, clock: datetime
    ) -> bool:
        """Return whether to record the frame ``values`` ``[D]``, taken at ``at`` (seconds), at
        local time ``clock``."""
        if self.command is not None:
            self._until = -np.inf
            return self.command
        if self.rule(values, faulty, clock):
            self._until = at + _AFTER if isinstance(self.rule, Contact) else -np.inf
            return True
        return bool(at <= self._until)
