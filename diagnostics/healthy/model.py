"""What healthy looks like: how a touch loads a cell, given how it loads the others.

Regressions of each cell from the others (see ``local_regressions``), fitted on the touches of fault-free recordings,
corrected by what all cells have in common (see ``stacking``). An open cell looks unloaded, and so does a healthy one
beside the contact: everything turns on how sharply the two can be told apart. Models of single frames, nearest frames,
trees, a neural network and one model shared by all cells were each worse on real grasps than regressions on whole
touches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from diagnostics.events.constant_runs import segments
from diagnostics.events.contact_events import SEGMENT, ContactEvent, EventLog, Summary, count_repeats
from diagnostics.healthy.cross_fitting import FOLDS, CrossFitting, RegressionFit
from diagnostics.healthy.local_regression import LocalRegression, predict_regressions
from diagnostics.healthy.prediction import Prediction
from diagnostics.healthy.stacking import RegressionOutput, Stacking, neighbourhood
from diagnostics.layout import SensorLayout

if TYPE_CHECKING:
    from diagnostics.preprocessing.scale import Array, Scale

_SAMPLES = 3000  # stretches of touches that the model is fitted on, about
_MOST_DRAWS = 8  # stretches of one touch: more of them say the same
_SHORTEST = 6  # frames of a stretch
_SUREST = 0.002  # a probability is never taken for nearer to 0 or 1, however many touches there were
_SOURCES = 12  # recordings: of fewer each touch is a source of its own, and counts
_FAMILIAR, _STRANGE = 1 / 400, 1 / 100  # chance that a touch does with a cell what none did before
_SHARED = 0.4  # of what is said of a cell where few touches teach: that is true of the cells around it as well
_AT_ONCE = 6144  # cells of stretches looked at between two pauses


@dataclass(frozen=True)
class HealthyModel:
    """See the module.

    Attributes:
        tiles: the models of all cells.
        layout: the array; rim: corrects what they foresee. Without: believed as it is.
    """

    local_regressions: tuple[LocalRegression, ...]
    layout: SensorLayout | None = None
    stacking: Stacking | None = None

    @classmethod
    def fit(
        cls, recordings: Sequence[NDArray[np.float64]], layout: SensorLayout, scale: Scale, seed: int = 0
    ) -> HealthyModel:
        """Fit on fault-free recordings, ``[T, D]`` each, all cells together; large arrays: ``patch_models``."""
        rng = np.random.default_rng(seed)
        features, source, n_events = excerpts(recordings, scale, rng)
        every = np.flatnonzero(layout.present)

        def regressions(of: Array) -> RegressionFit:
            return partial(predict_regressions, (LocalRegression.fit(of, every, every, _SUREST),))

        stacking = None
        if n_events >= FOLDS:
            stacking = CrossFitting.of(features, source, n_events, layout, every, regressions, 1.0, rng).fit_stacking()
        return cls((LocalRegression.fit(features, every, every, p_floor_of(n_events)),), layout, stacking)

    def check(self, layout: SensorLayout) -> None:
        """Raise ValueError unless each cell of ``layout`` is an output of exactly one local regression."""
        outputs = [regression.outputs for regression in self.local_regressions]
        if not np.array_equal(np.sort(np.concatenate(outputs)) if outputs else [], np.flatnonzero(layout.present)):
            raise ValueError(f"the models do not cover the cells of {layout}, each once")
        if not all(0 < regression.p_floor < 1 for regression in self.local_regressions):
            raise ValueError("expected p_floor between 0 and 1")

    def of_tile(self, i: int, cells: NDArray[np.intp], layout: SensorLayout) -> HealthyModel:
        """Return the model of tile i as one of an array ``layout`` of its own, in which its inputs are ``cells``."""
        return HealthyModel((self.local_regressions[i].at(cells),), layout, self.stacking)

    def p_floor(self, n_cells: int) -> NDArray[np.float64]:
        """Return the chance ``[D]`` of D cells that a touch does with one what none did before; 1: nothing is known."""
        p_floor = np.ones(n_cells)
        for regression in self.local_regressions:
            p_floor[regression.outputs] = regression.p_floor
        return p_floor

    def inexperience(self, n_cells: int) -> NDArray[np.float64]:
        """Return how little is known of healthy touches of D cells, ``[D]``: 0 where it holds 400, 1 with up to 100."""
        return _inexperience(self.p_floor(n_cells))

    def predict(self, features: Array, predictors: NDArray[np.bool_]) -> Prediction:
        """Say what healthy cells would do. A generator that pauses on its way, for those who cannot wait.

        Args:
            features: ``[n, 4, D]``, of n stretches (see ``Summary.features``).
            trusted: bool ``[D]``, the cells that may be asked.
        """
        regressed = predict_regressions(self.local_regressions, features, predictors)
        shape = features.shape[2]
        spread, p_floor, known = np.ones(shape), self.p_floor(shape), np.zeros(shape, bool)
        for regression in self.local_regressions:
            spread[regression.outputs], known[regression.outputs] = regression.spread, True
        never, always = expit(regressed.never), expit(regressed.always)
        if self.stacking is not None and self.layout is not None:
            judged = np.flatnonzero(known)
            step = max(1, _AT_ONCE // len(judged))
            for first in range(0, len(features), step):
                some = slice(first, first + step)
                of_some = RegressionOutput(*(values[some] for values in vars(regressed).values()))
                known_values = self.stacking.predict(
                    neighbourhood(of_some, features[some], predictors, self.layout, judged)
                )
                corrected, always[some, judged] = (p.T for p in known_values)
                # A cell that no touch of the reference reached may be out of reach, whatever those around it do.
                never[some, judged] = np.where(np.isnan(spread[judged]), never[some, judged], corrected)
        # Which cells a touch reaches is of a place; that no load is held without any around it, all touches teach.
        held = p_floor if self.stacking is None else np.minimum(p_floor, p_floor_of(self.stacking.events))
        never = np.where(known, np.clip(never, p_floor, 1 - p_floor), 1.0)
        always = np.where(known, np.clip(always, held, 1 - held), 1.0)
        return Prediction(never, always, regressed.mean, spread, 1 - _SHARED * _inexperience(p_floor))


def _inexperience(p_floor: NDArray[np.float64]) -> NDArray[np.float64]:
    inexperience: NDArray[np.float64] = np.log(p_floor / _FAMILIAR) / np.log(_STRANGE / _FAMILIAR)
    return np.clip(inexperience, 0.0, 1.0)


class ReferenceEvent(NamedTuple):
    """Where a touch was seen in fault-free recordings.

    Attributes:
        recording: its number; first: that of the first frame; frames: how many.
        again: it loads what an earlier one of the recording did, and tells little new: a pat, again and again.
    """

    recording: int
    first: int
    frames: int
    again: bool

    @classmethod
    def of(cls, events: Sequence[ContactEvent], recording: int) -> list[ReferenceEvent]:
        """Return where the touches of a recording were seen."""
        return [
            cls(recording, event.first, event.n, again > 0)
            for event, again in zip(events, count_repeats(events).tolist(), strict=True)
        ]


def count_events(seen: Sequence[ReferenceEvent]) -> int:
    """How many touches these are worth, those seen again not counted; all of them where there are few recordings."""
    few = _few_recordings(seen)
    return sum(few or not event.again for event in seen)


def _few_recordings(seen: Sequence[ReferenceEvent]) -> bool:
    """Whether there are too few recordings to take each for one source."""
    return len({event.recording for event in seen}) < _SOURCES


def excerpts(
    recordings: Sequence[NDArray[np.float64]], scale: Scale, rng: np.random.Generator
) -> tuple[Array, NDArray[np.intp], int]:
    """Return features ``[n, 4, D]`` of random stretches of touches in fault-free recordings, and their sources.

    And how many touches those are worth.
    """
    seen = [
        event for i, recording in enumerate(recordings) for event in ReferenceEvent.of(_events(recording, scale), i)
    ]
    return *drawn(seen, lambda i, frames: recordings[i][frames], scale, rng, _SAMPLES), count_events(seen)


def drawn(
    seen: list[ReferenceEvent],
    read: Callable[[int, slice], NDArray[np.float64]],
    scale: Scale,
    rng: np.random.Generator,
    most: int,
) -> tuple[Array, NDArray[np.intp]]:
    """Return features ``[n, 4, D]`` of random stretches of touches, and the source ``[n]`` of each.

    The touches of one recording are alike, and one source, unless there are too few recordings to tell them apart.
    """
    draws = int(np.clip(round(most / len(seen)), 1, _MOST_DRAWS))
    if len(seen) > most:
        seen = [seen[i] for i in np.sort(rng.choice(len(seen), most, replace=False))]
    features = []
    for i, first, n, _ in seen:
        root = scale.root_load(read(i, slice(first, first + n)))
        n = len(root)
        for draw in range(draws):
            length = int(rng.integers(min(_SHORTEST, n), n + 1)) if draw else n
            at = int(rng.integers(0, n - length + 1))
            features.append(Summary.of(root[at : at + length], first + at, scale.root_near).features())
    sources = range(len(seen)) if _few_recordings(seen) else [event.recording for event in seen]
    return np.stack(features), np.unique(sources, return_inverse=True)[1].repeat(draws)


def p_floor_of(n_events: int) -> float:
    """What never happened in n touches may happen in the next with a chance of about 1 in n (rule of succession)."""
    return max(_SUREST, 1 / (n_events + 2))


def _events(recording: NDArray[np.float64], scale: Scale) -> tuple[ContactEvent, ...]:
    events = EventLog()
    for frames, numbers, start in segments(recording, SEGMENT, scale.near / 2):
        events = events.extend(scale.root_load(frames), numbers, scale.root_near, start, np.zeros(len(start), bool))
    return events.kept
