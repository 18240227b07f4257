"""Ageing of a fleet: lifetimes of wires and cells from the journals, and whom to service next."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any

import numpy as np

from adaptfault.bundle.bundle import Bundle
from adaptfault.fleet.listing import Fleet
from adaptfault.prognosis.survival import COVERAGE, Lifetimes, Survival
from diagnostics import Fault
from diagnostics.shown import shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCHEMA = "adaptfault.fleet-survival/1"
MONTH = 30.0  # days

_DAY = 86400.0  # seconds
_SHOWN = 10  # robots, in the text
_YEARS = (365.25, 730.5)  # ages at which the text gives the curve

Entry = tuple[float, float, bool, int, int]


@dataclass(frozen=True)
class Service:
    """What to expect of one robot in the coming days.

    Attributes:
        robot: its name.
        faults: expected number of new faults of wires and cells.
        low, high: interval of it.
        known: number of faults known now.
    """

    robot: str
    faults: float
    low: float
    high: float
    known: int

    @property
    def probability(self) -> float:
        """Probability of at least one new fault."""
        return float(-np.expm1(-self.faults))

    def __str__(self) -> str:
        return (
            f"{self.robot}: {self.probability:.0%} for a new fault"
            f" ({self.faults:.2g} expected, {self.low:.2g} to {self.high:.2g}); {self.known} known"
        )


@shown
@dataclass(frozen=True, eq=False)
class FleetSurvival:
    """Survival of the wires and cells of a fleet.

    Attributes:
        units: estimates by kind of unit: "wires", "cells"; without the kinds that no run has
            watched.
        service: robots, the most likely to fail first.
        days: time ahead for which they are listed.
        left_out: robots that are not counted, with the reason.
    """

    units: dict[str, Survival]
    service: tuple[Service, ...]
    days: float
    left_out: tuple[str, ...] = ()

    @classmethod
    def of(cls, fleet: Fleet, days: float = MONTH) -> FleetSurvival:
        """Read the journals of all bundles.

        The age of a robot counts from ``commissioned``, or from the creation of its bundle. A fault
        happened halfway between the run that found it and the run before. Cells that fail with
        their wire count as the wire's.

        Raises:
            ValueError: ``days`` is not above 0, or no robot has a run that used recordings.
        """
        if not days > 0:
            raise ValueError(f"expected days > 0, got {days:g}")
        entries: dict[str, list[Entry]] = {"wires": [], "cells": []}
        known = []
        left_out = []
        for number, robot in enumerate(fleet.robots):
            try:
                found, faults = _lifetimes(Bundle.open(robot.bundle), robot.commissioned, number)
            except (OSError, ValueError) as error:
                left_out.append(f"{robot.name}: {error}")
                found = {}
                faults = 0
            else:
                if not any(found.values()):
                    left_out.append(f"{robot.name}: no run used recordings after its first day")
            known.append(faults)
            for kind, of in found.items():
                entries[kind] += of
        units = {kind: Survival.fit(_columns(of)) for kind, of in entries.items() if of}
        if not units:
            raise ValueError(
                f"no robot of {len(fleet)} has a run to learn from: {'; '.join(left_out[:3])}"
            )
        ahead = np.zeros((3, len(fleet)))
        for survival in units.values():
            numbers = np.array(survival.next_faults(days))
            ahead[:, : numbers.shape[1]] += numbers
        watched = {int(r) for survival in units.values() for r in survival.lifetimes.robot}
        service = [
            Service(
                fleet.robots[i].name,
                float(ahead[0, i]),
                float(ahead[1, i]),
                float(ahead[2, i]),
                known[i],
            )
            for i in sorted(watched)
        ]
        return cls(
            units, tuple(sorted(service, key=lambda s: (-s.faults, s.robot))), days, tuple(left_out)
        )

    def __str__(self) -> str:
        lines = []
        for kind, of in self.units.items():
            lines.append(
                f"{kind}: {of.lifetimes.faults} of {of.lifetimes.units.sum()} failed;"
                f" {of.rate_low:.2g} to {of.rate_high:.2g} faults of each in 1000 days"
                f" ({COVERAGE:.0%} interval)"
            )
            if of.shape_low < of.shape_high:
                trend = (
                    "rises"
                    if of.shape_low > 1
                    else "falls"
                    if of.shape_high < 1
                    else "may be constant"
                )
                interval = f"{of.shape_low:.2f} to {of.shape_high:.2f}"
                lines.append(
                    f"  hazard {trend} with age: Weibull shape {of.shape:.2f} ({interval})"
                )
            for age in _YEARS:
                if age <= of.lifetimes.end.max() and len(of.ages):
                    share, low, high = of.at(age)
                    lines.append(
                        f"  without a fault after {age:.0f} days: {share:.1%} ({low:.1%} to"
                        f" {high:.1%})"
                    )
        lines.append(f"whom to service in the next {self.days:g} days:")
        lines += [f"  {robot}" for robot in self.service[:_SHOWN]]
        if len(self.service) > _SHOWN:
            lines.append(f"  and {len(self.service) - _SHOWN} more")
        return "\n".join([*lines, *(f"left out: {text}" for text in self.left_out)])

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {
            "schema": SCHEMA,
            "days": self.days,
            "coverage": COVERAGE,
            "units": {kind: of.to_dict() for kind, of in self.units.items()},
            "service": [
                {**vars(robot), "probability": robot.probability} for robot in self.service
            ],
            "left_out": list(self.left_out),
        }

    def plot(self) -> Figure:
        """Return a figure of the curves with their intervals, and the Weibull distributions."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(4 * len(self.units), 3), layout="constrained")
        for axes, (kind, of) in zip(
            figure.subplots(1, len(self.units), squeeze=False)[0], self.units.items(), strict=True
        ):
            ages = np.linspace(0, of.lifetimes.end.max(), 200)
            axes.plot(ages, np.exp(-of.hazard(ages)), color="#c0392b", label="Weibull")
            if len(of.ages):
                axes.step(
                    [0, *of.ages],
                    [1, *of.survival],
                    where="post",
                    color="#2c6fa6",
                    label="Kaplan-Meier",
                )
                axes.fill_between(
                    of.ages, of.low, of.high, step="post", color="#2c6fa6", alpha=0.2, linewidth=0
                )
            axes.set(title=f"{kind} without a fault", xlabel="age in days")
            axes.legend(frameon=False)
        return figure


def _columns(entries: list[Entry]) -> Lifetimes:
    entry, end, failed, robot, units = zip(*entries, strict=True)
    return Lifetimes(
        np.array(entry),
        np.array(end),
        np.array(failed, bool),
        np.array(robot, np.intp),
        np.array(units, np.intp),
    )


def _lifetimes(
    bundle: Bundle, commissioned: str | None, number: int
) -> tuple[dict[str, list[Entry]], int]:
    """Return the lifetimes of the wires and cells of one robot, and the number of faults known
    now."""
    created = _days(bundle.about["created"])
    born = created if commissioned is None else _days(commissioned)
    entry = max(0.0, created - born)
    layout = bundle.layout
    wires = [
        line
        for line in layout.lines
        if "address" not in line.kind and len(layout.cells_on(line)) > 1
    ]
    alive: dict[str, set[Any]] = {
        "wires": set(wires),
        "cells": set(np.flatnonzero(layout.present).tolist()),
    }
    found: dict[str, list[Entry]] = {"wires": [], "cells": []}
    before = entry
    last = entry
    known = 0
    for run in bundle.journal.runs():
        if not run.get("used"):
            continue
        last = max(before, _days(run["time"]) - born)
        half = (before + last) / 2
        faults = [Fault.from_dict(fault) for fault in run["faults"]]
        known = len(faults)
        failed: dict[str, set[Any]] = {
            "wires": {fault.line for fault in faults if fault.line is not None},
            "cells": {cell for fault in faults if fault.line is None for cell in fault.cells},
        }
        behind: set[Any] = {
            cell for fault in faults if fault.line is not None for cell in fault.cells
        }
        ends: list[tuple[str, set[Any], bool]] = [
            ("wires", failed["wires"], True),
            ("cells", failed["cells"], True),
            ("cells", behind, False),
        ]
        for kind, units, fault in ends:
            if half > entry and (gone := len(units & alive[kind])):
                found[kind].append((entry, half, fault, number, gone))
            alive[kind] -= units
        before = last
    if last > entry:
        for kind, units in alive.items():
            if units:
                found[kind].append((entry, last, False, number, len(units)))
    return found, known


def _days(time: str) -> float:
    """Return days since 1970 of an ISO 8601 time; UTC where it states no zone."""
    of = datetime.fromisoformat(time)
    return (of if of.tzinfo else of.replace(tzinfo=timezone.utc)).timestamp() / _DAY
