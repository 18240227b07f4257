"""The technician's page of one diagnosis, without a bundle: one HTML file that needs no network."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from functools import partial
from pathlib import Path

from adaptfault.pages.html_page import Picture, render
from diagnostics import Diagnosis
from diagnostics.decision.grouped_faults import by_group
from diagnostics.decision.numbering import Numbering

HEADLINES = ("Nothing to do", "Watch: single cells are faulty", "Call a technician")
"""Of each severity."""

OF_A_DATA_SET = (
    "Fit for training, as far as it was tested",
    "Train with care: see what was found",
    "Not fit for training as it is",
)

_TESTED = 0.5  # below this share of tested cells, a log without a fault is no proof of health


def write_diagnosis(
    path: str | Path,
    diagnosis: Diagnosis,
    *,
    name: str,
    reference: bool,
    code: int | None = None,
    notes: Sequence[str] = (),
    count_from: int = 0,
    headlines: Sequence[str] = HEADLINES,
) -> Path:
    """Write the page; return its path.

    Args:
        path: the HTML file.
        diagnosis: what to show.
        name: of the log.
        reference: whether the diagnosis had fault-free recordings to compare with.
        code: the exit code of the command; None: that of the diagnosis. The page shows
            1 at least where a fault was found, or less than half of the cells were tested.
        notes: sentences below the verdict: a changed sensor, exchanged wires, faults that are
            handled.
        count_from: number of the first pad, row, column and cell on the page.
        headlines: of each severity.

    Raises:
        OSError: the folder cannot be written.
    """
    found = diagnosis.exit_code
    untested = diagnosis.coverage.test_coverage < _TESTED
    severity = min(found if code is None else code, 2)
    if severity == 0 and (found or untested):
        severity = 1
    headline = headlines[severity]
    if severity == 1 and diagnosis.faults and code is not None and code < found:
        headline = "Watch: the running version handles the faults"
    elif severity == 1 and not diagnosis.faults:
        why = "most cells were not tested" if untested else "see the reason"
        headline = f"No fault found, but {why}"
    return render(
        path,
        "pages/diagnosis.html",
        name=name,
        bad=severity >= 2,
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
