"""What a maintenance run decides about a log: refuse it, keep the running version, or deploy
another.

Changed readings come first, as any version is made for readings as they are, then the faults. A new
version is deployed only if it is significantly better than the running one on held-out windows with
the known faults injected (paired bootstrap over recordings), and no class collapses.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from adaptfault.bundle.known_faults import KnownFaults
from adaptfault.bundle.pointer import Pointer
from adaptfault.inspection.changed_readings import ChangedReadings
from adaptfault.inspection.find_changes import doubt
from adaptfault.inspection.plausibility import contradiction
from adaptfault.inspection.result import Inspection
from adaptfault.inspection.severity import UNREADABLE, Reason, of_accuracy, of_known
from adaptfault.robot.maintenance_report import Decision
from adaptfault.robot.maintenance_run import MaintenanceRun, Robot
from adaptfault.robot.model_comparison import Judgement, compare_candidate, with_faults
from adaptfault.robot.repair import Candidate, repair
from adaptfault.robot.sensor_state import unhandled_cells
from diagnostics import FaultSet

_CONTRADICTORY = 1.0  # residual variance ratio at which other cells predict no better than the mean


@dataclass(frozen=True)
class Outcome:
    """What was decided.

    Attributes:
        decision: see :class:`~adaptfault.robot.maintenance_report.MaintenanceReport`.
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


def decide(run: MaintenanceRun, inspection: Inspection) -> Outcome:
    """Decide about changed readings first, as about any version, then about the faults."""
    unreadable = [finding for finding in inspection.findings if finding.name in UNREADABLE]
    if unreadable:  # told as a finding
        return Outcome("refused", (), run.known, inspection.readings, used=False)
    if inspection.readings.reason:
        return _decide_readings(run, inspection.readings)
    return _decide_faults(run, inspection.readings)


def _decide_readings(run: MaintenanceRun, changed: ChangedReadings) -> Outcome:
    """Decide about exchanged wires or replaced pads; nothing is deployed where the running version
    is as good, or where a half of the log does not show them."""
    renewed = run
    if changed.recalibration is not None:
        renewed = replace(run, known=run.known.without(changed.recalibration.on(run.robot.layout)))
    known = renewed.known.merged(changed.diagnosis)
    refusal = _refusal(run, changed, known)
    if refusal is not None:
        reason = Reason(2, f"{changed.reason}; not undone: {refusal}")
        return Outcome("refused", (reason,), run.known, changed, changed, used=False)
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
        return Outcome(
            "kept",
            (Reason(2, f"{changed.reason}; {why}"),),
            run.known,
            changed,
            changed,
            used=False,
        )
    outcome = _decide_faults(run, changed.as_found)  # pads are used as they read now
    return replace(outcome, reasons=(Reason(1, f"{changed.reason}; {why}"), *outcome.reasons))


def _undone(run: MaintenanceRun, changed: ChangedReadings, judgement: Judgement) -> Outcome:
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


def _decide_faults(run: MaintenanceRun, readings: ChangedReadings) -> Outcome:
    """Decide about the faults of a log: refuse, keep, or repair, compare and deploy."""
    known = run.known.merged(readings.diagnosis)
    faulty = known.fault_set
    number = run.version.number
    refusal = _refusal(run, readings, known)
    if refusal is not None:
        # a log that contradicts the sensor teaches nothing of its faults
        working = bool(run.robot.present - faulty)
        reasons = (Reason(2, refusal),)
        return Outcome(
            "refused", reasons, run.known if working else known, readings, used=not working
        )
    if faulty == run.version.fault_set:
        text = f"version {number} excludes these cells already" if faulty else "no faulty cell"
        return Outcome("unchanged", (Reason(severity_of(run, faulty), text),), known, readings)
    judged = run.robot.bundle.journal.judged(faulty, number)
    if judged is not None:
        reason = Reason(judged["exit_code"], f"compared before: {judged['reason']}")
        return Outcome("kept", (reason,), known, readings, judged=judged)
    if faulty.cells in Pointer.read(run.robot.bundle.path).rejected:
        unhandled = len(faulty - run.version.fault_set)
        text = (
            f"a version for these faults was rolled back before, so version {number} runs,"
            f" which uses {unhandled} of the {len(faulty)} faulty cells"
        )
        return Outcome("kept", (Reason(severity_of(run, faulty), text),), known, readings)
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
) -> Outcome:
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
        return Outcome(
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
    return Outcome("deployed", (Reason(severity, text),), known, deploys=deploys, measured=measured)


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


def severity_of(run: MaintenanceRun, faulty: FaultSet) -> int:
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
