"""Spatial evidence: would a healthy cell hold this value while the other cells do what they do?

For each cell that ends the log still, at value v from frame s on, two explanations compete. Stuck: it reads v whatever
happens. Healthy: it reads v throughout a touch as often as healthy cells do when the others are touched like that.
Every touch after s adds

    log 1 / P(v throughout the touch | healthy, others)

Cells that broke together, as those on one wire, vouch for each other all the same: they are judged once more with none
of them asked (see :func:`group_excluded_evidence`).

How likely a stuck cell is to be stuck at just this v is charged once: a cell held still under a constant load also
reads one value, but an arbitrary one, while the rails are where broken cells go.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.contact_events import ContactEvent
from diagnostics.evidence.conditional_test import (
    P_MIN,
    SUDDEN_JUMP,
    CellState,
    ConditionalTest,
    HeldValues,
    Mask,
    Model,
)
from diagnostics.evidence.drift import drifting, gain_evidence, misleading, offset_evidence
from diagnostics.healthy.model import Prediction
from diagnostics.preprocessing.scale import Scale

_TELLING = 0.5  # log evidence from which on a touch counts as one that tested the cell
_ONE_LOAD = 0.5  # correlation of what touches elsewhere say of a load that outlasts them
_MOST_ROUNDS = 8  # of judging, leaving suspects out and putting others back
_MOST_DRIFTING = 16  # cells that are left out for their drift, one by one

Floats = NDArray[np.float64]


class Exclusion(NamedTuple):
    """What evidence is worth, as far as it matters while it is gathered.

    Attributes:
        suspicious: log evidence from which on a cell is left out when others are judged.
        gains: share of the evidence of another gain that counts.
    """

    threshold: float
    gains: float = 1.0


@dataclass(frozen=True)
class Spatial:
    """What the other cells say.

    Attributes:
        evidence: float ``[D]``, log likelihood ratio stuck : healthy; 0 where there is nothing to ask.
        surprise: float ``[D]``, the part of it that touches brought.
        at_first: float ``[D]``, the same while only the cells that moved were asked.
        asked: bool ``[D]``, the cells that are still now.
        touches: int ``[D]``, how many touches each was judged by that said more than nothing.
        offset: float ``[D]``, log likelihood ratio of a cell that moves, but is loaded all through the last touches,
            however little the others are; 0 for the others.
        gain: float ``[D]``, log likelihood ratio of a cell that moves, but has another gain; 0: too few touches tell.
        factor: float ``[D]``, how many times its gain in the reference, where it certainly is another; NaN elsewhere.
        since: int ``[D]``, from about which frame on; 0: all along, or not known.
    """

    evidence: Floats
    surprisal: Floats
    initial: Floats
    scored: Mask
    events: NDArray[np.intp]
    offset: Floats
    gain: Floats
    factor: Floats
    since: NDArray[np.intp]

    @property
    def drifting(self) -> Mask:
        """The cells that move, but certainly not as healthy ones do, bool ``[D]``."""
        return drifting(self.offset, self.gain)

    @classmethod
    def before(cls, cells: CellState) -> Spatial:
        """Return what is known where nothing touched the cells since earlier touches were weighed."""
        scored = cells.scored
        accumulated, nothing = np.where(scored, cells.accumulated, 0.0), np.zeros(len(scored))
        none = np.zeros(len(scored), np.intp)
        return cls(
            accumulated, accumulated, accumulated, scored, none, nothing, nothing, np.full(len(scored), np.nan), none
        )


class _Agreed(NamedTuple):
    """What the cells say that are asked in the end; ``initial``: what was brought while those asked at first were."""

    expected: Prediction
    surprisal: Floats
    summed: Floats
    initial: Floats
    evidence: Floats
    predictors: Mask


def _agreed(test: ConditionalTest, predictors: Mask, threshold: float) -> Generator[None, None, _Agreed]:
    """Ask the ``predictors`` cells, leave out those that look stuck, put the others back, until none changes sides."""
    predictors, summed = predictors & test.eligible, []
    for _ in range(_MOST_ROUNDS):
        yield
        expected, surprisal = yield from test.score(predictors)
        summed.append(test.summed(surprisal))
        evidence = np.where(test.scored, test.values.prior + summed[-1], 0.0)
        asked_now = predictors
        predictors = test.eligible & (evidence + test.cells.temporal < threshold)
        if (predictors == asked_now).all():
            break
    return _Agreed(expected, surprisal, summed[-1], summed[0], evidence, predictors)


def spatial_evidence(
    events: Sequence[ContactEvent], cells: CellState, model: Model, scale: Scale, tolerance: float, exclusion: Exclusion
) -> Generator[None, None, Spatial]:
    """Weigh stuck against healthy for each cell that is still now. A generator that pauses on its way.

    Cells that moved answer first; still cells whose value proved normal are then put back, and those that look
    stuck are left out, until no cell changes sides: cells that died side by side vouch for each other at first. Cells
    that move, but not as healthy ones do (see ``drift``), are left out as well.

    Args:
        touches: what happened.
        cells: what is known of them.
        model: what healthy looks like.
        scale: what a reading means.
        tolerance: how near to v counts as v.
        caution: what evidence is worth.
    """
    if not events:
        known, prior = Spatial.before(cells), HeldValues.now(cells, scale, tolerance).prior
        return replace(known, evidence=np.where(known.surprisal > 0, prior + known.surprisal, known.evidence))
    test = ConditionalTest.of(events, cells, model, scale, tolerance)
    values, runs = test.values, cells.runs
    # At first those are asked that moved, unless their load has outlived a touch, or jumped alone. Of the cells at rest
    # few are broken.
    first = np.array([event.first for event in events])
    moved = cells.eligible & runs.moved & (first[:, None] <= runs.start)
    fresh = runs.start >= events[-1].since
    predictors = test.eligible & runs.moved & (values.rests | (fresh & (cells.temporal < SUDDEN_JUMP)))
    agreed = yield from _agreed(test, predictors, exclusion.threshold)
    initial, drifts, whole = agreed.initial, np.zeros(len(predictors), bool), test.features[test.begins]
    for _ in range(_MOST_DRIFTING):
        yield
        expected = agreed.expected.on(test.begins)
        offset = offset_evidence(whole, expected.always, moved[-1] & np.isfinite(expected.spread))
        gain = gain_evidence(whole, expected, moved, scale.root_near, exclusion.gains * test.novelty[test.begins])
        more = misleading(offset, gain.evidence, drifts)
        if not more.any():
            break
        drifts |= more
        without = replace(test, eligible=test.eligible & ~drifts)
        agreed = yield from _agreed(without, agreed.predictors, exclusion.threshold)
    of_gain = drifting(offset, gain.evidence) & ~drifting(offset)
    return Spatial(
        agreed.evidence,
        agreed.summed,
        initial,
        test.scored,
        np.where(of_gain, gain.events, (agreed.surprisal > _TELLING).sum(axis=0)),
        offset,
        gain.evidence,
        factor=np.where(of_gain, gain.factor, np.nan),
        since=np.where(of_gain & (gain.since > 0), first[gain.since], 0),
    )


def group_excluded_evidence(
    events: Sequence[ContactEvent],
    cells: CellState,
    model: Model,
    scale: Scale,
    tolerance: float,
    predictors: Mask,
    groups: Sequence[NDArray[np.intp]],
) -> Generator[None, None, Floats]:
    """Return what touches brought against cells with nobody asked who may have broken with them, ``[groups, D]``.

    Args:
        touches, cells, model, scale, tolerance: as for :func:`spatial_evidence`.
        trusted: bool ``[D]``, those that were asked in the end.
        groups: cells each, that may have broken together.
    """
    test = ConditionalTest.of(events, cells, model, scale, tolerance)
    summed = np.zeros((len(groups), len(predictors)))
    for i, group in enumerate(groups):
        others = predictors & test.eligible
        others[group] = False
        _, surprisal = yield from test.score(others)
        summed[i] = test.summed(surprisal)
    return summed


def held_load_evidence(
    cells: CellState, outlasted: NDArray[np.intp], model: Model, scale: Scale, tolerance: float
) -> Generator[None, None, Floats]:
    """Return what it says that a load is held where nothing moves, a log likelihood ratio ``[D]``.

    All cells have a say in that, so that a thing that lies there is no fault: its cells have each other.

    Args:
        cells: what is known of them.
        outlasted: int ``[D]``, how many touches of other parts of the skin each load has outlasted.
        model, scale, tolerance: as for :func:`spatial_evidence`.
    """
    value = np.nan_to_num(cells.runs.value)
    values, root = HeldValues.of(value, scale, tolerance), scale.root_load(value)
    held = np.flatnonzero(outlasted)
    loaded = (root > scale.root_near).astype(np.float32)
    expected = yield from model.predict(np.stack([root, root, loaded, loaded])[None], cells.eligible)
    likely = expected.always[0, held] * expected.within(values.low[held], values.high[held], held)[0]
    # However often something else was touched, it is one load.
    evidence = np.zeros(len(outlasted))
    evidence[held] = -np.log(np.maximum(likely, P_MIN)) * outlasted[held] / (1 + _ONE_LOAD * (outlasted[held] - 1))
    return evidence
