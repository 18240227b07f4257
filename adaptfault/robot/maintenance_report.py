"""Result of a maintenance run, as text and as JSON."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from adaptfault.data.documents import members
from adaptfault.inspection.severity import STATUS, Reason, worst
from adaptfault.robot.model_comparison import Judgement
from adaptfault.robot.routine import RoutineResult
from adaptfault.robot.sensor_state import weak_base
from diagnostics import Diagnosis, Fault, FaultSet
from diagnostics.decision.numbering import Numbering
from diagnostics.sensor.sensor_change import SensorChange
from diagnostics.shown import shown

SCHEMA = "adaptfault.maintenance/1"
Decision = Literal["unchanged", "deployed", "kept", "refused"]

_FROM_0 = Numbering()


@shown
@dataclass(frozen=True, eq=False)
class MaintenanceReport:
    """Result of a maintenance run.

    Attributes:
        decision: "unchanged": no new fault, or the running version already excludes all faulty
            cells. "deployed": a new version runs, on probation. "kept": no candidate is better than
            the running version. "refused": the recordings do not fit this sensor, or no working
            model is left.
        reasons: why, and who has to act; the worst first.
        fault_set: F, as known now.
        version: number of the version that runs after this run.
        faults: known faults after this run, one for each root cause.
        diagnosis: of the new recordings; None without new recordings.
        judgement: comparison of the last candidate with the running version; None without a
            candidate.
        accuracy: of the version that runs now, under the known faults, on the held-out windows (R2
            of a regression); None if not measured.
        fault_free_accuracy: of version 1 on the same windows without faults; None if not measured.
        change: of a pad, or of the whole sensor, against the reference (gain, offset); None where
            none was found.
        rewiring: rows, columns or pads that answer in each other's place, as text; the deployed
            version undoes it.
        replaced_pads: pads that read otherwise; the deployed version recalibrates them.
        stages: cost and result of each adaptation stage, as text.
        used: names of the recordings whose diagnosis entered the known faults; empty where they
            were refused.
        left_out: recordings, or readings of them, that were not used, with the reason.
        warnings: damage found in the bundle.
        dry_run: nothing was changed.
        seconds: wall clock.
        n_cells: cells of the array, without masked positions; 0 where that is not known.
        measure: what ``accuracy`` is, "accuracy" or "R2"; where none was measured, "accuracy".
        set_size: mean number of classes in the sets of the version that runs now, which hold the
            true class with probability 0.9, on its validation; None: unknown, or a regression.
        selftest: what the log of a self-test routine tested; None: it is none.
    """

    decision: Decision
    reasons: tuple[Reason, ...]
    fault_set: FaultSet
    version: int
    faults: tuple[Fault, ...] = ()
    diagnosis: Diagnosis | None = None
    judgement: Judgement | None = None
    accuracy: float | None = None
    fault_free_accuracy: float | None = None
    change: SensorChange | None = None
    rewiring: tuple[str, ...] = ()
    replaced_pads: tuple[int, ...] = ()
    stages: tuple[str, ...] = ()
    used: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    dry_run: bool = False
    seconds: float = 0.0
    n_cells: int = 0
    measure: str = "accuracy"
    set_size: float | None = None
    selftest: RoutineResult | None = None

    @property
    def exit_code(self) -> int:
        """The worst severity of the reasons; see :mod:`adaptfault.inspection.severity`."""
        return worst(self.reasons)

    @property
    def reason(self) -> str:
        """The reasons in one line."""
        return "; ".join(reason.text for reason in self.reasons)

    def __str__(self) -> str:
        return self.text()

    def text(self, numbering: Numbering = _FROM_0) -> str:
        """Return the report as text; its first line is of the form of monitoring plugins."""
        status = STATUS[self.exit_code]
        n = self.n_cells or self.fault_set.n_cells
        faulty = len(self.fault_set)
        measured = [f"faulty={faulty};;;0;{n}"]
        if self.accuracy is not None:
            measured.append(f"{self.measure}={self.accuracy:.4f};;;0;1")
        would = " (dry run: nothing was changed)" if self.dry_run else ""
        lines = [
            f"ADAPTFAULT {status} - {self.decision}: {self.reason}{would} | {' '.join(measured)}"
        ]
        lines.append(
            f"version {self.version} runs; {faulty} of {n} cells {'is' if faulty == 1 else 'are'}"
            " faulty"
        )
        if self.set_size is not None:
            lines.append(f"  sets that hold the class at 90 %: {self.set_size:.2f} classes")
        if weak_base(self.accuracy, self.fault_free_accuracy):
            both = f"{self.accuracy:.3f} repaired, {self.fault_free_accuracy:.3f} healthy"
            lines.append(
                f"  weak base model: {self.measure} {both}; train it longer or on more recordings"
            )
        if self.diagnosis is not None:
            lines += [f"  {fault.reason}" for fault in self.diagnosis.faults]
            lines += [f"  {wire.reason}" for wire in self.diagnosis.possible]
            lines += [f"  {load.reason}" for load in self.diagnosis.static_loads]
            lines += [f"  {fault.reason}" for fault in self.diagnosis.transport]
            lines.append(f"  {self.diagnosis.coverage}")
            lines += [f"  to test more: {touch}" for touch in self.diagnosis.coverage.advice[:3]]
        if self.selftest is not None:
            lines.append(f"  {self.selftest}")
        lines = [numbering.text(line) for line in lines]
        lines += [f"  {stage}" for stage in self.stages]
        if self.judgement is not None:
            lines.append(f"  {self.judgement}")
        lines += [f"left out: {text}" for text in self.left_out]
        lines += [f"damage: {text}" for text in self.warnings]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        document = {"schema": SCHEMA, **members(self), **members(self, "exit_code", "reason")}
        del document["n_cells"]
        return document
