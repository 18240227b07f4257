"""Spatial evidence: does a healthy cell hold this value in these contact events, given the other
cells?

Detects cells that hold one value v from frame s to the end of the log: open, short, or stuck
anywhere. Every contact event e after s adds to the log likelihood ratio of stuck against healthy

    sum_e  w_e * -log P(cell reads v throughout e | healthy, readings of the other cells)
           + log P(v | stuck)

The prior of v counts once: broken cells mostly stick to a rail, a healthy cell under a constant
load reads any value. Without an event the ratio of a load is 1; that of a rest is its prior, as any
healthy cell may be at rest. The ratio equals a sequence of conditional tests as in
pseudo-likelihood estimation (Besag 1975). It does not detect cells that no event loads and that no
event leaves unloaded among loaded neighbours: they stay untested.

Which cells may serve as predictors depends on which cells are faulty, so the test is iterated:
cells that moved are the first predictors; then constant cells whose value is plausible join them,
and cells that look stuck leave, until nothing changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.conditional_test import CellState, ConditionalTest, Mask, Model
from diagnostics.evidence.drift import drifting, offset_evidence
from diagnostics.preprocessing.levels import SUSPICIOUS, TESTED

if TYPE_CHECKING:
    from diagnostics.events.contact_events import ContactEvent
    from diagnostics.evidence.prediction import Prediction

_MOST_ROUNDS = 16  # of scoring and updating the predictors, and of excluding drifting cells: a size

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Spatial:
    """Result of the spatial test.

    Attributes:
        evidence: float ``[D]``, log likelihood ratio stuck : healthy; 0 for cells that are not
            constant.
        surprisal: float ``[D]``, the part of it that the events add.
        scored: bool ``[D]``, the cells that are constant now.
        events: int ``[D]``, number of events that carry evidence about each cell.
        offset: float ``[D]``, log likelihood ratio that a moving cell never returns to its
            baseline; 0 elsewhere.
    """

    evidence: Floats
    surprisal: Floats
    scored: Mask
    events: NDArray[np.intp]
    offset: Floats

    @property
    def drifting(self) -> Mask:
        """Cells that move but certainly have another offset, bool ``[D]``."""
        return drifting(self.offset)

    @classmethod
    def before(cls, cells: CellState) -> Spatial:
        """Return the result without any event since earlier events were accumulated."""
        scored = cells.scored
        accumulated = np.where(scored, cells.accumulated, 0.0)
        nothing = np.zeros(len(scored))
        none = np.zeros(len(scored), np.intp)
        return cls(_with_prior(accumulated, cells), accumulated, scored, none, nothing)


class SpatialTest:
    """The iterated test.

    Args:
        events: the contact events, in time order.
        cells: state of each cell.
        model: the healthy model.

    Attributes:
        result: None before it is found.
    """

    def __init__(
        self,
        events: Sequence[ContactEvent],
        cells: CellState,
        model: Model,
    ) -> None:
        self.result = None if events else Spatial.before(cells)
        if not events:
            return
        self._events = events
        self._cells = cells
        self._test = ConditionalTest.of(events, cells, model)
        # First predictors: cells that moved, unless their load outlasts an event. Few of the cells
        # at rest are broken.
        fresh = cells.runs.start >= events[-1].since
        plausible = cells.values.rests | fresh
        self._predictors: Mask = cells.eligible & cells.runs.moved & plausible
        self._agreed: tuple[Prediction, Floats] | None = None  # score with the final predictors
        self._rounds = self._exclusions = 0

    def finish(self) -> Spatial:
        """Return the result: all cells are scored and the predictors updated until they agree, then
        drift is looked for."""
        while self.result is None:
            if self._agreed is None:
                self._update()
            else:
                self._look_for_drift(*self._agreed)
        return self.result

    def _update(self) -> None:
        test = self._test
        before = self._predictors & self._test.eligible
        expected, surprisal = test.score(before)
        evidence = _with_prior(test.summed(surprisal), self._cells)
        self._predictors = test.eligible & (evidence + self._cells.temporal < SUSPICIOUS)
        self._rounds += 1
        if self._rounds == _MOST_ROUNDS or (self._predictors == before).all():
            self._agreed = expected, surprisal

    def _look_for_drift(self, expected: Prediction, surprisal: Floats) -> None:
        """Exclude cells that no longer return to their baseline and start again, or set the result
        if there is no new one."""
        test = self._test
        offset = _offset(self._events, test, expected)
        more = drifting(offset) & test.eligible
        self._exclusions += 1
        if more.any() and self._exclusions < _MOST_ROUNDS:
            self._test = replace(test, eligible=test.eligible & ~more)
            self._agreed = None
            self._rounds = 0
            return
        summed = test.summed(surprisal)
        self.result = Spatial(
            _with_prior(summed, self._cells),
            summed,
            self._cells.scored,
            (surprisal > TESTED).sum(axis=0),
            offset,
        )


def _offset(events: Sequence[ContactEvent], test: ConditionalTest, expected: Prediction) -> Floats:
    """Return the evidence ``[D]`` of an offset; ``expected``: of the excerpts of the test."""
    whole = test.begins
    runs = test.cells.runs
    of_events = expected.on(whole)
    moving = test.cells.eligible & runs.moved & (events[-1].first <= runs.start)
    moving &= np.isfinite(of_events.spread)
    return offset_evidence(test.features[whole], of_events.always, moving, test.novelty[whole])


def _with_prior(surprisal: Floats, cells: CellState) -> Floats:
    """Return the evidence ``[D]``.

    A load that no event tests tells nothing, nor does a cell at rest that never moved. That one
    came to rest does: any healthy cell may.
    """
    came_to_rest = cells.values.rests & cells.runs.moved
    tells = cells.scored & (came_to_rest | (surprisal > 0))
    return np.where(tells, cells.values.prior + surprisal, 0.0)
