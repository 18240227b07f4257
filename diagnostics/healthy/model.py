"""The healthy model: the distribution of a cell's load in a contact event, given the loads of the
other cells.

Estimates, for each cell i and event e with features x_e of the other cells,

    P(unloaded throughout e | x_e),   P(loaded throughout e | x_e),   E[mean root load | x_e]

from ridge logistic and linear regressions per cell (:mod:`~diagnostics.healthy.local_regression`),
corrected by one small network on the neighbourhood of the cell
(:mod:`~diagnostics.healthy.stacking`): stacked generalization (Wolpert 1992). An open cell reads
the same as a healthy cell beside the contact, so the sharpness of the two probabilities decides
what can be detected. The model assumes that events are independent. It does not describe the course
of a load within an event.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from diagnostics.events.constant_runs import segments
from diagnostics.events.contact_events import ContactEvent, EventLog
from diagnostics.healthy.local_regression import LocalRegression, predict_regressions
from diagnostics.healthy.prediction import MIN_P_FLOOR, Prediction
from diagnostics.healthy.stacking import Stacking, neighbourhood
from diagnostics.layout import SensorLayout

if TYPE_CHECKING:
    from diagnostics.preprocessing.scale import Array, Scale

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
    layout: SensorLayout
    stacking: Stacking | None = None

    def check(self, layout: SensorLayout) -> None:
        """Raise ValueError unless each cell of ``layout`` is an output of exactly one local
        regression."""
        outputs = [regression.outputs for regression in self.local_regressions]
        if not np.array_equal(
            np.sort(np.concatenate(outputs)) if outputs else [], np.flatnonzero(layout.present)
        ):
            raise ValueError(
                f"the local regressions do not cover each cell of {layout} exactly once"
            )
        if not all(0 < regression.p_floor < 1 for regression in self.local_regressions):
            raise ValueError("expected p_floor between 0 and 1")

    def predict(self, features: Array, predictors: NDArray[np.bool_]) -> Prediction:
        """Predict the loads of healthy cells.

        Args:
            features: ``[n, 4, D]``, of n excerpts (see ``Summary.features``).
            predictors: bool ``[D]``, the cells whose readings may be used.
        """
        regressed = predict_regressions(self.local_regressions, features, predictors)
        spread, p_floor = np.ones((2, features.shape[2]))  # 1: no model of the cell
        for regression in self.local_regressions:
            spread[regression.outputs] = regression.spread
            p_floor[regression.outputs] = regression.p_floor
        known = p_floor < 1
        never, always = expit(regressed[:2])
        if self.stacking is not None:
            modelled = np.flatnonzero(known)
            step = max(1, _BATCH // len(modelled))
            for first in range(0, len(features), step):
                some = slice(first, first + step)
                samples = neighbourhood(
                    regressed[:, some], features[some], predictors, self.layout, modelled
                )
                corrected, always[some, modelled] = (p.T for p in self.stacking.predict(samples))
                # A cell that no reference event loaded may be out of reach, whatever its neighbours
                # read.
                never[some, modelled] = np.where(
                    np.isnan(spread[modelled]), never[some, modelled], corrected
                )
        # Which cells an event loads depends on the place; that a load is never held alone is
        # learned from all events.
        always_floor = (
            p_floor
            if self.stacking is None
            else np.minimum(p_floor, p_floor_of(self.stacking.events))
        )
        never = np.where(known, np.clip(never, p_floor, 1 - p_floor), 1.0)
        always = np.where(known, np.clip(always, always_floor, 1 - always_floor), 1.0)
        return Prediction(never, always, regressed[2], spread)


def p_floor_of(n_events: int) -> float:
    """Return the probability of what never happened in n events: 1 / (n + 2), Laplace's rule of
    succession."""
    return max(MIN_P_FLOOR, 1 / (n_events + 2))


def contact_events(recording: NDArray[np.float64], scale: Scale) -> tuple[ContactEvent, ...]:
    """Return the contact events of a recording ``[T, D]`` of the whole skin."""
    events = EventLog()
    for frames, numbers, runs in segments(recording, scale):
        events = events.extend(scale.root_load(frames), numbers, scale.root_near, runs.start)
    return events.kept
