"""The technician's report: one self-contained HTML file about a robot's sensor and its running
version."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.pointer import Pointer
from adaptfault.evaluation.class_recall import class_name
from adaptfault.pages.html_page import Picture, render
from adaptfault.robot.sensor_state import SensorState, unhandled_cells
from diagnostics import Diagnosis
from diagnostics.decision.grouped_faults import by_group
from diagnostics.decision.numbering import Numbering

if TYPE_CHECKING:
    from adaptfault.robot.maintenance_report import MaintenanceReport

_LISTED = 8  # classes in the table: a size

_HEADLINES = (
    "Nothing to do",
    "Watch: the faults are handled",
    "Call a technician",
    "Unknown: the recordings cannot be used",
)


def write_report(
    path: str | Path,
    bundle: Bundle,
    diagnosis: Diagnosis | None = None,
    *,
    run: MaintenanceReport | None = None,
    name: str | None = None,
    count_from: int = 0,
) -> Path:
    """Write the page and return its path.

    Args:
        path: of the HTML file.
        bundle: of the robot.
        diagnosis: to show; None: that of ``run``, or the last one in the journal.
        run: a maintenance run that the page is about, also a dry one; None: what the bundle knows.
        name: of the robot; None: of the bundle, or of its folder where that is called robot.bundle.
        count_from: number of the first pad, row, column and cell on the page.

    Raises:
        OSError: the file cannot be written.
    """
    runs = bundle.journal.runs()
    diagnosis = diagnosis or _last_diagnosis(run, runs)
    state = SensorState.of(bundle)
    problems = bundle.problems(repair=False)
    if run is not None:
        state = _state_after(run, bundle, state)
    unhandled = by_group([f for f in state.known.faults if f in state.unhandled], bundle.layout)
    dry_run = run is not None and run.dry_run
    recalls = [] if dry_run else sorted(bundle.class_recalls(), key=lambda one: one.low)
    handled = [fault for fault in state.known.faults if fault not in state.unhandled]
    return render(
        path,
        "robot/technician.html",
        name=name or robot_name(bundle.path),
        headline=_headline(state, problems),
        bad=state.exit_code >= 2,
        bundle=bundle,
        layout=bundle.layout,
        active=state.version,
        pointer=Pointer.read(bundle.path),
        state=state,
        unhandled=unhandled,
        ordered=sorted(
            [*unhandled, *by_group(handled, bundle.layout)],
            key=lambda fault: (fault not in unhandled, fault.line is None, -len(fault.cells)),
        ),
        recalls=recalls[:_LISTED],
        other_recalls=recalls[_LISTED:],
        class_name=lambda label: class_name(label, bundle.class_names),
        selftest=None if run is None else run.selftest,
        diagnosis=diagnosis,
        numbering=Numbering.from_layout(bundle.layout, count_from),
        verdicts=diagnosis and Picture.of(partial(diagnosis.plot, count_from=count_from)),
        dry_run=dry_run,
        runs=[_shown(one) for one in reversed(runs)],
        problems=problems,
        date=datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
    )


def _last_diagnosis(run: MaintenanceReport | None, runs: list[dict[str, Any]]) -> Diagnosis | None:
    """Return the diagnosis of a run, or the last one of the runs in the journal."""
    if run is not None and run.diagnosis is not None:
        return run.diagnosis
    diagnosed = [one["diagnosis"] for one in runs if one.get("diagnosis")]
    return Diagnosis.from_dict(diagnosed[-1]) if diagnosed else None


def _headline(state: SensorState, problems: list[str]) -> str:
    if state.exit_code == 1 and not state.known.faults:
        return "Watch: no fault is known, but see the reason"
    if state.exit_code == 0 and problems:
        return "Watch: files of the bundle are damaged"
    return _HEADLINES[state.exit_code]


def robot_name(bundle: Path) -> str:
    """Return the name of a bundle, or of the folder that holds it where the bundle is called
    robot.bundle."""
    path = bundle.resolve()
    return path.parent.name if path.stem == "robot" and path.parent.name else path.stem


def _state_after(run: MaintenanceReport, bundle: Bundle, state: SensorState) -> SensorState:
    """Return the state as a run reports it; a dry run changed nothing in the bundle."""
    unhandled = state.unhandled
    if run.dry_run:
        cells = unhandled_cells(bundle, run.fault_set, state.version)
        handled = run.decision == "deployed" or run.exit_code < 2
        unhandled = (
            () if handled else tuple(fault for fault in run.faults if cells & set(fault.cells))
        )
    measured = run.accuracy is not None
    return replace(
        state,
        exit_code=run.exit_code,
        known=replace(state.known, faults=run.faults),
        unhandled=unhandled,
        accuracy=run.accuracy if measured else state.accuracy,
        fault_free_accuracy=run.fault_free_accuracy if measured else state.fault_free_accuracy,
        reason=run.reason,
        measure=run.measure if measured else state.measure,
    )


def _shown(run: dict[str, Any]) -> dict[str, Any]:
    number = run.get("version", run.get("to"))
    return {
        "time": run["time"][:16].replace("T", " "),
        "what": run["what"],
        "version": number,
        "reason": run.get("reason", ""),
    }
