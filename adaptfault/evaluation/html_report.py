"""The report of a demonstration: one self-contained HTML file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from adaptfault.pages.html_page import Picture, render
from diagnostics import FaultSet
from diagnostics.decision.plot import draw_row, pads_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from adaptfault.evaluation.demo import DemoResult


@dataclass(frozen=True)
class _Row:
    """An injected fault, with the number of its cells that were found and that the log did not
    test."""

    injected: str
    cells: int
    found: int
    untested: int
    causes: tuple[str, ...]


def write_report(path: str | Path, result: DemoResult) -> Path:
    """Write the report of a demo run; returns its path.

    Raises:
        OSError: the folder cannot be written.
    """
    return render(
        path,
        "evaluation/report.html",
        result=result,
        layout=result.recordings.layout,
        rows=_rows(result),
        alarms=_false_alarm_texts(result),
        forces=Picture.of(lambda page: _draw_maps(result, page)),
        verdicts=Picture.of(result.diagnosis.plot),
        packages=("adaptfault", "torch", "numpy", "scikit-learn"),
    )


def _rows(result: DemoResult) -> list[_Row]:
    faulty = result.diagnosis.fault_set
    untested = set(result.diagnosis.coverage.untested.tolist())
    rows = []
    for fault in result.injected:
        causes = tuple(f.reason for f in result.diagnosis.faults if set(f.cells) & set(fault.cells))
        found = sum(cell in faulty for cell in fault.cells)
        rows.append(
            _Row(
                fault.describe(result.recordings.layout),
                len(fault.cells),
                found,
                len(untested & set(fault.cells)),
                causes,
            )
        )
    return rows


def _false_alarm_texts(result: DemoResult) -> list[str]:
    layout = result.recordings.layout
    return [layout.place(c) for c in result.false_alarms]


def _draw_maps(result: DemoResult, page: float) -> Figure:
    """Draw mean forces as the paper's Figure 3, with a third row: the forces after imputation."""
    layout = result.recordings.layout
    figure, axes = pads_figure(layout, n_rows=len(result.maps), page=page)
    # One colour scale for all, from the healthy map: a short is then off the scale.
    top = float(np.nanmax(result.maps["normal"][layout.is_cell])) or layout.full_scale
    marks = {"normal": FaultSet((), layout.n_cells), "broken": result.injected_set}
    for (name, values), row in zip(result.maps.items(), axes, strict=True):
        dead = marks.get(name, result.diagnosis.fault_set)
        title = f"{name}, "
        draw_row(row, values, layout, title, dead, top=top, label=layout.unit, extend="max")
    return figure
