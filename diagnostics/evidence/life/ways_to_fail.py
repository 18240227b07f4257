"""The evidence of each way in which a cell that moves can be dead, see
:data:`healthy_table.FAULTS`.

Each is a log likelihood ratio fault : healthy, summed over the units of the log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_expit, logsumexp, ndtri

from diagnostics.evidence.life.healthy_table import (
    AGAINST,
    BESIDE,
    REFUTED,
    THRESHOLD,
    Cells,
    Floats,
    Mask,
)
from diagnostics.evidence.life.levels_in_log import LifeLog, bounded
from diagnostics.evidence.life.life_model import LifeModel
from diagnostics.evidence.life.over_time import (
    dies_and_recovers,
    from_some_unit,
    opens_under_load,
    since_it_works,
    up_to_some_unit,
)
from diagnostics.evidence.life.record import LifeRecord
from diagnostics.preprocessing.levels import CERTAIN_RATIO, MAJORITY, TESTED

_LAGS = (1, 2, 3, 4)  # pieces
# Gain and offset, as a share of full scale, of a cell that reads otherwise than it did, but follows
# the others: a grid.
_OTHERWISE = (
    *((gain, 0.0) for gain in (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0)),
    *((1.0, offset) for offset in (0.02, 0.05, 0.1, 0.2, 0.4)),
)
_FEWEST_SEGMENTS = 2  # with load
_KEPT = 3  # answers: a size
# P(distance from the mean beside it) of a cell that reads it; dead cells beside it read otherwise.
_AMID = (0.7, 0.15, 0.07, 0.04, 0.04)
WORKS = float(-ndtri(np.exp(-CERTAIN_RATIO)))  # standard errors of a cell that follows the others
_CERTAINLY_NOT = 1e3  # evidence against what is impossible


@dataclass(frozen=True)
class Suspicion:
    """The two faults that all others are near, before the factors.

    Attributes:
        healthy: float ``[n, D]``, log P(level | healthy).
        context: int ``[n, D]``, what the others say.
        independent, intermittent: float ``[D]``, evidence.
        opens: float ``[D]``, evidence of a cell that is dead where its load exceeds some level.
        by_unit: float ``[units, D]``, evidence of each unit for an independent cell.
        dead: float ``[units, D]``, evidence of each unit for a cell that is dead for a time.
        dying: float ``[units, D]``, P(dead) in each unit, given the units up to it.
    """

    healthy: Floats
    context: NDArray[np.intp]
    independent: Floats
    intermittent: Floats
    opens: Floats
    by_unit: Floats
    dead: Floats
    dying: Floats

    @property
    def comes_and_goes(self) -> Floats:
        """float ``[D]``, evidence of a cell that is dead in some units, or under load."""
        return np.maximum(self.intermittent, self.opens)

    def refuted(self, log: LifeLog) -> Mask:
        """Return the cells that either fault explains better, bool ``[D]``."""
        factors = log.model.factors(log.units)
        evidence = np.maximum(self.independent * factors[0], self.comes_and_goes * factors[1])
        found: Mask = evidence > REFUTED
        return found


@dataclass(frozen=True)
class WaysToFail:
    """The evidence of all faults, before the factors, and what is known of them.

    Attributes:
        evidence: float ``[5, D]``.
        lag: int ``[D]``, pieces by which the cell is late, if it is.
        source: int ``[D]``, the cell that it repeats, if it does; -1: the mean of those beside it.
        share: float ``[D]``, of the tested units in which a cell that comes and goes was dead.
        against: bool ``[units, D]``, units against the cell.
        highest: float ``[D]``, highest reading of a piece, in the layout's unit.
        now: float ``[D]``, log ratio independent : healthy since the cell, if it ever was dead,
            works again.
        healthy: float ``[n, D]``, log P(level | healthy).
        context: int ``[n, D]``, what the others say.
    """

    evidence: Floats
    lag: NDArray[np.intp]
    source: NDArray[np.intp]
    share: Floats
    against: Mask
    highest: Floats
    now: Floats
    healthy: Floats
    context: NDArray[np.intp]


class EvidenceOfLog:
    """What a log says of each way to fail, given the cells that predict others; the last answers
    are kept.

    Args:
        log: the levels of the log.
    """

    def __init__(self, log: LifeLog) -> None:
        self.log = log
        self._seen: dict[bytes, Suspicion] = {}
        self._ways: dict[bytes, WaysToFail] = {}
        self._alike: tuple[Floats, ...] = ()

    @classmethod
    def of(cls, record: LifeRecord, model: LifeModel, beside: Cells) -> EvidenceOfLog | None:
        """Return the evidence of a log; None: it holds too little, and tells nothing."""
        if len(record.number) < _FEWEST_SEGMENTS:
            return None
        return cls(LifeLog.of(record, model, beside))

    def suspicion(self, known: Mask) -> Suspicion:
        """Return the evidence of the two faults that all others are near."""
        key = known.tobytes()
        if key not in self._seen:
            _forget(self._seen)
            self._seen[key] = suspicion(self.log, known)
        return self._seen[key]

    def ways(self, known: Mask) -> WaysToFail:
        """Return the evidence of each fault."""
        key = known.tobytes()
        if key not in self._ways:
            _forget(self._ways)
            seen = self.suspicion(known)
            if not self._alike:
                self._alike = _alike(self.log)
            self._ways[key] = ways_to_fail(self.log, known, seen, self._alike)
        return self._ways[key]


def _forget(answers: dict[bytes, Any]) -> None:
    """Drop the oldest answer, where many are kept."""
    if len(answers) >= _KEPT:
        del answers[next(iter(answers))]


def suspicion(log: LifeLog, known: Mask) -> Suspicion:
    """Return the evidence of the two faults, where only the ``known`` cells predict others."""
    healthy, context = log.healthy(known)
    by_unit = log.counted(log.own - healthy)
    dead = log.counted(log.at_rest - healthy)
    intermittent, dying = dies_and_recovers(dead)
    around = len(BESIDE) + 1
    opens = opens_under_load(log, log.at_rest - healthy, context // around)
    return Suspicion(
        healthy, context, by_unit.sum(axis=0), intermittent, opens, by_unit, dead, dying
    )


def ways_to_fail(log: LifeLog, known: Mask, seen: Suspicion, alike: Sequence[Floats]) -> WaysToFail:
    """Return the evidence of each fault.

    Args:
        log: the levels of the log.
        known: bool ``[D]``, cells that predict others.
        seen: the evidence of the first two faults, given these.
        alike: evidence ``[D]`` that a cell repeats each of those beside it, or their mean.
    """
    copy, source = _copies(log, known, seen, alike)
    if (known & (copy > REFUTED)).any():
        seen = suspicion(log, known & (copy <= REFUTED))
    lagged = [_late(log, seen, lag) for lag in _LAGS]
    late = logsumexp(lagged, axis=0) - np.log(len(lagged))
    clamped = _clamped(log, seen.context)
    # What was dead once, and works again, is no fault any more.
    now = since_it_works(seen.by_unit)
    works = now < -THRESHOLD
    independent = np.where(works, np.minimum(seen.independent, now), seen.independent)
    recovers = seen.intermittent - np.logaddexp(0.0, up_to_some_unit(seen.dead))
    intermittent = np.logaddexp(recovers, seen.opens) - np.log(2)
    tested = np.abs(seen.dead) > TESTED
    gone = (seen.dying > MAJORITY) & tested
    share = gone.sum(axis=0) / np.maximum(tested.sum(axis=0), 1)
    moves = log.by_unit(log.own - seen.healthy) > AGAINST
    rests = seen.dead > AGAINST
    return WaysToFail(
        evidence=np.stack([independent, intermittent, late, copy, clamped]),
        lag=np.array(_LAGS)[np.argmax(lagged, axis=0)],
        source=source,
        share=share,
        against=moves | rests,
        highest=np.fmax.reduce(log.readings).astype(np.float64),
        now=now,
        healthy=seen.healthy,
        context=seen.context,
    )


def follows_otherwise(log: LifeLog, ways: WaysToFail, cells: Cells) -> Floats:
    """Return the log ratio follows with another gain or offset : not at all, ``[cells]``."""
    healthy = ways.healthy[:, cells]
    context = ways.context[:, cells]
    level = log.level[:, cells]
    own = log.own[:, cells]
    independent = from_some_unit(log.counted(own - healthy, cells))
    best = np.full(len(cells), -np.inf)
    for gain, offset in _OTHERWISE:
        changed = log.tilted(log.model.otherwise(gain, offset, cells), context, level)
        evidence = from_some_unit(log.counted(changed - healthy, cells))
        best = np.maximum(best, evidence)
    return best - independent


def responses(log: LifeLog, known: Mask) -> tuple[Floats, Floats]:
    """Return how much the readings of each cell rise with the load that the others predict, and by
    how many standard errors, ``[D]`` each.

    Both are of the regression over the units of the log; ``known``: bool ``[D]``, cells that
    predict others.
    """
    length = np.diff(np.append(log.unit_begins, len(log.loads)))[:, None]
    load = np.add.reduceat(log.model.expected(log.loads, known) ** 2, log.unit_begins) / length
    reading = np.add.reduceat(log.readings, log.unit_begins, dtype=np.float64) / length
    load = load - load.mean(axis=0)
    reading = reading - reading.mean(axis=0)  # NaN where one is missing: of no use
    together = (load * reading).sum(axis=0)
    own = (load**2).sum(axis=0)
    size = np.sqrt(own * (reading**2).sum(axis=0))
    n = log.units * log.model.independent
    z = np.divide(together * np.sqrt(n), size, out=np.zeros(len(own)), where=size > 0)
    gain = np.divide(together, own, out=np.zeros(len(own)), where=own > 0)
    return gain, z


def _late(log: LifeLog, seen: Suspicion, lag: int) -> Floats:
    """Return the evidence ``[D]`` that a cell shows what the others said some pieces ago."""
    cells = np.arange(log.level.shape[1])
    table = log.model.probabilities[log.model.of_cell(cells)]
    ratio = np.zeros(seen.healthy.shape)
    late = log.tilted(table, seen.context[:-lag], log.level[lag:])
    ratio[lag:] = late - seen.healthy[lag:]
    evidence: Floats = log.counted(ratio).sum(axis=0)
    return evidence


def _clamped(log: LifeLog, context: NDArray[np.intp]) -> Floats:
    """Return the evidence ``[D]`` that a cell is clamped: any higher load explains its highest
    reading."""
    model = log.model
    limit = log.readings.max(axis=0)
    piece, cell = np.nonzero((log.readings >= limit - model.tolerance) & (log.level > 0))
    level = log.level[piece, cell]
    of_level = model.table[model.of_cell(cell), context[piece, cell]].astype(np.float64)
    at_least = np.arange(of_level.shape[1]) >= level[:, None]
    clamped = logsumexp(np.where(at_least, of_level, -np.inf), axis=1)
    ratio = np.zeros(log.level.shape)
    ratio[piece, cell] = clamped - of_level[np.arange(len(cell)), level]
    evidence: Floats = log.counted(ratio).sum(axis=0)
    return evidence


def _alike(log: LifeLog) -> tuple[Floats, ...]:
    """Return the evidence ``[D]`` that a cell repeats each of those beside it, and their mean."""
    errs = log.model.errs
    of_different = bounded(np.log(errs), errs)
    evidence = []
    for k, other in enumerate(log.beside.T):
        of_same = bounded(-np.log(log.model.equal[:, k]), errs)
        either, same = log.same(k)
        n_same = same.sum(axis=0)
        found = log.model.independent * (
            n_same * of_same + (either.sum(axis=0) - n_same) * of_different
        )
        evidence.append(np.where(other >= 0, found, -np.inf))
    evidence.append(_mean_of_others(log))
    return tuple(evidence)


def _copies(
    log: LifeLog, known: Mask, seen: Suspicion, alike: Sequence[Floats]
) -> tuple[Floats, NDArray[np.intp]]:
    """Return the evidence ``[D]`` that a cell repeats one beside it, and which, int ``[D]``.

    Or the mean of those beside it: -1. Either cell of two that read the same may be the copy: the
    one that fits worse to the others, without both.
    """
    evidence = [*alike[:-1], _unless_misled(alike[-1], log, seen)]
    cell = np.arange(len(known))
    best = np.argmax(evidence, axis=0)
    source = np.column_stack([log.beside, np.full(len(known), -1)])[cell, best]
    likeliest = np.max(evidence, axis=0) - np.log(len(evidence))
    total = np.maximum(likeliest, -_CERTAINLY_NOT)
    pairs = np.flatnonzero((total > REFUTED) & (source >= 0))
    if len(pairs):
        without = known.copy()
        without[pairs] = False
        without[source[pairs]] = False
        healthy, _ = log.healthy(without)
        fits = log.counted(healthy - log.own).sum(axis=0)
        worse = fits[source[pairs]] - fits[pairs]
        copies = total[pairs] + log_expit(worse)
        copied = total[pairs] + log_expit(-worse)
        total[pairs] = copies - np.logaddexp(0.0, copied)
    return total, source


def _mean_of_others(log: LifeLog) -> Floats:
    """Return the evidence ``[D]`` that a cell reads the mean of those beside it."""
    some, level = log.amid()
    healthy = log.model.amid[np.arange(level.shape[1]), level]
    ratio = np.where(some, np.log(np.asarray(_AMID)[level] / healthy), 0.0)
    evidence: Floats = (bounded(ratio, log.model.errs) * log.weight[:, None]).sum(axis=0)
    return evidence


def _unless_misled(evidence: Floats, log: LifeLog, seen: Suspicion) -> Floats:
    """Return the evidence of a mean, where none of the cells beside one is refuted: else their mean
    is unknown."""
    plain = np.maximum(seen.independent, seen.intermittent)
    worse = seen.refuted(log)[log.beside] & (plain[log.beside] > plain[:, None])
    misled = ((log.beside >= 0) & worse).any(axis=1)
    found: Floats = np.where(misled, np.minimum(evidence, 0.0), evidence)
    return found
