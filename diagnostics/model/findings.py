"""What the judgement of a log says of each cell, in the terms of the root causes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diagnostics.decision.calibration import faulty_at
from diagnostics.decision.root_causes import REFUTED_KINDS, CellFindings
from diagnostics.evidence.stream_state import StreamState
from diagnostics.faults import FaultKind
from diagnostics.model.judge import HELD, Judgement
from diagnostics.model.record import Mask
from diagnostics.model.ways import WAYS
from diagnostics.preprocessing.levels import DOUBTED, RARE

_SHOWN = 1.0  # evidence that excludes a way to fail, or suggests one
_NO_READING = (FaultKind.LATE, FaultKind.COPY)  # but frames, or a cell

Floats = NDArray[np.float64]


def findings(
    judgement: Judgement, stream: StreamState, full_scale: float, rate: float
) -> CellFindings:
    """Return the findings about each cell of a log: the model judges pieces; blinks and noise of
    single frames are told by the stream.

    Args:
        judgement: of the log.
        stream: the same log, for what is silent and which value a cell holds.
        full_scale: of the layout.
        rate: expected share of healthy cells among those that are faulty.
    """
    log = judgement.observed.log
    rest = log.symbols.rest
    present = stream.present
    silent = stream.silent & present
    delivers = present & ~silent
    probability = np.where(delivers, judgement.probability, np.where(silent, 1.0, 0.0))
    faulty = np.asarray(faulty_at(np.where(silent, 0.0, probability), rate) & delivers)
    frames = stream.intermittency
    blinks = frames.intermittent & delivers
    noisy = frames.excess & delivers
    if judgement.disturbed:
        faulty = faulty & (log.run >= HELD)
        probability = np.where(delivers & ~faulty, np.minimum(probability, 0.5), probability)
        blinks = np.zeros_like(blinks)
        noisy = np.zeros_like(noisy)
    by_frames = blinks | noisy
    probability = np.where(by_frames, 1 - RARE, probability)
    faulty = faulty | silent | by_frames
    moves = np.array([way.kind is not None for way in WAYS])[judgement.way]
    kind = _refuted(judgement)
    refuted = np.where(faulty & moves & ~silent & ~by_frames, kind, -1)
    value = log.value.astype(np.float64)
    holds = delivers & np.where(faulty, ~moves & ~by_frames, log.run >= HELD)
    rests = holds & (np.abs(value - rest.level) <= rest.near + log.symbols.tolerance)
    reading = stream.reading(value)
    beyond = holds & ~rests
    top = full_scale - log.symbols.tolerance
    zero = np.zeros_like(present)
    nothing = np.full(len(present), np.nan)
    return CellFindings(
        faulty=faulty,
        alive=delivers & log.far & ~faulty & (probability < DOUBTED),
        silent=silent,
        rests=rests,
        full=beyond & (reading >= top),
        zero=None if stream.load is None else beyond & (reading <= log.symbols.tolerance),
        intermittent=blinks,
        noisy=noisy,
        drifting=zero,
        gain=nothing,
        value=np.where(
            blinks,
            stream.reading(_blinks_to(stream, full_scale)),
            _value(judgement, refuted, stream, reading),
        ),
        since=np.select(
            [silent, blinks, noisy],
            [stream.runs.missed_since, frames.blinks_since, frames.noisy_since],
            _since(judgement),
        ),
        probability=probability,
        weight=judgement.log_odds.astype(np.float64),
        events=np.where(blinks, frames.blinks, len(judgement.units.begins)),
        known=stream.reference.dead > 0,
        refuted=refuted,
        unsure=np.full(len(present), -1),
        wire=np.full(len(present), -1),
        of_wire=np.zeros(len(present)),
        share=np.zeros(len(present)),
        as_one=zero,
        typical=reading,
    )


def shown(judgement: Judgement) -> Mask:
    """Return the cells that follow the others as a healthy one does, bool ``[D]``: they do not move
    by themselves, and no way to fail is near."""
    floats = [way.kind is FaultKind.FLOATING for way in WAYS]
    follows = (judgement.evidence[floats] < -_SHOWN).all(axis=0)
    found: Mask = follows & (judgement.evidence.max(axis=0) < _SHOWN)
    return found


def _refuted(judgement: Judgement) -> NDArray[np.intp]:
    """Return the number of the kind of each cell's likeliest way; -1: it holds a value."""
    numbers = {kind: i for i, kind in enumerate(REFUTED_KINDS)}
    of_way = [-1 if way.kind is None else numbers[way.kind] for way in WAYS]
    return np.array(of_way)[judgement.way]


def _value(
    judgement: Judgement, refuted: NDArray[np.intp], stream: StreamState, reading: Floats
) -> Floats:
    """Return what is told of each cell's likeliest fault, ``[D]``."""
    found = reading.copy()
    for i, way in enumerate(WAYS):
        of_way = (judgement.way == i) & (refuted >= 0)
        if way.value is not None and of_way.any():
            told = way.value(judgement.observed).astype(np.float64)
            if way.kind is FaultKind.COPY and stream.order is not None:
                told = np.where(np.isnan(told), told, stream.order[np.nan_to_num(told).astype(int)])
            if way.kind not in _NO_READING:
                told = stream.reading(told)
            found[of_way] = told[of_way]
    return found


def _blinks_to(stream: StreamState, full_scale: float) -> Floats:
    """Return the load to which each cell blinks, ``[D]``: full scale where most blinks go there."""
    frames = stream.intermittency
    found: Floats = np.where(
        2 * frames.high > frames.blinks, full_scale, np.maximum(stream.lowest, 0.0)
    )
    return found


def _since(judgement: Judgement) -> NDArray[np.intp]:
    """Return the number of the first frame of each cell's likeliest fault, int ``[D]``."""
    begins = judgement.observed.log.record.begins
    found = np.zeros(len(judgement.way), np.intp)
    for i, way in enumerate(WAYS):
        of_way = judgement.way == i
        if way.since is not None and of_way.any():
            piece = way.since(judgement.observed, judgement.units)
            found[of_way] = begins[piece[of_way]]
    return found
