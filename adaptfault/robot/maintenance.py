"""Maintenance: inspect new recordings, decide about the model, deploy or keep, journal and report.

Recordings that an earlier run used are skipped; the journal identifies them by the SHA-256 of their
content. What is deployed, and why, is said in :mod:`adaptfault.robot.decision`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.journal import Entry, now
from adaptfault.bundle.known_faults import KnownFaults
from adaptfault.bundle.signature import read_private_key
from adaptfault.bundle.signing import sign_bundle
from adaptfault.inspection.changed_readings import ChangedReadings
from adaptfault.inspection.find_changes import as_loads, find_sensor_change
from adaptfault.inspection.incoming import IncomingRecording, incoming_recordings
from adaptfault.inspection.inspection import inspect
from adaptfault.inspection.result import Inspection
from adaptfault.inspection.scanned import inspection_with_scan
from adaptfault.inspection.severity import (
    UNKNOWN,
    Reason,
    of_accuracy,
    of_change,
)
from adaptfault.robot.decision import Outcome, decide, severity_of
from adaptfault.robot.maintenance_report import MaintenanceReport
from adaptfault.robot.maintenance_run import MaintenanceRun, Robot
from adaptfault.robot.model_comparison import score, with_faults
from adaptfault.robot.routine import Routine
from diagnostics import Scan, judge_scan
from diagnostics.sensor.ageing import cell_condition
from diagnostics.sensor.sensor_change import SensorChange

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
    scan: Scan | None = None,
    sign: str | PathLike[str] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> MaintenanceReport:
    """Inspect new recordings and update the running version where that is needed
    (:mod:`adaptfault.robot.maintenance`).

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
        scan: of the read-out, in their time; known faulty cells do not recover by it. None: none.
        sign: PEM file of the private key that signs the bundle with what the run deploys; None: it
            is not signed.
        say: receives one line of progress before each long step.

    Raises:
        Busy: another maintenance run holds the lock.
        Damaged: a needed part of the bundle fails its checksum.
        ValueError: the routine or the scan is for another number of cells.
    """
    _check(bundle, routine, scan, sign)
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
            scan=scan,
        )
        usable = [recording for recording in fresh if recording.problem is None]
        report = _maintained(run, usable, untested_code, routine) if usable else _idle(run, fresh)
        if sign is not None and not dry_run and report.decision != "deployed":
            sign_bundle(bundle, sign)
    return replace(report, seconds=time.perf_counter() - began)


def _check(
    bundle: Bundle,
    routine: Routine | None,
    scan: Scan | None,
    sign: str | PathLike[str] | None,
) -> None:
    """Refuse what fits no run before the work that it would be missing for; the errors are those of
    :func:`maintain`."""
    if routine is not None:
        routine.check(bundle.layout)
    if scan is not None:
        judge_scan(scan, bundle.layout)
    if sign is not None:
        read_private_key(sign)


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
            run, Outcome("refused", (Reason(UNKNOWN, "no recording is usable"),), run.known)
        )
    reasons = [Reason(severity_of(run, run.known.fault_set), "all recordings were used before")]
    if run.scan is not None:
        reasons.append(Reason(1, "scan: not used, as it came without a new recording"))
    outcome = _with_onnx(run, Outcome("unchanged", tuple(reasons), run.known))
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
    inspection, told = _scanned(run, inspection)
    outcome = _with_onnx(run, decide(run, inspection))
    outcome = replace(outcome, reasons=(*outcome.reasons, *told))
    report = _report(run, outcome, inspection, untested_code)
    if outcome.used:
        report = replace(report, used=tuple(recording.name for recording in usable))
    if routine is not None and report.diagnosis is not None:
        report = replace(report, selftest=routine.after(report.diagnosis, len(usable)))
    if not run.dry_run:
        _write(run, outcome, report, usable)
    return report


def _scanned(run: MaintenanceRun, inspection: Inspection) -> tuple[Inspection, tuple[Reason, ...]]:
    """Return an inspection with the evidence of the scan, and what is told of the scan."""
    if run.scan is None:
        return inspection, ()
    scan = replace(run.scan, readings=run.scan.readings[:, run.version.source])
    inspection, found = inspection_with_scan(inspection, scan, run.known.fault_set)
    return inspection, (Reason(1 if found.incomplete else 0, f"scan: {found.summary}"),)


def _with_onnx(run: MaintenanceRun, outcome: Outcome) -> Outcome:
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


def _report(
    run: MaintenanceRun,
    outcome: Outcome,
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
    outcome: Outcome,
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
