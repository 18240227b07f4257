"""Fault injection: changes recordings to what the converter would report, with one law for each
kind of fault.

:mod:`diagnostics.simulation.circuit` shows where these laws hold and where a real array reads
something else.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.faults import Fault, FaultKind, KindName
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import LIGHT
from diagnostics.wiring import Line

# Defaults of ``Fault.value``, as shares of full scale, and as they are.
_SHARES = {
    FaultKind.SHORT: 1.0,
    FaultKind.NOISY: 0.05,  # standard deviation of the added noise
    FaultKind.DRIFT: 0.01,  # offset gained per second
    FaultKind.FLOATING: 0.2,  # range of the movement
    FaultKind.CLAMPED: 0.1,  # highest reading
}
_NUMBERS = {
    FaultKind.LATE: 10,  # frames
    FaultKind.WEAK: 0.35,  # share of the load that is left
}
_PERIODS = (12.0, 100.0)  # FLOATING: frames of one swing, drawn between these
# INTERMITTENT: probability per frame that a closed contact opens, and that an open one closes.
_OPENS = 0.2
_CLOSES = 0.4

Cells = NDArray[np.intp]
Floats = NDArray[np.float64]


def inject(
    recording: ArrayLike,
    faults: Iterable[Fault | int],
    layout: SensorLayout,
    *,
    seed: int | None = None,
    dither: float = 0.0,
    until: int | None = None,
    gain: float = 0.0,
) -> Floats:
    """Return a copy of ``recording`` with ``faults`` injected, each from its onset on.

    Faults are applied in order; every one reads the healthy recording, so an alias copies what the
    other cell would have read without faults. See ``Fault.value`` for its meaning by kind.

    Args:
        recording: ``[T, D]`` or ``[T, pads, rows, cols]``, in the layout's unit.
        faults: root causes, or cells, as a FaultSet holds them: these are open. Empty leaves the
            values as they are.
        layout: the array.
        seed: for the kinds that draw (INTERMITTENT, NOISY, FLOATING) and for dither; None draws
            anew each time.
        dither: noise of the converter on OPEN, SHORT and STUCK cells: uniform within +- this share
            of full scale.
        until: the faults end before this frame; None: they last.
        gain: change of the gain of a DRIFT cell per second, as a share of its reading, in addition
            to its offset.

    Returns:
        float64 ``[T, D]``; faulty readings lie within 0..full_scale, all others are unchanged, bit
        for bit. Missing readings (NaN) stay missing.

    Raises:
        ValueError: a fault names a cell that the layout does not have, or a STUCK fault has no
            value; ``until`` is negative.
    """
    if until is not None and until < 0:
        raise ValueError(f"until is the first frame after the faults, 0 or more; got {until}")
    healthy = layout.check_recording(recording)
    out = healthy.copy()
    rng = np.random.default_rng(seed)
    for given in faults:
        fault = given if isinstance(given, Fault) else Fault(FaultKind.OPEN, (given,))
        if fault.cells[-1] >= layout.n_cells:
            raise ValueError(
                f"the fault names cell {fault.cells[-1]}, but the layout has {layout.n_cells}"
                " cells, numbered from 0"
            )
        while_faulty = slice(fault.onset or 0, until)
        cells = np.array(fault.cells)
        seen = healthy[while_faulty]
        faulty = np.clip(
            _faulty_readings(fault, cells, seen, layout, rng, dither, gain), 0.0, layout.full_scale
        )
        out[while_faulty, cells] = np.where(np.isnan(seen[:, cells]), np.nan, faulty)
    return out


def _faulty_readings(
    fault: Fault,
    cells: Cells,
    healthy: Floats,  # [t, D], while the fault lasts
    layout: SensorLayout,
    rng: np.random.Generator,
    dither: float,
    gain: float,
) -> Floats:
    """Return what ``cells`` read under ``fault``, ``[t, len(cells)]``."""
    own = healthy[:, cells]
    full_scale = layout.full_scale
    value = fault.value
    if value is None:
        value = _SHARES.get(fault.kind, 0.0) * full_scale + _NUMBERS.get(fault.kind, 0.0)
    match fault.kind:
        case FaultKind.OPEN | FaultKind.SHORT | FaultKind.STUCK:
            if fault.kind is FaultKind.STUCK and fault.value is None:
                raise ValueError("a STUCK fault needs a value: what do its cells read?")
            return value + dither * full_scale * rng.uniform(-1.0, 1.0, own.shape)
        case FaultKind.ALIAS:
            partners = _bridge_partners(fault, cells, layout)
            sources = _alias_sources(fault, cells, layout) if partners is None else partners
            # Where nothing is connected, no current flows.
            others: Floats = np.where(sources >= 0, healthy[:, np.maximum(sources, 0)], 0.0)
            # Two cells in parallel: their conductances add, and so do their forces.
            return others if partners is None else own + others
        case FaultKind.INTERMITTENT:
            # One contact serves all the cells of the fault: they blink together, each only while it
            # is loaded.
            closed = _blinking(len(own), rng)[:, None]
            return np.where(closed | ~(own > LIGHT * full_scale), own, value)
        case FaultKind.NOISY:
            return own + rng.normal(0.0, value, own.shape)
        case FaultKind.DRIFT:
            frames = np.arange(1, len(own) + 1)[:, None]
            drifted: Floats = (
                own * (1.0 + gain / layout.rate * frames) + value / layout.rate * frames
            )
            return drifted
        case FaultKind.FLOATING:
            swing = value * _swinging(own.shape, rng)
            floating: Floats = np.fmin.reduce(own, initial=np.inf) + swing
            return floating
        case FaultKind.LATE:
            return own[np.maximum(np.arange(len(own)) - int(value), 0)]
        case FaultKind.COPY:
            return _copied(fault, cells, healthy, layout)
        case FaultKind.CLAMPED:
            return np.minimum(own, value)
        case FaultKind.WEAK:
            lowest = np.fmin.reduce(own, initial=np.inf)
            weakened: Floats = lowest + value * (own - lowest)
            return weakened


def _swinging(shape: tuple[int, ...], rng: np.random.Generator) -> Floats:
    """Return a sine from 0 to 1 for each cell, ``[t, cells]``, each with a period and a phase of
    its own."""
    period = rng.uniform(*_PERIODS, shape[1])
    phase = rng.uniform(0.0, 1.0, shape[1])
    turns = np.arange(shape[0])[:, None] / period + phase
    swing: Floats = (1.0 + np.sin(2 * np.pi * turns)) / 2
    return swing


def _copied(fault: Fault, cells: Cells, healthy: Floats, layout: SensorLayout) -> Floats:
    """Return what the cells of a COPY fault read, ``[t, cells]``."""
    if fault.value is not None:
        # IndexError names a cell that is not there
        source = layout.cell(*layout.position(int(fault.value)))
        return np.repeat(healthy[:, [source]], len(cells), axis=1)
    copied = healthy[:, cells].copy()
    for i, cell in enumerate(cells.tolist()):
        beside = layout.beside[cell]
        beside = beside[beside >= 0]
        if len(beside):
            copied[:, i] = healthy[:, beside].mean(axis=1)
    return copied


def _alias_sources(fault: Fault, cells: Cells, layout: SensorLayout) -> Cells:
    """Return the cell that each of ``cells`` reads instead of itself; -1: an address with nothing
    connected."""
    line = fault.line
    if fault.value is None:
        raise ValueError(
            "an ALIAS fault needs a value: the bit's level, or the row, column or cell read instead"
        )
    value = int(fault.value)
    if line is None:
        # IndexError names a cell that is not there
        return np.full(len(cells), layout.cell(*layout.position(value)))
    if line.kind in ("row_address", "column_address"):
        moved, sources = layout.misaddressed(line, value)
        where = dict(zip(moved.tolist(), sources.tolist(), strict=True))
        return np.array([where.get(c, c) for c in cells.tolist()])
    positions = [layout.position(c) for c in cells.tolist()]
    if line.kind == "row":
        return np.array([layout.cell(pad, value, col) for pad, _, col in positions])
    return np.array([layout.cell(pad, row, value) for pad, row, _ in positions])


def _bridge_partners(fault: Fault, cells: Cells, layout: SensorLayout) -> Cells | None:
    """Return the cell that each of ``cells`` is bridged with; -1: an absent one. None: the alias is
    not a bridge.

    A bridge names the cells of both lines; a line that reads another names only its own.
    """
    line = fault.line
    if line is None or line.kind not in ("row", "column") or fault.value is None:
        return None
    index = int(fault.value)
    size = layout.rows if line.kind == "row" else layout.cols
    if index == line.index or not 0 <= index < size:
        return None
    ours = set(layout.cells_on(line).tolist())
    theirs = set(layout.cells_on(Line(line.pad, line.kind, index)).tolist())
    if not theirs or not theirs <= set(fault.cells) <= ours | theirs:
        return None
    step = (index - line.index) * (layout.cols if line.kind == "row" else 1)
    partners = np.where(np.isin(cells, list(theirs)), cells - step, cells + step)
    return np.where(layout.is_cell[partners], partners, -1)


def _blinking(frames: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return ``[frames]`` bool, True while a loose contact is closed: a two-state Markov chain,
    closed at first."""
    state = True
    closed = []
    for draw in rng.random(frames).tolist():
        state = draw >= _OPENS if state else draw < _CLOSES
        closed.append(state)
    return np.array(closed, bool)


def line_fault(
    layout: SensorLayout,
    line: Line,
    kind: FaultKind | KindName,
    *,
    value: float | None = None,
    onset: int | None = None,
    break_at: int | None = None,
    driven_from: Literal["first", "last"] = "first",
) -> Fault:
    """Return the fault of a wire: every cell it serves, or for a stuck address bit those that it
    misreads.

    Args:
        layout: the array.
        line: the wire.
        kind: kind of the fault, or its name.
        value: as in :class:`~diagnostics.faults.Fault`.
        onset: first faulty frame; None: from the first frame on.
        break_at: a row or column is broken between positions ``break_at - 1`` and ``break_at``
            along it (a row's positions are column numbers, a column's are row numbers): the cells
            beyond are faulty, the others work. None: the whole wire.
        driven_from: the end at which the wire is connected, position 0 or the last one.

    Raises:
        ValueError: ``break_at`` out of range or on a wire that is no row or column, an alias of
            part of a wire, no cell behind the break.
        IndexError: the layout has no such wire.
    """
    kind = FaultKind(kind)
    state = str(kind)
    if break_at is not None:
        cells, where = _beyond(layout, line, kind, break_at, driven_from)
        state += f" {where}"
    elif kind is FaultKind.ALIAS and line.kind in ("row_address", "column_address"):
        value = int(value or 0)
        state = "stuck"
        cells, _ = layout.misaddressed(line, value)
    else:
        cells = layout.cells_on(line)
    return Fault(
        kind,
        tuple(cells.tolist()),
        line=line,
        value=value,
        onset=onset,
        reason=f"{line} is {state}",
    )


def _beyond(
    layout: SensorLayout, line: Line, kind: FaultKind, break_at: int, driven_from: str
) -> tuple[Cells, str]:
    """Return the cells behind a break, and where these are, as text."""
    if line.kind not in ("row", "column"):
        raise ValueError(f"break_at is a position along a row or column; {line} has no positions")
    if kind is FaultKind.ALIAS:
        raise ValueError(
            "break_at goes with a fault of the cells behind the break, not with an alias of a whole"
            " wire"
        )
    along, positions = ("column", layout.cols) if line.kind == "row" else ("row", layout.rows)
    if not 0 <= break_at <= positions:
        raise ValueError(
            f"break_at {break_at} is outside {line}: use 0 to {positions}, counted in {along}s"
        )
    if driven_from not in ("first", "last"):
        raise ValueError(
            f"driven_from must be 'first' or 'last', the connected end; got {driven_from!r}"
        )
    cells = layout.cells_on(line)
    place = cells % layout.cols if line.kind == "row" else cells // layout.cols % layout.rows
    beyond = place >= break_at if driven_from == "first" else place < break_at
    if not beyond.any():
        raise ValueError(
            f"{line} has no cell behind a break at {break_at} when driven from its {driven_from}"
            " position: move the break, or drive the wire from the other end"
        )
    return cells[beyond], (
        f"from {along} {break_at} on" if driven_from == "first" else f"up to {along} {break_at - 1}"
    )


def bridge(layout: SensorLayout, line: Line, *, onset: int | None = None) -> Fault:
    """Return the fault of a row or column that touches the next one: an ALIAS with the cells of
    both.

    In :func:`inject` both cells of a pair read the sum of their forces, clipped at full scale:
    their conductances are in parallel. That holds where lines float while they are not selected.
    Where a switch like the driver's holds the other line at ground, a real array reads their mean
    (:mod:`diagnostics.simulation.circuit`).

    Raises:
        ValueError: the wire is no row or column, or there is no next one.
        IndexError: the layout has no such wire.
    """
    if line.kind not in ("row", "column"):
        raise ValueError(f"rows and columns have neighbours that they can touch; {line} has none")
    cells = layout.cells_on(line)
    if line.index + 1 >= (layout.rows if line.kind == "row" else layout.cols):
        raise ValueError(
            f"{line} is the last {line.kind}: name the one before it, to bridge the two"
        )
    cells = np.concatenate([cells, layout.cells_on(Line(line.pad, line.kind, line.index + 1))])
    return Fault(
        FaultKind.ALIAS,
        tuple(cells.tolist()),
        line=line,
        value=line.index + 1,
        onset=onset,
        reason=f"{line} touches {line.kind} {line.index + 1}",
    )


def freeze_stream(recording: ArrayLike, onset: int, until: int | None = None) -> Floats:
    """Return a copy of ``recording`` ``[T, ...]`` that repeats frame ``onset`` to its end, or
    before frame ``until``.

    A transport fault: one frame is repeated, and no cell is broken.

    Raises:
        ValueError: ``onset`` or ``until`` is negative.
    """
    if onset < 0 or (until is not None and until < 0):
        raise ValueError(f"frames are numbered from 0; got onset {onset} and until {until}")
    out = np.array(recording, dtype=np.float64)
    out[onset:until] = out[onset : onset + 1]
    return out


def lose_frames(recording: ArrayLike, share: float, *, seed: int | None = None) -> Floats:
    """Return a copy of ``recording`` ``[T, ...]`` in which randomly chosen frames are missing: all
    NaN.

    A transport fault: lost packets. ``share`` of the frames are lost, 0..1, rounded to whole
    frames; ``seed`` chooses them, None draws anew each time.

    Raises:
        ValueError: ``share`` is outside 0..1.
    """
    if not 0 <= share <= 1:
        raise ValueError(f"share is the part of the frames that is lost, 0..1; got {share!r}")
    out = np.array(recording, dtype=np.float64)
    out[np.random.default_rng(seed).permutation(len(out))[: round(share * len(out))]] = np.nan
    return out
