"""The judgement of a log: who is trusted, the evidence of each way to fail, and P(faulty).

Trusted are at first the cells that move and do not hold a load at the end. The worst of all leaves,
and what is left is predicted anew, until nobody is suspect; then cells that did not move but read
as the others say join them. With w the ways to fail and their evidence E_w,

    log odds = log (p / (1 - p)) + log sum over w of  prior_w exp(E_w)

where the prevalence p is that of the log (EM, shrunk to a usual one). A pad may share what the
reference never saw: an offset, noise, coarse steps. How its cells move then tells nothing of them,
and only what holds a value is faulty. So it is with a pad of which many moving cells are refuted,
and with all cells, where that holds of the array, or trusted ones are odd again and again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit, logsumexp

from diagnostics.faults import FaultKind
from diagnostics.model.as_one import AsOne
from diagnostics.model.groups import Groups
from diagnostics.model.lines import Failing, Lines
from diagnostics.model.observed import HELD, Log, Observed
from diagnostics.model.over_time import USUAL, Units, within_limit
from diagnostics.model.predictor import Predictor
from diagnostics.model.record import Array, Cells, Mask, Record, Recorder, record_of
from diagnostics.model.rest import DITHER
from diagnostics.model.symbols import NOTHING, Flatness, Symbols
from diagnostics.model.ways import COMES_AND_GOES, FLOATS, WAYS, Way
from diagnostics.preprocessing.levels import MAJORITY

_SUSPECT = 3.0  # evidence of a fault with which a cell predicts no other
_WORST = 0.5  # of the highest evidence: who leaves in one round
_ROUNDS = 16
_GOES = 6.0  # evidence that a fault has gone
_PREVALENCE = 0.03
_WEIGHS = 20.0  # cells that the usual prevalence is worth
_ITERATIONS = 10
_DECIDING = [i for i, way in enumerate(WAYS) if way.decides]
_FLOATS = WAYS.index(FLOATS)
_OTHERS = [i for i, way in enumerate(WAYS) if not way.decides]
_EXPLAINS = 0.5  # of the evidence of any way: a value that is held
_NEARLY_ALL = 0.9  # of it: what tells more than that a cell floats
_DISTURBED = 1 / 3  # of the cells that move
_FEWEST = 4  # cells that show a disturbance
_MOST_CELLS = 0.75  # of those that are trusted: so many are less odd than
_STRANGE = 10.0  # times as often as usual
# of a log: what is kept of all cells, but no fewer pieces
_MOST_READINGS = 500_000
_FEWEST_PIECES = 512

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Judgement:
    """What a log says of each cell, ``[D]``.

    Attributes:
        evidence: ``[ways, D]``, of each way to fail, within the limits of healthy cells.
        of_ways: ``[ways, D]``, the same without limits.
        log_odds: float, faulty : healthy, with the usual prevalence.
        probability: float, P(faulty).
        way: int, number of the likeliest way.
        known: bool, trusted cells.
        observed: what these say of the log.
        units: of the log.
        failing: lines and groups that fail now and then.
        disturbed: bool, cells of which only a held value tells: all do what the reference never
            saw.
    """

    evidence: Array
    of_ways: Array
    log_odds: Floats
    probability: Floats
    way: Cells
    known: Mask
    observed: Observed
    units: Units
    failing: Failing
    disturbed: Mask


@dataclass
class Model:
    """All that a log is judged with.

    Attributes:
        symbols, flatness, predictor: of healthy cells.
        length: frames of a piece.
        longest: frames of a recording of the reference, at most.
        present, living: bool ``[D]``, cells that there are, and that ever moved.
        odd: ``[D]``, share of the units in which each healthy cell is odd.
        highest: ``[2, ways, D]``, evidence of each way that a healthy cell reaches in a short log
            and in a long one.
        reached: int ``[2]``, units of these logs.
        telling: bool ``[ways]``, those of which hardly any healthy cell of this array is certain.
        lines, groups: of the array.
    """

    symbols: Symbols
    flatness: Flatness
    predictor: Predictor
    length: int
    longest: int
    present: Mask
    living: Mask
    odd: Array
    highest: Array
    reached: Cells
    telling: Mask
    lines: Lines
    groups: Groups

    @classmethod
    def of(
        cls,
        symbols: Symbols,
        flatness: Flatness,
        predictor: Predictor,
        length: int,
        longest: int,
        present: Mask,
        living: Mask,
        lines: Lines,
        groups: Groups,
    ) -> Model:
        """Return the model before healthy logs tell how odd cells are."""
        odd = np.full(len(present), USUAL, np.float32)
        highest = np.zeros((2, len(WAYS), len(present)), np.float32)
        reached = np.ones(2, np.intp)
        telling = np.ones(len(WAYS), bool)
        return cls(
            symbols,
            flatness,
            predictor,
            length,
            longest,
            present,
            living,
            odd,
            highest,
            reached,
            telling,
            lines,
            groups,
        )

    def recorder(self) -> Recorder:
        """Return what builds the record of a log that goes on and on."""
        most = max(_FEWEST_PIECES, _MOST_READINGS / len(self.present))
        tolerance = DITHER * self.symbols.rest.full
        return Recorder(self.length, tolerance, most, self._as_one, longest=self.longest)

    @property
    def _as_one(self) -> AsOne | None:
        return self.groups.as_one if len(self.groups.as_one.on) else None

    def record_of(self, recordings: Sequence[NDArray[np.floating]]) -> Record:
        """Return the record of a log, recordings ``[T, D]``."""
        return record_of(recordings, self.length, self._as_one)

    def _evidence(
        self, observed: Observed, units: Units, chosen: Sequence[int]
    ) -> tuple[Array, Array]:
        """Return the evidence ``[ways, D]`` of the ``chosen`` ways, so that what a healthy cell may
        reach in a log stays below certainty, which grows with the log, and without this limit."""
        short, long = self.reached.tolist()
        share = np.clip((len(units.begins) - short) / max(1, long - short), 0, 1)
        highest = self.highest[0] + share * (self.highest[1] - self.highest[0])
        longer = len(units.begins) / long
        floats = FLOATS.evidence(observed, units)
        floats_surely = within_limit(floats, highest[_FLOATS], longer)
        every = []
        certain = []
        for i in chosen:
            evidence = floats if i == _FLOATS else WAYS[i].evidence(observed, units)
            if not self.telling[i]:
                evidence = np.minimum(evidence, 0)
            surely = within_limit(evidence, highest[i], longer)
            if WAYS[i].floats:
                evidence = np.minimum(evidence, floats)
                surely = np.minimum(surely, floats_surely)
            every.append(evidence)
            certain.append(surely)
        return np.stack(certain), np.stack(every)

    def log_of_record(self, record: Record) -> Log:
        """Return a record as symbols."""
        return Log(record, self.symbols, self.present, self.living)

    def observed(self, log: Log, known: Mask) -> Observed:
        """Return what the ``known`` cells say of a log."""
        return Observed(log, known, self.predictor, self.flatness)

    def log_likelihood(self, log: Log, onset: int, known: Mask) -> tuple[Array, Mask]:
        """Return the mean log likelihood of what each cell shows in the loaded pieces of a log
        since frame ``onset``, given the ``known`` cells (bool ``[D]``), and whether it was loaded,
        ``[D]`` each."""
        since = log.record.begins >= onset
        loaded: Mask = (log.load > NOTHING) & since[:, None]
        ever = np.asarray(loaded.any(axis=0))
        on = (loaded & known).any(axis=1)
        if not on.any():
            return np.zeros(len(known), np.float32), ever
        observed = self.observed(log, known & log.received)
        likely: Array = observed.of_level[on].mean(axis=0)
        return likely, ever

    def judge_record(
        self, record: Record, explained: Mask | None = None, healthy: Mask | None = None
    ) -> Judgement:
        """Judge a record, with pieces of this model's length; other arguments as for
        :meth:`judge_log`."""
        return self.judge_log(self.log_of_record(record), explained, healthy)

    def judge_log(
        self, log: Log, explained: Mask | None = None, healthy: Mask | None = None
    ) -> Judgement:
        """Judge a log, which is changed by it.

        Args:
            log: of any length.
            explained: bool ``[D]``, cells that tell what their pad shares, no more; None: none.
            healthy: bool ``[D]``, cells to be trusted; None: they are found.
        """
        if explained is not None:
            log.received &= ~explained
            log.far &= ~explained
        of_groups = self._failing_groups(log)
        log.disturbed = self._disturbed(log, of_groups)
        observed = self._by_trusted(log, of_groups.cells, healthy)
        moving = self.moving(log)
        telling = moving & ~self._by_itself(observed, moving) & ~log.disturbed
        failing = self.lines.failing(observed, moving, telling, of_groups)
        if (failing.cells & ~of_groups.cells).any():
            observed = self._by_trusted(log, failing.cells, healthy)
        units = replace(Units.of(observed, self.odd), goes=_GOES)
        evidence, of_ways = self._evidence(observed, units, range(len(WAYS)))
        # of what never moved in the reference only a value that it holds away from rest tells
        holds = (log.level[-1] > 0) & (log.run >= HELD)
        judged = log.received & (self.living | holds) & ~log.overloaded
        judged &= len(log.record) >= HELD  # fewer pieces prove nothing
        disturbed = log.disturbed
        only_held = disturbed | ~self.living
        counts = _counting(evidence, WAYS, only_held)
        log_odds = logit(_PREVALENCE) + _of_any(counts, WAYS)
        alone = log.far & ~failing.cells
        odd = self._odd_as_a_whole(observed, alone & (log_odds > 0) & _moves(counts), alone)
        if (odd & ~disturbed).any():
            disturbed = disturbed | odd
            only_held = disturbed | ~self.living
            counts = _counting(evidence, WAYS, only_held)
            log_odds = logit(_PREVALENCE) + _of_any(counts, WAYS)
        return Judgement(
            evidence=evidence,
            of_ways=of_ways,
            log_odds=log_odds,
            probability=_with_prevalence(log_odds, judged),
            # limits say who is faulty, not of what
            way=_likeliest(_counting(of_ways, WAYS, only_held), log.run == len(log.record)),
            known=observed.known,
            observed=observed,
            units=units,
            failing=failing,
            disturbed=disturbed,
        )

    def _failing_groups(self, log: Log) -> Failing:
        """Return the groups that fail, unless all others are disturbed as well."""
        found = self.groups.failing(log, log.far & self.living)
        if self._disturbed(log, found).all():
            return Failing.none(len(self.present))
        return found

    def _disturbed(self, log: Log, failing: Failing) -> Mask:
        """Return the cells of disturbed pads, bool ``[D]``, without those that are ``failing`` as a
        whole; all cells, where those of many pads are."""
        telling = log.received & self.living & ~failing.cells
        found = log.disturbed & ~failing.cells
        if found[telling].sum() > _DISTURBED * telling.sum():
            return np.ones_like(found)
        return found

    def _by_itself(self, observed: Observed, moving: Mask) -> Mask:
        """Return the ``moving`` cells that move by themselves and do not just come and go, bool
        ``[D]``: they tell nothing of their line, where they are not most of it."""
        units = Units.of(observed, self.odd)
        floats = FLOATS.evidence(observed, units)
        goes = COMES_AND_GOES.evidence(observed, units)
        alone = moving & ~observed.known & (floats > _SUSPECT) & (floats > goes)
        on = self.lines.on & moving
        most = 2 * (on & alone).sum(axis=1) > on.sum(axis=1)
        found: Mask = alone & ~on[most].any(axis=0)
        return found

    def moving(self, log: Log) -> Mask:
        """Return the cells that move and hold no load at the end, bool ``[D]``."""
        found: Mask = log.far & self.living & ~((log.run >= HELD) & (log.load[-1] > NOTHING))
        return found

    def evidence_of_any(self, observed: Observed, units: Units) -> Array:
        """Return the evidence ``[D]`` of any of the ways that tell who is trusted."""
        return self._told(observed, units, _DECIDING)[0]

    def _told(self, observed: Observed, units: Units, chosen: Sequence[int]) -> tuple[Array, Array]:
        """Return the evidence ``[D]`` of any of the ``chosen`` ways, within the limits of healthy
        cells and without: these say who is suspect, not who is worse."""
        ways = [WAYS[i] for i in chosen]
        certain, every = self._evidence(observed, units, chosen)
        disturbed = observed.log.disturbed
        of_certain = _of_any(_counting(certain, ways, disturbed), ways)
        return of_certain, _of_any(_counting(every, ways, disturbed), ways)

    def _by_trusted(self, log: Log, out: Mask, healthy: Mask | None) -> Observed:
        """Return what those say of a log who are trusted to predict the others; those that are
        ``out`` (bool ``[D]``) are not. ``healthy``: those, where it is known. Ways to fail that
        take long are asked at the end."""
        if healthy is not None:
            return self.observed(log, log.received & self.living & healthy & ~out)
        stays = ~(log.received & self.living) | out
        moving = self.moving(log)
        observed = self.observed(log, moving & ~out)
        for _ in range(_ROUNDS):
            known = observed.known
            units = Units.of(observed, self.odd)
            evidence, of_all = self._told(observed, units, _DECIDING)
            suspect = known & (evidence > _SUSPECT)
            if suspect.any():
                observed = self.observed(log, known & ~self._worst(suspect, known, of_all))
                continue
            # a cell that a worse one of its pad had made look wrong comes back, but once only
            misled = moving & ~self._worst_of_pad(~known, of_all)
            joins = ~known & ~stays & ((evidence < 0) | misled)
            if joins.any():
                stays |= joins
                observed = self.observed(log, known | joins)
                continue
            evidence, of_all = self._told(observed, units, _OTHERS)
            suspect = known & (evidence > _SUSPECT)
            if not suspect.any():
                break
            suspect = self._worst(suspect, known, of_all)
            stays |= suspect
            observed = self.observed(log, known & ~suspect)
        return observed

    def _worst(self, suspect: Mask, known: Mask, evidence: Array) -> Mask:
        """Return the suspects that none beside them exceeds."""
        worst = suspect & (evidence > _WORST * evidence[known].max())
        found: Mask = worst & (evidence >= self._beside(known, evidence))
        return found

    def _worst_of_pad(self, some: Mask, evidence: Array) -> Mask:
        """Return ``some`` of the cells, the one with the highest evidence of each pad, bool
        ``[D]``."""
        pad = self.predictor.pad
        highest = np.full(pad.max() + 1, -np.inf, np.float32)
        np.maximum.at(highest, pad[some], evidence[some])
        found: Mask = some & (evidence >= highest[pad])
        return found

    def _beside(self, some: Mask, evidence: Array) -> Array:
        """Return the highest evidence of ``some`` of the cells beside each one, ``[D]``."""
        beside = self.predictor.beside
        counts = (beside >= 0) & some[beside]
        found: Array = np.where(counts, evidence[beside], -np.inf).max(axis=1, initial=-np.inf)
        return found

    def _odd_as_a_whole(self, observed: Observed, refuted: Mask, alone: Mask) -> Mask:
        """Return the cells of pads of which many that move ``alone`` are ``refuted``, bool ``[D]``
        each; all cells, where that holds of the array, or trusted ones are odd in many units."""
        whole = refuted.sum() >= _FEWEST and refuted.sum() > _DISTURBED * alone.sum()
        odd = observed.odd[:, observed.known].mean(axis=0)
        strange = len(odd) >= _FEWEST and np.quantile(odd, _MOST_CELLS) > _STRANGE * USUAL
        if whole or strange:
            return np.ones_like(refuted)
        of_pad = self.predictor.on_pad(np.stack([refuted, alone]).astype(np.float32))
        many: Mask = (of_pad[0] >= _FEWEST) & (of_pad[0] > _DISTURBED * of_pad[1])
        return many


def _moves(evidence: Array) -> Mask:
    """Return the cells of which a way to move tells more than a held value, bool ``[D]``;
    ``evidence``: ``[ways, D]``."""
    holds = np.array([way.kind is None for way in WAYS])
    found: Mask = evidence[~holds].max(axis=0) > evidence[holds].max(axis=0)
    return found


def _counting(evidence: Array, ways: Sequence[Way], disturbed: Mask) -> Array:
    """Return the evidence ``[ways, D]`` that counts: of ``disturbed`` cells (bool ``[D]``) that of
    a held value alone is more than nothing."""
    moves = np.array([way.kind is not None for way in ways])
    found: Array = np.where(moves[:, None] & disturbed, np.minimum(evidence, 0), evidence)
    return found


def _of_any(evidence: Array, ways: Sequence[Way]) -> Array:
    """Return the evidence ``[D]`` of any of the ways, of ``[ways, D]``."""
    prior = np.log([way.prior for way in ways])
    found: Array = logsumexp(evidence + prior[:, None], axis=0)
    return found


def _likeliest(evidence: Array, still: Mask) -> Cells:
    """Return the way of each cell, int ``[D]``: the one that tells most of those that explain most
    of what any way does. A value that is held tells more than another way, floating less; a cell
    that is ``still`` (bool ``[D]``) all along holds one."""
    found: Cells = evidence.argmax(axis=0)
    most = evidence.max(axis=0)
    held = [i for i, way in enumerate(WAYS) if way.kind is None]
    told = [i for i, way in enumerate(WAYS) if way.kind not in (None, FaultKind.FLOATING)]
    explains = evidence > _NEARLY_ALL * most
    explains[held] = still | (evidence[held] > _EXPLAINS * most)
    for chosen in (told, held):
        best = np.where(explains[chosen], evidence[chosen], -np.inf)
        found = np.where(explains[chosen].any(axis=0), np.array(chosen)[best.argmax(axis=0)], found)
    return found


def _with_prevalence(log_odds: Floats, judged: Mask) -> Floats:
    """Return P(faulty) ``[D]`` with the prevalence of the log, and no more than that of cells that
    are not ``judged`` (bool ``[D]``)."""
    prevalence = _PREVALENCE
    found: Floats = expit(log_odds)
    for _ in range(_ITERATIONS):
        total = found[judged].sum() + _WEIGHS * _PREVALENCE
        prevalence = total / (judged.sum() + _WEIGHS)
        found = expit(log_odds + logit(prevalence) - logit(_PREVALENCE))
    return np.where(judged, found, np.minimum(found, min(prevalence, MAJORITY)))
