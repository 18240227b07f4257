"""A cold start's picture of health: how a touch loads cells of this skin whose surroundings look like this.

Without a fault-free reference each cell is judged by all trusted cells together: from the mean of its four nearest
trusted neighbours, of the four diagonal ones, and from how well they enclose it: the smaller load of two opposite
neighbours, the best pair counting. Built from the log itself. It interpolates, never extrapolates: a cell at the rim
of the contact is rightly unloaded, however loaded its neighbours on one side are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.healthy.prediction import Prediction
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.scale import Array

if TYPE_CHECKING:
    from diagnostics.events.contact_events import ContactEvent

_NEIGHBOURS = 20
_PRIOR_WEIGHT = 1.0  # neighbours that the share over all samples counts for: few neighbours prove little
_MOST_SAMPLES = 20_000
_LEAST_SPREAD = 0.05  # of the root load


@dataclass(frozen=True)
class NearestNeighbours:
    """The touches of the log at hand, ``[n, 4, D]`` features (see ``Summary.features``)."""

    log: Array
    layout: SensorLayout

    @classmethod
    def of(cls, events: Sequence[ContactEvent], layout: SensorLayout) -> NearestNeighbours:
        """Learn from the touches of a log, and from each part of them."""
        return cls(
            np.stack([part.features() for event in events for part in (*event.parts, event.suffixes()[0])]), layout
        )

    def predict(self, features: Array, predictors: NDArray[np.bool_]) -> Prediction:
        """See ``HealthyModel.predict``. A cell between no two trusted neighbours is not judged: all is as expected."""
        from scipy.spatial import cKDTree

        shape = (len(features), features.shape[2])
        never, always, mean = np.ones(shape), np.ones(shape), np.zeros(shape)
        spread = np.full(shape[1], np.nan)
        present = self.layout.present.ravel()
        known = _describe(self.log, predictors, self.layout)
        usable = np.flatnonzero(predictors & present & np.isfinite(known).all(axis=(0, 2)))
        if not len(usable):
            return Prediction(never, always, mean, spread, own=np.zeros(shape[1]))
        samples = known[:, usable].reshape(-1, known.shape[2])
        answers = np.moveaxis(self.log[:, :, usable], 1, -1).reshape(-1, self.log.shape[1])
        kept = np.linspace(0, len(samples) - 1, min(len(samples), _MOST_SAMPLES)).astype(int)
        tree, answers = cKDTree(samples[kept]), answers[kept]
        scored = _describe(features, predictors, self.layout)
        judged = np.flatnonzero(np.isfinite(scored).all(axis=(0, 2)) & present)
        neighbours = min(_NEIGHBOURS, len(answers))
        # Most cells lie far from any load, and are surrounded alike: that is looked up once, as the first.
        neighbourhood = scored[:, judged].reshape(-1, scored.shape[2])
        loaded = neighbourhood.any(axis=1)
        which = np.where(loaded, np.cumsum(loaded), 0).reshape(len(features), len(judged))
        unloaded = np.zeros((1, scored.shape[2]))
        _, nearest = tree.query(np.concatenate([unloaded, neighbourhood[loaded]]), k=neighbours)
        near = answers[nearest.reshape(-1, neighbours)]  # (m, K, 4)

        def share(of: NDArray[np.bool_], overall: NDArray[np.bool_]) -> NDArray[np.float64]:
            prior = (overall.sum() + 0.5) / (len(overall) + 1)
            result: NDArray[np.float64] = (of.sum(axis=1) + prior * _PRIOR_WEIGHT) / (neighbours + _PRIOR_WEIGHT)
            return result[which]

        never[:, judged] = share(near[..., 2] == 0, answers[:, 2] == 0)
        always[:, judged] = share(near[..., 3] == 1, answers[:, 3] == 1)
        mean[:, judged] = near[..., 1].mean(axis=1)[which]
        spread[judged] = max(float(near[..., 1].std(axis=1)[which].mean()), _LEAST_SPREAD)
        return Prediction(never, always, mean, spread, own=np.zeros(shape[1]))


def _describe(features: Array, predictors: NDArray[np.bool_], layout: SensorLayout) -> NDArray[np.float64]:
    """Return what surrounds each cell in each stretch, ``[n, D, 6]``; NaN where no two opposite cells are trusted."""
    grid = layout.grid(
        np.where(predictors & layout.present.ravel(), features[:, :2], np.nan)
    )  # (n, 2, pads, rows, cols)
    padded = np.pad(grid, ((0, 0), (0, 0), (0, 0), (1, 1), (1, 1)), constant_values=np.nan)
    rows, cols = layout.rows, layout.cols

    def shifted(*offsets: tuple[int, int]) -> NDArray[np.float64]:
        return np.stack([padded[..., 1 + r : 1 + r + rows, 1 + c : 1 + c + cols] for r, c in offsets])

    beside, opposite = shifted((-1, 0), (0, -1)), shifted((1, 0), (0, 1))
    diagonal, across = shifted((-1, -1), (-1, 1)), shifted((1, 1), (1, -1))
    near, far = _mean(np.concatenate([beside, opposite])), _mean(np.concatenate([diagonal, across]))
    # A cell that has one kind of neighbour only is described by that kind.
    near, far = np.where(np.isnan(near), far, near), np.where(np.isnan(far), near, far)
    pairs = np.minimum(np.concatenate([beside, diagonal]), np.concatenate([opposite, across]))
    described = np.stack([near, far, np.fmax.reduce(pairs)], axis=2)  # (n, 2, 3, pads, rows, cols)
    return np.moveaxis(described.reshape(len(features), 6, layout.n_cells), 1, 2)


def _mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean over the first axis without the NaN, NaN where nothing else is there."""
    count = (~np.isnan(values)).sum(axis=0)
    total = np.nansum(values, axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
