"""The iterated test whether each cell depends on the others, and its result."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit, logsumexp

from diagnostics.evidence.life.healthy_table import (
    COPY,
    INTERMITTENT,
    REFUTED,
    THRESHOLD,
    WEAK,
    Cells,
    Floats,
    Mask,
)
from diagnostics.evidence.life.levels_in_log import LifeLog
from diagnostics.evidence.life.ways_to_fail import (
    WORKS,
    EvidenceOfLog,
    Suspicion,
    WaysToFail,
    follows_otherwise,
    responses,
)
from diagnostics.evidence.life.wires import FailingWires, failing_wires
from diagnostics.preprocessing.levels import DOUBTED, EXPECTED, FEWEST, MAJORITY

_SHARES = (0.4, 0.3, 0.1, 0.1, 0.1)  # of the FAULTS among faults
_ROUNDS = 16  # at most: a size
_OFTEN = 2  # times that a cell was refuted: it does not come back
_SHOWN = 2.0  # evidence against independence that proves life
_DOUBT = logit(DOUBTED) - logit(EXPECTED)  # evidence of a fault from which on a cell is in doubt
_EITHER = 1.0  # evidence against a copy, without which either of two cells may be it
_DISTURBED = 1 / 3  # share of the tested cells: if more are refuted, all are disturbed


@dataclass(frozen=True)
class Life:
    """Evidence of each cell, ``[D]``.

    Attributes:
        evidence: float, log likelihood ratio of any of the faults : healthy.
        kind: int, number of the likeliest of the ``FAULTS``, or ``WEAK``.
        shown: bool, the cell depends on the others as a healthy cell does.
        refuted: bool, cells that must not predict others.
        certain: bool, those of them that are faulty.
        lag: int, pieces by which the cell is late, if it is.
        source: int, the cell that it repeats, if it does; -1: the mean of those beside it.
        share: float, of the tested units in which a cell that comes and goes was dead.
        since: int, number of the first frame of the first unit against the cell.
        against: bool ``[units, D]``, units against the cell.
        begins: int ``[units]``, number of the first frame of each.
        highest: float, highest reading of a piece, in the layout's unit.
        wire: int, number of the wire that fails now and then, from 0; -1: none.
        of_wire: float, P(this wire fails); 0: none.
        as_one: bool, cells that read as one with those of their wire, while it fails.
        floats: bool, certain cells that do not follow the others at all, not with a lower gain
            either.
        gain: float, share of their load that certain cells read which follow the others; NaN:
            other cells.
        contradicting: share of the tested cells that are refuted, where it is so large that all are
            disturbed and none is faulty; else 0.
    """

    evidence: Floats
    kind: NDArray[np.intp]
    shown: Mask
    refuted: Mask
    certain: Mask
    lag: NDArray[np.intp]
    source: NDArray[np.intp]
    share: Floats
    since: NDArray[np.intp]
    against: Mask
    begins: NDArray[np.intp]
    highest: Floats
    wire: NDArray[np.intp]
    of_wire: Floats
    as_one: Mask
    floats: Mask
    gain: Floats
    contradicting: float

    @classmethod
    def unknown(cls, n_cells: int) -> Life:
        """Return the evidence of a log that tells nothing."""
        nothing = np.zeros(n_cells)
        zero = np.zeros(n_cells, np.intp)
        no = np.zeros(n_cells, bool)
        return cls(
            evidence=nothing,
            kind=zero,
            shown=no,
            refuted=no,
            certain=no,
            lag=zero,
            source=zero,
            share=nothing,
            since=zero,
            against=no[None],
            begins=zero[:1],
            highest=nothing,
            wire=zero - 1,
            of_wire=nothing,
            as_one=no,
            floats=no,
            gain=np.full(n_cells, np.nan),
            contradicting=0.0,
        )

    @classmethod
    def assumed(cls, n_cells: int) -> Life:
        """Return the evidence where the reference tells nothing: a cell that moves counts as
        alive."""
        return replace(cls.unknown(n_cells), shown=np.ones(n_cells, bool))

    def undecided(self) -> Life:
        """Return the evidence where a disturbance may be why cells depend on each other otherwise:
        none is refuted."""
        none = np.zeros_like(self.refuted)
        evidence = np.minimum(self.evidence, 0.0)
        return replace(self, evidence=evidence, refuted=none, certain=none, floats=none)

    @property
    def units(self) -> NDArray[np.intp]:
        """Number of units against each cell, int ``[D]``."""
        found: NDArray[np.intp] = self.against.sum(axis=0)
        return found

    def mostly_before(self, frame: NDArray[np.intp]) -> Mask:
        """Return the cells that most units against them contradict before a ``frame`` (int
        ``[D]``), bool ``[D]``."""
        before = (self.against & (self.begins[:, None] < frame)).sum(axis=0)
        found: Mask = before > MAJORITY * self.units
        return found


class LifeTest:
    """The iterated test.

    What it finds of the log, given the cells that predict others, is kept with the log: a second
    test of it is short.

    Args:
        evidence: what the log says; None: it holds too little, and tells nothing.
        eligible: bool ``[D]``, cells that are present and not explained otherwise.
        constant: bool ``[D]``, cells that look stuck now, and predict no others; None: none.
        first: an earlier test, whose result this one begins with; None: there is none.

    Attributes:
        known: bool ``[D]``, the cells that predict others.
        wires: what the wires say; None: not yet tested.
    """

    def __init__(
        self,
        evidence: EvidenceOfLog | None,
        eligible: Mask,
        constant: Mask | None = None,
        first: LifeTest | None = None,
    ) -> None:
        self._evidence = evidence
        self._eligible = eligible
        self._constant = np.zeros_like(eligible) if constant is None else constant
        self.known = eligible & ~self._constant
        self.wires: FailingWires | None = None
        if first is not None:
            self.known &= first.known
            self.wires = first.wires

    def finish(self) -> Life:
        """Return the result."""
        evidence = self._evidence
        if evidence is None:
            return Life.unknown(len(self._eligible))
        log = evidence.log
        if self.wires is None:
            self._settled(evidence, np.zeros_like(self._eligible))
            known = self._eligible & ~self._constant
            self.wires = failing_wires(log, self.known, known)
            if self.wires.refuted.any():
                self._settled(evidence, self.wires.refuted)
        else:
            self._settled(evidence, self.wires.refuted)
        wires = self.wires
        ways = evidence.ways(self.known)
        life = _concluded(log, ways, self._eligible, self._constant, wires)
        life = _without_followers(log, ways, life)
        return _with_weak(log, self.known, life)

    def _settled(self, evidence: EvidenceOfLog, out: Mask) -> None:
        """Find the cells that predict others, without those that are
        ``out`` (bool ``[D]``)."""
        log = evidence.log
        refuted = np.zeros(len(self._eligible), np.intp)  # how often each cell was
        self.known = self.known & ~out
        seen = evidence.suspicion(self.known)
        for _ in range(_ROUNDS):
            bad = self._eligible & seen.refuted(log)
            gone = self._worst(seen, bad, log.beside)
            refuted += gone
            # A cell that the others beside it had made look wrong comes back, but once only.
            returns = self._eligible & ~self._constant & ~out & ~bad & (refuted < _OFTEN)
            known = self.known & ~gone | returns
            if (known == self.known).all():
                break
            self.known = known
            seen = evidence.suspicion(known)

    def _worst(self, seen: Suspicion, bad: Mask, beside: Cells) -> Mask:
        """Return the worst of the ``bad`` cells that predict others, bool ``[D]``.

        They are worse than any cell beside them, and half as bad as the worst of all.
        """
        plain = np.maximum(seen.independent, seen.comes_and_goes)
        predicts = bad & self.known
        of_beside = np.where((beside >= 0) & self.known[beside], plain[beside], -np.inf)
        of_all = plain.max(initial=-np.inf, where=predicts)
        local = plain >= of_beside.max(axis=1, initial=-np.inf)
        found: Mask = predicts & local & (plain > MAJORITY * of_all)
        return found


def _without_followers(log: LifeLog, ways: WaysToFail, life: Life) -> Life:
    """Return the result where cells that follow the others otherwise are not floating.

    A load that lies still, another specimen, a weak cell: it reads otherwise, but it follows the
    others.
    """
    cells = np.flatnonzero((life.refuted | life.certain) & (life.kind == 0))
    if not len(cells):
        return life
    better = follows_otherwise(log, ways, cells)
    evidence = life.evidence.copy()
    follows = cells[better > REFUTED]
    evidence[follows] = np.minimum(evidence[follows], 0.0)
    floats = life.floats.copy()
    floats[cells[better > 0]] = False
    return replace(life, evidence=evidence, floats=floats)


def _with_weak(log: LifeLog, known: Mask, life: Life) -> Life:
    """Return the result where certain cells that seem to float, but follow the others with less
    than half of their load, are weak."""
    cells = np.flatnonzero(life.floats)
    if not len(cells):
        return life
    gain, z = responses(log, known)
    usual = float(np.median(gain[known & (z > WORKS)])) if (known & (z > WORKS)).any() else np.inf
    cells = cells[(z[cells] > WORKS) & (gain[cells] < MAJORITY * usual)]
    kind = life.kind.copy()
    kind[cells] = WEAK
    floats = life.floats.copy()
    floats[cells] = False
    found = life.gain.copy()
    found[cells] = gain[cells] / usual
    since = np.where(np.isfinite(found), 0, life.since)
    return replace(life, kind=kind, floats=floats, gain=found, since=since)


def _concluded(
    log: LifeLog, ways: WaysToFail, eligible: Mask, constant: Mask, wires: FailingWires
) -> Life:
    """Return the result."""
    scaled = ways.evidence * log.model.factors(log.units)
    any_fault = logsumexp(scaled + np.log(_SHARES)[:, None], axis=0)
    of_wire = np.where(wires.refuted, wires.evidence, any_fault)
    evidence = np.where(eligible, of_wire, 0.0)
    kind = np.where(wires.refuted, INTERMITTENT, ways.evidence.argmax(axis=0))
    against = np.where(wires.refuted, wires.against, ways.against)
    refuted = eligible & (evidence > REFUTED)
    certain = refuted & (evidence > THRESHOLD)
    depends = (ways.now < -_SHOWN) & (ways.evidence[0] < 0)
    # Of two cells that read the same, either may be the copy.
    in_doubt = (evidence > _DOUBT) | (scaled[COPY] > -_EITHER) | (wires.evidence > _DOUBT)
    shown = eligible & depends & ~in_doubt & ~refuted
    moving = ~constant
    alone = moving & ~wires.refuted
    contradict = int((refuted & alone).sum())
    tested = int(((shown | refuted) & alone).sum())
    contradicting = contradict / max(tested, 1)
    first = log.begins[against.argmax(axis=0)]
    life = Life(
        evidence=evidence,
        kind=kind,
        shown=shown,
        refuted=refuted,
        certain=certain,
        lag=ways.lag,
        source=ways.source,
        share=np.where(wires.refuted, wires.share, ways.share),
        since=np.where(wires.as_one, wires.since, np.where(against[0], 0, first)),
        against=against,
        begins=log.begins,
        highest=ways.highest,
        wire=wires.wire,
        of_wire=wires.probability,
        as_one=wires.as_one,
        floats=certain & (kind == 0),
        gain=np.full(len(evidence), np.nan),
        contradicting=0.0,
    )
    if contradicting > _DISTURBED and contradict >= FEWEST:
        return replace(life.undecided(), contradicting=contradicting)
    return life
