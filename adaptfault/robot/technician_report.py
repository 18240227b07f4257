"""The technician's page: one HTML file that needs nothing else, about a robot's skin and what runs on it."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any

from adaptfault.evaluation.html_page import embedded, render, version_of
from adaptfault.robot.bundle import Bundle
from adaptfault.robot.pointer import Pointer
from diagnostics import Diagnosis


def write_report(path: str | Path, bundle: Bundle, diagnosis: Diagnosis | None = None) -> Path:
    """Write the page; returns its path.

    Args:
        path: where to.
        bundle: the robot's.
        diagnosis: to show; None: the last one in the journal.

    Raises:
        OSError: the folder cannot be written.
    """
    runs = bundle.journal.runs()
    if diagnosis is None:
        told = [run["diagnosis"] for run in runs if run.get("diagnosis")]
        diagnosis = Diagnosis.from_dict(told[-1]) if told else None
    active = bundle.active()
    judged = [run for run in runs if run.get("accuracy") is not None and run["version"] == active.number]
    return render(
        path,
        "technician.html",
        bundle=bundle,
        name=bundle.path.name,
        layout=bundle.layout,
        active=active,
        pointer=Pointer.read(bundle.path),
        knowledge=bundle.knowledge(),
        diagnosis=diagnosis,
        verdicts=None if diagnosis is None else embedded(diagnosis.plot()),
        last=judged[-1] if judged else None,
        runs=[_shown(run) for run in reversed(runs)],
        problems=bundle.problems(mend=False),
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
