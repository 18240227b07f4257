"""The outcome of one robot: a few hundred bytes, without the diagnosis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

from adaptfault.data.documents import rebuilt
from adaptfault.fleet.listing import Robot
from adaptfault.robot.metrics import PadCells, RobotMetrics, cells_by_pad, summed

if TYPE_CHECKING:  # passing outcomes on needs no torch
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.robot.maintenance_report import Decision as Decided
    from adaptfault.robot.maintenance_report import MaintenanceReport
    from diagnostics import Fault

    Decision = Decided | Literal["error"]

NAMES = {"Decision": str}
"""What names of types stand for that only a type checker imports."""

_NOTES = 5


@dataclass(frozen=True)
class Cause:
    """One root cause on one robot.

    Attributes:
        kind: of the fault, as "short".
        wire: the line, as "pad 1, row 2"; None for single cells.
        family: kind of line, as "row"; None for single cells.
        cells: number of faulty cells that it explains.
    """

    kind: str
    wire: str | None
    family: str | None
    cells: int

    @classmethod
    def of(cls, fault: Fault) -> Cause:
        """Return the cause of a fault."""
        line = fault.line
        wire, family = (None, None) if line is None else (str(line), line.kind)
        return cls(str(fault.kind), wire, family, len(fault.cells))


@dataclass(frozen=True)
class Outcome:
    """Result of maintenance of one robot.

    Attributes:
        robot: the robot.
        decision: of the maintenance; "error" if it failed.
        exit_code: of the maintenance; 3 for an error.
        reason: of the decision, one line.
        version: that runs now; None for an error, as the following.
        cells, faulty: number of cells, and of known faulty ones.
        shape: of the array, as "2 x 11 x 10".
        accuracy, fault_free_accuracy: of the running version, with and without the faults; None if
        never measured.
        causes: known root causes.
        notes: first recordings left out, and damage.
        recordings: number of new recordings used.
        seconds: wall clock on the worker.
        pads: cells of each pad by state.
        coverage: share of the cells that the new recordings tested; None without new recordings.
    """

    robot: Robot
    decision: Decision
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
    pads: tuple[PadCells, ...] = ()
    coverage: float | None = None

    @classmethod
    def of(
        cls,
        robot: Robot,
        bundle: Bundle,
        report: MaintenanceReport,
        *,
        notes: tuple[str, ...],
        seconds: float,
    ) -> Outcome:
        """Summarise a report; without a measurement in this run, the accuracy is the last one
        measured."""
        accuracy = report.accuracy
        free = report.fault_free_accuracy
        if accuracy is None and report.decision != "refused":
            runs = [run for run in bundle.journal.runs() if run.get("accuracy") is not None]
            if runs and runs[-1]["version"] == report.version:
                accuracy = runs[-1]["accuracy"]
                free = runs[-1]["fault_free_accuracy"]
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
            pads=cells_by_pad(bundle.layout, report.faults, report.diagnosis),
            coverage=None if report.diagnosis is None else report.diagnosis.coverage.test_coverage,
        )

    @classmethod
    def error(cls, robot: Robot, reason: str, seconds: float = 0.0) -> Outcome:
        """Return the outcome of a robot whose maintenance failed."""
        return cls(robot, "error", 3, " ".join(reason.split()), seconds=seconds)

    @property
    def kept(self) -> float:
        """Share of the fault-free accuracy that is left; 0 if unknown."""
        if self.accuracy is None or not self.fault_free_accuracy:
            return 0.0
        return self.accuracy / self.fault_free_accuracy

    def metrics(self, time: float) -> RobotMetrics:
        """Return the metrics of a run that ended at ``time``, in seconds since 1970."""
        faults = summed((cause.kind, cause.wire or "", cause.cells) for cause in self.causes)
        return RobotMetrics(
            self.robot.name,
            time,
            self.exit_code,
            self.pads,
            self.coverage,
            self.accuracy,
            faults,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        return asdict(self)

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> Outcome:
        """Rebuild from :meth:`to_dict`, also after JSON.

        Raises:
            ValueError: a field is missing or of another type.
        """
        return rebuilt(d, cls, NAMES)
