"""The technician's page of one diagnosis, without a bundle: one HTML file that needs no network."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Literal

from adaptfault.evaluation.html_page import embedded, render, version_of
from diagnostics import Diagnosis

Verdict = Literal["call", "watch", "nothing"]

HEADLINES: dict[Verdict, str] = {
    "call": "Call a technician",
    "watch": "Watch: single cells are faulty",
    "nothing": "Nothing to do",
}

_TESTED = 0.5  # below this share of tested cells, a log without a fault is no proof of health


def verdict(diagnosis: Diagnosis) -> Verdict:
    """Return the verdict of a diagnosis: ``"call"`` for a wire or a tenth of the cells, ``"watch"`` for single cells.

    A log without a fault that tested less than half of the cells gives ``"watch"`` as well.
    """
    if diagnosis.exit_code >= 2:
        return "call"
    return "watch" if diagnosis.faults or diagnosis.coverage.test_coverage < _TESTED else "nothing"


def write_diagnosis(path: str | Path, diagnosis: Diagnosis, *, name: str, reference: bool) -> Path:
    """Write the page; return its path.

    Args:
        path: the HTML file.
        diagnosis: what to show.
        name: of the log.
        reference: whether the diagnosis had fault-free recordings to compare with.

    Raises:
        OSError: the folder cannot be written.
    """
    state = verdict(diagnosis)
    headline = HEADLINES[state]
    if state == "watch" and not diagnosis.faults:
        headline = "No fault found, but most cells were not tested"
    return render(
        path,
        "diagnosis.html",
        name=name,
        state=state,
        headline=headline,
        diagnosis=diagnosis,
        layout=diagnosis.layout,
        ordered=sorted(diagnosis.faults, key=lambda fault: (fault.line is None, -len(fault.cells))),
        reference=reference,
        verdicts=embedded(diagnosis.plot()),
        date=datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        versions=f"adaptfault {version_of('adaptfault')}",
    )
