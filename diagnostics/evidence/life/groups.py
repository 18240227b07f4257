"""Groups that fail as a whole: cells of one bus, converter or connector that read as one.

Healthy cells of a group differ from each other, and have noise. Behind a bad connector all of them
read one value, whatever it is and however it moves, or none of them changes. So the state of a
group in a piece is one of::

    0       usual
    1..9    one reading, none that changes, or both; at rest, loaded, or at full scale

and is compared with a Markov chain of the reference, P(state | state a piece ago). A group that
fails is in any of the states 1 to 9 equally often.

Not detected: groups whose healthy cells all read the same without noise, as at a threshold, where
they fail to just that; a group that fails and keeps the loads and the noise of its cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.life.healthy_table import STATES, Floats, Levels, Mask
from diagnostics.evidence.life.levels_in_log import LevelLog, LifeLog
from diagnostics.evidence.life.life_model import GroupModel, LifeModel, cells_on_lines
from diagnostics.evidence.life.over_time import dies_and_recovers, from_some_unit
from diagnostics.evidence.life.record import PIECE
from diagnostics.evidence.life.tables import (
    counts_of,
    log_table,
    shares_of_errors,
    shrinkage_of,
)
from diagnostics.preprocessing.levels import LEAST_LOADED, MAJORITY

if TYPE_CHECKING:
    from diagnostics.evidence.life.folds import Fold
    from diagnostics.layout import SensorLayout
    from diagnostics.wiring import LineKind

_AS_ONE = 0.95  # of the pieces of a group that fails
_RECOVERS = 0.1  # probability per piece
_KINDS: tuple[LineKind, ...] = ("converter", "bus", "group")


def log_of(groups: GroupModel, log: LifeLog, eligible: Mask) -> tuple[LevelLog, Floats]:
    """Return the states in a log, and log P(state | healthy), ``[n, G]``."""
    state = groups.states(log.loads, log.readings, log.constant, eligible)
    on = groups.on.T.astype(np.float64)
    readings = np.where(np.isnan(log.readings), 0.0, log.readings) @ on / on.sum(axis=0)
    # The chain knows that successive pieces are alike: each is a unit, independent of the others.
    weight = np.ones(len(state))
    own = LevelLog(state.astype(np.float64), readings, log.piece, groups, weight, state, unit=1)
    group = np.arange(state.shape[1])
    healthy = groups.table[groups.of_cell(group), before(state, log.piece), state]
    return own, healthy.astype(np.float64)


def before(state: Levels, piece: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the state of each group a piece ago, int ``[n, G]``; 10: unknown."""
    found = np.full(state.shape, STATES, np.intp)
    found[1:] = np.where((np.diff(piece) == 1)[:, None], state[:-1], STATES)
    return found


@dataclass(frozen=True)
class GroupTest:
    """What a log says of each group.

    Attributes:
        evidence: float ``[G]``, log ratio fails as a whole : healthy, before the factors.
        holds: bool ``[G]``, groups that seem to have broken once and for all, and hold a value
            since: their cells tell which.
        dead: float ``[units, G]``, the same of the worst piece of each unit.
        since: int ``[G]``, number of the first frame in which it failed.
    """

    evidence: Floats
    holds: Mask
    dead: Floats
    since: NDArray[np.intp]


def tested_groups(log: LifeLog, groups: GroupModel, eligible: Mask) -> GroupTest:
    """Return the evidence of each group; ``eligible``: bool ``[D]``, cells that tell of theirs."""
    own, healthy = log_of(groups, log, eligible)
    dead = own.counted(_failing(own.level) - healthy)
    # How often a group fails is not known: at least once.
    recovers, _ = dies_and_recovers(dead, 1 / len(dead), _RECOVERS)
    lasting = from_some_unit(dead)
    begins = own.unit_begins[np.flip(dead, axis=0).cumsum(axis=0)[::-1].argmax(axis=0)]
    since = [own.readings[begin:, g] for g, begin in enumerate(begins.tolist())]
    holds = np.array([np.ptp(readings) <= 2 * groups.tolerance for readings in since])
    holds &= lasting >= recovers
    evidence = np.maximum(recovers, lasting)
    of_unit = np.maximum.reduceat(dead, log.unit_begins, axis=0)
    return GroupTest(evidence, holds, of_unit, _first_frames(own, dead, log.ends_as_one))


def _first_frames(
    own: LevelLog, dead: Floats, ends_as_one: NDArray[np.uint8] | None
) -> NDArray[np.intp]:
    """Return the number of the first frame in which each group read as one, int ``[G]``.

    It lies in the first of the runs of pieces that speak against the group at least half as much as
    the worst one, summed up; ``dead``: float ``[n, G]``, log ratio of each.
    """
    since = np.zeros(dead.shape[1], np.intp)
    summed = np.zeros(dead.shape)
    summed[0] = np.maximum(dead[0], 0.0)
    for k in range(1, len(dead)):
        summed[k] = np.where(dead[k] > 0, summed[k - 1] + dead[k], 0.0)
    told = (summed >= MAJORITY * summed.max(axis=0)).argmax(axis=0)
    for g, piece in enumerate(told.tolist()):
        while piece and summed[piece - 1, g] > 0:
            piece -= 1
        since[g] = own.piece[piece] * PIECE
        if ends_as_one is None or not ends_as_one[piece, g]:
            continue
        since[g] += PIECE - ends_as_one[piece, g]
        while (
            piece
            and ends_as_one[piece, g] >= PIECE
            and own.piece[piece - 1] == own.piece[piece] - 1
        ):
            piece -= 1
            since[g] -= ends_as_one[piece, g]
    return since


def fit_groups(
    held_out: Sequence[LifeModel], folds: Sequence[Fold], layout: SensorLayout
) -> tuple[GroupModel | None, list[GroupModel | None]]:
    """Return the model, and that for each fold, fitted to the others; None: no group has enough
    cells.

    Args:
        held_out: models of the cells for each fold, fitted to the others.
        folds: of the reference.
        layout: the array.
    """
    present = layout.present.ravel()
    on = cells_on_lines(layout, _KINDS)
    if not len(on):
        return None, [None] * len(folds)
    constant = np.concatenate([fold.constant[:, present] for fold in folds])
    blank = GroupModel(
        levels=np.zeros(0),
        predicted=np.zeros(0),
        table=np.zeros((0, 0, 0), np.float32),
        independent=1.0,
        errs=np.zeros(0),
        reached=np.zeros((1, len(on))),
        units=1,
        counts=1.0,
        on=on,
        tolerance=held_out[0].tolerance,
        noise=bool(constant.mean() <= LEAST_LOADED),
    )
    states = [blank.states(fold.loads, fold.readings, fold.constant, present) for fold in folds]
    shape = (len(on), STATES + 1, STATES)
    every = np.ones(len(on), bool)
    counts = np.stack(
        [
            counts_of(before(state, fold.piece), state, shape, every)
            for state, fold in zip(states, folds, strict=True)
        ]
    )
    total = counts.sum(axis=0)
    shrinkage = shrinkage_of(counts, total)
    fitted = replace(blank, table=log_table(total, shrinkage))
    models = [replace(fitted, table=log_table(total - of, shrinkage)) for of in counts]
    ratios = []
    for model, fold, groups in zip(held_out, folds, models, strict=True):
        log = LifeLog(fold.loads, fold.readings, fold.constant, fold.piece, model, layout.beside)
        own, healthy = log_of(groups, log, present)
        # Groups are alike: what was never seen of any of them is rare in each.
        ratios.append(own.by_unit(_failing(own.level) - healthy).reshape(-1, 1))
    one = np.ones(1, bool)
    errs, without = shares_of_errors(ratios, blank.independent, one, one, least=0.0)
    return replace(fitted, errs=np.repeat(errs, len(on))), [
        replace(model, errs=np.repeat(of, len(on)))
        for model, of in zip(models, without, strict=True)
    ]


def _failing(state: Levels) -> Floats:
    """Return log P(state | fails as a whole)."""
    found: Floats = np.where(
        state > 0, float(np.log(_AS_ONE / (STATES - 1))), float(np.log(1 - _AS_ONE))
    )
    return found
