"""Root causes: one fault per cause, with its wire or cell, onset, probability, reason, and what to
check.

Cells with the same kind of fault and the same value form a group. Each group is explained by the
line cover (:mod:`~diagnostics.decision.line_cover`); pairs of lines that read the same by address
aliasing. Causes that act through more than one group, as a broken supply wire of several chips, are
reported as several faults. With declared wiring the wires are buses and nested groups, see
:mod:`~diagnostics.wiring`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diagnostics.decision.cell_findings import (
    OF_WIRES,
    REFUTED_KINDS,
    CellFindings,
    Floats,
    Mask,
)
from diagnostics.decision.line_cover import Cause, solve
from diagnostics.decision.sentences import alternatives_of, reason_of
from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import ANYWHERE, MAJORITY, SLIGHT, SUSPICIOUS
from diagnostics.wiring import LineKind

_HELD = (FaultKind.OPEN, FaultKind.SHORT, FaultKind.STUCK)

# Faults of a wire that all cells on it show, touched or not.
_WITHOUT_CONTACT = (*_HELD, FaultKind.FLOATING)


def root_causes(
    found: CellFindings, aliases: Sequence[Fault], layout: SensorLayout
) -> tuple[tuple[Fault, ...], tuple[Fault, ...]]:
    """Return the root causes of the faulty cells, one fault each, the one with most cells first;
    and possible wires.

    The cells of ``aliases``, the faults of lines that read the same, have no other cause.
    """
    aliased = np.zeros(layout.n_cells, bool)
    aliased[[cell for fault in aliases for cell in fault.cells]] = True
    causes = _causes(found, aliased, layout, 0.0)
    singles = sum(cause.line is None for _, _, cause in causes)
    if 0 < singles < sum(cause.proven for _, _, cause in causes):
        # With many single faults, some are neighbours on a wire by chance: solve again with a
        # higher prevalence.
        common = (1 - ANYWHERE) / 2 * singles / int((found.alive | found.faulty).sum())
        causes = _causes(found, aliased, layout, common)
    told = [(_fault(*one, found, layout), one[2].proven) for one in causes]
    proven = [fault for fault, is_proven in told if is_proven]
    faults = _addresses_of_dead_rows([*aliases, *proven], found, layout)
    faults.sort(key=lambda fault: (-len(fault.cells), fault.cells))
    return tuple(faults), tuple(fault for fault, is_proven in told if not is_proven)


def pulling(faults: Sequence[Fault], pulled: Mask, layout: SensorLayout) -> tuple[Fault, ...]:
    """Return the faults, and of shorted cells that their row and column read too little where cells
    on these are ``pulled`` (bool ``[D]``)."""
    told = list(faults)
    if not pulled.any():
        return tuple(told)
    lines = [layout.cells_on(line) for line in layout.lines if line.kind in ("row", "column")]
    for i, fault in enumerate(faults):
        if fault.kind is not FaultKind.SHORT or fault.line is not None:
            continue
        crossing = [cells for cells in lines if fault.cells[0] in cells]
        beside = {cell for cells in crossing for cell in cells[pulled[cells]].tolist()}
        if beside:
            reason = (
                f"{fault.reason}; {len(beside)} cells of its row and column read a part of their"
                " load through it, and are not tested"
            )
            told[i] = replace(fault, reason=reason)
    return tuple(told)


def cut_off(unused: Mask, layout: SensorLayout) -> tuple[Fault, ...]:
    """Return the possible wires of pads with ``unused`` cells (bool ``[D]``): a pad that nothing
    touches reads as one that is cut off at its rest."""
    faults = []
    for pad in np.unique(layout.pad_of[unused]).tolist():
        cells = np.flatnonzero(unused & (layout.pad_of == pad))
        holding = [
            line for line in reversed(layout.lines) if np.isin(cells, layout.cells_on(line)).all()
        ]
        if not holding:
            continue
        line = min(holding, key=lambda line: len(layout.cells_on(line)))
        reason = (
            f"nothing touched pad {pad}, or {line} is open: its cells hold the readings that they"
            " have without contact; press on it to tell"
        )
        faults.append(
            Fault(FaultKind.OPEN, tuple(cells.tolist()), line=line, probability=0.5, reason=reason)
        )
    return tuple(faults)


def _causes(
    found: CellFindings, aliased: Mask, layout: SensorLayout, common: float
) -> list[tuple[FaultKind, float | None, Cause]]:
    """Return kind, value and cause of each fault; ``common``: lower limit of the prevalence of one
    kind."""
    causes = _proven_wires(found, aliased, layout)
    aliased = aliased.copy()
    aliased[[cell for _, _, cause in causes for cell in cause.cells]] = True
    joined = _of_failing_wires(found, aliased, layout, common)
    aliased[[cell for _, _, cause in joined for cell in cause.cells]] = True
    causes += joined
    # A wire has no rest level of its own: cells that no longer return to theirs drift one by one.
    drifting = np.flatnonzero(found.faulty & found.drifting & np.isnan(found.gain) & ~aliased)
    causes += [(FaultKind.DRIFT, None, Cause(None, (c,), (c,), 1.0)) for c in drifting.tolist()]
    for kind, faulty, consistent, value in _groups(found, layout.full_scale):
        # A working cell contradicts a broken wire; so does one with another fault, or another
        # value.
        contradicting = found.alive | (found.faulty & ~consistent) | aliased
        if kind in _HELD:
            # A cell that became constant before the wire broke does not contradict it.
            leading = faulty if faulty.any() else consistent & (found.weight >= SUSPICIOUS)
            begun = int(np.median(found.since[leading])) if leading.any() else 0
            contradicting &= ~(consistent & ~faulty & (found.since <= begun) & (begun > 0))
        if kind in _WITHOUT_CONTACT:
            contradicting |= ~consistent & ~found.silent
        explained = _explained(faulty, consistent, contradicting, ~aliased, found, layout, common)
        causes += [(kind, value, cause) for cause in explained]
    return causes


def _proven_wires(
    found: CellFindings, aliased: Mask, layout: SensorLayout
) -> list[tuple[FaultKind, float | None, Cause]]:
    """Return the wires that are proved to fail now and then."""
    free = ~aliased
    causes: list[tuple[FaultKind, float | None, Cause]] = []
    for number in range(int(found.wire.max()) + 1):
        seen = np.flatnonzero((found.wire == number) & free)
        holds = [
            line
            for line in layout.lines
            if not line.kind.endswith("_address") and np.isin(seen, layout.cells_on(line)).all()
        ]
        if not len(seen) or not holds:
            continue
        line = min(holds, key=lambda line: len(layout.cells_on(line)))
        cells = layout.cells_on(line)
        cells = cells[free[cells]]
        free[cells] = False
        probability = float(found.of_wire[seen[0]])
        cause = Cause(line, tuple(cells.tolist()), tuple(seen.tolist()), probability)
        causes.append((FaultKind.INTERMITTENT, None, cause))
    return causes


def _of_failing_wires(
    found: CellFindings, aliased: Mask, layout: SensorLayout, common: float
) -> list[tuple[FaultKind, float | None, Cause]]:
    """Return the wires that fail now and then.

    One by one their cells may be uncertain, or look as if they moved by themselves: a wire that
    opens under load leaves each of them its light contacts. They fail together.
    """
    likely = np.maximum(found.refuted, found.unsure)
    consistent = (likely >= 0) & (likely < len(OF_WIRES))
    contradicting = (found.alive | found.faulty) & ~consistent | aliased
    faulty = found.faulty & consistent
    explained = _explained(faulty, consistent, contradicting, ~aliased, found, layout, common)
    wires: list[tuple[FaultKind, float | None, Cause]] = []
    for cause in explained:
        kind = OF_WIRES[int(np.median(likely[list(cause.seen)]))]
        # touched or not, all cells of a wire that floats do
        floats = kind is FaultKind.FLOATING
        if floats and len(cause.seen) <= MAJORITY * len(cause.cells):
            continue
        if cause.line is not None and cause.proven:
            wires.append((kind, None, cause))
    return wires


def _explained(
    faulty: Mask,
    consistent: Mask,
    contradicting: Mask,
    free: Mask,
    found: CellFindings,
    layout: SensorLayout,
    common: float,
) -> tuple[Cause, ...]:
    """Return the causes of ``free`` cells with the same fault; see ``solve``.

    Cells that were dead in the reference are no evidence for a wire that broke later, though they
    may lie on it. A wire that was broken in the reference explains such cells only.
    """
    faulty = faulty & free
    consistent = consistent & free
    known = found.known & faulty

    def of(faulty: Mask, consistent: Mask, contradicting: Mask) -> tuple[Cause, ...]:
        return solve(faulty, consistent, contradicting, found.weight, layout, common)

    causes = of(faulty & ~known, consistent & ~known, contradicting & ~known)
    known[[cell for cause in causes if cause.proven for cell in cause.cells]] = False
    return causes + of(known, known, ~known)


def _groups(
    found: CellFindings, full_scale: float
) -> list[tuple[FaultKind, Mask, Mask, float | None]]:
    """Return (kind, certainly faulty cells, all consistent cells, value) of each group that may
    share a cause."""
    faulty = found.faulty
    value = found.value
    moving = found.intermittent | found.noisy | found.drifting | (found.refuted >= 0)
    constant = faulty & ~found.silent & ~moving
    of_gain = found.drifting & (found.gain > 1)
    weak = found.drifting & (found.gain < 1)
    groups: list[tuple[FaultKind, Mask, Mask, float | None]] = [
        (FaultKind.OPEN, faulty & found.silent, found.silent, None),
        (FaultKind.OPEN, constant & found.rests, found.rests, None),
        (FaultKind.SHORT, constant & found.full, found.full, full_scale),
        *([] if found.zero is None else [(FaultKind.OPEN, constant & found.zero, found.zero, 0.0)]),
        (FaultKind.INTERMITTENT, faulty & found.intermittent, found.intermittent, None),
        (FaultKind.NOISY, faulty & found.noisy, found.noisy, None),
        (FaultKind.DRIFT, faulty & of_gain, of_gain, None),
    ]
    for number, kind in enumerate(REFUTED_KINDS):
        refuted = found.refuted == number
        if kind is FaultKind.WEAK:
            refuted |= weak
        groups.append((kind, faulty & refuted, refuted, None))
    at_an_end = found.full if found.zero is None else found.full | found.zero
    intermediate = np.flatnonzero(constant & ~found.rests & ~at_an_end)
    intermediate = intermediate[np.argsort(value[intermediate])]
    for cells in np.split(
        intermediate, np.flatnonzero(np.diff(value[intermediate]) > SLIGHT * full_scale) + 1
    ):
        if len(cells):
            mask = np.zeros(len(faulty), bool)
            mask[cells] = True
            groups.append((FaultKind.STUCK, mask, mask, float(np.median(value[cells]))))
    return [group for group in groups if group[2].any()]


def _fault(
    kind: FaultKind, value: float | None, cause: Cause, found: CellFindings, layout: SensorLayout
) -> Fault:
    seen = list(cause.seen)
    own = (
        FaultKind.STUCK,
        FaultKind.OPEN,
        FaultKind.INTERMITTENT,
        FaultKind.LATE,
        FaultKind.COPY,
        FaultKind.CLAMPED,
    )
    if kind is FaultKind.WEAK:
        value = float(np.median(found.gain[seen]))
    if kind in own and not found.silent[seen[0]]:
        value = float(np.median(found.value[seen]))
        if np.isnan(value):  # a copy of no single cell
            value = None
        elif (
            found.zero is not None and kind is FaultKind.OPEN
        ):  # at rest, which is not the lower end
            kind = FaultKind.STUCK
            if value >= (1 - SLIGHT) * layout.full_scale:
                kind = FaultKind.SHORT
            elif value <= SLIGHT * layout.full_scale:
                kind = FaultKind.OPEN
        if kind in _HELD:
            value = _middle((found.value if found.typical is None else found.typical)[seen])
    start = int(np.median(found.since[seen]))
    fault = Fault(
        kind,
        cause.cells,
        line=cause.line,
        value=value,
        onset=start if start > 0 else None,
        probability=(
            float(found.probability[cause.cells[0]]) if cause.line is None else cause.probability
        ),
        evidence=int(found.events[seen].sum()),
    )
    fault = replace(fault, reason=reason_of(fault, cause, found, layout))
    if cause.proven and cause.line is not None and cause.line.kind in ("row", "column"):
        fault = replace(fault, alternatives=alternatives_of(fault, cause, found, layout))
    return fault


def _middle(readings: Floats) -> float:
    """Return the median; of whole numbers the lower one of the two in the middle, a reading."""
    if (readings == np.rint(readings)).all():
        return float(np.sort(readings)[(len(readings) - 1) // 2])
    return float(np.median(readings))


def _addresses_of_dead_rows(
    faults: list[Fault], found: CellFindings, layout: SensorLayout
) -> list[Fault]:
    """Merge dead lines that one stuck address bit would explain: it selects lines without contact
    instead."""
    for line in layout.lines:
        if line.kind not in ("row_address", "column_address"):
            continue
        kind: LineKind = "row" if line.kind == "row_address" else "column"
        whole = {
            f.line.index: f
            for f in faults
            if f.kind is FaultKind.OPEN and f.line and (f.line.pad, f.line.kind) == (line.pad, kind)
            if len(f.cells) == len(layout.cells_on(f.line))
        }
        if len(whole) < 2:
            continue
        for level in (0, 1):
            cells, sources = layout.misaddressed(line, level)
            moved = _index(cells, kind, layout)
            dead = {index: whole[index] for index in moved if index in whole}
            # One stuck bit is likelier than two broken wires. All lines that it moves must be dead
            # or untested.
            if (
                len(dead) < max(2, len(moved) / 2)
                or found.alive[[*cells, *sources[sources >= 0]]].any()
            ):
                continue
            reads = _index(sources[sources >= 0], kind, layout)
            instead = f"untouched {_named(kind, reads)}" if reads else f"addresses without a {kind}"
            text = (
                f"{line} is stuck at {level}: {_named(kind, moved)} read nothing, as {instead}"
                " would"
            )
            merged = Fault(
                FaultKind.ALIAS,
                tuple(cells.tolist()),
                line=line,
                value=level,
                onset=max((f.onset or 0) for f in dead.values()) or None,
                probability=min(f.probability or 0.0 for f in dead.values()),
                reason=f"{text}; check the {kind} multiplexer and its address wires",
                evidence=sum(f.evidence or 0 for f in dead.values()),
                alternatives=(
                    (
                        f"the wires of {_named(kind, list(dead))} are open, independently of each"
                        " other"
                    ),
                ),
            )
            faults = [f for f in faults if f not in dead.values()] + [merged]
    return faults


def _index(cells: NDArray[np.intp], kind: LineKind, layout: SensorLayout) -> list[int]:
    """Return the indices of the rows, or columns, of the cells, ascending."""
    on = cells // layout.cols % layout.rows if kind == "row" else cells % layout.cols
    numbers: list[int] = np.unique(on).tolist()
    return numbers


def _named(kind: LineKind, numbers: Sequence[int]) -> str:
    """Return lines in words, as "row 1" or "rows 1, 3"."""
    return f"{kind}{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"
