"""Cross-fitting: training samples for the stacking from events that the local regressions were not
fitted on.

Estimates nothing itself. The events are split into 4 folds; regressions fitted on 3 of them predict
the fourth, with a random 3 to 95 % of the cells excluded from the predictors, as if they were dead
or had not moved yet. So the stacking learns how reliable the regressions are. Equals scikit-learn's
``StackingClassifier(cv=GroupKFold(4))``, with dropout of inputs (Chernozhukov et al. 2018 name the
scheme).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.healthy.local_regression import LocalRegression, predict_regressions
from diagnostics.healthy.stacking import neighbourhood
from diagnostics.preprocessing.scale import Array

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

FOLDS = 4  # of the sources
_LEFT_OUT = np.geomspace(0.03, 0.95, 7)  # shares of the cells that are no predictors, in turn
_SCORED = 0.12  # share of the cells, at most, that give samples in one round
_SAMPLES = 100_000  # in all, about: a size

Indices = NDArray[np.intp]


def stacking_samples(
    features: Array,
    source: Indices,
    layout: SensorLayout,
    outputs: Indices,
    fit: Callable[[Array], LocalRegression],
    share: float,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Draw samples from excerpts of events.

    Args:
        features: ``[n, 4, D]``.
        source: int ``[n]``; excerpts of one source lie in one fold.
        layout: the array.
        outputs: the cells that have regressions.
        fit: returns the regressions of the ``outputs``, fitted on features ``[m, 4, D]``.
        share: of all samples that are drawn from this array.
        rng: draws them.

    Returns:
        Features of m samples ``[m, k]``, see ``stacking.neighbourhood``, and whether the cell
        stayed unloaded, and loaded, throughout ``[m, 2]``.
    """
    present = np.flatnonzero(layout.present)
    per_excerpt = sum(min(left, _SCORED) for left in _LEFT_OUT) * len(outputs)
    most = max(1, round(share * _SAMPLES / (FOLDS * per_excerpt)))  # excerpts in each round
    fold = rng.permutation(source.max() + 1)[source] % FOLDS
    samples = []
    did = []
    for k in range(FOLDS):
        regression = fit(features[fold != k])
        held_out = features[fold == k]
        for left in _LEFT_OUT:
            some = held_out[np.sort(rng.permutation(len(held_out))[:most])]
            out = rng.permutation(present)[: max(1, round(left * len(present)))]
            predictors = np.ones(layout.n_cells, bool)
            predictors[out] = False
            out = out[np.isin(out, outputs)]
            out = np.sort(out[: max(1, round(_SCORED * len(outputs)))])
            regressed = predict_regressions([regression], some, predictors)
            described = neighbourhood(regressed, some, predictors, layout, out)
            samples.append(described.reshape(len(described), -1).T.astype(np.float64))
            did.append(
                np.column_stack(
                    [(some[:, 2, out] == 0).T.ravel(), (some[:, 3, out] == 1).T.ravel()]
                )
            )
    return np.concatenate(samples), np.concatenate(did)
