"""Injects faults into recordings, as the converter would report them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import Line, SensorLayout

# What a fault does when it does not say so itself, in shares of full scale.
_NOISE = 0.05  # NOISY: standard deviation of the added noise
_DRIFT = 0.01  # DRIFT: offset gained per second
_LOADED = 0.05  # INTERMITTENT: a loose contact blinks while its cell carries more than this
# INTERMITTENT: chance per frame that a closed contact opens and that an open one closes again.
_OPENS, _CLOSES = 0.2, 0.4


def inject(
    recording: ArrayLike, faults: Iterable[Fault], layout: SensorLayout, *, seed: int | None = None, dither: float = 0.0
) -> NDArray[np.float64]:
    """Return a copy of ``recording`` in which ``faults`` happen, each from its onset on.

    Faults are applied in order; every one reads the healthy recording, so an alias copies what the other cell would
    have read without faults. What ``Fault.value`` means for each kind is written there.

    Args:
        recording: ``[T, D]`` or ``[T, pads, rows, cols]``, in the layout's unit.
        faults: root causes; empty leaves the values as they are.
        layout: the array.
        seed: for the kinds that draw (INTERMITTENT, NOISY) and for dither; None draws anew each time.
        dither: the converter's unrest on OPEN, SHORT and STUCK cells: uniform within +- this share of full scale.

    Returns:
        float64 ``[T, D]``; faulty readings lie within 0..full_scale, all others are untouched, bit for bit. Missing
        readings (NaN) stay missing.

    Raises:
        ValueError: a fault names a cell that the layout does not have, or a STUCK fault has no value.
    """
    healthy = layout.check_recording(recording)
    out = healthy.copy()
    rng = np.random.default_rng(seed)
    for fault in faults:
        if fault.cells[-1] >= layout.n_cells:
            raise ValueError(
                f"the fault names cell {fault.cells[-1]}, but the layout has {layout.n_cells} cells, numbered from 0"
            )
        start = fault.onset or 0
        cells = np.array(fault.cells)
        faulty = np.clip(_faulty_readings(fault, cells, healthy[start:], layout, rng, dither), 0.0, layout.full_scale)
        out[start:, cells] = np.where(np.isnan(healthy[start:, cells]), np.nan, faulty)
    return out


def _faulty_readings(
    fault: Fault,
    cells: NDArray[np.intp],
    healthy: NDArray[np.float64],  # [t, D], from the onset on
    layout: SensorLayout,
    rng: np.random.Generator,
    dither: float,
) -> NDArray[np.float64]:
    """Return what ``cells`` read under ``fault``, ``[t, len(cells)]``."""
    own = healthy[:, cells]
    full_scale = layout.full_scale
    match fault.kind:
        case FaultKind.OPEN | FaultKind.SHORT | FaultKind.STUCK:
            value = fault.value
            if value is None:
                if fault.kind is FaultKind.STUCK:
                    raise ValueError("a STUCK fault needs a value: what do its cells read?")
                value = full_scale if fault.kind is FaultKind.SHORT else 0.0
            return value + dither * full_scale * rng.uniform(-1.0, 1.0, own.shape)
        case FaultKind.ALIAS:
            sources = _alias_sources(fault, cells, layout)
            # Nothing is connected to that address: no current flows.
            return np.where(sources >= 0, healthy[:, np.maximum(sources, 0)], 0.0)
        case FaultKind.INTERMITTENT:
            # One contact serves all the cells of the fault: they blink together, each only while it is loaded.
            closed = _blinking(len(own), rng)[:, None]
            return np.where(closed | ~(own > _LOADED * full_scale), own, fault.value or 0.0)
        case FaultKind.NOISY:
            sigma = _NOISE * full_scale if fault.value is None else fault.value
            return own + rng.normal(0.0, sigma, own.shape)
        case FaultKind.DRIFT:
            rate = _DRIFT * full_scale if fault.value is None else fault.value
            return own + rate / layout.rate * np.arange(1, len(own) + 1)[:, None]


def _alias_sources(fault: Fault, cells: NDArray[np.intp], layout: SensorLayout) -> NDArray[np.intp]:
    """Return which cell each of ``cells`` reads instead of itself; -1: an address with nothing connected."""
    line = fault.line
    if fault.value is None:
        raise ValueError("an ALIAS fault needs a value: the bit's level, or the row, column or cell read instead")
    value = int(fault.value)
    if line is None:
        return np.full(len(cells), layout.cell(*layout.position(value)))  # IndexError names a cell that is not there
    if line.kind in ("row_address", "column_address"):
        moved, sources = layout.misaddressed(line, value)
        where = dict(zip(moved.tolist(), sources.tolist(), strict=True))
        return np.array([where.get(c, c) for c in cells.tolist()])
    positions = [layout.position(c) for c in cells.tolist()]
    if line.kind == "row":
        return np.array([layout.cell(pad, value, col) for pad, _, col in positions])
    return np.array([layout.cell(pad, row, value) for pad, row, _ in positions])


def _blinking(frames: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return ``[frames]`` bool, True while a loose contact is closed: a two-state Markov chain, closed at first."""
    draws = rng.random(frames)
    closed = np.empty(frames, bool)
    state = True
    for t in range(frames):
        state = draws[t] >= _OPENS if state else draws[t] < _CLOSES
        closed[t] = state
    return closed


def line_fault(
    layout: SensorLayout, line: Line, kind: FaultKind, *, value: float | None = None, onset: int | None = None
) -> Fault:
    """Return the fault of a whole wire: every cell it serves, or for a stuck address bit those that it misreads."""
    if kind is FaultKind.ALIAS and line.kind in ("row_address", "column_address"):
        cells, _ = layout.misaddressed(line, int(value or 0))
        return Fault(
            kind, tuple(cells.tolist()), line=line, value=int(value or 0), onset=onset, reason=f"{line} is stuck"
        )
    return Fault(
        kind, tuple(layout.cells_on(line).tolist()), line=line, value=value, onset=onset, reason=f"{line} is {kind}"
    )
