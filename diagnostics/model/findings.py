"""What the judgement of a log says of each cell, in the terms of the root causes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from diagnostics.decision.address_aliasing import find_aliasing
from diagnostics.decision.calibration import faulty_at
from diagnostics.decision.cell_findings import OF_WIRES, REFUTED_KINDS, CellFindings
from diagnostics.decision.judged import Judged
from diagnostics.evidence.stream_state import StreamState
from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import SensorLayout
from diagnostics.model.judge import Judgement, Model
from diagnostics.model.objects import judged_with_objects
from diagnostics.model.observed import HELD, Log
from diagnostics.model.record import Mask
from diagnostics.model.symbols import NOTHING
from diagnostics.model.ways import FLOATS, WAYS
from diagnostics.model.ways.comes_and_goes import COMES_AND_GOES
from diagnostics.model.ways.floats import floats_lately
from diagnostics.model.ways.holds import expected
from diagnostics.preprocessing.levels import CERTAIN_RATIO, DOUBTED, RARE

_SHOWN = 1.0  # evidence that excludes a way to fail, or suggests one
_ALONE = 0.7  # of what lines move, that is no offset of their pad
_NO_READING = (FaultKind.LATE, FaultKind.COPY, FaultKind.WEAK)  # but frames, a cell, a gain

Floats = NDArray[np.float64]


def judged_by_model(
    model: Model, stream: StreamState, layout: SensorLayout, rate: float, full_scale: float
) -> Judged:
    """Return what the model says of the log behind a ``stream``.

    Args:
        model: of the array.
        stream: the log.
        layout: of its cells.
        rate: expected share of healthy cells among those that are faulty.
        full_scale: of a reading.
    """
    log = model.log_of_record(stream.record())
    if stream.crosstalk is not None:
        log.disturbed[:] = True
    aliases, _ = find_aliasing(stream, partial(model.log_likelihood, log))
    touched = (log.load > NOTHING).any(axis=0)
    aliases = [fault for fault in aliases if _reads_the_same_loads(fault, log)]
    misread = np.zeros(layout.n_cells, bool)
    misread[[cell for fault in aliases for cell in fault.cells]] = True
    judgement, still = judged_with_objects(model, log, layout, misread)
    found = findings(judgement, stream, full_scale, rate)
    follows = shown(judgement) & (found.probability < DOUBTED)
    return Judged(
        found=found,
        aliases=aliases,
        shown=follows & touched & stream.touched & model.living,
        evidence={
            "spatial": found.weight,
            "events": found.events.astype(np.float64),
        },
        still=still,
        contradicting=float(judgement.disturbed[model.present].mean()),
        pulled=partial(model.lines.pulled, judgement.observed),
    )


def _reads_the_same_loads(alias: Fault, log: Log) -> bool:
    """Return whether cells of two lines that always read the same are loaded meanwhile: what a pad
    shares looks alike on lines that nothing touches. Of lines of one cell each the model tells
    which of the two is the copy."""
    cells = list(alias.cells)
    since = log.record.begins >= (alias.onset or 0)
    loaded = (log.load[:, cells] > NOTHING) & ~log.disturbed[cells]
    if len(cells) == 2 or not loaded[since].any():
        return False
    moves = np.ptp(log.record.mean[since][:, cells], axis=0).sum()
    alone = np.ptp(log.above[since][:, cells], axis=0).sum()
    return bool(alone > _ALONE * moves)


@dataclass(frozen=True)
class _Blamed:
    """Who is faulty, and by what, bool ``[D]`` each.

    Attributes:
        delivers, silent: cells with readings, and those without.
        known: cells that were dead in the reference already, and have not moved since.
        blinks, noisy: told by single frames.
        on_line: cells of lines that fail as a whole.
        faulty: all of these, and what the pieces of the log tell.
        probability: float, that it is.
    """

    delivers: Mask
    silent: Mask
    known: Mask
    blinks: Mask
    noisy: Mask
    on_line: Mask
    faulty: Mask
    probability: Floats

    @property
    def by_frames(self) -> Mask:
        """Told by single frames."""
        return self.blinks | self.noisy

    @property
    def by_pieces(self) -> Mask:
        """Told by the pieces of the log."""
        return self.faulty & ~self.silent & ~self.by_frames & ~self.known


def _blamed(judgement: Judgement, stream: StreamState, rate: float) -> _Blamed:
    """Return who is faulty; arguments as of :func:`findings`."""
    log = judgement.observed.log
    disturbed = judgement.disturbed
    silent = stream.silent & stream.present
    delivers = log.received & ~silent
    probability = np.where(delivers, judgement.probability, np.where(silent, 1.0, 0.0))
    # how many others are faulty makes none faulty that shows no more than a healthy one
    faulty = faulty_at(np.where(silent, 0.0, probability), rate) & (judgement.log_odds > 0)
    known = delivers & (stream.reference.dead > 0) & ~stream.runs.moved
    probability[known] = stream.reference.dead[known]
    faulty = (delivers & faulty | known) & (~disturbed | (log.run >= HELD))
    unknown = delivers & disturbed & ~faulty
    probability = np.where(unknown, np.minimum(probability, 0.5), probability)
    on_line = delivers & judgement.failing.cells & ~disturbed
    # a line that fails as a whole explains what its cells do
    told = delivers & ~disturbed & ~on_line
    frames = stream.intermittency
    noisy = frames.excess & told
    blinks = frames.intermittent & told
    if log.step:  # of a coarser converter: loads come and go in one
        blinks = np.zeros_like(blinks)
    probability = np.where(blinks | noisy, 1 - RARE, probability)
    probability = np.where(on_line, judgement.failing.probability, probability)
    faulty = faulty | silent | blinks | noisy | on_line
    return _Blamed(delivers, silent, known, blinks, noisy, on_line, faulty, probability)


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
    failing = judgement.failing
    frames = stream.intermittency
    blamed = _blamed(judgement, stream, rate)
    way = np.where(blamed.on_line, WAYS.index(COMES_AND_GOES), judgement.way)
    kind = _kinds()[way]
    refuted = np.where(blamed.by_pieces, kind, -1)
    drifts = blamed.by_pieces & _drifts()[way]
    # what never left its rest agrees with a broken line, whatever is likeliest of it
    to_end = log.run >= min(HELD, len(log.record))
    holds = blamed.delivers & (blamed.faulty | to_end) & (refuted < 0)
    holds &= ~blamed.by_frames & ~drifts
    rests = holds & _below_or_at_rest(log, stream)
    reading = stream.reading(log.value.astype(np.float64))
    beyond = holds & ~rests
    tolerance = log.symbols.tolerance
    told = _value(judgement, np.where(refuted >= 0, way, -1), stream, reading)
    gain = np.where(refuted == REFUTED_KINDS.index(FaultKind.WEAK), told, np.nan)
    reads_more = gain > 1
    typical = stream.typical_reading()
    return CellFindings(
        faulty=blamed.faulty,
        # how many others are faulty makes no wire of those that move
        alive=blamed.delivers & log.far & ~blamed.faulty & (expit(judgement.log_odds) < DOUBTED),
        silent=blamed.silent,
        rests=rests,
        full=beyond & (reading >= full_scale - tolerance),
        zero=None if stream.load is None else beyond & (reading <= tolerance),
        intermittent=blamed.blinks,
        noisy=blamed.noisy,
        drifting=reads_more | drifts,
        gain=gain,
        value=np.where(blamed.blinks, stream.blinks_to(full_scale), told),
        since=np.select(
            [blamed.silent, blamed.blinks, blamed.noisy],
            [stream.runs.missed_since, frames.blinks_since, frames.noisy_since],
            _since(judgement, way, blamed.on_line),
        ),
        probability=blamed.probability,
        weight=np.where(blamed.known, CERTAIN_RATIO, _weight(judgement, holds)),
        events=np.select(
            [blamed.blinks, blamed.on_line],
            [frames.blinks, failing.units],
            len(judgement.units.begins),
        ),
        known=blamed.known,
        refuted=np.where(reads_more, -1, refuted),
        unsure=_unsure(judgement, blamed, kind),
        wire=np.where(blamed.on_line, failing.line, -1),
        of_wire=failing.probability,
        share=failing.share,
        as_one=failing.as_one,
        typical=np.where(np.abs(typical - reading) <= 2 * tolerance, typical, reading),
    )


def _below_or_at_rest(log: Log, stream: StreamState) -> Mask:
    """Return the cells that hold a value at their rest, or below it, bool ``[D]``: there a cell is
    cut off as well."""
    rest = log.symbols.rest
    # where a cell rests that was dead already, the reference does not show
    level = np.where(stream.reference.dead > 0, stream.reference.scale.baseline, rest.level)
    found: Mask = log.value - level <= rest.near + log.symbols.tolerance
    return found


def _unsure(judgement: Judgement, blamed: _Blamed, kind: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the ``kind`` (int ``[D]``) of cells that are not certain one by one; -1: none. The
    cells of a line that fails now and then fail together."""
    comes_and_goes = (kind >= 0) & (kind < len(OF_WIRES))
    likely = (judgement.evidence.max(axis=0) > 0) & ~shown(judgement)
    moves = blamed.delivers & judgement.observed.log.far & ~judgement.disturbed
    return np.where(moves & ~blamed.faulty & comes_and_goes & likely, kind, -1)


def shown(judgement: Judgement) -> Mask:
    """Return the cells that follow the others as a healthy one does, bool ``[D]``, in the later
    half of the log as well: they do not hold one value there nor move by themselves, no way to
    fail is near, and their line works."""
    observed = judgement.observed
    units = judgement.units
    later_half = len(observed.log.record) - units.begins[len(units.begins) // 2]
    follows = (floats_lately(observed, units) < -_SHOWN) & (observed.log.run < later_half)
    follows &= judgement.evidence[WAYS.index(FLOATS)] < -_SHOWN
    found: Mask = follows & (judgement.evidence.max(axis=0) < _SHOWN) & ~judgement.failing.doubted
    return found


def _weight(judgement: Judgement, holds: Mask) -> Floats:
    """Return the log ratio of each cell, faulty : healthy, ``[D]``; of one that ``holds`` a value
    (bool) by that alone. On a broken line this value is no surprise."""
    observed = judgement.observed
    of_holding = judgement.evidence[[way.kind is None for way in WAYS]].max(axis=0)
    of_holding = of_holding - expected(observed.log)
    weight = np.where(holds, of_holding, judgement.log_odds).astype(np.float64)
    # where a cell rests that never moved in the reference, or that nothing touches, tells nothing
    tells = observed.log.living & ~observed.unwitnessed.all(axis=0)
    return np.where(tells, weight, np.minimum(weight, 0.0))


def _kinds() -> NDArray[np.intp]:
    """Return the number of the kind of each way; -1: it holds a value, or drifts."""
    numbers: dict[FaultKind | None, int] = {kind: i for i, kind in enumerate(REFUTED_KINDS)}
    return np.array([numbers.get(way.kind, -1) for way in WAYS])


def _drifts() -> Mask:
    """Return of each way whether a cell that fails so does not come to rest, bool."""
    return np.array([way.kind is FaultKind.DRIFT for way in WAYS])


def _value(
    judgement: Judgement, way: NDArray[np.intp], stream: StreamState, reading: Floats
) -> Floats:
    """Return what is told of the fault of each cell, ``[D]``; ``way``: int ``[D]``, number of its
    way to move; -1: none."""
    found = reading.copy()
    for i, one in enumerate(WAYS):
        of_way = way == i
        if one.value is not None and of_way.any():
            told = one.value(judgement.observed).astype(np.float64)
            if one.kind is FaultKind.COPY and stream.order is not None:
                told = np.where(np.isnan(told), told, stream.order[np.nan_to_num(told).astype(int)])
            if one.kind not in _NO_READING:
                told = stream.reading(told)
            found[of_way] = told[of_way]
    return found


def _since(judgement: Judgement, way: NDArray[np.intp], on_line: Mask) -> NDArray[np.intp]:
    """Return the number of the first frame of the fault of each cell, int ``[D]``; ``on_line``:
    bool ``[D]``, cells of a line that fails."""
    begins = judgement.observed.log.record.begins
    found = np.where(on_line, judgement.failing.since, 0)
    for i, one in enumerate(WAYS):
        of_way = (way == i) & ~on_line
        if one.since is not None and of_way.any():
            piece = one.since(judgement.observed, judgement.units)
            found[of_way] = begins[piece[of_way]]
    return found
