"""Wires that fail now and then: is the mean load of their cells what the cells off them say?

The cells of a wire fail together, and predict each other: one by one they look healthy. A wire is
tested as a cell is, with the mean root load of its cells, the prediction by the cells that are not
on it, and a table of its own; it is at rest in the units of a two-state Markov chain, or where its
predicted level exceeds one of four limits. The worst wire is taken out of the predictors first.

Not detected: wires of fewer than three cells, a wire without others that could tell of its load,
one that healthy contacts often leave alone (an edge), one whose cells keep a load or another rest
level while it is open. A wire that breaks once and for all is found by its constant cells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from diagnostics.evidence.life.groups import tested_groups
from diagnostics.evidence.life.healthy_table import AGAINST, FEWEST_CELLS, THRESHOLD, Floats, Mask
from diagnostics.evidence.life.levels_in_log import LevelLog, LifeLog
from diagnostics.evidence.life.life_model import WireModel
from diagnostics.evidence.life.over_time import (
    dies_and_recovers,
    from_some_unit,
    opens_under_load,
)
from diagnostics.preprocessing.levels import CERTAIN_RATIO, EXPECTED_LATE, MAJORITY, TESTED

# Evidence that makes up for how rare broken wires are, and for contacts unlike the reference's.
_BROKEN = CERTAIN_RATIO / 2 - float(np.log(EXPECTED_LATE))
_PROVEN = _BROKEN + float(np.log(9.0))  # at odds of 9
_MOST_WIRES = 4  # that fail in a log: where more do, the whole array is disturbed


@dataclass(frozen=True)
class WireTest:
    """What a log says of each wire, given the cells that predict others.

    Attributes:
        evidence: float ``[W]``, log ratio fails now and then : healthy, before the factors.
        dead: float ``[units, W]``, the same of each unit, at rest.
    """

    evidence: Floats
    dead: Floats


@dataclass(frozen=True)
class FailingWires:
    """What the wires say of each cell.

    Attributes:
        evidence: float ``[D]``, of the worst wire of each cell, after the factors; 0: none.
        wire: int ``[D]``, number of the wire that fails, from 0; -1: none.
        probability: float ``[D]``, of this wire; 0: none.
        against: bool ``[units, D]``, units in which these were at rest.
        share: float ``[D]``, share of the tested units in which they were at rest.
        as_one: bool ``[D]``, cells that read as one, instead of being at rest.
        since: int ``[D]``, number of the first frame in which these did.
    """

    evidence: Floats
    wire: NDArray[np.intp]
    probability: Floats
    against: Mask
    share: Floats
    as_one: Mask
    since: NDArray[np.intp]

    @classmethod
    def none(cls, units: int, n_cells: int) -> FailingWires:
        """Return what is known before any test."""
        zero = np.zeros(n_cells)
        no = np.zeros(n_cells, bool)
        against = np.zeros((units, n_cells), bool)
        since = np.zeros(n_cells, np.intp)
        return cls(zero, np.full(n_cells, -1), zero, against, zero, no, since)

    def with_one(
        self, on: Mask, scaled: float, dead: Floats, *, since: int | None = None
    ) -> FailingWires:
        """Return what is known with one more that fails.

        Args:
            on: bool ``[D]``, its cells.
            scaled: its evidence, after the factors.
            dead: float ``[units]``, the same of each unit.
            since: number of the first frame in which its cells read as one; None: they are at
                rest.
        """
        share = (dead > TESTED).sum() / max(1, (np.abs(dead) > TESTED).sum())
        return FailingWires(
            np.where(on, np.maximum(self.evidence, scaled), self.evidence),
            np.where(on, self.wire.max() + 1, self.wire),
            np.where(on, expit(scaled - _BROKEN), self.probability),
            np.where(on, (dead > AGAINST)[:, None], self.against),
            np.where(on, share, self.share),
            self.as_one | (on & (since is not None)),
            np.where(on, since or 0, self.since),
        )

    @property
    def refuted(self) -> Mask:
        """bool ``[D]``, cells on wires that fail."""
        found: Mask = self.wire >= 0
        return found


def wire_log(
    log: LifeLog, wires: WireModel, known: Mask, eligible: Mask
) -> tuple[LevelLog, NDArray[np.intp], Floats]:
    """Return the levels of the wires, what the others say of them, and log P(level | healthy),
    ``[n, W]``.

    Args:
        log: the levels of the cells.
        wires: the model.
        known: bool ``[D]``, cells that predict others.
        eligible: bool ``[D]``, cells that tell of their wire.
    """
    told = wires.told(log.loads, known)
    readings = np.where(told, wires.means(log.readings, eligible), np.nan)
    means = wires.means(log.loads, eligible)
    own = LevelLog(means, readings, log.piece, wires, log.weight)
    expected = wires.expected(log.model.means, log.loads, known, eligible)
    context = wires.contexts(expected, means, log.loads, log.piece, known)
    healthy = own.tilted(wires.probabilities, context, own.level)
    return own, context, healthy


def tested_wires(log: LifeLog, wires: WireModel, known: Mask, eligible: Mask) -> WireTest:
    """Return the evidence of each wire; arguments as in :func:`wire_log`."""
    own, context, healthy = wire_log(log, wires, known, eligible)
    ratio = own.at_rest - healthy
    # A load that is not predicted, as of a faulty cell on the wire, is no sign of an open one.
    ratio = np.where(own.level > 0, np.minimum(ratio, 0.0), ratio)
    dead = own.counted(ratio)
    intermittent, _ = dies_and_recovers(dead)
    opens = opens_under_load(own, ratio, context // wires.per_level)
    evidence = np.maximum(intermittent, opens)
    # Its cells tell more of a wire that broke once and for all: the value that they hold, since
    # when.
    evidence = np.where(from_some_unit(dead) < evidence, evidence, 0.0)
    enough = (wires.on & eligible).sum(axis=1) >= FEWEST_CELLS
    # Where healthy ones look as if they failed, the others do not tell of the wire.
    enough &= wires.reached[0] < THRESHOLD
    # An open wire reads one and the same: rest levels that creep look like loads, and like none.
    without = np.where((own.level == 0) & (ratio > 0), own.readings, np.nan)
    wanders = np.fmax.reduce(without) - np.fmin.reduce(without)
    enough &= ~(wanders > 2 * log.model.tolerance)
    # Those beside it tell most of a wire.
    enough &= (wires.beside & known).sum(axis=1) >= MAJORITY * wires.beside.sum(axis=1)
    return WireTest(np.where(enough, evidence, 0.0), dead)


def failing_wires(log: LifeLog, known: Mask, eligible: Mask) -> FailingWires:
    """Return what the wires say of each cell; arguments as in :func:`wire_log`."""
    failing = _failing_groups(log, eligible)
    wires = log.model.wires
    found = 0
    while wires is not None:
        free = ~failing.refuted
        test = tested_wires(log, wires, known & free, eligible & free)
        scaled = test.evidence * wires.factors(log.units)[0]
        of_cell = np.where(wires.on & eligible & free, scaled[:, None], 0.0).max(axis=0)
        failing = replace(failing, evidence=np.maximum(failing.evidence, of_cell))
        worst = int(np.argmax(scaled))
        if scaled[worst] <= _PROVEN:
            break
        if found == _MOST_WIRES:
            return replace(failing, wire=np.full(len(known), -1))
        on = wires.on[worst] & eligible & free
        failing = failing.with_one(on, float(scaled[worst]), test.dead[:, worst])
        found += 1
    return failing


def _failing_groups(log: LifeLog, eligible: Mask) -> FailingWires:
    """Return what the groups say of each cell: of those that fail the largest first, which explain
    the groups in them."""
    failing = FailingWires.none(log.units, len(eligible))
    groups = log.model.groups
    if groups is None:
        return failing
    test = tested_groups(log, groups, eligible)
    scaled = test.evidence * groups.factors(log.units)[0]
    of_cell = np.where(groups.on & eligible, scaled[:, None], 0.0).max(axis=0)
    proven = (scaled > _PROVEN) & ~test.holds
    # What most of them do is the array's, or that of the recordings.
    if proven.sum() > MAJORITY * len(proven):
        return failing
    failing = replace(failing, evidence=of_cell)
    for g in np.argsort(-groups.on.sum(axis=1), kind="stable").tolist():
        on = groups.on[g] & eligible & ~failing.refuted
        if proven[g] and on.any():
            since = int(test.since[g])
            failing = failing.with_one(on, float(scaled[g]), test.dead[:, g], since=since)
    return failing
