"""The question that is put to the other cells: would healthy ones hold these values in these touches?

Now and then a touch is like none before, and then the model errs about many cells at once. The cells that work give
that away, and the model is believed the less in that touch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit, softmax

from diagnostics.events.constant_runs import SHORTEST_RUN, ConstantRuns
from diagnostics.events.contact_events import ContactEvent, count_repeats
from diagnostics.preprocessing.scale import Array, Scale

if TYPE_CHECKING:
    from diagnostics.healthy.prediction import Prediction

_ANYWHERE = 0.2  # of broken cells stick anywhere, of the rest as many to the low rail as to the high one
P_MIN = 1e-4  # no touch is less likely than this: models err
SUDDEN_JUMP = 1.0  # log ratio of a jump from which on a cell is no witness
_WORTHS = (0.25, 0.5, 0.75, 1.0)  # of the log odds of the model, in one touch or another
_WITNESS_SHARE = 0.5  # of what the moving cells say of that counts: neighbours err together
_USUALLY = 0.741  # spreads: half of all loads are farther off what is expected (Student's t, 4 degrees of freedom)
_AS_USUAL, _STRANGEST = 4, 4.0  # cells that are off as usual, beside those seen in a touch; times as far, at most
_REPEATS, _THE_SAME = 0.15, 0.95  # correlation of what touches say that load the cells alike, and the cosine of such

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Model(Protocol):
    """Knows what healthy cells would do in a touch."""

    def predict(self, features: Array, predictors: NDArray[np.bool_]) -> Prediction:
        """See ``HealthyModel.predict``."""


@dataclass(frozen=True)
class CellState:
    """What is known of each cell before the others are asked, ``[D]``.

    Attributes:
        runs: the still stretch of each.
        settled: float, evidence from earlier touches, of the stretches that still go on.
        temporal: float, log likelihood ratio of what it holds and of the jump into it, where the cell jumped alone.
        sudden: float, that of the jump, wherever it jumped.
        askable: bool, where there is a cell that is not known to be faulty.
        outlasted: bool, where a load is held since before something else was touched.
    """

    runs: ConstantRuns
    accumulated: Floats
    temporal: Floats
    sudden: Floats
    eligible: Mask
    outlasted: Mask

    def of(self, cells: NDArray[np.intp]) -> CellState:
        """Return the same of some cells."""
        rest = (values[cells] for name, values in vars(self).items() if name != "runs")
        return CellState(self.runs.of(cells), *rest)

    @property
    def scored(self) -> Mask:
        """bool ``[D]``, those that are still now, and not known to be faulty."""
        return self.eligible & (self.runs.length >= SHORTEST_RUN)


@dataclass(frozen=True)
class HeldValues:
    """What still cells read, ``[D]``.

    Attributes:
        rests: bool, the reading of an untouched cell.
        low, high: root loads between which a cell reads the same.
        prior: log probability that a broken cell sticks to this value.
    """

    rests: Mask
    low: Floats
    high: Floats
    prior: Floats

    @classmethod
    def now(cls, cells: CellState, scale: Scale, tolerance: float) -> HeldValues:
        """Of the cells that are still now; the others count as 0."""
        still = cells.scored
        return cls.of(np.where(still, np.nan_to_num(cells.runs.value), 0.0), scale, tolerance)

    @classmethod
    def of(cls, value: Floats, scale: Scale, tolerance: float) -> HeldValues:
        """Of cells that read ``value`` (``[D]``)."""
        rests = scale.root_load(value) <= scale.root_near
        full = value >= scale.full_scale - 2 * tolerance
        low = scale.root_load(value - 2 * tolerance).astype(np.float64)
        high = np.where(full, np.inf, scale.root_load(value + 2 * tolerance))
        anywhere = _ANYWHERE * 4 * tolerance / scale.full_scale
        return cls(rests, low, high, np.log(np.where(rests | full, (1 - _ANYWHERE) / 2, anywhere)))


@dataclass(frozen=True)
class ConditionalTest:
    """What is asked of the cells that are still now, whoever answers.

    Attributes:
        cells, model: what is known of the cells, what healthy looks like.
        values: what still cells read.
        asked, askable: bool ``[D]``, the cells that are judged, and those that may be asked about others.
        features, begins, counted: see :func:`_looked_at`.
        worth: float ``[n, 1]``, of what each stretch says so much is new.
    """

    cells: CellState
    model: Model
    values: HeldValues
    scored: Mask
    eligible: Mask
    features: Array
    begins: Mask
    counted: Mask
    novelty: Floats

    @classmethod
    def of(
        cls, events: Sequence[ContactEvent], cells: CellState, model: Model, scale: Scale, tolerance: float
    ) -> ConditionalTest:
        """Ask about one touch or more."""
        still, runs, values = cells.scored, cells.runs, HeldValues.now(cells, scale, tolerance)
        # A load that came all of a sudden, and is still held: a quick grasp, or many cells broken at once. While this
        # touch lasts nobody can tell, so such cells are neither judged by it nor asked about the others.
        held = still & ~values.rests & runs.moved & (runs.start >= events[-1].since) & ~cells.outlasted
        unsure = held & (cells.sudden >= SUDDEN_JUMP) & (cells.temporal < SUDDEN_JUMP)
        scored = still & ~unsure
        features, begins, counted = _looked_at(events, runs, scored)
        novelty = 1 / (
            1 + _REPEATS * count_repeats(events, _THE_SAME, values.rests | ~still)[begins.cumsum() - 1, None]
        )
        return cls(cells, model, values, scored, cells.eligible & ~unsure, features, begins, counted, novelty)

    def score(self, predictors: Mask) -> tuple[Prediction, Floats]:
        """Return what the ``predictors`` cells (bool ``[D]``) expect, and the surprise of each stretch ``[n, D]``."""
        expected = self.model.predict(self.features, predictors)
        held = np.flatnonzero(self.scored & ~self.values.rests)
        likely = _shrunk_to_even(expected.never, self.features[:, 2] == 0, predictors & self.cells.runs.moved)
        inflation = _inflation(expected, self.features, predictors)
        within = expected.within(self.values.low[held], self.values.high[held], held, inflation)
        likely[:, held] = expected.always[:, held] * within
        return expected, np.where(self.counted, -self.novelty * np.log(np.maximum(likely, P_MIN)), 0.0)

    def summed(self, surprisal: Floats) -> Floats:
        """Return the evidence ``[D]`` of all touches, those before included."""
        return np.where(self.scored, self.cells.accumulated + surprisal.sum(axis=0), 0.0)


def _looked_at(events: Sequence[ContactEvent], runs: ConstantRuns, scored: Mask) -> tuple[Array, Mask, Mask]:
    """Return the stretches that tell something: features ``[n, 4, D]``, whole touches ``[n]``, those that count.

    For each cell that is ``scored`` (bool ``[D]``) one stretch of each touch counts, ``[n, D]``: the longest within its
    still stretch.
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
    """Return how many times as far as usual loads are off what is expected, ``[n]``, 1 to 4.

    So far off are half of those of the ``working`` (bool ``[D]``), cells that are known to work.
    """
    known = working & np.isfinite(expected.spread)
    loaded = features[:, 2, known] > 0
    error = np.abs(features[:, 1, known] - expected.mean[:, known]) / expected.spread[known]
    error = np.column_stack([np.where(loaded, error, np.inf), np.full((len(features), _AS_USUAL), _USUALLY)])
    middle = (loaded.sum(axis=1) + _AS_USUAL) // 2
    half: Floats = np.sort(error, axis=1)[np.arange(len(features)), middle]
    return np.clip(half / _USUALLY, 1.0, _STRANGEST)


def _shrunk_to_even(never: Floats, unloaded: NDArray[np.bool_], working: NDArray[np.bool_]) -> Floats:
    """Return P(unloaded throughout) ``[n, D]``, nearer to even in the touches in which the model errs.

    A touch like none before surprises many cells at once, and those that move tell so: how well their own loads were
    foreseen decides what the log odds are worth for all the others.

    Args:
        never: ``[n, D]``, what the model says.
        unloaded: bool ``[n, D]``, what the cells did.
        witness: bool ``[D]``, those that are known to work.
    """
    odds = logit(np.maximum(never, P_MIN))
    right = np.where(unloaded | np.isinf(odds), odds, -odds)[:, working]  # where nothing is known, nothing is wrong
    likelihood = -np.stack([np.log1p(np.exp(-novelty * right)).sum(axis=1) for novelty in _WORTHS])
    share = softmax(_WITNESS_SHARE * likelihood, axis=0)  # (worths, n)
    doubted = np.sum([p[:, None] * expit(w * odds) for p, w in zip(share, _WORTHS, strict=True)], axis=0)
    believed: Floats = np.maximum(never, doubted)  # doubt is no evidence against cells expected to stay unloaded
    return believed
