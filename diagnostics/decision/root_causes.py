"""Root causes: which fault, on which wire or cell, since when, said in one plain sentence."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.decision.line_cover import Cause, solve
from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import Line, LineKind, SensorLayout

if TYPE_CHECKING:
    from diagnostics.decision.address_aliasing import Aliasing

_SAME_VALUE = 0.02  # of full scale: stuck cells this near to each other may share a cause
_SAME_KIND = 1 / 3  # of the single faults: open, short or stuck
_LEADING = 2.5  # log ratio of cells that tell when a wire broke, where none is faulty beyond doubt

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CellFindings:
    """What is known of the cells, arrays ``[D]`` all.

    Attributes:
        faulty: those beyond doubt.
        alive: those that move, as no dead cell does.
        silent: those that deliver no reading, or none any more.
        rests: those that read what an untouched cell reads, and are still; full: the same with full scale.
        intermittent, noisy, drifting: those that move, but wrongly.
        gain: how many times their gain in the reference those read that drift in that; NaN: all others.
        value: what still cells read, and what blinking ones blink to; NaN: nothing.
        since: number of the first frame of what speaks for a fault.
        probability: P(faulty).
        weight: log likelihood ratio faulty : healthy.
        doubt: how far a cell that is not beyond doubt is from being so, 0 to 1, see ``solve``.
        touches: how many touches tested the cell, or how often it blinked.
        known: those that were dead in the reference already.
    """

    faulty: Mask
    alive: Mask
    silent: Mask
    rests: Mask
    full: Mask
    intermittent: Mask
    noisy: Mask
    drifting: Mask
    gain: Floats
    value: Floats
    since: NDArray[np.intp]
    probability: Floats
    weight: Floats
    doubt: Floats
    events: NDArray[np.intp]
    known: Mask


def root_causes(found: CellFindings, find_aliasing: Sequence[Aliasing], layout: SensorLayout) -> tuple[Fault, ...]:
    """Name the root causes of faulty cells, one fault each, the biggest first: that is where a technician starts."""
    aliased = np.zeros(layout.n_cells, bool)
    for aliasing in find_aliasing:
        aliased[list(aliasing.cells)] = True
    faults = [_aliased(aliasing, layout) for aliasing in find_aliasing]
    causes = _causes(found, aliased, layout, 0.0)
    singles = sum(cause.line is None for _, _, cause in causes)
    if 0 < singles < len(causes):
        # Where many cells fail one by one, some will be neighbours at the end of a wire: look at the wires once more.
        common = _SAME_KIND * singles / int((found.alive | found.faulty).sum())
        causes = _causes(found, aliased, layout, common)
    faults += [_fault(kind, value, cause, found, layout) for kind, value, cause in causes]
    faults = _addresses_of_dead_rows(faults, found, layout)
    return tuple(sorted(faults, key=lambda fault: (-len(fault.cells), fault.cells)))


def _causes(
    found: CellFindings, aliased: Mask, layout: SensorLayout, common: float
) -> list[tuple[FaultKind, float | None, Cause]]:
    """Return kind, value and cause of each fault; ``common``: the share of single faults of one kind, at least."""
    causes = []
    for kind, faulty, matching, value in _alike(found, layout.full_scale):
        # A live cell contradicts a broken wire; so does one that is faulty in another way, or reads another value.
        contradicting = found.alive | (found.faulty & ~matching) | aliased
        if kind in (FaultKind.OPEN, FaultKind.SHORT, FaultKind.STUCK):
            # What a cell did before the others broke says nothing of the wire.
            leading = faulty if faulty.any() else matching & (found.weight >= _LEADING)
            begun = int(np.median(found.since[leading])) if leading.any() else 0
            contradicting &= ~(matching & ~faulty & (found.since <= begun) & (begun > 0))
            contradicting |= ~matching & ~found.silent
        explained = _explained(faulty & ~aliased, matching & ~aliased, contradicting, found, layout, common)
        causes += [(kind, value, cause) for cause in explained]
    return causes


def _explained(
    faulty: Mask, matching: Mask, contradicting: Mask, found: CellFindings, layout: SensorLayout, common: float
) -> tuple[Cause, ...]:
    """Explain cells that misbehave in the same way; see ``solve``.

    Those that were dead in the reference already bear no witness of a wire that has broken since, though it may serve
    them as well; and of one that was broken then, all cells were dead.
    """
    known = found.known & faulty

    def of(faulty: Mask, matching: Mask, contradicting: Mask) -> tuple[Cause, ...]:
        return solve(faulty, matching, contradicting, found.weight, found.doubt, layout, common)

    causes = of(faulty & ~known, matching & ~known, contradicting & ~known)
    known[[cell for cause in causes for cell in cause.cells]] = False
    return causes + of(known, known, ~known)


def _alike(found: CellFindings, full_scale: float) -> list[tuple[FaultKind, Mask, Mask, float | None]]:
    """Return (kind, faulty, all that could be faulty alike, value) of each group that could share a cause."""
    faulty, value = found.faulty, found.value
    moving = found.intermittent | found.noisy | found.drifting
    still = faulty & ~found.silent & ~moving
    of_gain = found.drifting & np.isfinite(found.gain)
    of_offset = found.drifting & ~of_gain
    groups: list[tuple[FaultKind, Mask, Mask, float | None]] = [
        (FaultKind.OPEN, faulty & found.silent, found.silent, None),
        (FaultKind.OPEN, still & found.rests, found.rests, None),
        (FaultKind.SHORT, still & found.full, found.full, full_scale),
        (FaultKind.INTERMITTENT, faulty & found.intermittent, found.intermittent, None),
        (FaultKind.NOISY, faulty & found.noisy, found.noisy, None),
        *((FaultKind.DRIFT, faulty & drifting, drifting, None) for drifting in (of_offset, of_gain)),
    ]
    between = np.flatnonzero(still & ~found.rests & ~found.full)
    between = between[np.argsort(value[between])]
    for cells in np.split(between, np.flatnonzero(np.diff(value[between]) > _SAME_VALUE * full_scale) + 1):
        if len(cells):
            mask = np.zeros(len(faulty), bool)
            mask[cells] = True
            groups.append((FaultKind.STUCK, mask, mask, float(np.median(value[cells]))))
    return [group for group in groups if group[2].any()]


def _fault(kind: FaultKind, value: float | None, cause: Cause, found: CellFindings, layout: SensorLayout) -> Fault:
    seen = list(cause.seen)
    if kind in (FaultKind.STUCK, FaultKind.OPEN, FaultKind.INTERMITTENT) and not found.silent[seen[0]]:
        value = float(np.median(found.value[seen]))
    start = int(np.median(found.since[seen]))
    fault = Fault(
        kind,
        cause.cells,
        line=cause.line,
        value=value,
        onset=start if start > 0 else None,
        probability=float(found.probability[cause.cells[0]]) if cause.line is None else cause.probability,
        evidence=int(found.events[seen].sum()),
    )
    fault = replace(fault, reason=_reason(fault, cause, found, layout))
    if cause.line is not None and cause.line.kind in ("row", "column"):
        fault = replace(fault, alternatives=_alternatives(fault, cause, found, layout))
    return fault


def _aliased(a: Aliasing, layout: SensorLayout) -> Fault:
    across = "row" if a.line.kind in ("row", "row_address") else "column"
    if a.line.kind in ("row", "column"):
        other = Line(a.line.pad, a.line.kind, a.value)
        text = f"{a.line} and {across} {a.value} are bridged: both always read the same"
        check = f"the solder and the flex cable between {across}s {a.line.index} and {other.index}"
    else:
        copies = ", ".join(f"{across} {i} reads {f'{across} {j}' if j >= 0 else 'nothing'}" for i, j in a.copies)
        text = f"{a.line} is stuck at {a.value}: {copies}"
        check = f"the {across} multiplexer and its address wires"
    since = "" if a.onset == 0 else f" from frame {a.onset} on ({a.onset / layout.rate:.1f} s)"
    reason = f"{text}{since}; {a.witnesses} times they agreed on a moving load; check {check}"
    return Fault(
        FaultKind.ALIAS,
        a.cells,
        line=a.line,
        value=a.value,
        onset=a.onset or None,
        probability=1.0 - 0.5 ** min(a.witnesses, 30),
        reason=reason,
        evidence=a.witnesses,
        alternatives=a.alternatives,
    )


_DOING = {
    FaultKind.INTERMITTENT: "blinks between its load and {value:.4g} {unit}",
    FaultKind.NOISY: "is far noisier than a healthy cell under the same load",
    FaultKind.DRIFT: "moves, but never comes back to rest",
}


def _does(fault: Fault, found: CellFindings, layout: SensorLayout) -> str:
    gain = found.gain[list(fault.cells)]
    if fault.kind is FaultKind.DRIFT and np.isfinite(gain).any():
        return f"is loaded when the others are, but reads about {np.nanmedian(gain):.2g} times what it should"
    if fault.kind in _DOING:
        return _DOING[fault.kind].format(value=fault.value or 0.0, unit=layout.unit)
    if found.silent[fault.cells[0]]:
        return "delivers no reading"
    return f"reads {fault.value or 0.0:.4g} {layout.unit}"


def _reason(fault: Fault, cause: Cause, found: CellFindings, layout: SensorLayout) -> str:
    """Say what was seen and what to check."""
    does = _does(fault, found, layout)
    already = ", and did so in the reference already" if found.known[list(cause.seen)].all() else ""
    since = "" if fault.onset is None else f" from frame {fault.onset} on ({fault.onset / layout.rate:.1f} s)"
    if fault.line is None:
        pad, row, column = layout.position(fault.cells[0])
        whatever = "" if fault.kind in _DOING else ", whatever touches it"
        return f"pad {pad}, row {row}, column {column} is {fault.kind}: it {does}{since}{whatever}{already}"
    inferred = len(cause.cells) - len(cause.seen)
    also = f"; {inferred} more, not tested, are inferred from the wire" if inferred else ""
    where = "" if cause.whole else _span(fault, layout)
    seen = f"each of {len(cause.seen)} cells on it {does}{since}{already}{also}"
    return f"{fault.line} is {fault.kind}{where}: {seen}; check {_wire(fault.line)}"


def _span(fault: Fault, layout: SensorLayout) -> str:
    """Say behind which point of its line a fault lies: " from column 5 on" or " up to column 4"."""
    assert fault.line is not None
    across, name = (2, "column") if fault.line.kind == "row" else (1, "row")
    dead = [layout.position(cell)[across] for cell in fault.cells]
    on_line = [layout.position(cell)[across] for cell in layout.cells_on(fault.line).tolist()]
    return f" from {name} {min(dead)} on" if max(dead) == max(on_line) else f" up to {name} {max(dead)}"


def _alternatives(fault: Fault, cause: Cause, found: CellFindings, layout: SensorLayout) -> tuple[str, ...]:
    """Say what else would look the same: the address of a dead line, or a break a little elsewhere."""
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
            others.append("a break one or more untested cells nearer to the live end")
    return tuple(others)


def _wire(line: Line) -> str:
    return (
        "the converter channel and its cable" if line.kind == "converter" else f"the {line.kind} wire and its address"
    )


def _addresses_of_dead_rows(faults: list[Fault], found: CellFindings, layout: SensorLayout) -> list[Fault]:
    """Put dead lines together that one stuck address bit would explain: it then reads lines that nothing touched."""
    open_lines = Counter((f.line.pad, f.line.kind) for f in faults if f.line and f.kind is FaultKind.OPEN)
    for line in layout.lines:
        if line.kind not in ("row_address", "column_address"):
            continue
        kind: LineKind = "row" if line.kind == "row_address" else "column"
        if open_lines[line.pad, kind] < 2:
            continue
        for level in (0, 1):
            cells, sources = layout.misaddressed(line, level)
            moved = _index(cells, kind, layout)
            dead = [
                f for f in faults
                if f.kind is FaultKind.OPEN and f.line is not None and (f.line.pad, f.line.kind) == (line.pad, kind)
                and f.line.index in moved and set(layout.cells_on(f.line).tolist()) == set(f.cells)
            ]  # fmt: skip
            # One broken bit is likelier than two broken wires; all the lines that it moves are dead, or never tested.
            if len(dead) < max(2, len(moved) / 2) or found.alive[[*cells, *sources[sources >= 0]]].any():
                continue
            reads = _index(sources[sources >= 0], kind, layout)
            instead = f"untouched {kind}s {', '.join(map(str, reads))}" if reads else f"addresses without a {kind}"
            named = ", ".join(map(str, moved))
            wires = ", ".join(str(f.line.index) for f in dead if f.line)
            text = f"{line} is stuck at {level}: {kind}s {named} read nothing, as {instead} would"
            merged = Fault(
                FaultKind.ALIAS,
                tuple(cells.tolist()),
                line=line,
                value=level,
                onset=max((f.onset or 0) for f in dead) or None,
                probability=min(f.probability or 0.0 for f in dead),
                reason=f"{text}; check the {kind} multiplexer and its address wires",
                evidence=sum(f.evidence or 0 for f in dead),
                alternatives=(f"the wires of {kind}s {wires} are open, each for itself",),
            )
            faults = [f for f in faults if f not in dead] + [merged]
    return faults


def _index(cells: NDArray[np.intp], kind: LineKind, layout: SensorLayout) -> list[int]:
    """Return the numbers of the rows, or columns, that cells lie on, ascending."""
    on = cells // layout.cols % layout.rows if kind == "row" else cells % layout.cols
    numbers: list[int] = np.unique(on).tolist()
    return numbers
