"""What a rim is taught by: cells left out at random, in touches that the regressions of these cells were not fitted on.

A rim is to learn how far the regressions can be believed when some of the cells are dead, or have not moved yet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.healthy.stacking import RegressionOutput, Stacking, neighbourhood
from diagnostics.preprocessing.scale import Array

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

FOLDS = 4  # of what there is to learn from: each teaches how far to believe what the others taught
_LEFT_OUT = (0.03, 0.06, 0.12, 0.2, 0.4, 0.7, 0.95)  # of the cells, in turn: so many may be dead, or not moved yet
_LOOKED_AT = 0.12  # of the cells at most, among those left out
_SAMPLES = 100_000  # cells left out of a stretch that are looked at in all, about

CellState = NDArray[np.intp]
Mask = NDArray[np.bool_]
RegressionFit = Callable[
    [Array, Mask], RegressionOutput
]  # of features [n, 4, D], where the cells bool [D] may be asked


@dataclass(frozen=True)
class CrossFitting:
    """Cells of which it is known what they did.

    Attributes:
        samples: float64 ``[m, k]``, what there was to know of each, see ``stacking.neighbourhood``.
        never, always: bool ``[m]``, whether it stayed unloaded, or loaded, throughout.
        touches: that they are of.
    """

    samples: NDArray[np.float64]
    never: Mask
    always: Mask
    events: int

    @classmethod
    def of(
        cls,
        features: Array,
        source: CellState,
        events: int,
        layout: SensorLayout,
        outputs: CellState,
        fit: Callable[[Array], RegressionFit],
        share: float,
        rng: np.random.Generator,
    ) -> CrossFitting:
        """Draw from stretches of touches of an array, cross-fitted in folds of the sources.

        Args:
            features: ``[n, 4, D]``; source: int ``[n]``, stretches of one source teach nothing of each other.
            touches: that they are of.
            layout: the array.
            outputs: the cells that regressions are for.
            fit: returns the regressions of the ``outputs``, fitted on features ``[m, 4, D]``.
            share: of all lessons that this array gives.
            rng: draws them.
        """
        present = np.flatnonzero(layout.present)
        looked_at = sum(min(left, _LOOKED_AT) for left in _LEFT_OUT) * len(outputs)
        most = max(1, round(share * _SAMPLES / (FOLDS * looked_at)))  # stretches in each round
        fold = rng.permutation(source.max() + 1)[source] % FOLDS
        found = []
        for k in range(FOLDS):
            regressed, held = fit(features[fold != k]), features[fold == k]
            for left in _LEFT_OUT:
                some = held[np.sort(rng.permutation(len(held))[:most])]
                out = rng.permutation(present)[: max(1, round(left * len(present)))]
                predictors = np.ones(layout.n_cells, bool)
                predictors[out] = False
                out = out[np.isin(out, outputs)]
                out = np.sort(out[: max(1, round(_LOOKED_AT * len(outputs)))])
                known_values = neighbourhood(regressed(some, predictors), some, predictors, layout, out)
                samples = known_values.reshape(len(known_values), -1).T.astype(np.float64)
                found.append(cls(samples, (some[:, 2, out] == 0).T.ravel(), (some[:, 3, out] == 1).T.ravel(), 0))
        return replace(cls.joined(found), events=events)

    @classmethod
    def joined(cls, parts: Sequence[CrossFitting]) -> CrossFitting:
        """Join the lessons of several arrays."""
        samples, never, always = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("samples", "never", "always")
        )
        return cls(samples, never, always, sum(part.events for part in parts))

    def fit_stacking(self) -> Stacking:
        """Return what they teach."""
        return Stacking.fit(self.samples, self.never, self.always, self.events)
