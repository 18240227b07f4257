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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diagnostics.decision.line_cover import Cause, solve
from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import ANYWHERE, MAJORITY, SLIGHT, SUSPICIOUS
from diagnostics.wiring import LineKind, action, counted

# Of cells that move and are proved not to be alive.
REFUTED_KINDS = (
    FaultKind.FLOATING,
    FaultKind.INTERMITTENT,
    FaultKind.LATE,
    FaultKind.COPY,
    FaultKind.CLAMPED,
    FaultKind.WEAK,
)

_HELD = (FaultKind.OPEN, FaultKind.SHORT, FaultKind.STUCK)

# Faults of a wire that all cells on it show, touched or not.
_WITHOUT_CONTACT = (*_HELD, FaultKind.FLOATING)

# Those that a wire has which fails now and then, as one that opens under load.
OF_WIRES = REFUTED_KINDS[:2]

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CellFindings:
    """Findings about each cell, arrays ``[D]``; masks are bool.

    Attributes:
        faulty: certainly faulty cells.
        alive: cells that move as no dead cell does.
        silent: cells that deliver no reading, or no longer do.
        rests: constant cells at their baseline.
        full: constant cells at full scale, and not at their baseline.
        zero: constant cells at 0, and not at their baseline; None for sensors that rest low.
        typical: float, reading that is told of constant cells; None: ``value``.
        intermittent, noisy, drifting: cells that move, but wrongly.
        gain: float, gain relative to the reference of cells with a changed gain; NaN: others.
        value: float, reading (not load) of constant cells, and reading to which intermittent cells
            blink; NaN: none.
        since: int, number of the first frame of the fault.
        probability: float, P(faulty).
        weight: float, log likelihood ratio faulty : healthy.
        events: int, number of events that tested the cell, or number of its blinks.
        known: cells that were dead in the reference already.
        refuted: int, number in ``REFUTED_KINDS`` of cells that move and are proved not to be alive;
            -1: others.
        unsure: int, the same of cells that may have one of the ``OF_WIRES``; -1: others.
        wire: int, number of the proven wire of such a cell, from 0; -1: others.
        of_wire: float, P(this wire fails).
        share: float, of the contacts in which such a cell was dead.
        as_one: bool, cells that read as one with those of their wire, while it fails.
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
    events: NDArray[np.intp]
    known: Mask
    refuted: NDArray[np.intp]
    unsure: NDArray[np.intp]
    wire: NDArray[np.intp]
    of_wire: Floats
    share: Floats
    as_one: Mask
    zero: Mask | None = None
    typical: Floats | None = None

    def of(self, cells: NDArray[np.intp]) -> CellFindings:
        """Return the findings in the order of ``cells``."""
        return replace(
            self,
            **{name: values[cells] for name, values in vars(self).items() if values is not None},
        )

    def without(self, cells: Mask) -> CellFindings:
        """Return the findings without those about some cells, bool ``[D]``, which have readings but
        were not tested."""
        masks = ("faulty", "alive", "rests", "full", "zero", "intermittent", "noisy", "drifting")
        numbers = ("refuted", "unsure", "wire")
        found = {name: getattr(self, name) for name in (*masks, *numbers)}
        return replace(
            self,
            probability=np.where(cells, np.minimum(self.probability, MAJORITY), self.probability),
            **{name: found[name] & ~cells for name in masks if found[name] is not None},
            **{name: np.where(cells, -1, found[name]) for name in numbers},
        )


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
    proven = [
        _fault(kind, value, cause, found, layout) for kind, value, cause in causes if cause.proven
    ]
    faults = _addresses_of_dead_rows([*aliases, *proven], found, layout)
    possible = [
        _fault(kind, value, cause, found, layout)
        for kind, value, cause in causes
        if not cause.proven
    ]
    return tuple(sorted(faults, key=lambda fault: (-len(fault.cells), fault.cells))), tuple(
        possible
    )


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
        explained = _explained(
            faulty & ~aliased, consistent & ~aliased, contradicting, found, layout, common
        )
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
    explained = _explained(
        faulty & ~aliased, consistent & ~aliased, contradicting, found, layout, common
    )
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
    found: CellFindings,
    layout: SensorLayout,
    common: float,
) -> tuple[Cause, ...]:
    """Return the causes of cells with the same fault; see ``solve``.

    Cells that were dead in the reference are no evidence for a wire that broke later, though they
    may lie on it. A wire that was broken in the reference explains such cells only.
    """
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
            low = SLIGHT * layout.full_scale
            high = (1 - SLIGHT) * layout.full_scale
            kind = (
                FaultKind.SHORT
                if value >= high
                else FaultKind.OPEN
                if value <= low
                else FaultKind.STUCK
            )
        if kind in (FaultKind.OPEN, FaultKind.SHORT, FaultKind.STUCK):
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
    fault = replace(fault, reason=_reason(fault, cause, found, layout))
    if cause.proven and cause.line is not None and cause.line.kind in ("row", "column"):
        fault = replace(fault, alternatives=_alternatives(fault, cause, found, layout))
    return fault


def _middle(readings: Floats) -> float:
    """Return the median; of whole numbers the lower one of the two in the middle, a reading."""
    if (readings == np.rint(readings)).all():
        return float(np.sort(readings)[(len(readings) - 1) // 2])
    return float(np.median(readings))


_DOING = {
    FaultKind.INTERMITTENT: "blinks between its load and {value:.4g} {unit}",
    FaultKind.NOISY: "is far noisier than a healthy cell under the same load",
    FaultKind.DRIFT: "moves, but never returns to its baseline",
    FaultKind.FLOATING: "moves by itself, whatever the cells around it read",
    FaultKind.LATE: "follows the cells around it about {value:.0f} frames late",
    FaultKind.WEAK: "reads {value:.2g} times what it should",
    FaultKind.CLAMPED: (
        "never reads more than {value:.4g} {unit}, however much the cells around it are loaded"
    ),
}


_CHECKS = {
    FaultKind.OPEN: "its solder joint and trace",
    FaultKind.INTERMITTENT: "its solder joint and trace for a loose contact",
    FaultKind.NOISY: "its connection and shielding",
    FaultKind.DRIFT: "the cell for wear or dirt, and calibrate it again",
    FaultKind.FLOATING: "its trace for a break: an open input picks up what is around it",
    FaultKind.LATE: "the converter and the buffer that it is read from",
    FaultKind.COPY: "the multiplexer and the order in which cells are read",
    FaultKind.WEAK: "the cell for wear or dirt, and calibrate it again",
    FaultKind.CLAMPED: "its amplifier and supply",
}


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
    if fault.kind in _DOING:
        return _DOING[fault.kind].format(value=fault.value or 0.0, unit=layout.unit)
    if found.silent[fault.cells[0]]:
        return "delivers no reading"
    return f"reads {fault.value or 0.0:.4g} {layout.unit}"


def _reason(fault: Fault, cause: Cause, found: CellFindings, layout: SensorLayout) -> str:
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
            "" if fault.kind in _DOING or found.silent[fault.cells[0]] else ", whatever touches it"
        )
        check = _CHECKS.get(fault.kind, "the cell and its traces for a short circuit")
        return (
            f"{layout.place(fault.cells[0])} {fault.kind.verb()}: it {does}{since}{whatever}"
            f"{already}; check {check}"
        )
    inferred = len(cause.cells) - len(cause.seen)
    are = "is" if inferred == 1 else "are"
    if fault.line.kind in ("position", "bus", "group"):
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


def _alternatives(
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
