"""The state of a fleet: robots that need a technician, wires that fail most often, failed
robots."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from datetime import date, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from adaptfault.data.documents import members
from adaptfault.fleet.outcome import Outcome
from adaptfault.inspection.severity import STATUS
from adaptfault.robot.metrics import RobotMetrics
from adaptfault.robot.sensor_state import weak_base
from diagnostics.shown import shown

SCHEMA = "adaptfault.fleet/1"
STATES = ("ok", "degraded", "technician", "unknown")

_SHOWN = 10  # of each list, in the text
_YEAR = 365.25


@dataclass(frozen=True)
class WireCount:
    """Number of faults of one wire over the fleet.

    Attributes:
        wire: the line, as "pad 1, row 2", or "single cells".
        kind: of the fault.
        shape: of the array; wires of different arrays are counted apart.
        robots: number of robots with this fault.
        share: of the robots with such an array.
        cells: faulty cells that it explains, over all robots.
    """

    wire: str
    kind: str
    shape: str
    robots: int
    share: float
    cells: int

    def __str__(self) -> str:
        robots = f"{self.robots} robot{'' if self.robots == 1 else 's'}"
        return f"{self.wire} {self.kind}: {robots} ({100 * self.share:.1f}%), {self.cells} cells"


@dataclass(frozen=True)
class AgeGroup:
    """Robots whose sensor has been in service for the same number of whole years.

    Attributes:
        years: whole years in service.
        robots: number of robots.
        degraded: number of them with a fault.
        wires: mean number of faulty wires.
        cells: mean number of faulty cells.
        worst: the wire that fails most often, with its number of robots; None without faulty wires.
    """

    years: int
    robots: int
    degraded: int
    wires: float
    cells: float
    worst: str | None

    def __str__(self) -> str:
        worst = f"; most often {self.worst}" if self.worst else ""
        robots = (
            f"{self.robots} robot{'s' * (self.robots != 1)}"
            f" {'has' if self.degraded == 1 else 'have'}"
        )
        return (
            f"{self.years} to {self.years + 1} years: {self.degraded} of {robots} faults,"
            f" {self.wires:.2f} wires and {self.cells:.1f} cells each{worst}"
        )


@shown
@dataclass(frozen=True)
class FleetReport:
    """Result of maintenance of a fleet.

    Attributes:
        outcomes: one per robot, in the order of the list.
        began, ended: UTC, as ISO 8601.
        dry_run: nothing was changed.
        source: the list of the fleet.
    """

    outcomes: tuple[Outcome, ...]
    began: str
    ended: str
    dry_run: bool = False
    source: str = ""

    @property
    def exit_code(self) -> int:
        """The worst of the robots: 2 if one needs a technician, else 3 if one is unknown, else 1,
        else 0.

        A robot known to be degraded outranks one in an unknown state.
        """
        return max((o.exit_code for o in self.outcomes), key=(0, 1, 3, 2).index, default=0)

    @property
    def counts(self) -> dict[str, int]:
        """Robots by state: ok (exit code 0), degraded (1), technician (2), unknown (3)."""
        codes = Counter(o.exit_code for o in self.outcomes)
        return {state: codes[code] for code, state in enumerate(STATES)}

    @cached_property
    def technician(self) -> tuple[Outcome, ...]:
        """Robots that need a technician, most urgent first: by remaining accuracy, then by share of
        faulty cells."""
        needy = [o for o in self.outcomes if o.exit_code == 2]
        return tuple(
            sorted(needy, key=lambda o: (o.kept, -(o.faulty or 0) / (o.cells or 1), o.robot.name))
        )

    @property
    def errors(self) -> tuple[Outcome, ...]:
        """Robots in an unknown state: an error, or unusable recordings."""
        return tuple(o for o in self.outcomes if o.exit_code == 3)

    @property
    def needy(self) -> tuple[Outcome, ...]:
        """Robots that need somebody, worst first: those for a technician, then those in an unknown
        state."""
        return (*self.technician, *self.errors)

    @property
    def weak(self) -> tuple[Outcome, ...]:
        """Robots whose repaired model is better than their healthy one: its base model is weak."""
        return tuple(o for o in self.outcomes if weak_base(o.accuracy, o.fault_free_accuracy))

    @cached_property
    def wires(self) -> tuple[WireCount, ...]:
        """Faulty wires, the most frequent first; single cells are one entry per kind."""
        skins = Counter(o.shape for o in self.outcomes if o.shape)
        robots: Counter[tuple[str, str, str]] = Counter()
        cells: Counter[tuple[str, str, str]] = Counter()
        for outcome in self.outcomes:
            behind: Counter[tuple[str, str, str]] = Counter()
            for cause in outcome.causes:
                behind[cause.wire or "single cells", cause.kind, outcome.shape or ""] += cause.cells
            robots.update(behind.keys())
            cells.update(behind)
        found = [WireCount(*key, n, n / skins[key[2]], cells[key]) for key, n in robots.items()]
        return tuple(sorted(found, key=lambda w: (-w.robots, -w.cells, w.wire, w.kind, w.shape)))

    @property
    def families(self) -> dict[str, int]:
        """Root causes by kind of wire (row, column, address lines, converter) or single cells, most
        frequent first."""
        causes = Counter(
            cause.family or "single cells" for o in self.outcomes for cause in o.causes
        )
        return dict(causes.most_common())

    @cached_property
    def ages(self) -> tuple[AgeGroup, ...]:
        """Faults by whole years in service, of maintained robots with a known first day."""
        today = datetime.fromisoformat(self.ended).date()
        groups: dict[int, list[Outcome]] = {}
        for outcome in self.outcomes:
            if outcome.robot.commissioned is not None and outcome.decision != "error":
                days = (today - date.fromisoformat(outcome.robot.commissioned)).days
                groups.setdefault(max(0, int(days / _YEAR)), []).append(outcome)
        return tuple(_group(years, groups[years]) for years in sorted(groups))

    @property
    def seconds(self) -> float:
        """Total time of all robots on the workers."""
        return sum(o.seconds for o in self.outcomes)

    def __str__(self) -> str:
        status = STATUS[self.exit_code]
        counts = ", ".join(f"{n} {state}" for state, n in self.counts.items() if n) or "none"
        measured = " ".join(
            f"{state}={n};;;0;{len(self.outcomes)}" for state, n in self.counts.items()
        )
        would = " (dry run: nothing was changed)" if self.dry_run else ""
        robots = f"{len(self.outcomes)} robot{'s' * (len(self.outcomes) != 1)}"
        lines = [f"ADAPTFAULT FLEET {status} - {robots}: {counts}{would} | {measured}"]
        lines += _listed(
            "need a technician, the most urgent first", [_needy(o) for o in self.technician]
        )
        lines += _listed(
            "weak base models, better repaired than healthy", [o.robot.name for o in self.weak]
        )
        lines += _listed("most frequent faults", [str(wire) for wire in self.wires])
        lines += _listed("by age", [str(group) for group in self.ages])
        lines += _listed("unknown state", [f"{o.robot.name}: {o.reason}" for o in self.errors])
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {
            "schema": SCHEMA,
            **members(self),
            **members(self, "exit_code", "counts", "wires", "families", "ages", "seconds"),
            "technician": [o.robot.name for o in self.technician],
            "weak_base_models": [o.robot.name for o in self.weak],
            "errors": {o.robot.name: o.reason for o in self.errors},
        }

    def metrics(self) -> list[RobotMetrics]:
        """Return the metrics of each robot."""
        ended = datetime.fromisoformat(self.ended).timestamp()
        return [outcome.metrics(ended) for outcome in self.outcomes]

    def write_page(self, path: str | Path) -> Path:
        """Write the report as one self-contained HTML file and return its path.

        Raises:
            OSError: the file cannot be written.
        """
        from adaptfault.pages.html_page import render

        return render(path, "fleet/fleet.html", report=self)


def _group(years: int, outcomes: list[Outcome]) -> AgeGroup:
    robots = Counter(wire for o in outcomes for wire in {c.wire for c in o.causes if c.wire})
    worst = min(robots, key=lambda wire: (-robots[wire], wire), default=None)
    return AgeGroup(
        years=years,
        robots=len(outcomes),
        degraded=sum(bool(o.faulty) for o in outcomes),
        wires=sum(len({c.wire for c in o.causes if c.wire}) for o in outcomes) / len(outcomes),
        cells=sum(o.faulty or 0 for o in outcomes) / len(outcomes),
        worst=None if worst is None else f"{worst} ({robots[worst]})",
    )


def _needy(o: Outcome) -> str:
    tags = f" [{', '.join(o.robot.tags)}]" if o.robot.tags else ""
    left = f"{100 * o.kept:.0f}% of the accuracy is left" if o.accuracy is not None else o.reason
    return f"{o.robot.name}{tags}: {left}; {o.faulty} of {o.cells} cells are faulty"


def _listed(title: str, entries: list[str]) -> list[str]:
    if not entries:
        return []
    more = [f"  and {len(entries) - _SHOWN} more"] if len(entries) > _SHOWN else []
    return [f"{title}:", *(f"  {entry}" for entry in entries[:_SHOWN]), *more]
