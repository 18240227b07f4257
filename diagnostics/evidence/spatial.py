"""Spatial evidence: does a healthy cell hold this value in these contact events, given the other cells?

Detects cells that hold one value v from frame s to the end of the log: open, short, or stuck anywhere. Every contact
event e after s adds to the log likelihood ratio of stuck against healthy

    sum_e  w_e * -log P(cell reads v throughout e | healthy, readings of the other cells)  +  log P(v | stuck)

The prior of v counts once: broken cells mostly stick to a rail, a healthy cell under a constant load reads any value.
Without an event the ratio is 1, whatever v is.
The ratio equals a sequence of conditional tests as in pseudo-likelihood estimation (Besag 1975). It does not detect
cells that no event loads and that no event leaves unloaded among loaded neighbours: they stay untested.

Which cells may serve as predictors depends on which cells are faulty, so the test is iterated: cells that moved are
the first predictors; then constant cells whose value is plausible join them, and cells that look stuck leave, until
nothing changes. Cells that failed together corroborate each other as predictors, so groups that one broken line would
explain are scored once more with the whole group excluded (:func:`group_excluded_evidence`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.conditional_test import (
    CellState,
    ConditionalTest,
    HeldValues,
    Mask,
    Model,
)
from diagnostics.evidence.drift import drifting, gain_evidence, misleading, offset_evidence
from diagnostics.evidence.jumps import SUDDEN_JUMP
from diagnostics.preprocessing.levels import P_MIN, SUSPICIOUS, TESTED

if TYPE_CHECKING:
    from diagnostics.events.contact_events import ContactEvent
    from diagnostics.healthy.prediction import Prediction
    from diagnostics.preprocessing.scale import Scale

_ONE_LOAD = 0.5  # correlation of the evidence that events elsewhere give about one held load
_MOST_ROUNDS = 16  # of scoring and updating the predictors, and of excluding drifting cells: a size

Floats = NDArray[np.float64]


class Exclusion(NamedTuple):
    """When a cell is excluded from the predictors; the defaults are those of a cold start and of tiles.

    Attributes:
        threshold: log evidence from which on a cell is excluded.
        gains: factor on the evidence of a changed gain, see :func:`~diagnostics.evidence.drift.gains_count`.
    """

    threshold: float = SUSPICIOUS
    gains: float = 1.0


@dataclass(frozen=True)
class Spatial:
    """Result of the spatial test.

    Attributes:
        evidence: float ``[D]``, log likelihood ratio stuck : healthy; 0 for cells that are not constant.
        surprisal: float ``[D]``, the part of it that the events add.
        initial: float ``[D]``, the same in the first round, when only cells that moved were predictors.
        scored: bool ``[D]``, the cells that are constant now.
        events: int ``[D]``, number of events that carry evidence about each cell.
        offset: float ``[D]``, log likelihood ratio that a moving cell never returns to its baseline; 0 elsewhere.
        gain: float ``[D]``, log likelihood ratio that a moving cell has another gain; 0: too few events.
        factor: float ``[D]``, that gain relative to the reference, where it is certain; NaN elsewhere.
        since: int ``[D]``, first frame of the changed gain; 0: from the start, or unknown.
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
        """Cells that move but certainly have another offset or gain, bool ``[D]``."""
        return drifting(self.offset, self.gain)

    @classmethod
    def before(cls, cells: CellState) -> Spatial:
        """Return the result without any event since earlier events were accumulated."""
        scored, d = cells.scored, len(cells.scored)
        accumulated, nothing, none = np.where(scored, cells.accumulated, 0.0), np.zeros(d), np.zeros(d, np.intp)
        unknown = np.full(d, np.nan)
        return cls(accumulated, accumulated, accumulated, scored, none, nothing, nothing, unknown, none)


class SpatialTest:
    """The iterated test; each :meth:`step` is one round, so that a control loop can spread it over frames.

    Args:
        events: the contact events, in time order.
        cells: state of each cell.
        model: the healthy model.
        scale: baseline and full scale.
        tolerance: a reading within 2 tolerances of v counts as v.
        exclusion: when a cell is excluded from the predictors.

    Attributes:
        result: of the rounds so far.
    """

    def __init__(
        self,
        events: Sequence[ContactEvent],
        cells: CellState,
        model: Model,
        scale: Scale,
        tolerance: float,
        exclusion: Exclusion,
    ) -> None:
        self.result = Spatial.before(cells)
        self._events, self._cells, self._scale, self._exclusion = events, cells, scale, exclusion
        self._final = not events
        if not events:
            prior, known = HeldValues.now(cells, scale, tolerance).prior, self.result
            self.result = replace(known, evidence=_with_prior(known.surprisal, prior))
            return
        self._test = test = ConditionalTest.of(events, cells, model, scale, tolerance)
        runs = cells.runs
        # First predictors: cells that moved, unless their load outlasts an event, or they jumped alone. Few of the
        # cells at rest are broken.
        fresh = runs.start >= events[-1].since
        plausible = test.values.rests | (fresh & (cells.temporal < SUDDEN_JUMP))
        self._predictors: Mask = test.eligible & runs.moved & plausible
        self._drifts = np.zeros(len(plausible), bool)
        self._initial: Floats | None = None
        self._rounds = self._exclusions = 0
        self._agreed: tuple[Prediction, Floats, Floats, Floats] | None = None  # scores with the final predictors

    def step(self) -> bool:
        """Score all cells once and update the predictors, or look for drift. Return whether the result is final."""
        if self._final:
            return True
        if self._agreed is not None:
            self._final = self._drift(*self._agreed)
            return self._final
        test, predictors = self._test, self._predictors & self._test.eligible
        expected, surprisal = test.score(predictors)
        summed = test.summed(surprisal)
        evidence = _with_prior(summed, test.values.prior)
        if self._initial is None:
            self._initial = summed
        self._rounds += 1
        self._predictors = test.eligible & (evidence + self._cells.temporal < self._exclusion.threshold)
        if self._rounds == _MOST_ROUNDS or (self._predictors == predictors).all():
            self._agreed = expected, surprisal, summed, evidence
        return False

    def finish(self) -> Spatial:
        """Run all rounds and return the result."""
        while not self.step():
            pass
        return self.result

    def _drift(self, expected: Prediction, surprisal: Floats, summed: Floats, evidence: Floats) -> bool:
        """Look for cells with another offset or gain; exclude them and start again if there are new ones."""
        test, cells = self._test, self._cells
        first = np.array([event.first for event in self._events])
        moved = cells.eligible & cells.runs.moved & (first[:, None] <= cells.runs.start)
        whole, on_whole = test.features[test.begins], expected.on(test.begins)
        novelty = test.novelty(expected.own)[test.begins]
        moving = moved[-1] & np.isfinite(on_whole.spread)
        offset = offset_evidence(whole, on_whole.always, moving, 1.0 if expected.own else novelty)
        gain = gain_evidence(whole, on_whole, moved, self._scale.root_near, self._exclusion.gains * novelty)
        of_gain = drifting(offset, gain.evidence) & ~drifting(offset)
        assert self._initial is not None
        self.result = Spatial(
            evidence,
            summed,
            self._initial,
            cells.scored,
            np.where(of_gain, gain.events, (surprisal > TESTED).sum(axis=0)),
            offset,
            gain.evidence,
            factor=np.where(of_gain, gain.factor, np.nan),
            since=np.where(of_gain & (gain.since > 0), first[gain.since], 0),
        )
        more = misleading(offset, gain.evidence, self._drifts)
        self._exclusions += 1
        if not more.any() or self._exclusions >= _MOST_ROUNDS:
            return True
        self._drifts = self._drifts | more
        self._test = replace(test, eligible=test.eligible & ~more)
        self._rounds, self._agreed = 0, None
        return False


def _with_prior(surprisal: Floats, prior: Floats) -> Floats:
    """Return the evidence ``[D]``: where no event was surprising, the value tells nothing either."""
    return np.where(surprisal > 0, prior + surprisal, 0.0)


def group_excluded_evidence(
    events: Sequence[ContactEvent],
    cells: CellState,
    model: Model,
    scale: Scale,
    tolerance: float,
    predictors: Mask,
    groups: Sequence[NDArray[np.intp]],
) -> Floats:
    """Return the summed surprisal with each group of cells excluded from the predictors, ``[groups, D]``.

    Args:
        events, cells, model, scale, tolerance: as for :class:`SpatialTest`.
        predictors: bool ``[D]``, the final predictors.
        groups: cell indices of each group that one fault would explain.
    """
    test = ConditionalTest.of(events, cells, model, scale, tolerance)
    summed = np.zeros((len(groups), len(predictors)))
    for i, group in enumerate(groups):
        others = predictors & test.eligible
        others[group] = False
        _, surprisal = test.score(others)
        summed[i] = test.summed(surprisal)
    return summed


def held_load_evidence(
    cells: CellState, outlasted: NDArray[np.intp], model: Model, scale: Scale, tolerance: float
) -> Floats:
    """Return the log likelihood ratio ``[D]`` of loads that are held where nothing moves.

    All cells are predictors here, so an object that rests on the skin is no fault: its cells support each other.

    Args:
        cells: state of each cell.
        outlasted: int ``[D]``, number of events elsewhere on the skin that each load has outlasted.
        model, scale, tolerance: as for :class:`SpatialTest`.
    """
    value = np.nan_to_num(cells.runs.value)
    values, root = HeldValues.of(value, scale, tolerance), scale.root_load(value)
    held = np.flatnonzero(outlasted)
    loaded = (root > scale.root_near).astype(np.float32)
    expected = model.predict(np.stack([root, root, loaded, loaded])[None], cells.eligible)
    likely = expected.always[0, held] * expected.within(values.low[held], values.high[held], held)[0]
    # One load is tested, however many events there were elsewhere.
    evidence = np.zeros(len(outlasted))
    evidence[held] = -np.log(np.maximum(likely, P_MIN)) * outlasted[held] / (1 + _ONE_LOAD * (outlasted[held] - 1))
    return evidence
