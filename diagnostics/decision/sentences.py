"""The sentence that tells the technician of a fault: what was observed, what to check, and which
other causes have the same findings."""

from __future__ import annotations

import numpy as np

from diagnostics.decision.cell_findings import CellFindings
from diagnostics.decision.line_cover import Cause
from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import SensorLayout
from diagnostics.wiring import DECLARED, action, counted


def _does(fault: Fault, found: CellFindings, layout: SensorLayout) -> str:
    gain = found.gain[list(fault.cells)]
    if fault.kind in (FaultKind.DRIFT, FaultKind.WEAK) and np.isfinite(gain).any():
        return (
            f"is loaded when the others are, but reads about {np.nanmedian(gain):.2g} times what it"
            " should"
        )
    if fault.kind is FaultKind.COPY:
        source = (
            "the mean of the cells beside it"
            if fault.value is None
            else layout.place(int(fault.value))
        )
        return f"repeats {source}"
    comes_and_goes = np.max([found.refuted, found.unsure, found.wire], axis=0) >= 0
    if fault.kind is FaultKind.INTERMITTENT and comes_and_goes[list(fault.cells)].any():
        share = float(np.median(found.share[list(fault.cells)]))
        if found.as_one[list(fault.cells)].any():
            return f"reads what all others on it read, or does not change, {share:.0%} of the time"
        return (
            f"reads nothing in {share:.0%} of the contacts that load the cells around it, and its"
            " load in the others"
        )
    if fault.kind.does:
        return fault.kind.does.format(value=fault.value or 0.0, unit=layout.unit)
    if found.silent[fault.cells[0]]:
        return "delivers no reading"
    return f"reads {fault.value or 0.0:.4g} {layout.unit}"


def reason_of(fault: Fault, cause: Cause, found: CellFindings, layout: SensorLayout) -> str:
    """Return one sentence: what was observed, and what to check."""
    does = _does(fault, found, layout)
    if not cause.proven:
        few = f"{len(cause.seen)} cells on it" if len(cause.seen) > 1 else "1 cell on it"
        return (
            f"{fault.line} may {_infinitive(fault.kind)}{_where(fault, cause, layout)} (P ="
            f" {fault.probability:.2f}), or only {few}, each of which {does}: one more contact"
            " along it will tell"
        )
    already = ", and did so in the reference already" if found.known[list(cause.seen)].all() else ""
    since = (
        ""
        if fault.onset is None
        else f" from frame {fault.onset} on ({fault.onset / layout.rate:.1f} s)"
    )
    if fault.line is None:
        whatever = (
            "" if fault.kind.does or found.silent[fault.cells[0]] else ", whatever touches it"
        )
        return (
            f"{layout.place(fault.cells[0])} {fault.kind.verb()}: it {does}{since}{whatever}"
            f"{already}; check {fault.kind.check}"
        )
    inferred = len(cause.cells) - len(cause.seen)
    are = "is" if inferred == 1 else "are"
    if fault.line.kind in DECLARED:
        silent = (
            "are silent"
            if found.silent[fault.cells[0]]
            else f"{fault.kind.verb(plural=True)}: each cell {does}"
        )
        also = f"; {inferred} of the cells, not tested, {are} inferred" if inferred else ""
        return f"{action(fault.line)}: {_behind(fault, layout)} {silent}{since}{already}{also}"
    also = f"; {inferred} more, not tested, {are} inferred from the wire" if inferred else ""
    seen = f"each of {len(cause.seen)} cells on it {does}{since}{already}{also}"
    of_converter = fault.line.kind == "converter"
    check = (
        "the converter channel and its cable"
        if of_converter
        else f"the {fault.line.kind} wire and its address"
    )
    return f"{fault.line} {fault.kind.verb()}{_where(fault, cause, layout)}: {seen}; check {check}"


def _infinitive(kind: FaultKind) -> str:
    """Return the verb as it follows "may": "be stuck"."""
    verb = kind.verb()
    return f"be {verb[3:]}" if verb.startswith("is ") else kind.verb(plural=True)


def _behind(fault: Fault, layout: SensorLayout) -> str:
    """Return what a dead bus or group holds, as "all 4 triangles behind it"."""
    assert fault.line is not None
    cells = len(layout.cells_on(fault.line))
    if len(fault.cells) < cells:
        return f"{len(fault.cells)} of {cells} cells on it"
    parts = layout.parts(fault.line)
    if len(parts) > 1:
        return f"all {counted(parts)} behind it"
    return f"all {cells} {'axes' if fault.line.kind == 'position' else 'cells'} on it"


def _where(fault: Fault, cause: Cause, layout: SensorLayout) -> str:
    """Return the part of its line that a fault affects, as " from column 5 on" or " up to column
    4"; "": all of it."""
    if cause.whole or fault.line is None:
        return ""
    across, name = (2, "column") if fault.line.kind == "row" else (1, "row")
    dead = [layout.position(cell)[across] for cell in fault.cells]
    on_line = [layout.position(cell)[across] for cell in layout.cells_on(fault.line).tolist()]
    return (
        f" from {name} {min(dead)} on"
        if max(dead) == max(on_line)
        else f" up to {name} {max(dead)}"
    )


def alternatives_of(
    fault: Fault, cause: Cause, found: CellFindings, layout: SensorLayout
) -> tuple[str, ...]:
    """Return other causes with the same findings: the address of a dead line, or a break further
    along it."""
    assert fault.line is not None
    others = []
    cells = layout.cells_on(fault.line)
    if cause.whole and fault.kind in (FaultKind.OPEN, FaultKind.SHORT):
        others.append(f"the address or the multiplexer output of {fault.line}, not its wire")
    untested = ~found.alive & ~found.faulty
    unseen = np.setdiff1d(cells, np.array(cause.seen))
    if cause.whole and fault.kind is FaultKind.OPEN and untested[unseen].any():
        others.append(f"a break in {fault.line} that leaves the untested cells on it alive")
    if not cause.whole and untested[cells].any():
        edge = fault.cells[0] if fault.cells[-1] == cells[-1] else fault.cells[-1]
        i = int(np.searchsorted(cells, edge))
        beside = cells[i - 1] if edge == fault.cells[0] else cells[min(i + 1, len(cells) - 1)]
        if untested[beside]:
            others.append("a break one or more untested cells closer to the working end")
    return tuple(others)
