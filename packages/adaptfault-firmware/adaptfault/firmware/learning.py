"""Limits of the monitor for the microcontroller, from a fitted diagnosis and fault-free recordings.

The diagnosis brings the dither, the rest of each cell, and how often healthy frames repeat. The
recordings, one behind the other, bring the range of each cell, its predictors, and how many frames
its predictors moved in at most while it did not:

    confidence(j tells of i) = (pieces in which both move + a p) / (pieces in which j moves + a)
    stuck_after              = MARGIN x most frames + LEAST

with pieces of 8 frames, p the share of the pieces in which i moves, and a = 8. No two of the four
predictors of a cell share a row or column: one that is cut, or floats, is one predictor less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.firmware.counting import MISSING, PREDICTORS, TOP, CountingMonitor, Counts, Limits
from diagnostics import SelfDiagnosis, SensorLayout

MARGIN = 4.0
"""Times what the reference shows at most."""

LEAST = 128
"""Frames beside it."""

_PIECE = 8  # frames
_WEIGHS = 8.0  # pieces that the share of the cell itself is worth
_LOOKED_AT = 64  # cells that may be its predictors
_FEWEST = 8  # pieces in which a cell moves that is judged, or tells of others
_BEYOND = 0.1  # of full scale: outside of what the reference shows
_SILENT = 32  # fresh frames without a reading, at least
_STUCK = 32767  # stuck_after at most
_PATIENCE = 65534

Mask = NDArray[np.bool_]


def learn_limits(diagnoser: SelfDiagnosis, recordings: Sequence[ArrayLike]) -> Limits:
    """Return the limits of an array.

    Args:
        diagnoser: fitted to fault-free recordings.
        recordings: fault-free, ``[T, D]`` each, in the layout's unit and in time order.

    Raises:
        ValueError: it is not fitted, the array has several axes or rests in the middle, or the
            recordings do not fit it.
    """
    layout = diagnoser.layout
    reference = diagnoser.reference_
    if reference is None:
        raise ValueError("a monitor needs a diagnosis that is fitted to fault-free recordings")
    load = diagnoser.load_
    if layout.axes > 1 or (load is not None and load.direction == "middle"):
        raise ValueError(
            f"a monitor is for cells of one axis that rest at one end of their range; got {layout}"
        )
    frames = [layout.check_recording(one, "a reference recording") for one in recordings]
    if not sum(map(len, frames)):
        raise ValueError("no fault-free frames: expected recordings [T, D] with T >= 1")
    step = 0.0 if reference.noise is None else reference.noise.step
    rest = reference.scale.baseline
    if load is not None:
        rest = load.readings(rest, np.zeros(layout.n_cells, bool))
    per_unit = counts_per_unit(layout, step)
    known = Limits(
        per_unit=per_unit,
        dither=max(1, round(2 * reference.tolerance * per_unit)),
        near=max(1, round(reference.scale.near * per_unit)),
        patience=min(_PATIENCE, reference.repeats(layout).loaded),
        silent_after=_SILENT,
        rest=_clipped(rest * per_unit),
        lowest=np.full(layout.n_cells, -TOP, np.int16),
        highest=np.full(layout.n_cells, TOP, np.int16),
        stuck_after=np.zeros(layout.n_cells, np.uint16),
        predictors=np.zeros((layout.n_cells, PREDICTORS), np.uint16),
    )
    living = layout.is_cell & (reference.dead == 0)
    return from_recordings(known, [known.counts(one) for one in frames], layout, living)


def counts_per_unit(layout: SensorLayout, step: float) -> float:
    """Return counts of one unit: converter steps (``step``, 0: unknown), where they fit 15 bits."""
    finest = TOP / (2 * layout.full_scale)  # what is twice full scale is no reading
    return finest if step <= 0 else min(1 / step, finest)


def from_recordings(
    known: Limits, recordings: Sequence[Counts], layout: SensorLayout, living: Mask
) -> Limits:
    """Return limits with what fault-free recordings bring: ranges, predictors, and how long cells
    hold.

    Args:
        known: what the diagnosis brings.
        recordings: int16 ``[T, D]`` each.
        layout: of the array.
        living: bool ``[D]``, cells that work.
    """
    stream = np.concatenate(recordings)
    moves = _moves(known, stream)
    pieces = np.add.reduceat(moves, np.arange(0, len(moves), _PIECE), axis=0) > 0
    living = living & (pieces.sum(axis=0) >= _FEWEST)
    predictors, told = find_predictors(pieces, layout, living)
    limits = replace(known, predictors=predictors)
    most, silent = _most(limits, stream)
    after = np.minimum(MARGIN * most + LEAST, _STUCK)
    lowest, highest = _ranges(limits, stream, layout, living)
    return replace(
        limits,
        silent_after=min(_PATIENCE, max(_SILENT, 2 * silent)),
        lowest=lowest,
        highest=highest,
        stuck_after=np.where(told, after, 0).astype(np.uint16),
    )


def _ranges(
    limits: Limits, stream: Counts, layout: SensorLayout, living: Mask
) -> tuple[Counts, Counts]:
    """Return the lowest and the highest count of each healthy cell, int16 ``[D]``: what it reads at
    least, and what any living cell reads at most; a held load may be new to a cell."""
    known = stream != MISSING
    low = np.where(known, stream, TOP).min(axis=0).astype(int)
    high = np.where(known & living, stream, -TOP).max(initial=-TOP)
    beyond = round(_BEYOND * layout.full_scale * limits.per_unit)
    lowest = np.where(living, low - beyond, -TOP)
    highest = np.where(living, int(high) + beyond, TOP)
    return _clipped(lowest), _clipped(highest)


def _clipped(values: NDArray[np.floating] | NDArray[np.integer]) -> Counts:
    """Return values as counts."""
    found: Counts = np.clip(np.rint(values), -TOP, TOP).astype(np.int16)
    return found


def _moves(limits: Limits, stream: Counts) -> Mask:
    """Return in which frames each cell leaves its run, bool ``[T, D]``."""
    monitor = CountingMonitor(limits)
    found = np.zeros(stream.shape, bool)
    for i, frame in enumerate(stream):
        monitor.update(frame)
        found[i] = (monitor.run == 0) & (monitor.repeats == 0)
    return found


def _most(limits: Limits, stream: Counts) -> tuple[NDArray[np.int64], int]:
    """Return ``seen`` of each cell at most, ``[D]``, and ``silent`` of all, in a healthy stream."""
    monitor = CountingMonitor(limits)
    most = np.zeros(stream.shape[1], np.int64)
    silent = 0
    for frame in stream:
        monitor.update(frame)
        most = np.maximum(most, monitor.seen)
        silent = max(silent, int(monitor.silent[monitor.last != MISSING].max(initial=0)))
    return most, silent


def find_predictors(
    pieces: Mask, layout: SensorLayout, living: Mask
) -> tuple[NDArray[np.uint16], Mask]:
    """Return the predictors of each cell, ``[D, 4]``, and which cells have enough, bool ``[D]``.

    Args:
        pieces: bool ``[n, D]``, pieces in which each cell moves.
        layout: of the array; predictors may be on any pad.
        living: bool ``[D]``, cells that work and move.
    """
    moving = pieces.astype(np.float64)
    count = moving.sum(axis=0)
    share = count / len(pieces)
    confidence = (moving.T @ moving + _WEIGHS * share) / (count + _WEIGHS)[:, None]  # [j, i]
    confidence[~living] = -1.0
    np.fill_diagonal(confidence, -1.0)
    sharing = _sharing(layout)
    found = np.zeros((layout.n_cells, PREDICTORS), np.uint16)
    told = np.zeros(layout.n_cells, bool)
    for cell in np.flatnonzero(living).tolist():
        best = np.argsort(-confidence[:, cell], kind="stable")
        chosen = _apart(best[living[best] & (best != cell)][:_LOOKED_AT], sharing)
        if len(chosen) == PREDICTORS:
            found[cell] = chosen
            told[cell] = True
    return found, told


def _apart(best: NDArray[np.intp], sharing: Mask) -> list[int]:
    """Return the first cells of which no two share a wire."""
    chosen: list[int] = []
    for one in best.tolist():
        if not sharing[one, chosen].any():
            chosen.append(one)
        if len(chosen) == PREDICTORS:
            break
    return chosen


def _sharing(layout: SensorLayout) -> Mask:
    """Return which cells share a row or column, bool ``[D, D]``."""
    found = np.zeros((layout.n_cells, layout.n_cells), bool)
    for line in layout.lines:
        if line.kind in ("row", "column"):
            cells = layout.cells_on(line)
            found[np.ix_(cells, cells)] = True
    return found
