"""What comes back from one robot: a few hundred bytes, not its diagnosis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

from adaptfault.fleet.listing import Robot

if TYPE_CHECKING:  # who only passes outcomes on does without torch
    from adaptfault.robot.bundle import Bundle
    from adaptfault.robot.maintenance import Decision, MaintenanceReport
    from diagnostics import Fault

_NOTES = 5


@dataclass(frozen=True)
class Cause:
    """One root cause on one robot.

    Attributes:
        kind: of the fault, as "short".
        wire: the line, as "pad 1, row 2"; None for cells by themselves.
        family: what kind of line, as "row"; None likewise.
        cells: how many are behind it.
    """

    kind: str
    wire: str | None
    family: str | None
    cells: int

    @classmethod
    def of(cls, fault: Fault) -> Cause:
        """Sum a fault up."""
        line = fault.line
        wire, family = (None, None) if line is None else (str(line), line.kind)
        return cls(str(fault.kind), wire, family, len(fault.cells))


@dataclass(frozen=True)
class Outcome:
    """How maintenance of one robot ended.

    Attributes:
        robot: which.
        decision: of the maintenance; "error" if there was none.
        exit_code: of the maintenance; 3 for an error.
        reason: why, in one line.
        version: that runs now; None for an error, as what follows.
        cells, faulty: how many cells the skin has, and how many of them are known to be faulty.
        shape: of the skin, as "2 x 11 x 10".
        accuracy, fault_free_accuracy: of what runs now, under the faults and without; None if never judged.
        causes: known root causes.
        notes: recordings left out and damage, the first few.
        recordings: how many new ones were used.
        seconds: wall clock on the worker.
    """

    robot: Robot
    decision: Decision | Literal["error"]
    exit_code: int
    reason: str
    version: int | None = None
    cells: int | None = None
    faulty: int | None = None
    shape: str | None = None
    accuracy: float | None = None
    fault_free_accuracy: float | None = None
    causes: tuple[Cause, ...] = ()
    notes: tuple[str, ...] = ()
    recordings: int = 0
    seconds: float = 0.0

    @classmethod
    def of(
        cls, robot: Robot, bundle: Bundle, report: MaintenanceReport, *, notes: tuple[str, ...], seconds: float
    ) -> Outcome:
        """Sum a report up; where nothing was judged in this run, the accuracy is the one last judged."""
        accuracy, free = report.accuracy, report.fault_free_accuracy
        if accuracy is None and report.decision != "refused":
            runs = [run for run in bundle.journal.runs() if run.get("accuracy") is not None]
            if runs and runs[-1]["version"] == report.version:
                accuracy, free = runs[-1]["accuracy"], runs[-1]["fault_free_accuracy"]
        every = (*notes, *report.left_out, *report.warnings)
        more = (f"and {len(every) - _NOTES} more",) if len(every) > _NOTES else ()
        return cls(
            robot=robot,
            decision=report.decision,
            exit_code=report.exit_code,
            reason=report.reason,
            version=report.version,
            cells=int(bundle.layout.present.sum()),
            faulty=len(report.fault_set),
            shape=" x ".join(map(str, bundle.layout.shape)),
            accuracy=accuracy,
            fault_free_accuracy=free,
            causes=tuple(Cause.of(fault) for fault in report.faults),
            notes=(*every[:_NOTES], *more),
            recordings=len(report.used),
            seconds=seconds,
        )

    @classmethod
    def error(cls, robot: Robot, reason: str, seconds: float = 0.0) -> Outcome:
        """Return the outcome of a robot that could not be maintained."""
        return cls(robot, "error", 3, " ".join(reason.split()), seconds=seconds)

    @property
    def kept(self) -> float:
        """The share of the fault-free accuracy that is left; 0 where nothing that works is known."""
        if self.accuracy is None or not self.fault_free_accuracy:
            return 0.0
        return self.accuracy / self.fault_free_accuracy

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        return asdict(self)

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> Outcome:
        """Rebuild it from :meth:`to_dict`'s dict, also after a way through JSON."""
        robot = {**d["robot"], "recordings": tuple(d["robot"]["recordings"]), "tags": tuple(d["robot"]["tags"])}
        causes = tuple(Cause(**cause) for cause in d["causes"])
        return cls(**{**d, "robot": Robot(**robot), "causes": causes, "notes": tuple(d["notes"])})
