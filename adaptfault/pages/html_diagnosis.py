"""The technician's page of one diagnosis, without a bundle: one HTML file that needs no network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Literal

from adaptfault.pages.html_page import Picture, render
from diagnostics import Diagnosis
from diagnostics.decision.grouped_faults import by_group
from diagnostics.decision.numbering import Numbering

Verdict = Literal["call", "watch", "nothing"]

HEADLINES: dict[Verdict, str] = {
    "call": "Call a technician",
    "watch": "Watch: single cells are faulty",
    "nothing": "Nothing to do",
}

OF_A_DATA_SET: dict[Verdict, str] = {
    "call": "Not fit for training as it is",
    "watch": "Train with care: see what was found",
    "nothing": "Fit for training, as far as it was tested",
}

_TESTED = 0.5  # below this share of tested cells, a log without a fault is no proof of health


def verdict(diagnosis: Diagnosis, code: int | None = None) -> Verdict:
    """Return the verdict of a diagnosis: ``"call"`` for a wire or a tenth of the cells, ``"watch"``
    for single cells.

    A log without a fault that tested less than half of the cells gives ``"watch"`` as well.
    ``code`` is the exit code of ``adaptfault diagnose``, where more is known than the faults: 2
    gives ``"call"``, 1 at least ``"watch"``.
    """
    code = diagnosis.exit_code if code is None else code
    if code >= 2:
        return "call"
    return (
        "watch"
        if code or diagnosis.exit_code or diagnosis.coverage.test_coverage < _TESTED
        else "nothing"
    )


def write_diagnosis(
    path: str | Path,
    diagnosis: Diagnosis,
    *,
    name: str,
    reference: bool,
    code: int | None = None,
    notes: Sequence[str] = (),
    count_from: int = 0,
    headlines: Mapping[Verdict, str] = HEADLINES,
) -> Path:
    """Write the page; return its path.

    Args:
        path: the HTML file.
        diagnosis: what to show.
        name: of the log.
        reference: whether the diagnosis had fault-free recordings to compare with.
        code: the exit code of the command; None: that of the diagnosis.
        notes: sentences below the verdict: a changed sensor, exchanged wires, faults that are
            handled.
        count_from: number of the first pad, row, column and cell on the page.
        headlines: of each verdict.

    Raises:
        OSError: the folder cannot be written.
    """
    state = verdict(diagnosis, code)
    headline = headlines[state]
    if state == "watch" and diagnosis.faults and code is not None and code < diagnosis.exit_code:
        headline = "Watch: the running version handles the faults"
    elif state == "watch" and not diagnosis.faults:
        untested = diagnosis.coverage.test_coverage < _TESTED
        headline = "No fault found, but " + (
            "most cells were not tested" if untested else "see the reason"
        )
    return render(
        path,
        "pages/diagnosis.html",
        name=name,
        state=state,
        notes=[
            note[0].upper() + note[1:]
            for note in (*notes, *(load.reason for load in diagnosis.static_loads))
        ],
        headline=headline,
        diagnosis=diagnosis,
        layout=diagnosis.layout,
        ordered=sorted(
            by_group(diagnosis.faults, diagnosis.layout),
            key=lambda fault: (fault.line is None, -len(fault.cells)),
        ),
        reference=reference,
        numbering=Numbering.from_layout(diagnosis.layout, count_from),
        verdicts=Picture.of(partial(diagnosis.plot, count_from=count_from)),
        date=datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
    )
