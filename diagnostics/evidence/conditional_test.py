"""Conditional test: probability of the constant value of each cell in each event, given the
readings of the predictors.

Computes for event e and constant cell i the surprisal

    -w_e log P(cell i reads v_i throughout e | healthy, predictors)

with r_e earlier events that load the same cells. The model knows the surroundings of a cell only,
so that repeats tell nothing new: w_e = u_e = 1 / (1 + r_e); for a cell at rest
w_e = 2.5 u_e / (1 + 0.15 (sum u - 1)), as any two events share the errors (design effect, Kish
1965). P is the predicted probability of staying
unloaded for a cell at its baseline, and of staying loaded near v_i for one that holds a load. In
unusual events the model errs about many cells at once. So the probability is averaged over powers
0.25 to 1 of the odds (tempered likelihoods), each with its posterior given the moving cells of the
same event (Bayesian model averaging); the spread of loads is inflated by their median error. Errors
that no moving cell shows are not recognised.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit, softmax

from diagnostics.events.constant_runs import SHORTEST_RUN, ConstantRuns
from diagnostics.events.contact_events import THE_SAME, ContactEvent, count_repeats
from diagnostics.evidence.prediction import MEDIAN_ERROR, Prediction
from diagnostics.preprocessing.levels import ANYWHERE, P_MIN
from diagnostics.preprocessing.scale import Array, Scale

_POWERS = (0.25, 0.5, 0.75, 1.0)  # of the likelihood of the model, in one event
# pseudo-count of cells with a usual error; upper limit: all cells may be dead
_PRIOR_CELLS = 4
_MAX_INFLATION = 4.0
_SHARED = 0.15  # correlation of the errors of two events
# of an event; benchmarks/cold_calibration.py fits 2.9, at less precision
_AT_REST = 2.5

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Model = Callable[[Array, Mask], Prediction]  # the method ``predict`` of a healthy model


@dataclass(frozen=True)
class CellState:
    """State of each cell before the spatial test, ``[D]``.

    Attributes:
        runs: the constant runs.
        scale: baseline and full scale.
        tolerance: a reading within 2 tolerances of a value counts as that value.
        accumulated: float, evidence of earlier events for the runs that still last.
        temporal: float, log likelihood ratio of the run and of the jump into it, if the cell jumped
            alone.
        eligible: bool, cells that are present and not known to be faulty.
    """

    runs: ConstantRuns
    scale: Scale
    tolerance: float
    accumulated: Floats
    temporal: Floats
    eligible: Mask

    def of(self, cells: NDArray[np.intp]) -> CellState:
        """Return the state of some cells."""
        runs = self.runs.of(cells)
        scale = self.scale.of(cells)
        accumulated = self.accumulated[cells]
        temporal = self.temporal[cells]
        eligible = self.eligible[cells]
        return CellState(runs, scale, self.tolerance, accumulated, temporal, eligible)

    @property
    def scored(self) -> Mask:
        """bool ``[D]``, constant cells that are not known to be faulty."""
        return self.eligible & (self.runs.length >= SHORTEST_RUN)

    @cached_property
    def values(self) -> HeldValues:
        """The values of the ``scored`` cells; those of the others count as 0."""
        value = np.where(self.scored, np.nan_to_num(self.runs.value), 0.0)
        return HeldValues.of(value, self.scale, self.tolerance)


@dataclass(frozen=True)
class HeldValues:
    """Values of constant cells, ``[D]``.

    Attributes:
        rests: bool, the value is at the baseline.
        low, high: float, root loads that count as the value.
        prior: float, log probability that a broken cell sticks to this value.
    """

    rests: Mask
    low: Floats
    high: Floats
    prior: Floats

    @classmethod
    def of(cls, value: Floats, scale: Scale, tolerance: float) -> HeldValues:
        """Return the values of cells that read ``value`` (``[D]``)."""
        rests = scale.root_load(value) <= scale.root_near
        full = value >= scale.full_scale - 2 * tolerance
        low = scale.root_load(value - 2 * tolerance).astype(np.float64)
        high = np.where(full, np.inf, scale.root_load(value + 2 * tolerance))
        anywhere = ANYWHERE * 4 * tolerance / scale.full_scale
        return cls(rests, low, high, np.log(np.where(rests | full, (1 - ANYWHERE) / 2, anywhere)))


@dataclass(frozen=True)
class ConditionalTest:
    """The test for any choice of predictors.

    Attributes:
        cells: state of the cells.
        model: the healthy model.
        eligible: bool ``[D]``, cells that may be predictors.
        features, begins, counted: see :func:`_excerpts`.
        repeats: int ``[n, 1]``, r_e of each excerpt.
    """

    cells: CellState
    model: Model
    eligible: Mask
    features: Array
    begins: Mask
    counted: Mask
    repeats: NDArray[np.intp]

    @classmethod
    def of(cls, events: Sequence[ContactEvent], cells: CellState, model: Model) -> ConditionalTest:
        """Prepare the test of one event or more."""
        features, begins, counted = _excerpts(events, cells.runs, cells.scored)
        repeats = count_repeats(events, THE_SAME, cells.values.rests | ~cells.scored)[
            begins.cumsum() - 1, None
        ]
        return cls(cells, model, cells.eligible, features, begins, counted, repeats)

    def score(self, predictors: Mask) -> tuple[Prediction, Floats]:
        """Return the prediction of the ``predictors`` (bool ``[D]``), and the surprisal of each
        excerpt ``[n, D]``."""
        expected = self.model(self.features, predictors)
        values = self.cells.values
        held = np.flatnonzero(self.cells.scored & ~values.rests)
        likely = _tempered(
            expected.never, self.features[:, 2] == 0, predictors & self.cells.runs.moved
        )
        inflation = _inflation(expected, self.features, predictors)
        within = expected.within(values.low[held], values.high[held], held, inflation)
        likely[:, held] = expected.always[:, held] * within
        surprisal = -self._weights * np.log(np.maximum(likely, P_MIN))
        return expected, np.where(self.counted, surprisal, 0.0)

    @property
    def novelty(self) -> Floats:
        """The weight u_e of each excerpt, ``[n, 1]``."""
        return np.asarray(1 / (1 + self.repeats))

    @property
    def _weights(self) -> Floats:
        """The weight w_e of each excerpt for each cell, ``[n, D]``, see the module."""
        weights = self.novelty
        scale = _AT_REST / (1 + _SHARED * (weights[self.begins].sum() - 1))
        return weights * np.where(self.cells.values.rests, scale, 1.0)

    def summed(self, surprisal: Floats) -> Floats:
        """Return the evidence ``[D]`` of all events, earlier ones included."""
        return np.where(self.cells.scored, self.cells.accumulated + surprisal.sum(axis=0), 0.0)


def _excerpts(
    events: Sequence[ContactEvent], runs: ConstantRuns, scored: Mask
) -> tuple[Array, Mask, Mask]:
    """Return the excerpts of events that carry evidence.

    For each ``scored`` cell (bool ``[D]``) one excerpt of each event counts: the longest within its
    constant run.

    Returns:
        Features ``[n, 4, D]``, whether the excerpt is a whole event ``[n]``, whether it counts for
        a cell ``[n, D]``.
    """
    suffixes = [suffix for event in events for suffix in event.suffixes()]
    first = np.array([suffix.first for suffix in suffixes])
    begins = np.array([i == 0 for event in events for i in range(len(event.parts))])
    within = first[:, None] >= runs.start
    earlier = np.concatenate([np.zeros((1, len(scored)), bool), within[:-1]]) & ~begins[:, None]
    counted = within & ~earlier & scored
    needed = np.flatnonzero(begins | counted.any(axis=1))
    return np.stack([suffixes[i].features() for i in needed]), begins[needed], counted[needed]


def _inflation(expected: Prediction, features: Array, working: Mask) -> Floats:
    """Return the factor on the spread in each excerpt, ``[n]``, 1 to 4.

    The median error of the ``working`` cells (bool ``[D]``) relative to that of Student's t.
    """
    known = working & np.isfinite(expected.spread)
    loaded = features[:, 2, known] > 0
    error = np.abs(features[:, 1, known] - expected.mean[:, known]) / expected.spread[known]
    error = np.column_stack(
        [np.where(loaded, error, np.inf), np.full((len(features), _PRIOR_CELLS), MEDIAN_ERROR)]
    )
    middle = (loaded.sum(axis=1) + _PRIOR_CELLS) // 2
    half: Floats = np.sort(error, axis=1)[np.arange(len(features)), middle]
    return np.clip(half / MEDIAN_ERROR, 1.0, _MAX_INFLATION)


def _tempered(never: Floats, unloaded: NDArray[np.bool_], working: NDArray[np.bool_]) -> Floats:
    """Return P(unloaded throughout) ``[n, D]``, tempered in events in which the model errs about
    the working cells.

    Args:
        never: ``[n, D]``, the probability predicted.
        unloaded: bool ``[n, D]``, whether the cells stayed unloaded.
        working: bool ``[D]``, cells that are known to work.
    """
    odds = logit(np.maximum(never, P_MIN))
    # infinite odds: no model of the cell
    right = np.where(unloaded | np.isinf(odds), odds, -odds)[:, working]
    likelihood = -np.stack([np.log1p(np.exp(-power * right)).sum(axis=1) for power in _POWERS])
    share = softmax(likelihood, axis=0)  # (powers, n)
    averaged = np.sum(
        [p[:, None] * expit(w * odds) for p, w in zip(share, _POWERS, strict=True)], axis=0
    )
    tempered: Floats = np.maximum(never, averaged)  # tempering never adds evidence against a cell
    return tempered
