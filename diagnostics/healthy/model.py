"""The healthy model: the distribution of a cell's load in a contact event, given the loads of the other cells.

Estimates, for each cell i and event e with features x_e of the other cells,

    P(unloaded throughout e | x_e),   P(loaded throughout e | x_e),   E[mean root load | x_e]

from ridge logistic and linear regressions per cell (:mod:`~diagnostics.healthy.local_regression`), corrected by one
small network on the neighbourhood of the cell (:mod:`~diagnostics.healthy.stacking`): stacked generalization
(Wolpert 1992). An open cell reads the same as a healthy cell beside the contact, so the sharpness of the two
probabilities decides what can be detected. The model assumes that events are independent. It does not describe the
course of a load within an event.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from diagnostics.events.constant_runs import SHORTEST_RUN, segments
from diagnostics.events.contact_events import ContactEvent, EventLog, Summary, count_repeats
from diagnostics.healthy.cross_fitting import FOLDS, CrossFitting, RegressionFit
from diagnostics.healthy.local_regression import LocalRegression, predict_regressions
from diagnostics.healthy.prediction import Prediction
from diagnostics.healthy.stacking import Stacking, neighbourhood
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import FEWEST
from diagnostics.preprocessing.readings import SEGMENT

if TYPE_CHECKING:
    from diagnostics.preprocessing.scale import Array, Scale

_SAMPLES = 3000  # excerpts of events to fit on, about
_MOST_DRAWS = 8  # excerpts of one event: more of them are nearly the same
MIN_P_FLOOR = 0.002  # lower limit of the probabilities, however many events there are: models err
_BATCH = 6144  # cells times excerpts in one batch: bounds memory


@dataclass(frozen=True)
class HealthyModel:
    """See the module.

    Attributes:
        local_regressions: one per tile; each cell is an output of exactly one.
        layout: the array of the ``stacking``.
        stacking: corrects the regressions; None: too few events to fit one.
    """

    local_regressions: tuple[LocalRegression, ...]
    layout: SensorLayout | None = None
    stacking: Stacking | None = None

    @classmethod
    def fit(
        cls, recordings: Sequence[NDArray[np.float64]], layout: SensorLayout, scale: Scale, seed: int = 0
    ) -> HealthyModel:
        """Fit one tile to fault-free recordings, ``[T, D]`` each; ``fit_healthy_model`` fits several tiles."""
        rng = np.random.default_rng(seed)
        features, source, n_events = excerpts(recordings, scale, rng)
        every = np.flatnonzero(layout.present)

        def regressions(training: Array) -> RegressionFit:
            return partial(predict_regressions, (LocalRegression.fit(training, every, every, MIN_P_FLOOR),))

        stacking = None
        if n_events >= FOLDS:
            stacking = CrossFitting.of(features, source, n_events, layout, every, regressions, 1.0, rng).fit_stacking()
        return cls((LocalRegression.fit(features, every, every, p_floor_of(n_events)),), layout, stacking)

    def check(self, layout: SensorLayout) -> None:
        """Raise ValueError unless each cell of ``layout`` is an output of exactly one local regression."""
        outputs = [regression.outputs for regression in self.local_regressions]
        if not np.array_equal(np.sort(np.concatenate(outputs)) if outputs else [], np.flatnonzero(layout.present)):
            raise ValueError(f"the local regressions do not cover each cell of {layout} exactly once")
        if not all(0 < regression.p_floor < 1 for regression in self.local_regressions):
            raise ValueError("expected p_floor between 0 and 1")

    def of_tile(self, i: int, cells: NDArray[np.intp], layout: SensorLayout) -> HealthyModel:
        """Return the model of tile i on its own ``layout``, in which the inputs of the tile are ``cells``."""
        return HealthyModel((self.local_regressions[i].at(cells),), layout, self.stacking)

    def p_floor(self, n_cells: int) -> NDArray[np.float64]:
        """Return the lower limit ``[D]`` of the probabilities of each cell; 1: no model of the cell."""
        p_floor = np.ones(n_cells)
        for regression in self.local_regressions:
            p_floor[regression.outputs] = regression.p_floor
        return p_floor

    def predict(self, features: Array, predictors: NDArray[np.bool_]) -> Prediction:
        """Predict the loads of healthy cells.

        Args:
            features: ``[n, 4, D]``, of n excerpts (see ``Summary.features``).
            predictors: bool ``[D]``, the cells whose readings may be used.
        """
        regressed = predict_regressions(self.local_regressions, features, predictors)
        n_cells = features.shape[2]
        spread, p_floor, known = np.ones(n_cells), self.p_floor(n_cells), np.zeros(n_cells, bool)
        for regression in self.local_regressions:
            spread[regression.outputs], known[regression.outputs] = regression.spread, True
        never, always = expit(regressed[:2])
        if self.stacking is not None and self.layout is not None:
            modelled = np.flatnonzero(known)
            step = max(1, _BATCH // len(modelled))
            for first in range(0, len(features), step):
                some = slice(first, first + step)
                samples = neighbourhood(regressed[:, some], features[some], predictors, self.layout, modelled)
                corrected, always[some, modelled] = (p.T for p in self.stacking.predict(samples))
                # A cell that no reference event loaded may be out of reach, whatever its neighbours read.
                never[some, modelled] = np.where(np.isnan(spread[modelled]), never[some, modelled], corrected)
        # Which cells an event loads depends on the place; that a load is never held alone is learned from all events.
        always_floor = p_floor if self.stacking is None else np.minimum(p_floor, p_floor_of(self.stacking.events))
        never = np.where(known, np.clip(never, p_floor, 1 - p_floor), 1.0)
        always = np.where(known, np.clip(always, always_floor, 1 - always_floor), 1.0)
        return Prediction(never, always, regressed[2], spread)


class ReferenceEvent(NamedTuple):
    """Where a contact event lies in the fault-free recordings.

    Attributes:
        recording: index of the recording.
        first: number of the first frame.
        frames: number of frames.
        again: whether it loads the same cells as an earlier event of the recording.
    """

    recording: int
    first: int
    frames: int
    again: bool

    @classmethod
    def of(cls, events: Sequence[ContactEvent], recording: int) -> list[ReferenceEvent]:
        """Return the events of one recording."""
        return [
            cls(recording, event.first, event.n, again > 0)
            for event, again in zip(events, count_repeats(events).tolist(), strict=True)
        ]


def count_events(seen: Sequence[ReferenceEvent]) -> int:
    """Return the number of distinct events; with few recordings repeated ones count too."""
    few = _few_recordings(seen)
    return sum(few or not event.again for event in seen)


def _few_recordings(seen: Sequence[ReferenceEvent]) -> bool:
    """Return whether there are too few recordings for cross-fitting by recording."""
    return len({event.recording for event in seen}) < FEWEST


def excerpts(
    recordings: Sequence[NDArray[np.float64]], scale: Scale, rng: np.random.Generator
) -> tuple[Array, NDArray[np.intp], int]:
    """Return random excerpts of the events in fault-free recordings.

    Returns:
        Features ``[n, 4, D]``, source of each ``[n]``, number of distinct events.
    """
    seen = [
        event
        for i, recording in enumerate(recordings)
        for event in ReferenceEvent.of(contact_events(recording, scale), i)
    ]
    return *drawn(seen, lambda i, frames: recordings[i][frames], scale, rng, _SAMPLES), count_events(seen)


def drawn(
    seen: list[ReferenceEvent],
    read: Callable[[int, slice], NDArray[np.float64]],
    scale: Scale,
    rng: np.random.Generator,
    most: int,
) -> tuple[Array, NDArray[np.intp]]:
    """Return features ``[n, 4, D]`` of random excerpts of events, and the source ``[n]`` of each.

    Events of one recording are correlated and share a source, unless recordings are few.

    Args:
        seen: the events.
        read: returns the given frames of a recording, ``[t, D]``.
        scale: baseline and full scale.
        rng: draws the excerpts.
        most: number of excerpts, about.
    """
    draws = int(np.clip(round(most / len(seen)), 1, _MOST_DRAWS))
    if len(seen) > most:
        seen = [seen[i] for i in np.sort(rng.choice(len(seen), most, replace=False))]
    features = []
    for i, first, n, _ in seen:
        root = scale.root_load(read(i, slice(first, first + n)))
        n = len(root)
        for draw in range(draws):
            length = int(rng.integers(min(SHORTEST_RUN, n), n + 1)) if draw else n
            at = int(rng.integers(0, n - length + 1))
            features.append(Summary.of(root[at : at + length], first + at, scale.root_near).features())
    sources = range(len(seen)) if _few_recordings(seen) else [event.recording for event in seen]
    return np.stack(features), np.unique(sources, return_inverse=True)[1].repeat(draws)


def p_floor_of(n_events: int) -> float:
    """Return the probability of what never happened in n events: 1 / (n + 2), Laplace's rule of succession."""
    return max(MIN_P_FLOOR, 1 / (n_events + 2))


def contact_events(recording: NDArray[np.float64], scale: Scale) -> tuple[ContactEvent, ...]:
    """Return the contact events of a recording ``[T, D]`` of the whole skin."""
    events = EventLog()
    for frames, numbers, start in segments(recording, SEGMENT, scale.near / 2):
        events = events.extend(scale.root_load(frames), numbers, scale.root_near, start, np.zeros(len(start), bool))
    return events.kept
