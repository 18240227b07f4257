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
and cells that look stuck leave, until nothing changes. Cells that failed together corroborate each
other as predictors, so groups that one broken line would explain are scored once more with the
whole group excluded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.conditional_test import CellState, ConditionalTest, Mask, Model
from diagnostics.evidence.drift import Gain, drifting, gain_evidence, misleading, offset_evidence
from diagnostics.evidence.jumps import SUDDEN_JUMP
from diagnostics.preprocessing.levels import P_MIN, SUSPICIOUS, TESTED

if TYPE_CHECKING:
    from diagnostics.events.contact_events import ContactEvent
    from diagnostics.healthy.prediction import Prediction

_ONE_LOAD = 0.5  # correlation of the evidence that events elsewhere give about one held load
_MOST_ROUNDS = 16  # of scoring and updating the predictors, and of excluding drifting cells: a size

Floats = NDArray[np.float64]


class Exclusion(NamedTuple):
    """When a cell is excluded from the predictors; the defaults are those of a cold start and of
    tiles.

    Attributes:
        threshold: log evidence from which on a cell is excluded.
        baselines, gains: factor on the evidence of an offset, and of a changed gain, see
            :func:`~diagnostics.evidence.drift.drift_counts`.
    """

    threshold: float = SUSPICIOUS
    baselines: float = 1.0
    gains: float = 1.0


@dataclass(frozen=True)
class Spatial:
    """Result of the spatial test.

    Attributes:
        evidence: float ``[D]``, log likelihood ratio stuck : healthy; 0 for cells that are not
            constant.
        surprisal: float ``[D]``, the part of it that the events add.
        initial: float ``[D]``, the same in the first round, when only cells that moved were
            predictors.
        scored: bool ``[D]``, the cells that are constant now.
        events: int ``[D]``, number of events that carry evidence about each cell.
        offset: float ``[D]``, log likelihood ratio that a moving cell never returns to its
            baseline; 0 elsewhere.
        gain: float ``[D]``, log likelihood ratio that a moving cell has another gain; 0: too few
            events.
        factor: float ``[D]``, that gain relative to the reference, where it is certain; NaN
            elsewhere.
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
        accumulated = np.where(scored, cells.accumulated, 0.0)
        nothing = np.zeros(d)
        none = np.zeros(d, np.intp)
        evidence = _with_prior(accumulated, cells)
        unknown = np.full(d, np.nan)
        return cls(
            evidence, accumulated, accumulated, scored, none, nothing, nothing, unknown, none
        )


class SpatialTest:
    """The iterated test.

    Args:
        events: the contact events, in time order.
        cells: state of each cell.
        model: the healthy model.
        exclusion: when a cell is excluded from the predictors.
        misleading: bool ``[D]``, cells that are tested and predict no others; None: none.

    Attributes:
        result: None before it is found.
    """

    def __init__(
        self,
        events: Sequence[ContactEvent],
        cells: CellState,
        model: Model,
        exclusion: Exclusion,
        misleading: Mask | None = None,
    ) -> None:
        self.result = None if events else Spatial.before(cells)
        if not events:
            return
        self._events = events
        self._cells = cells
        self._exclusion = exclusion
        self._test = ConditionalTest.of(events, cells, model)
        if misleading is not None:
            self._test = replace(self._test, eligible=self._test.eligible & ~misleading)
        # First predictors: cells that moved, unless their load outlasts an event, or they jumped
        # alone. Few of the cells at rest are broken.
        fresh = cells.runs.start >= events[-1].since
        plausible = cells.values.rests | (fresh & (cells.temporal < SUDDEN_JUMP))
        self._predictors: Mask = cells.eligible & cells.runs.moved & plausible
        self._summed: list[Floats] = []  # surprisal of each round
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
        self._summed.append(test.summed(surprisal))
        evidence = _with_prior(self._summed[-1], self._cells)
        self._predictors = test.eligible & (
            evidence + self._cells.temporal < self._exclusion.threshold
        )
        self._rounds += 1
        if self._rounds == _MOST_ROUNDS or (self._predictors == before).all():
            self._agreed = expected, surprisal

    def _look_for_drift(self, expected: Prediction, surprisal: Floats) -> None:
        """Exclude cells with another offset or gain and start again, or set the result if there is
        no new one."""
        test = self._test
        first = np.array([event.first for event in self._events])
        offset, gain = _drift(first, test, expected, self._exclusion)
        more = misleading(offset, gain.evidence, ~test.eligible)
        self._exclusions += 1
        if more.any() and self._exclusions < _MOST_ROUNDS:
            self._test = replace(test, eligible=test.eligible & ~more)
            self._agreed = None
            self._rounds = 0
            return
        of_gain = drifting(offset, gain.evidence) & ~drifting(offset)
        self.result = Spatial(
            _with_prior(self._summed[-1], self._cells),
            self._summed[-1],
            self._summed[0],
            self._cells.scored,
            np.where(of_gain, gain.events, (surprisal > TESTED).sum(axis=0)),
            offset,
            gain.evidence,
            factor=np.where(of_gain, gain.factor, np.nan),
            since=np.where(of_gain & (gain.since > 0), first[gain.since], 0),
        )


def _drift(
    first: NDArray[np.intp], test: ConditionalTest, expected: Prediction, exclusion: Exclusion
) -> tuple[Floats, Gain]:
    """Return the evidence ``[D]`` of an offset, and that of a changed gain.

    Args:
        first: int ``[n]``, first frame of each event.
        test: of these events.
        expected: prediction for their excerpts.
        exclusion: has the factors on the evidence.
    """
    runs = test.cells.runs
    moved = test.cells.eligible & runs.moved & (first[:, None] <= runs.start)
    whole = test.features[test.begins]
    on_whole = expected.on(test.begins)
    novelty = test.novelty(expected.own)[test.begins]
    moving = moved[-1] & np.isfinite(on_whole.spread)
    offset = offset_evidence(whole, on_whole.always, moving, exclusion.baselines * novelty)
    return offset, gain_evidence(
        whole, on_whole, moved, test.cells.scale.root_near, exclusion.gains * novelty
    )


def _with_prior(surprisal: Floats, cells: CellState) -> Floats:
    """Return the evidence ``[D]``.

    A load that no event tests tells nothing, nor does a cell at rest that never moved. That one
    came to rest does: any healthy cell may.
    """
    came_to_rest = cells.values.rests & cells.runs.moved
    tells = cells.scored & (came_to_rest | (surprisal > 0))
    return np.where(tells, cells.values.prior + surprisal, 0.0)


def held_load_evidence(cells: CellState, outlasted: NDArray[np.intp], model: Model) -> Floats:
    """Return the log likelihood ratio ``[D]`` of loads that are held where nothing moves.

    All cells are predictors here, so an object that rests on the skin is no fault: its cells
    support each other.

    Args:
        cells: state of each cell.
        outlasted: int ``[D]``, number of events elsewhere on the skin that each constant load has
            outlasted.
        model: the healthy model.
    """
    held = np.flatnonzero(outlasted)
    root = cells.scale.root_load(np.nan_to_num(cells.runs.value))
    loaded = (root > cells.scale.root_near).astype(np.float32)
    expected = model(np.stack([root, root, loaded, loaded])[None], cells.eligible)
    likely = (
        expected.always[0, held]
        * expected.within(cells.values.low[held], cells.values.high[held], held)[0]
    )
    # One load is tested, however many events there were elsewhere.
    evidence = np.zeros(len(outlasted))
    evidence[held] = (
        -np.log(np.maximum(likely, P_MIN))
        * outlasted[held]
        / (1 + _ONE_LOAD * (outlasted[held] - 1))
    )
    return evidence
