"""Root causes: which fault, on which wire or cell, since when, said in one plain sentence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import Line, SensorLayout
from diagnostics.temporal import LastRuns
from diagnostics.wiring import Cause, explain

_SAME_VALUE = 0.02  # of full scale: stuck cells this near to each other may share a cause


def root_causes(
    faulty: NDArray[np.bool_],
    alive: NDArray[np.bool_],
    silent: NDArray[np.bool_],
    probability: NDArray[np.float64],
    runs: LastRuns,
    frame_numbers: NDArray[np.intp],
    layout: SensorLayout,
    tolerance: float,
) -> tuple[Fault, ...]:
    """Name the root causes of faulty cells, one fault each, the biggest first: that is where a technician starts.

    Args:
        faulty: bool ``[D]``, the cells to explain.
        alive: bool ``[D]``, the cells that proved to work.
        silent: bool ``[D]``, cells that never delivered a reading.
        probability: float ``[D]``, P(faulty).
        runs: the still stretch that ends each cell's log.
        frame_numbers: int ``[T]``, the number in the user's log of each frame that ``runs`` counts.
        layout: the array.
        tolerance: how near to a rail counts as the rail.
    """
    faults: list[Fault] = []
    for kind, cells, value in _alike(faulty, silent, runs.value, layout.full_scale, tolerance):
        # A live cell contradicts a broken wire; so does one that is faulty in another way.
        others = alive.copy()
        others[np.setdiff1d(np.flatnonzero(faulty), cells)] = True
        for cause in explain(cells, others, layout):
            start = int(np.median(runs.start[list(cause.seen)]))
            first = cause.cells[0]
            if kind is FaultKind.STUCK and cause.line is None:
                value = float(runs.value[first])
            fault = Fault(
                kind,
                cause.cells,
                line=cause.line,
                value=value,
                onset=int(frame_numbers[start]) if start > 0 else None,
                probability=float(probability[first]) if cause.line is None else cause.probability,
            )
            faults.append(replace(fault, reason=_reason(fault, cause, layout)))
    return tuple(sorted(faults, key=lambda fault: (-len(fault.cells), fault.cells)))


def _alike(
    faulty: NDArray[np.bool_],
    silent: NDArray[np.bool_],
    value: NDArray[np.float64],
    full_scale: float,
    tolerance: float,
) -> list[tuple[FaultKind, NDArray[np.intp], float | None]]:
    """Group faulty cells that could share a cause: the same kind and nearly the same value (None: no reading)."""
    heard = faulty & ~silent
    low, high = heard & (value <= tolerance), heard & (value >= full_scale - tolerance)
    rails = ((FaultKind.OPEN, silent, None), (FaultKind.OPEN, low, 0.0), (FaultKind.SHORT, high, full_scale))
    groups = [(kind, np.flatnonzero(cells), at) for kind, cells, at in rails if cells.any()]
    between = np.flatnonzero(heard & ~low & ~high)
    between = between[np.argsort(value[between])]
    for cells in np.split(between, np.flatnonzero(np.diff(value[between]) > _SAME_VALUE * full_scale) + 1):
        if len(cells):
            groups.append((FaultKind.STUCK, np.sort(cells), float(np.median(value[cells]))))
    return groups


def _reason(fault: Fault, cause: Cause, layout: SensorLayout) -> str:
    """Say what was seen and what to check."""
    reads = "delivers no reading" if fault.value is None else f"reads {fault.value:.4g} {layout.unit}"
    since = "" if fault.onset is None else f" from frame {fault.onset} on ({fault.onset / layout.rate:.1f} s)"
    if fault.line is None:
        pad, row, column = layout.position(fault.cells[0])
        return f"pad {pad}, row {row}, column {column} is {fault.kind}: it {reads}{since}, whatever touches it"
    inferred = len(cause.cells) - len(cause.seen)
    also = f"; {inferred} more, not touched, are inferred" if inferred else ""
    seen = f"each of {len(cause.seen)} cells on it {reads}{since}{also}"
    return f"{fault.line} is {fault.kind}: {seen}; check {_wire(fault.line)}"


def _wire(line: Line) -> str:
    return (
        "the converter channel and its cable" if line.kind == "converter" else f"the {line.kind} wire and its address"
    )
