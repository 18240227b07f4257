"""The maintenance routine: diagnose what came in, merge it with what was known, adapt, judge, deploy or keep."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.robot.bundle import Bundle, now
from adaptfault.robot.deployment_test import Judgement, judge, with_faults
from adaptfault.robot.known_faults import Knowledge
from adaptfault.robot.plausibility import contradiction, implausible
from adaptfault.robot.pointer import Pointer
from diagnostics import Diagnosis, Fault, FaultSet

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter
    from adaptfault.adaptation.result import Adaptation

SCHEMA = "adaptfault.maintenance/1"
Decision = Literal["unchanged", "deployed", "kept", "refused"]

_TECHNICIAN_BELOW = 0.9  # of the fault-free accuracy: what is left then is no repair
_CONTRADICTORY = 1.0  # the healthy cells explain each other worse than their means do
_UNKNOWN = 3


@dataclass(frozen=True, eq=False)
class MaintenanceReport:
    """What a maintenance run found and did.

    Attributes:
        decision: "unchanged": nothing new, or nothing that what runs does not do without already. "deployed": a new
            version runs, on probation. "kept": the faults are known, what runs is as good as what could. "refused": the
            recordings cannot be from this sensor, or there is nothing that works.
        exit_code: 0 no fault known; 1 degraded but handled; 2 needs a technician; 3 unusable recordings.
        reason: why, in one sentence.
        fault_set: F, as known now.
        version: that runs now.
        faults: that are known now, one for each root cause.
        diagnosis: of the new recordings; None where there were none.
        judgement: of the last candidate beside what ran; None where there was none.
        accuracy: of what runs now, under the faults known now, on the windows kept for that; None if not judged.
        fault_free_accuracy: of version 1 on the same windows without faults; None if not judged.
        stages: what each stage of the adaptation cost and reached, as text.
        used, left_out: names of recordings, and why the latter could not be used.
        warnings: damage that was found in the bundle.
        dry_run: nothing was changed.
        seconds: wall clock.
    """

    decision: Decision
    exit_code: int
    reason: str
    fault_set: FaultSet
    version: int
    faults: tuple[Fault, ...] = ()
    diagnosis: Diagnosis | None = None
    judgement: Judgement | None = None
    accuracy: float | None = None
    fault_free_accuracy: float | None = None
    stages: tuple[str, ...] = ()
    used: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    dry_run: bool = False
    seconds: float = 0.0

    def __str__(self) -> str:
        status = ("OK", "WARNING", "CRITICAL", "UNKNOWN")[self.exit_code]
        n = self.fault_set.n_cells
        measured = [f"faulty={len(self.fault_set)};;;0;{n}"]
        if self.accuracy is not None:
            measured.append(f"accuracy={self.accuracy:.4f};;;0;1")
        would = " (dry run: nothing was changed)" if self.dry_run else ""
        lines = [f"ADAPTFAULT {status} - {self.decision}: {self.reason}{would} | {' '.join(measured)}"]
        lines.append(f"version {self.version} runs; {len(self.fault_set)} of {n} cells are faulty")
        if self.diagnosis is not None:
            lines += [f"  {fault.reason}" for fault in self.diagnosis.faults]
            lines += [f"  {fault.reason}" for fault in self.diagnosis.transport]
            lines.append(f"  {self.diagnosis.coverage}")
            lines += [f"  to test more: {touch}" for touch in self.diagnosis.coverage.advice[:3]]
        lines += [f"  {stage}" for stage in self.stages]
        if self.judgement is not None:
            lines.append(f"  {self.judgement}")
        lines += [f"left out: {text}" for text in self.left_out]
        lines += [f"damage: {text}" for text in self.warnings]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {
            "schema": SCHEMA,
            "decision": self.decision,
            "exit_code": self.exit_code,
            "reason": self.reason,
            "fault_set": list(self.fault_set),
            "version": self.version,
            "faults": [fault.to_dict() for fault in self.faults],
            "diagnosis": None if self.diagnosis is None else self.diagnosis.to_dict(),
            "judgement": None if self.judgement is None else vars(self.judgement),
            "accuracy": self.accuracy,
            "fault_free_accuracy": self.fault_free_accuracy,
            "stages": list(self.stages),
            "used": list(self.used),
            "left_out": list(self.left_out),
            "warnings": list(self.warnings),
            "dry_run": self.dry_run,
            "seconds": self.seconds,
        }


def maintain(
    bundle: Bundle,
    recordings: ArrayLike | Sequence[ArrayLike],
    *,
    names: Sequence[str] = (),
    dry_run: bool = False,
    budget: float | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> MaintenanceReport:
    """Diagnose what was recorded since the last run and bring what runs up to date.

    The same recordings twice change nothing: the journal knows them by their content. A new version is deployed only
    if, with the new faults put into windows that no model learned from, it is better than what runs beyond chance
    (bootstrap over recordings), and no class collapses.

    Args:
        bundle: the robot's.
        recordings: ``[T, D]`` or a list of them, in the layout's unit, in time order.
        names: of the recordings, for messages.
        dry_run: find out and report, change nothing.
        budget: seconds that an adaptation may take.
        say: told what is being done.

    Raises:
        Busy: another run is under way.
        Damaged: a part of the bundle that is needed is not what was written.
    """
    began = time.perf_counter()
    with bundle.maintenance():
        report = _Maintenance(bundle, dry_run, budget, say).run(_checked(recordings, names, bundle))
    return replace(report, seconds=time.perf_counter() - began)


@dataclass
class _Incoming:
    """A recording that came in: its content, and whether it can be used."""

    name: str
    frames: NDArray[np.float64] | None
    digest: str
    problem: str | None


def _checked(recordings: ArrayLike | Sequence[ArrayLike], names: Sequence[str], bundle: Bundle) -> list[_Incoming]:
    given: Any = recordings
    if isinstance(given, np.ndarray) and (given.ndim <= 2 or given.shape[1:] == bundle.layout.shape):
        given = [given]
    incoming = []
    for i, recording in enumerate(given):
        name = names[i] if i < len(names) else f"recording {i}"
        raw = np.ascontiguousarray(recording, dtype=np.float64)
        digest = hashlib.sha256(repr(raw.shape).encode() + raw.tobytes()).hexdigest()
        try:
            frames = bundle.layout.check_recording(raw, name)
            problem = implausible(frames, bundle.layout) if len(frames) else "it holds no frame"
        except ValueError as error:
            frames, problem = None, str(error)
        incoming.append(_Incoming(name, frames, digest, problem))
    return incoming


@dataclass
class _Maintenance:
    """One run under way."""

    bundle: Bundle
    dry_run: bool
    budget: float | None
    say: Callable[[str], None]
    warnings: tuple[str, ...] = field(default=(), init=False)
    judged: dict[str, Any] | None = field(default=None, init=False)

    def run(self, incoming: Sequence[_Incoming]) -> MaintenanceReport:
        """Diagnose what was not seen before, decide, and write down what was done, unless this is a dry run."""
        bundle = self.bundle
        self.warnings = tuple(bundle.problems(mend=not self.dry_run))
        self.version = bundle.active()
        self.before = bundle.knowledge()
        seen = bundle.journal.seen([r.digest for r in incoming])
        fresh = list({r.digest: r for r in incoming if r.digest not in seen}.values())
        usable = [r for r in fresh if r.problem is None]
        self.left_out = tuple(f"{r.name}: {r.problem}" for r in fresh if r.problem is not None)
        if not fresh:
            code = self._code(self.before.fault_set)
            return self._report("unchanged", code, "no recording that was not seen before", self.before)
        if not usable:
            return self._report("refused", _UNKNOWN, "no recording is usable", self.before)
        self.say(f"diagnosing {len(usable)} new recordings")
        frames = [r.frames for r in usable if r.frames is not None]
        report = self._decide(bundle.diagnoser().diagnose(frames), frames, tuple(r.name for r in usable))
        if not self.dry_run:
            self._write(report, usable)
        return report

    def _decide(
        self, diagnosis: Diagnosis, frames: list[NDArray[np.float64]], used: tuple[str, ...]
    ) -> MaintenanceReport:
        """Say what is to be done about a diagnosis, and deploy if that is it."""
        known = self.before.merged(diagnosis)
        faulty = known.fault_set
        found: dict[str, Any] = {"diagnosis": diagnosis, "used": used}
        adapter = self.bundle.parts.adapter()
        present = FaultSet(tuple(np.flatnonzero(self.bundle.layout.present).tolist()), faulty.n_cells)
        if not present - faulty:
            reason = "no healthy cell is left to predict from: replace the sensor"
            return self._report("refused", 2, reason, known, **found)
        strange = contradiction(frames, faulty, adapter.statistics, self.bundle.layout)
        if strange > _CONTRADICTORY:
            reason = (
                f"the cells that seem healthy contradict each other ({strange:.1f} of what moves in them is not"
                " explained by the others; 1 is as if they had nothing in common): not this sensor, or wired otherwise"
            )
            return self._report("refused", 2, reason, self.before, **found)
        if faulty == self.version.fault_set:
            reason = f"version {self.version.number} does without these cells already" if faulty else "no faulty cell"
            return self._report("unchanged", self._code(faulty), reason, known, **found)
        if (judged := self._judged_before(faulty)) is not None:
            self.judged = judged
            return self._report("kept", judged["exit_code"], f"judged before: {judged['reason']}", known, **found)
        if faulty.cells in Pointer.read(self.bundle.path).rejected:
            reason = "a version for these faults was rolled back before"
            return self._report("kept", max(1, self._code(faulty)), reason, known, **found)
        return self._adapt(adapter, known, found)

    def _adapt(self, adapter: Adapter, known: Knowledge, found: dict[str, Any]) -> MaintenanceReport:
        """Adapt and judge: the cheapest stage that is enough, and if a class collapses in it, the fill alone."""
        from adaptfault.adaptation.result import Adaptation

        faulty = known.fault_set
        windows = self.bundle.parts.check_windows()
        broken = with_faults(windows, known.faults, self.bundle.layout)
        running = Adaptation.load(self.version.folder)
        free = float((adapter.model.predict(windows.x) == windows.y).mean())
        self.say(f"{len(faulty)} of {faulty.n_cells} cells are faulty; adapting")
        for method in ("auto", "fill"):
            adaptation = adapter.adapt(faulty, method=method, budget=self.budget, progress=False)
            judgement = judge(running.predict, adaptation.predict, broken)
            found["stages"] = tuple(str(stage) for stage in adaptation.stages)
            if not judgement.collapsed:
                break
        found |= {"judgement": judgement, "fault_free_accuracy": free}
        if judgement.collapsed:
            names = ", ".join(self._class_name(c) for c in judgement.collapsed)
            code = self._code(faulty, judgement.running, free)
            reason = f"the adapted model loses more than half of what is recognised of {names}"
            return self._report("refused", max(1, code), reason, known, accuracy=judgement.running, **found)
        if not judgement.better:
            code = max(1, self._code(faulty, judgement.running, free))
            reason = f"version {self.version.number} is as good under these faults as the adapted model, within chance"
            return self._report("kept", code, reason, known, accuracy=judgement.running, **found)
        code = self._code(faulty, judgement.candidate, free)
        reason = (
            f"accuracy {judgement.running:.3f} -> {judgement.candidate:.3f} under the faults known now"
            f" ({free:.3f} without any)"
        )
        number = self.version.number if self.dry_run else self._deploy(adaptation, known, judgement, free)
        return self._report("deployed", code, reason, known, accuracy=judgement.candidate, number=number, **found)

    def _judged_before(self, faulty: FaultSet) -> dict[str, Any] | None:
        """Return how an adaptation to these faults was judged beside what runs, if it was in the last run."""
        judged = self.bundle.journal.last("judged")
        if judged is None or (tuple(judged["fault_set"]), judged["version"]) != (faulty.cells, self.version.number):
            return None
        return dict(judged)

    def _deploy(self, adaptation: Adaptation, known: Knowledge, judgement: Judgement, free: float) -> int:
        about = {
            "reason": f"accuracy {judgement.running:.3f} -> {judgement.candidate:.3f}",
            "knowledge": known.to_dict(),
            "accuracy": judgement.candidate,
            "fault_free_accuracy": free,
        }
        version = self.bundle.write_version(adaptation, about)
        self.bundle.deploy(version.number)
        return version.number

    def _write(self, report: MaintenanceReport, usable: Sequence[_Incoming]) -> None:
        """Note the run. A crash before this leaves recordings to be seen again: they find nothing new."""
        self.bundle.journal.add(
            now(),
            report.decision,
            {**report.to_dict(), "knowledge": self.known.to_dict(), "judged": self._judgement_of(report)},
            [(r.digest, r.name) for r in usable],
        )

    def _judgement_of(self, report: MaintenanceReport) -> dict[str, Any] | None:
        """Return what the next run has to know so as not to judge the same again."""
        if report.judgement is None or report.decision == "deployed":
            return self.judged
        about = {"version": report.version, "exit_code": report.exit_code, "reason": report.reason}
        return {**about, "fault_set": list(report.fault_set)}

    def _report(
        self,
        decision: Decision,
        code: int,
        reason: str,
        known: Knowledge,
        *,
        number: int | None = None,
        **found: Any,
    ) -> MaintenanceReport:
        self.known = known
        return MaintenanceReport(
            decision=decision,
            exit_code=code,
            reason=reason,
            fault_set=known.fault_set,
            version=self.version.number if number is None else number,
            faults=known.faults,
            left_out=self.left_out,
            warnings=self.warnings,
            dry_run=self.dry_run,
            **found,
        )

    def _code(self, faulty: FaultSet, accuracy: float | None = None, free: float | None = None) -> int:
        """0 no fault known, 1 handled, 2 too little accuracy is left."""
        if accuracy is None or free is None:
            about = self.version.about
            accuracy, free = about.get("accuracy"), about.get("fault_free_accuracy")
        if accuracy is not None and free is not None and accuracy < _TECHNICIAN_BELOW * free:
            return 2
        return 1 if len(faulty) else 0

    def _class_name(self, number: int) -> str:
        names = self.bundle.class_names
        return names[number] if names else f"class {number}"
