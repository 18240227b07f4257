"""Maintenance: inspect new recordings, repair the model, compare it with the running one, deploy or
keep."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.bundle.bundle import Bundle, now
from adaptfault.bundle.journal import Entry
from adaptfault.bundle.known_faults import KnownFaults
from adaptfault.bundle.pointer import Pointer
from adaptfault.bundle.signature import read_private_key
from adaptfault.bundle.signing import sign_bundle
from adaptfault.inspection.changed_readings import ChangedReadings
from adaptfault.inspection.find_changes import as_loads, doubt, find_sensor_change
from adaptfault.inspection.incoming import IncomingRecording, incoming_recordings
from adaptfault.inspection.inspection import inspect
from adaptfault.inspection.plausibility import contradiction
from adaptfault.inspection.result import Inspection
from adaptfault.inspection.severity import (
    UNKNOWN,
    UNREADABLE,
    Reason,
    of_accuracy,
    of_change,
    of_known,
)
from adaptfault.robot.maintenance_report import Decision, MaintenanceReport
from adaptfault.robot.maintenance_run import MaintenanceRun, Robot
from adaptfault.robot.model_comparison import Judgement, compare_candidate, score, with_faults
from adaptfault.robot.repair import Candidate, repair
from adaptfault.robot.routine import Routine
from adaptfault.robot.sensor_state import unhandled_cells
from diagnostics import FaultSet
from diagnostics.sensor.ageing import cell_condition
from diagnostics.sensor.sensor_change import SensorChange

_CONTRADICTORY = 1.0  # residual variance ratio at which other cells predict no better than the mean

_DECIDED = ("fault", "wire", "rewired", "replaced_pad", "gain", "offset")
"""Findings that a run acts upon, or measures the effect of: it gives the reason itself."""


def maintain(
    bundle: Bundle,
    recordings: ArrayLike | Sequence[ArrayLike],
    *,
    names: Sequence[str] = (),
    dry_run: bool = False,
    budget: float | None = None,
    untested_code: int = 1,
    routine: Routine | None = None,
    sign: str | PathLike[str] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> MaintenanceReport:
    """Inspect new recordings and update the running version where that is needed.

    Recordings that an earlier run used are skipped; the journal identifies them by the SHA-256 of
    their content. A new version is deployed only if it is significantly better than the running one
    on held-out windows with the known faults injected (paired bootstrap over recordings), and no
    class collapses.

    Args:
        bundle: of the robot.
        recordings: ``[T, D]`` or a list of them, in the layout's unit, in time order.
        names: of the recordings, for messages.
        dry_run: report only, change nothing.
        budget: seconds that an adaptation may take.
        untested_code: exit code where no fault is known and the recordings test less than 5 % of
            the cells.
        routine: of which the recordings are a log: the report says what it left untested, and the
            next best recording.
        sign: PEM file of the private key that signs the bundle with what the run deploys; None: it
            is not signed.
        say: receives one line of progress before each long step.

    Raises:
        Busy: another maintenance run holds the lock.
        Damaged: a needed part of the bundle fails its checksum.
        ValueError: the routine is for another number of cells.
    """
    if routine is not None:
        routine.check(bundle.layout)
    if sign is not None:
        read_private_key(sign)  # before the work that it would be missing for
    began = time.perf_counter()
    with bundle.maintenance(dry_run=dry_run):
        if not dry_run:
            bundle.sweep()
        warnings = tuple(bundle.problems(repair=not dry_run))
        fresh = _fresh(incoming_recordings(recordings, names, bundle.layout), bundle)
        run = MaintenanceRun(
            robot=Robot(bundle),
            version=bundle.active(),
            known=bundle.known_faults(),
            dry_run=dry_run,
            budget=budget,
            sign=sign,
            say=say,
            warnings=warnings,
            left_out=tuple(text for one in fresh if (text := one.left_out(bundle.layout))),
        )
        usable = [recording for recording in fresh if recording.problem is None]
        report = _maintained(run, usable, untested_code, routine) if usable else _idle(run, fresh)
        if sign is not None and not dry_run and report.decision != "deployed":
            sign_bundle(bundle, sign)
    return replace(report, seconds=time.perf_counter() - began)


@dataclass(frozen=True)
class _Outcome:
    """What was decided.

    Attributes:
        decision: see :class:`MaintenanceReport`.
        reasons: of the decision.
        known: the known faults from now on.
        readings: of the log, as the version that runs from now on takes them; None: nothing was
            diagnosed.
        told: changed readings that this version undoes, or that are refused.
        used: whether the log teaches something about this sensor.
        deploys: number of the version that runs from now on; None: the running one stays.
        judged: comparison that the next run need not repeat.
        measured: further fields of the report.
    """

    decision: Decision
    reasons: tuple[Reason, ...]
    known: KnownFaults
    readings: ChangedReadings | None = None
    told: ChangedReadings | None = None
    used: bool = True
    deploys: int | None = None
    judged: dict[str, Any] | None = None
    measured: dict[str, Any] = field(default_factory=dict)


def _fresh(incoming: Sequence[IncomingRecording], bundle: Bundle) -> list[IncomingRecording]:
    """Return the recordings that no earlier run used, each once."""
    seen = bundle.journal.seen([recording.digest for recording in incoming])
    return list(
        {
            recording.digest: recording for recording in incoming if recording.digest not in seen
        }.values()
    )


def _idle(run: MaintenanceRun, fresh: Sequence[IncomingRecording]) -> MaintenanceReport:
    """Return the report on a log without any usable recording."""
    if fresh:
        return _report(
            run, _Outcome("refused", (Reason(UNKNOWN, "no recording is usable"),), run.known)
        )
    reason = Reason(_severity(run, run.known.fault_set), "all recordings were used before")
    outcome = _with_onnx(run, _Outcome("unchanged", (reason,), run.known))
    report = _report(run, outcome)
    if outcome.deploys is not None:
        _write(run, outcome, report, ())
    return report


def _maintained(
    run: MaintenanceRun,
    usable: Sequence[IncomingRecording],
    untested_code: int,
    routine: Routine | None,
) -> MaintenanceReport:
    """Inspect usable recordings, decide, and journal the run unless it is a dry run."""
    run.say(f"inspecting {len(usable)} new recordings")
    frames = [
        run.version.undo(recording.frames) for recording in usable if recording.frames is not None
    ]
    inspection = inspect(frames, run.robot.diagnoser, reference=run.robot.healthy)
    outcome = _with_onnx(run, _decide(run, inspection))
    report = _report(run, outcome, inspection, untested_code)
    if outcome.used:
        report = replace(report, used=tuple(recording.name for recording in usable))
    if routine is not None and report.diagnosis is not None:
        report = replace(report, selftest=routine.after(report.diagnosis, len(usable)))
    if not run.dry_run:
        _write(run, outcome, report, usable)
    return report


def _with_onnx(run: MaintenanceRun, outcome: _Outcome) -> _Outcome:
    """Return an outcome that keeps the running version with one that deploys the same with its ONNX
    file, where that lacks it for want of memory."""
    if run.dry_run or outcome.decision not in ("unchanged", "kept"):
        return outcome
    whole = run.robot.bundle.with_onnx(run.version)
    if whole is None:
        return outcome
    text = f"version {whole.number} is version {run.version.number} with its ONNX file"
    judged = outcome.judged
    if judged is not None:
        judged = {**judged, "version": whole.number}
    return replace(
        outcome,
        decision="deployed",
        reasons=(*outcome.reasons, Reason(0, text)),
        deploys=whole.number,
        judged=judged,
    )


def _decide(run: MaintenanceRun, inspection: Inspection) -> _Outcome:
    """Decide about changed readings first, as about any version, then about the faults."""
    unreadable = [finding for finding in inspection.findings if finding.name in UNREADABLE]
    if unreadable:  # told as a finding
        return _Outcome("refused", (), run.known, inspection.readings, used=False)
    if inspection.readings.reason:
        return _decide_readings(run, inspection.readings)
    return _decide_faults(run, inspection.readings)


def _decide_readings(run: MaintenanceRun, changed: ChangedReadings) -> _Outcome:
    """Decide about exchanged wires or replaced pads; nothing is deployed where the running version
    is as good, or where a half of the log does not show them."""
    renewed = run
    if changed.recalibration is not None:
        renewed = replace(run, known=run.known.without(changed.recalibration.on(run.robot.layout)))
    known = renewed.known.merged(changed.diagnosis)
    refusal = _refusal(run, changed, known)
    if refusal is not None:
        reason = Reason(2, f"{changed.reason}; not undone: {refusal}")
        return _Outcome("refused", (reason,), run.known, changed, changed, used=False)
    judgement = _judged_readings(run, changed, known)
    why: str | None = f"version {run.version.number} is as good without it, {judgement}"
    if _was_rolled_back(run, changed):
        why = "a version that undid it was rolled back before"
    elif judgement.better and not judgement.collapsed:
        why = doubt(changed, run.robot.diagnoser)
    if why is None:
        return _undone(renewed, changed, judgement)
    why = f"not undone: {why}"
    if changed.as_found is None:
        return _Outcome(
            "kept",
            (Reason(2, f"{changed.reason}; {why}"),),
            run.known,
            changed,
            changed,
            used=False,
        )
    outcome = _decide_faults(run, changed.as_found)  # pads are used as they read now
    return replace(outcome, reasons=(Reason(1, f"{changed.reason}; {why}"), *outcome.reasons))


def _undone(run: MaintenanceRun, changed: ChangedReadings, judgement: Judgement) -> _Outcome:
    """Return the outcome with a version that undoes the change; a dry run writes none."""
    undone = "a new version would undo it"
    if not run.dry_run:
        run.say(changed.reason)
        about = {**run.version.about, "reason": changed.reason, **changed.readings(run.version)}
        run = replace(
            run, version=run.robot.bundle.write_version(run.robot.model(run.version), about)
        )
        undone = f"version {run.version.number} undoes it"
    outcome = _decide_faults(run, changed)
    deploys = None if run.dry_run else run.version.number
    return replace(
        outcome,
        decision="deployed",
        reasons=(Reason(1, f"{changed.reason}; {undone}"), *outcome.reasons),
        told=changed,
        deploys=deploys if outcome.deploys is None else outcome.deploys,
        judged=None,
        measured={"judgement": judgement, **outcome.measured},
    )


def _judged_readings(
    run: MaintenanceRun, changed: ChangedReadings, known: KnownFaults
) -> Judgement:
    """Compare the running version with and without the change undone, on windows that are changed
    likewise."""
    model = run.robot.model(run.version)
    top = run.robot.layout.full_scale
    windows = with_faults(run.robot.windows, known.faults, run.robot.layout)
    windows = replace(windows, x=changed.changed(windows.x, top))
    return compare_candidate(
        model.predict, lambda x: model.predict(changed.undone(x, top)), windows
    )


def _was_rolled_back(run: MaintenanceRun, changed: ChangedReadings) -> bool:
    """Return whether a version that undid the same change was rolled back, or never confirmed."""
    runs = run.robot.bundle.journal.runs()
    left = {one["from"] for one in runs if one["what"] == "rollback"}
    told = {name: list(values) for name, values in changed.told.items()}
    return any(
        one["what"] == "deployed"
        and one["version"] in left
        and {name: one.get(name) for name in told} == told
        for one in runs
    )


def _decide_faults(run: MaintenanceRun, readings: ChangedReadings) -> _Outcome:
    """Decide about the faults of a log: refuse, keep, or repair, compare and deploy."""
    known = run.known.merged(readings.diagnosis)
    faulty = known.fault_set
    number = run.version.number
    refusal = _refusal(run, readings, known)
    if refusal is not None:
        # a log that contradicts the sensor teaches nothing of its faults
        working = bool(run.robot.present - faulty)
        reasons = (Reason(2, refusal),)
        return _Outcome(
            "refused", reasons, run.known if working else known, readings, used=not working
        )
    if faulty == run.version.fault_set:
        text = f"version {number} excludes these cells already" if faulty else "no faulty cell"
        return _Outcome("unchanged", (Reason(_severity(run, faulty), text),), known, readings)
    judged = run.robot.bundle.journal.judged(faulty, number)
    if judged is not None:
        reason = Reason(judged["exit_code"], f"compared before: {judged['reason']}")
        return _Outcome("kept", (reason,), known, readings, judged=judged)
    if faulty.cells in Pointer.read(run.robot.bundle.path).rejected:
        unhandled = len(faulty - run.version.fault_set)
        text = (
            f"a version for these faults was rolled back before, so version {number} runs,"
            f" which uses {unhandled} of the {len(faulty)} faulty cells"
        )
        return _Outcome("kept", (Reason(_severity(run, faulty), text),), known, readings)
    candidate, judgement = _best(run, known)
    return replace(_decide_candidate(run, known, candidate, judgement), readings=readings)


def _best(run: MaintenanceRun, known: KnownFaults) -> tuple[Candidate, Judgement]:
    """Return the first candidate in which no class collapses, else the last one, and its
    comparison."""
    windows = with_faults(run.robot.windows, known.faults, run.robot.layout)
    running = run.robot.model(run.version)
    for candidate in repair(run, known.fault_set):
        judgement = compare_candidate(running.predict, candidate.model.predict, windows)
        if not judgement.collapsed:
            break
    return candidate, judgement


def _decide_candidate(
    run: MaintenanceRun, known: KnownFaults, candidate: Candidate, judgement: Judgement
) -> _Outcome:
    """Deploy a candidate where it is better; one that uses recovered cells again, where it is no
    worse."""
    free = run.robot.fault_free_accuracy
    measured: dict[str, Any] = {
        "judgement": judgement,
        "fault_free_accuracy": free,
        "stages": candidate.stages,
    }
    obstacle = _obstacle(run, candidate, judgement)
    if obstacle is not None:
        severity = _measured_severity(run.robot, known, judgement.running)
        decision: Decision = "kept"
        if judgement.collapsed and candidate.stored is None:
            decision = "refused"
            severity = max(1, severity)
        judged = {
            "version": run.version.number,
            "exit_code": severity,
            "reason": obstacle,
            "fault_set": list(known.fault_set),
            "classes": [one.to_dict() for one in judgement.recalls],
        }
        measured["accuracy"] = judgement.running
        return _Outcome(
            decision, (Reason(severity, obstacle),), known, judged=judged, measured=measured
        )
    measured["accuracy"] = judgement.candidate
    severity = _measured_severity(run.robot, known, judgement.candidate)
    accuracies = f"{judgement.measure} {judgement.running:.3f} -> {judgement.candidate:.3f}"
    text = f"{accuracies} under the faults known now ({free:.3f} without any)"
    if candidate.stored is not None:
        recovered = len(run.version.fault_set) - len(known.fault_set)
        text = (
            f"{recovered} cells recovered; version {candidate.stored.number} uses them again"
            f" ({accuracies})"
        )
    deploys = None if run.dry_run else _deploy(run, candidate, known, judgement)
    return _Outcome(
        "deployed", (Reason(severity, text),), known, deploys=deploys, measured=measured
    )


def _obstacle(run: MaintenanceRun, candidate: Candidate, judgement: Judgement) -> str | None:
    """Return why a candidate does not run; None where it does."""
    number = run.version.number
    if candidate.stored is not None:
        if judgement.gain >= 0 and not judgement.collapsed:
            return None
        recovered = len(run.version.fault_set) - len(candidate.stored.fault_set)
        return (
            f"{recovered} cells recovered, but version {candidate.stored.number}, which uses them,"
            f" is worse: {judgement.measure} {judgement.running:.3f} -> {judgement.candidate:.3f}"
        )
    if judgement.collapsed:
        names = ", ".join(run.robot.class_name(c) for c in judgement.collapsed)
        what = "R2" if judgement.measure == "R2" else "recall"
        return f"the adapted model loses more than half of the {what} of {names}"
    if judgement.better:
        return None
    return (
        f"version {number} is as good under these faults as the adapted model (90 % interval of the"
        " gain includes 0)"
    )


def _deploy(
    run: MaintenanceRun, candidate: Candidate, known: KnownFaults, judgement: Judgement
) -> int:
    """Return the number of the version that holds a candidate; it is written where there is
    none."""
    if candidate.stored is not None:
        return candidate.stored.number
    about = {
        "reason": f"{judgement.measure} {judgement.running:.3f} -> {judgement.candidate:.3f}",
        "knowledge": known.to_dict(),
        **run.version.readings,
        "accuracy": judgement.candidate,
        "fault_free_accuracy": run.robot.fault_free_accuracy,
        "chance": run.robot.chance[1],
    }
    return run.robot.bundle.write_version(candidate.model, about).number


def _refusal(run: MaintenanceRun, readings: ChangedReadings, known: KnownFaults) -> str | None:
    """Return why no version can be made from a log; None where one can."""
    faulty = known.fault_set
    if not run.robot.present - faulty:
        return "no healthy cell is left to predict from: replace the sensor"
    # neither says what the other cells should read
    untrue = faulty | readings.diagnosis.statically_loaded
    strange = contradiction(readings.frames, untrue, run.robot.adapter.statistics, run.robot.layout)
    if strange <= _CONTRADICTORY:
        return None
    return (
        f"residual variance ratio {strange:.2f} of the cells taken as healthy exceeds"
        f" {_CONTRADICTORY:g}: wrong sensor, or changed wiring"
    )


def _severity(run: MaintenanceRun, faulty: FaultSet) -> int:
    """Return the severity of known faults, from what was measured of the running version when it
    was made."""
    about = run.version.about
    accuracy = about.get("accuracy")
    measured = of_accuracy(accuracy, about.get("fault_free_accuracy"), about.get("chance", 0.0))
    return max(of_known(faulty, unhandled_cells(run.robot.bundle, faulty, run.version)), measured)


def _measured_severity(robot: Robot, known: KnownFaults, accuracy: float) -> int:
    """Return the severity of known faults from the accuracy that a model was just measured to have
    with them."""
    handled = of_known(known.fault_set, unhandled=FaultSet((), known.n_cells))
    return max(handled, of_accuracy(accuracy, robot.fault_free_accuracy, robot.chance[1]))


def _report(
    run: MaintenanceRun,
    outcome: _Outcome,
    inspection: Inspection | None = None,
    untested_code: int = 1,
) -> MaintenanceReport:
    """Return the report; what is told of the log comes before the decision, and the worst first."""
    robot = run.robot
    readings = outcome.readings
    version = run.version if outcome.deploys is None else robot.bundle.versions[outcome.deploys]
    number = version.number
    judgement = outcome.measured.get("judgement")
    change = None
    reasons: list[Reason] = []
    if inspection is not None and readings is not None:
        change = inspection.change
        if readings is not inspection.readings:  # pads are used as they read now
            change = find_sensor_change(robot.diagnoser, readings, robot.healthy)
        reasons += _of_chance(robot, outcome.measured.get("accuracy"))
        reasons += _of_findings(inspection, untested_code)
        reasons += [] if change is None else [_of_change(robot, change, outcome.known, number)]
    reasons = sorted([*reasons, *outcome.reasons], key=lambda reason: -reason.severity)
    return MaintenanceReport(
        decision=outcome.decision,
        reasons=tuple(reasons),
        fault_set=outcome.known.fault_set,
        version=number,
        faults=outcome.known.faults,
        diagnosis=None if readings is None else readings.diagnosis,
        change=change,
        dry_run=run.dry_run,
        n_cells=len(robot.present),
        set_size=version.set_size,
        measure="accuracy" if judgement is None else judgement.measure,
        **({} if outcome.told is None else outcome.told.told),
        left_out=run.left_out,
        warnings=run.warnings,
        **outcome.measured,
    )


def _of_chance(robot: Robot, accuracy: float | None) -> list[Reason]:
    """Return that the accuracy which was measured is that of guessing."""
    if accuracy is None:
        return []
    share, limit = robot.chance
    severity = of_accuracy(accuracy, None, limit)
    if severity == 0:
        return []
    constant = "mean" if robot.measure == "R2" else "most frequent class"
    guessing = f"always naming the {constant} gives {share:.3f}"
    text = f"the model is at chance: {robot.measure} {accuracy:.3f}, where {guessing}"
    return [Reason(severity, text)]


def _of_findings(inspection: Inspection, untested_code: int) -> list[Reason]:
    """Return what an inspection tells, but for what the run decides about."""
    reasons = []
    for finding in inspection.findings:
        severity = untested_code if finding.name == "untested" else finding.severity
        if finding.name not in _DECIDED and finding.name != "lost_frames":
            reasons.append(Reason(severity, finding.reason))
    return reasons


def _of_change(robot: Robot, change: SensorChange, known: KnownFaults, number: int) -> Reason:
    """Return a change of pad or sensor, and its effect on the accuracy of the version that runs
    from now on."""
    layout = robot.layout
    windows = with_faults(robot.windows, known.faults, layout)
    model = robot.model(robot.bundle.versions[number])
    before = score(model.predict, windows)
    after = score(model.predict, replace(windows, x=_changed(robot, change, windows.x)))
    effect = f"{robot.measure} of version {number} {before:.3f} -> {after:.3f} with this change"
    return Reason(of_change(before, after), f"{change.reason}; {effect}")


def _changed(robot: Robot, change: SensorChange, x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return scaled windows as a changed sensor reads them."""
    layout = robot.layout
    load = robot.diagnoser.load_
    gain, offset = change.of_cells(layout)
    if load is None:
        return (x * gain + offset / layout.full_scale).astype(np.float32)
    readings = x.astype(np.float64) * layout.full_scale
    loads = load.loads(readings) * gain + offset
    return (load.readings(loads, readings < load.rest) / layout.full_scale).astype(np.float32)


def _condition(run: MaintenanceRun, readings: ChangedReadings) -> bytes:
    """Return the row of a run, as the journal keeps it; see :mod:`diagnostics.sensor.ageing`."""
    robot = run.robot
    loads = as_loads(robot.diagnoser, readings.frames)
    healthy = as_loads(robot.diagnoser, robot.healthy)
    condition = cell_condition(loads, healthy, robot.layout)
    verdicts = readings.diagnosis.verdicts.astype(np.int8)
    return condition.values.astype("<f2").tobytes() + verdicts.tobytes()


def _write(
    run: MaintenanceRun,
    outcome: _Outcome,
    report: MaintenanceReport,
    usable: Sequence[IncomingRecording],
) -> None:
    """Deploy and journal the run in one step.

    After a crash before this the recordings are inspected again, with the same result.
    """
    document = {**report.to_dict(), "knowledge": outcome.known.to_dict(), "judged": outcome.judged}
    used = []
    condition = None
    if outcome.used and outcome.readings is not None:  # refused recordings are inspected again
        used = [(recording.digest, recording.name) for recording in usable]
        condition = _condition(run, outcome.readings)
    entry = Entry(now(), report.decision, document, used, condition)
    if outcome.deploys is None:
        run.robot.bundle.journal.add(entry)
    else:
        run.robot.bundle.deploy(outcome.deploys, entry, sign=run.sign)
