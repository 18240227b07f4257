"""The technician's report: one self-contained HTML file about a robot's sensor and its running version."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any

from adaptfault.evaluation.html_page import embedded, render, version_of
from adaptfault.robot.bundle import Bundle
from adaptfault.robot.pointer import Pointer
from diagnostics import Diagnosis


def write_report(path: str | Path, bundle: Bundle, diagnosis: Diagnosis | None = None) -> Path:
    """Write the page and return its path.

    Args:
        path: of the HTML file.
        bundle: of the robot.
        diagnosis: to show; None: the last one in the journal.

    Raises:
        OSError: the file cannot be written.
    """
    runs = bundle.journal.runs()
    if diagnosis is None:
        diagnosed = [run["diagnosis"] for run in runs if run.get("diagnosis")]
        diagnosis = Diagnosis.from_dict(diagnosed[-1]) if diagnosed else None
    active = bundle.active()
    compared = [run for run in runs if run.get("accuracy") is not None and run["version"] == active.number]
    return render(
        path,
        "technician.html",
        bundle=bundle,
        name=bundle.path.name,
        layout=bundle.layout,
        active=active,
        pointer=Pointer.read(bundle.path),
        knowledge=bundle.known_faults(),
        diagnosis=diagnosis,
        verdicts=None if diagnosis is None else embedded(diagnosis.plot()),
        last=compared[-1] if compared else None,
        runs=[_shown(run) for run in reversed(runs)],
        problems=bundle.problems(repair=False),
        versions=f"adaptfault {version_of('adaptfault')}",
        python=platform.python_version(),
    )


def _shown(run: dict[str, Any]) -> dict[str, Any]:
    number = run.get("version", run.get("to"))
    return {
        "time": run["time"][:16].replace("T", " "),
        "what": run["what"],
        "version": number,
        "reason": run.get("reason", ""),
    }
