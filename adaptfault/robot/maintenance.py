"""Maintenance: diagnose new recordings, merge with the known faults, adapt, compare, deploy or keep."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.data.printable import printable
from adaptfault.data.windows import recordings_of
from adaptfault.evaluation.scores import chance
from adaptfault.robot.ageing import encode
from adaptfault.robot.bundle import Bundle, now
from adaptfault.robot.changed_readings import ChangedReadings, as_loads, find_changed_readings
from adaptfault.robot.checksummed_json import Damaged
from adaptfault.robot.converter_range import within_range
from adaptfault.robot.deployment_test import Judgement, compare_candidate, with_faults
from adaptfault.robot.journal import Entry
from adaptfault.robot.known_faults import KnownFaults
from adaptfault.robot.maintenance_report import Decision, MaintenanceReport
from adaptfault.robot.plausibility import contradiction, implausible
from adaptfault.robot.pointer import Pointer
from adaptfault.robot.sensor_state import TECHNICIAN_BELOW, UNTESTED, judged_before, unhandled_cells
from adaptfault.robot.versions import Version
from diagnostics import Diagnosis, FaultSet, SelfDiagnosis
from diagnostics.evidence.ageing import cell_condition
from diagnostics.evidence.sensor_change import find_change

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter
    from adaptfault.adaptation.result import Adaptation
    from adaptfault.data.windows import Windows
    from diagnostics import SensorLayout

_CONTRADICTORY = 1.0  # residual variance ratio at which other cells predict no better than the mean
_UNKNOWN = 3


def maintain(
    bundle: Bundle,
    recordings: ArrayLike | Sequence[ArrayLike],
    *,
    names: Sequence[str] = (),
    dry_run: bool = False,
    budget: float | None = None,
    untested_code: int = 1,
    say: Callable[[str], None] = lambda text: None,
) -> MaintenanceReport:
    """Diagnose new recordings and update the running version where that is needed.

    Recordings that an earlier run used are skipped; the journal identifies them by the SHA-256 of their content. A new
    version is deployed only if it is significantly better than the running one on held-out windows with the known
    faults injected (paired bootstrap over recordings), and no class collapses.

    Args:
        bundle: of the robot.
        recordings: ``[T, D]`` or a list of them, in the layout's unit, in time order.
        names: of the recordings, for messages.
        dry_run: report only, change nothing.
        budget: seconds that an adaptation may take.
        untested_code: exit code where no fault is known and the recordings test less than 5 % of the cells.
        say: receives one line of progress before each long step.

    Raises:
        Busy: another maintenance run holds the lock.
        Damaged: a needed part of the bundle fails its checksum.
    """
    began = time.perf_counter()
    with bundle.maintenance(dry_run=dry_run):
        report = _Maintenance(bundle, dry_run, budget, untested_code, say).run(_checked(recordings, names, bundle))
    return replace(report, seconds=time.perf_counter() - began)


@dataclass
class _InputRecording:
    """A recording given to maintenance, and the reason why it cannot be used, if any."""

    name: str
    frames: NDArray[np.float64] | None
    digest: str
    problem: str | None
    outside: int = 0  # readings out of the converter's range, missing in ``frames``

    def left_out(self, layout: SensorLayout) -> str:
        """Return what is not used of it and why, in one sentence; empty: all is used."""
        if self.problem is not None:
            return f"{self.name}: {self.problem}"
        range_ = f"0 to {layout.full_scale:g} {layout.unit}"
        return f"{self.name}: {self.outside} readings outside {range_} are missing" if self.outside else ""


def _checked(
    recordings: ArrayLike | Sequence[ArrayLike], names: Sequence[str], bundle: Bundle
) -> list[_InputRecording]:
    incoming = []
    for i, recording in enumerate(bundle.layout.recordings(recordings)):
        name = printable(names[i]) if i < len(names) else f"recording {i}"
        raw = np.ascontiguousarray(recording, dtype=np.float64)
        digest = hashlib.sha256(repr(raw.shape).encode() + raw.tobytes()).hexdigest()
        try:
            frames = bundle.layout.check_recording(raw, name)
            problem = implausible(frames, bundle.layout) if len(frames) else "it holds no frame"
        except ValueError as error:
            frames, problem = None, str(error)
        outside = 0
        if frames is not None and problem is None:
            frames, outside = within_range(frames, bundle.layout)
        incoming.append(_InputRecording(name, frames, digest, problem, outside))
    return incoming


@dataclass
class _Maintenance:
    """State of one maintenance run."""

    bundle: Bundle
    dry_run: bool
    budget: float | None
    untested_code: int
    say: Callable[[str], None]
    warnings: tuple[str, ...] = field(default=(), init=False)
    judged: dict[str, Any] | None = field(default=None, init=False)
    condition: bytes | None = field(default=None, init=False)
    next: int | None = field(default=None, init=False)  # number of the version that runs after this run, if another

    def run(self, incoming: Sequence[_InputRecording]) -> MaintenanceReport:
        """Diagnose recordings that no earlier run used, decide, and journal the run unless it is a dry run."""
        bundle = self.bundle
        if not self.dry_run:
            bundle.sweep()
        self.warnings = tuple(bundle.problems(repair=not self.dry_run))
        self.version = bundle.active()
        self.before = bundle.known_faults()
        seen = bundle.journal.seen([r.digest for r in incoming])
        fresh = list({r.digest: r for r in incoming if r.digest not in seen}.values())
        usable = [r for r in fresh if r.problem is None]
        self.left_out = tuple(text for r in fresh if (text := r.left_out(bundle.layout)))
        if not fresh:
            code = self._code(self.before.fault_set)
            return self._report("unchanged", code, "all recordings were used before", self.before)
        if not usable:
            return self._report("refused", _UNKNOWN, "no recording is usable", self.before)
        self.say(f"diagnosing {len(usable)} new recordings")
        frames = [self.version.undo(r.frames) for r in usable if r.frames is not None]
        changed = find_changed_readings(self.diagnoser, frames, lambda: self.healthy)
        report = self._decide_readings(changed, frames, tuple(r.name for r in usable))
        loads, healthy = self._loads(frames if report.diagnosis is changed.as_found else changed.frames)
        report = self._with_change(self._with_coverage(_with_transport(report)), loads, healthy)
        report = self._with_chance(self._with_static_loads(report))
        if report.used and report.diagnosis is not None:
            self.condition = encode(cell_condition(loads, healthy, bundle.layout), report.diagnosis.verdicts)
        if not self.dry_run:
            self._write(report, usable)
        return report

    @cached_property
    def diagnoser(self) -> SelfDiagnosis:
        """The fitted diagnosis of the bundle."""
        return self.bundle.diagnoser()

    @cached_property
    def adapter(self) -> Adapter:
        """The adapter of the bundle, with the fault-free model and windows."""
        return self.bundle.parts.adapter()

    @cached_property
    def healthy(self) -> list[NDArray[np.float64]]:
        """Healthy recordings of the bundle, ``[T, D]`` each."""
        return recordings_of(self.adapter.train, self.bundle.layout)

    def _loads(self, frames: list[NDArray[np.float64]]) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
        """Return new recordings, and the healthy ones of the bundle, as loads, ``[T, D]`` each."""
        return as_loads(self.diagnoser, frames), as_loads(self.diagnoser, self.healthy)

    def _decide_readings(
        self, changed: ChangedReadings, frames: list[NDArray[np.float64]], used: tuple[str, ...]
    ) -> MaintenanceReport:
        """Decide about exchanged wires or replaced pads first, as about any version, then about the faults.

        Nothing is deployed where the recordings are refused, or where the running version is as good without it.
        """
        if not changed.reason:
            return self._decide(changed.diagnosis, changed.frames, used)
        before = self.before
        if changed.recalibration is not None:
            self.before = before.without(changed.recalibration.on(self.bundle.layout))
        known = self.before.merged(changed.diagnosis)
        refusal = self._refusal(changed.diagnosis, changed.frames, known)
        judgement = None
        if refusal is not None:
            decision: Decision = "refused"
            why = f"not undone: {refusal}"
        else:
            judgement = self._judged_readings(changed, known)
            decision = "kept"
            why = f"not undone: version {self.version.number} is as good without it, {judgement}"
            if self._rolled_back(changed):
                why = "not undone: a version that undid it was rolled back before"
            elif judgement.better and not judgement.collapsed:
                decision = "deployed"
        if decision == "deployed":
            self._deploy_readings(changed)
            return self._with_new_readings(self._decide(changed.diagnosis, changed.frames, used), changed, judgement)
        self.before = before
        if changed.as_found is not None and refusal is None:  # pads are used as they read now
            report = self._decide(changed.as_found, frames, used)
            return replace(
                report, exit_code=max(1, report.exit_code), reason=f"{changed.reason}; {why}; {report.reason}"
            )
        found: dict[str, Any] = {"diagnosis": changed.diagnosis, **changed.told}
        return self._report(decision, 2, f"{changed.reason}; {why}", before, **found)

    def _judged_readings(self, changed: ChangedReadings, known: KnownFaults) -> Judgement:
        """Compare the running version with and without the change undone, on windows that are changed likewise."""
        from adaptfault.adaptation.result import Adaptation

        model, top = Adaptation.load(self.version.folder), self.bundle.layout.full_scale
        windows = with_faults(self.bundle.parts.check_windows(), known.faults, self.bundle.layout)
        windows = replace(windows, x=changed.changed(windows.x, top))
        return compare_candidate(model.predict, lambda x: model.predict(changed.undone(x, top)), windows)

    def _rolled_back(self, changed: ChangedReadings) -> bool:
        """Return whether a version that undid the same change was rolled back, or never confirmed."""
        runs = self.bundle.journal.runs()
        left = {run["from"] for run in runs if run["what"] == "rollback"}
        told = {name: list(values) for name, values in changed.told.items()}
        return any(
            run["what"] == "deployed" and run["version"] in left and {name: run.get(name) for name in told} == told
            for run in runs
        )

    def _deploy_readings(self, changed: ChangedReadings) -> None:
        """Deploy the running model as a version that undoes the change; a dry run changes nothing."""
        from adaptfault.adaptation.result import Adaptation

        if self.dry_run:
            return
        self.say(changed.reason)
        about = {**self.version.about, "reason": changed.reason, **changed.readings(self.version)}
        self.version = self.bundle.write_version(Adaptation.load(self.version.folder), about)
        self.next = self.version.number

    def _with_new_readings(
        self, report: MaintenanceReport, changed: ChangedReadings, judgement: Judgement | None
    ) -> MaintenanceReport:
        """Return the report with a change that a deployed version undoes."""
        undone = "a new version would undo it" if self.dry_run else f"version {self.version.number} undoes it"
        return replace(
            report,
            decision="deployed",
            exit_code=max(1, report.exit_code),
            reason=f"{changed.reason}; {undone}; {report.reason}",
            judgement=report.judgement or judgement,
            **changed.told,
        )

    def _with_coverage(self, report: MaintenanceReport) -> MaintenanceReport:
        """Return the report with the exit code of recordings that test nothing."""
        diagnosis = report.diagnosis
        if diagnosis is None or report.exit_code != 0 or diagnosis.coverage.test_coverage >= UNTESTED:
            return report
        share = diagnosis.coverage.test_coverage
        reason = f"the recordings test only {share:.0%} of the cells, so faults may be hidden; {report.reason}"
        return replace(report, exit_code=self.untested_code, reason=reason)

    def _with_static_loads(self, report: MaintenanceReport) -> MaintenanceReport:
        """Return the report with the objects that lie still on the array: its model reads them as contact."""
        loads = () if report.diagnosis is None else report.diagnosis.static_loads
        reason = "; ".join([*(load.reason for load in loads), report.reason])
        return replace(report, exit_code=max(1, report.exit_code), reason=reason) if loads else report

    def _with_chance(self, report: MaintenanceReport) -> MaintenanceReport:
        """Return the report with exit code 2 where the accuracy that was measured is that of guessing."""
        if report.accuracy is None:
            return report
        share, limit = chance(self.bundle.parts.check_windows().y)
        if report.accuracy >= limit:
            return report
        reason = (
            f"the model is at chance: accuracy {report.accuracy:.3f}, where always naming the most frequent class gives"
            f" {share:.3f}; {report.reason}"
        )
        return replace(report, exit_code=2, reason=reason)

    def _with_change(
        self, report: MaintenanceReport, loads: list[NDArray[Any]], reference: list[NDArray[Any]]
    ) -> MaintenanceReport:
        """Return the report with a change of pad or sensor, and its effect on the accuracy; see :meth:`_loads`."""
        from adaptfault.adaptation.result import Adaptation

        layout, load = self.bundle.layout, self.diagnoser.load_
        disturbed = FaultSet((), layout.n_cells) if report.diagnosis is None else report.diagnosis.disturbed
        change = find_change(loads, reference, layout, report.fault_set | disturbed)
        if change is None:
            return report
        gain, offset = change.of_cells(layout)
        windows = with_faults(self.bundle.parts.check_windows(), report.faults, layout)
        model = Adaptation.load(self.bundle.versions[report.version].folder)
        before = float((model.predict(windows.x) == windows.y).mean())
        changed = (windows.x * gain + offset / layout.full_scale).astype(np.float32)
        if load is not None:
            readings = windows.x.astype(np.float64) * layout.full_scale
            changed_loads = load.loads(readings) * gain + offset
            changed = (load.readings(changed_loads, readings < load.rest) / layout.full_scale).astype(np.float32)
        after = float((model.predict(changed) == windows.y).mean())
        effect = f"{change.reason}; accuracy of version {report.version} {before:.3f} -> {after:.3f} with this change"
        code = max(report.exit_code, 2 if after < TECHNICIAN_BELOW * before else 1)
        return replace(report, change=change, exit_code=code, reason=f"{effect}; {report.reason}")

    def _decide(
        self, diagnosis: Diagnosis, frames: list[NDArray[np.float64]], used: tuple[str, ...]
    ) -> MaintenanceReport:
        """Decide about a diagnosis; deploy where the decision is to."""
        known = self.before.merged(diagnosis)
        faulty = known.fault_set
        found: dict[str, Any] = {"diagnosis": diagnosis, "used": used}
        adapter = self.adapter
        refusal = self._refusal(diagnosis, frames, known)
        if refusal is not None:
            working = bool(self._present - faulty)  # recordings that contradict the sensor teach nothing of its faults
            found["used"] = () if working else used
            return self._report("refused", 2, refusal, self.before if working else known, **found)
        if faulty == self.version.fault_set:
            reason = f"version {self.version.number} excludes these cells already" if faulty else "no faulty cell"
            return self._report("unchanged", self._code(faulty), reason, known, **found)
        if (judged := judged_before(self.bundle, faulty, self.version.number)) is not None:
            self.judged = judged
            return self._report("kept", judged["exit_code"], f"compared before: {judged['reason']}", known, **found)
        if faulty.cells in Pointer.read(self.bundle.path).rejected:
            unhandled = len(faulty - self.version.fault_set)
            reason = (
                f"a version for these faults was rolled back before, so version {self.version.number} runs,"
                f" which uses {unhandled} of the {len(faulty)} faulty cells"
            )
            return self._report("kept", self._code(faulty), reason, known, **found)
        return self._adapt(adapter, known, found)

    def _refusal(self, diagnosis: Diagnosis, frames: list[NDArray[np.float64]], known: KnownFaults) -> str | None:
        """Return why no version can be made from these recordings; None where one can."""
        faulty = known.fault_set
        if not self._present - faulty:
            return "no healthy cell is left to predict from: replace the sensor"
        untrue = faulty | diagnosis.statically_loaded  # neither says what the other cells should read
        strange = contradiction(frames, untrue, self.adapter.statistics, self.bundle.layout)
        if strange <= _CONTRADICTORY:
            return None
        return (
            f"residual variance ratio {strange:.2f} of the cells taken as healthy exceeds {_CONTRADICTORY:g}:"
            " wrong sensor, or changed wiring"
        )

    @cached_property
    def _present(self) -> FaultSet:
        layout = self.bundle.layout
        return FaultSet(tuple(np.flatnonzero(layout.present).tolist()), layout.n_cells)

    def _adapt(self, adapter: Adapter, known: KnownFaults, found: dict[str, Any]) -> MaintenanceReport:
        """Adapt and compare: method "auto" first; where a class collapses, imputation alone."""
        from adaptfault.adaptation.result import Adaptation

        faulty = known.fault_set
        windows = self.bundle.parts.check_windows()
        if (earlier := self._version_for(faulty)) is not None:
            return self._return_to(earlier, windows, known, found)
        broken = with_faults(windows, known.faults, self.bundle.layout)
        running = Adaptation.load(self.version.folder)
        free = self._fault_free_accuracy(windows)
        self.say(f"{len(faulty)} of {self.bundle.layout.present.sum()} cells are faulty; adapting")
        for method in ("auto", "fill"):
            adaptation = adapter.adapt(faulty, method=method, budget=self.budget, progress=False)
            judgement = compare_candidate(running.predict, adaptation.predict, broken)
            found["stages"] = tuple(str(stage) for stage in adaptation.stages)
            if not judgement.collapsed:
                break
        found |= {"judgement": judgement, "fault_free_accuracy": free}
        if judgement.collapsed:
            names = ", ".join(self._class_name(c) for c in judgement.collapsed)
            code = self._code(faulty, judgement.running, free)
            reason = f"the adapted model loses more than half of the recall of {names}"
            return self._report("refused", max(1, code), reason, known, accuracy=judgement.running, **found)
        if not judgement.better:
            code = self._code(faulty, judgement.running, free)
            reason = (
                f"version {self.version.number} is as good under these faults as the adapted model"
                " (90 % interval of the gain includes 0)"
            )
            return self._report("kept", code, reason, known, accuracy=judgement.running, **found)
        code = self._code(faulty, judgement.candidate, free)
        reason = (
            f"accuracy {judgement.running:.3f} -> {judgement.candidate:.3f} under the faults known now"
            f" ({free:.3f} without any)"
        )
        number = self.version.number if self.dry_run else self._deploy(adaptation, known, judgement, free)
        return self._report("deployed", code, reason, known, accuracy=judgement.candidate, number=number, **found)

    def _fault_free_accuracy(self, windows: Windows) -> float:
        """Return the accuracy of version 1, the model of the healthy sensor, on windows without faults."""
        from adaptfault.adaptation.result import Adaptation

        try:
            model = Adaptation.load(self.bundle.versions[1].folder)
        except (Damaged, FileNotFoundError):
            return float((self.adapter.model.predict(windows.x) == windows.y).mean())
        return float((model.predict(windows.x) == windows.y).mean())

    def _version_for(self, faulty: FaultSet) -> Version | None:
        """Return the latest version for exactly this F, where the running one also excludes recovered cells."""
        if not set(faulty) < set(self.version.fault_set):
            return None
        for number in reversed(self.bundle.versions.numbers):
            with suppress(Damaged, FileNotFoundError):
                version = self.bundle.versions[number]
                if version.fault_set == faulty and version.readings == self.version.readings:
                    return version
        return None

    def _return_to(
        self, earlier: Version, windows: Windows, known: KnownFaults, found: dict[str, Any]
    ) -> MaintenanceReport:
        """Return to a version that uses the recovered cells, unless it is less accurate than the running one."""
        from adaptfault.adaptation.result import Adaptation

        broken = with_faults(windows, known.faults, self.bundle.layout)
        running, candidate = Adaptation.load(self.version.folder), Adaptation.load(earlier.folder)
        judgement = compare_candidate(running.predict, candidate.predict, broken)
        free = self._fault_free_accuracy(windows)
        found |= {"judgement": judgement, "fault_free_accuracy": free}
        recovered = len(self.version.fault_set) - len(known.fault_set)
        accuracies = f"accuracy {judgement.running:.3f} -> {judgement.candidate:.3f}"
        if judgement.gain < 0 or judgement.collapsed:
            code = self._code(known.fault_set, judgement.running, free)
            reason = (
                f"{recovered} cells recovered, but version {earlier.number}, which uses them, is worse: {accuracies}"
            )
            return self._report("kept", code, reason, known, accuracy=judgement.running, **found)
        if not self.dry_run:
            self.next = earlier.number
        code = self._code(known.fault_set, judgement.candidate, free)
        number = self.version.number if self.dry_run else earlier.number
        reason = f"{recovered} cells recovered; version {earlier.number} uses them again ({accuracies})"
        return self._report("deployed", code, reason, known, accuracy=judgement.candidate, number=number, **found)

    def _deploy(self, adaptation: Adaptation, known: KnownFaults, judgement: Judgement, free: float) -> int:
        about = {
            "reason": f"accuracy {judgement.running:.3f} -> {judgement.candidate:.3f}",
            "knowledge": known.to_dict(),
            **self.version.readings,
            "accuracy": judgement.candidate,
            "fault_free_accuracy": free,
            "chance": chance(self.bundle.parts.check_windows().y)[1],
        }
        version = self.bundle.write_version(adaptation, about)
        self.next = version.number
        return version.number

    def _write(self, report: MaintenanceReport, usable: Sequence[_InputRecording]) -> None:
        """Deploy and journal the run in one step.

        After a crash before this the recordings are diagnosed again, with the same result.
        """
        document = {**report.to_dict(), "knowledge": self.known.to_dict(), "judged": self._judgement_of(report)}
        used = [(r.digest, r.name) for r in usable] if report.used else []  # refused ones are diagnosed again
        entry = Entry(now(), report.decision, document, used, self.condition)
        if self.next is None:
            self.bundle.journal.add(entry)
        else:
            self.bundle.deploy(self.next, entry)

    def _judgement_of(self, report: MaintenanceReport) -> dict[str, Any] | None:
        """Return what the next run needs so that it does not repeat the same comparison."""
        if report.judgement is None or report.decision == "deployed":
            return self.judged
        about = {"version": report.version, "exit_code": report.exit_code, "reason": report.reason}
        return {**about, "fault_set": list(report.fault_set)}

    def _report(
        self,
        decision: Decision,
        code: int,
        reason: str,
        known: KnownFaults,
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
            n_cells=int(self.bundle.layout.present.sum()),
            **found,
        )

    def _code(self, faulty: FaultSet, accuracy: float | None = None, free: float | None = None) -> int:
        """Return 0: no known fault; 1: handled; 2: not handled, or too little accuracy."""
        if accuracy is None or free is None:
            if unhandled_cells(self.bundle, faulty, self.version):
                return 2
            about = self.version.about
            accuracy, free = about.get("accuracy"), about.get("fault_free_accuracy")
            if accuracy is not None and accuracy < about.get("chance", 0):
                return 2
        if accuracy is not None and free is not None and accuracy < TECHNICIAN_BELOW * free:
            return 2
        return 1 if len(faulty) else 0

    def _class_name(self, number: int) -> str:
        names = self.bundle.class_names
        return names[number] if names else f"class {number}"


def _with_transport(report: MaintenanceReport) -> MaintenanceReport:
    """Return the report with the exit code and the reason of a stream that was frozen."""
    if report.diagnosis is None or not report.diagnosis.frozen:
        return report
    reason = f"{report.diagnosis.frozen[0].reason}; {report.reason}"
    return replace(report, exit_code=max(1, report.exit_code), reason=reason)
