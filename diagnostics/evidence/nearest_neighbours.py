"""The k-NN spatial model of a cold start, built from the log itself without a reference.

Estimates the load of a cell from 20 cells with the most similar surroundings, anywhere on the array
and in any event. Surroundings are the mean load of the four adjacent predictors, of the four
diagonal ones, of the 16 of the ring around these, and the enclosure (maximum over pairs of opposite
neighbours of the smaller load), for highest and mean root load:

    P(never loaded) = (count of never loaded neighbours + prior) / (k + 1)

Equals scikit-learn's ``KNeighborsClassifier`` and ``KNeighborsRegressor`` (Cover and Hart 1967)
with one pseudo-count. It interpolates and never extrapolates: of cells that no two opposite
predictors enclose it predicts held loads alone, from the means.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.prediction import Prediction
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.scale import Array

if TYPE_CHECKING:
    from diagnostics.events.contact_events import ContactEvent

_NEIGHBOURS = 20  # k
_MOST_SAMPLES = 20_000  # in the search tree: a size
_MIN_SPREAD = 0.05  # of the root load: no reading is predicted more exactly
_MEANS = slice(6)  # of the surroundings: the means, without the enclosure


@dataclass(frozen=True)
class NearestNeighbours:
    """The model of one log.

    Attributes:
        log: features ``[n, 4, D]`` of the events of the log (see ``Summary.features``).
        layout: the array.
        rest: highest root load at which a working cell may rest.
    """

    log: Array
    layout: SensorLayout
    rest: float = 0.0

    @classmethod
    def of(
        cls, events: Sequence[ContactEvent], layout: SensorLayout, rest: float = 0.0
    ) -> NearestNeighbours:
        """Build the model from the events of a log and from each of their parts."""
        parts = [part.features() for event in events for part in (*event.parts, event.whole)]
        return cls(np.stack(parts), layout, rest)

    def predict(self, features: Array, predictors: NDArray[np.bool_]) -> Prediction:
        """Predict the loads of healthy cells. P(never loaded) is 1 for a cell that no two opposite
        predictors enclose.

        Args:
            features: ``[n, 4, D]``, of n excerpts (see ``Summary.features``).
            predictors: bool ``[D]``, the cells whose readings may be used.
        """
        shape = (len(features), features.shape[2])
        never = np.ones(shape)
        always = np.ones(shape)
        mean = np.zeros(shape)
        spread = np.full(shape[1], np.nan)
        present = self.layout.is_cell
        usable = predictors & present
        known, scored = (_describe(of, usable, self.layout) for of in (self.log, features))
        enclosed = np.isfinite(scored).all(axis=(0, 2)) & present
        # A held load beside unloaded cells is unlikely anywhere; an unloaded cell at the border
        # tells nothing.
        border = np.isfinite(scored[..., _MEANS]).all(axis=(0, 2)) & present & ~enclosed
        border &= (features[:, 1] > self.rest).all(axis=0)
        for cells, described in ((enclosed, slice(None)), (border, _MEANS)):
            found = self._predict(known[..., described], scored[:, cells, described], usable)
            if found is None:
                continue
            if cells is enclosed:
                never[:, cells] = found.never
            always[:, cells] = found.always
            mean[:, cells] = found.mean
            spread[cells] = found.spread
        return Prediction(never, always, mean, spread)

    def _predict(
        self, known: NDArray[np.float64], scored: NDArray[np.float64], usable: NDArray[np.bool_]
    ) -> Prediction | None:
        """Return the prediction of some cells; None without any, or without any to learn from.

        Args:
            known: surroundings of all cells in the log, ``[n, D, k]``.
            scored: surroundings of the predicted cells in the excerpts, ``[n, cells, k]``.
            usable: bool ``[D]``, the cells whose readings may be used.
        """
        from scipy.spatial import cKDTree

        described = np.flatnonzero(usable & np.isfinite(known).all(axis=(0, 2)))
        if not len(described) or not scored.size:
            return None
        samples = known[:, described].reshape(-1, known.shape[2])
        targets = np.moveaxis(self.log[:, :, described], 1, -1).reshape(-1, self.log.shape[1])
        kept = np.linspace(0, len(samples) - 1, min(len(samples), _MOST_SAMPLES)).astype(int)
        tree = cKDTree(samples[kept])
        targets = targets[kept]
        neighbours = min(_NEIGHBOURS, len(targets))
        # Most cells lie far from any load and have the same surroundings, which are searched for
        # once, as the first.
        neighbourhood = scored.reshape(-1, scored.shape[2])
        loaded = neighbourhood.any(axis=1)
        which = np.where(loaded, np.cumsum(loaded), 0).reshape(len(scored), -1)
        unloaded = np.zeros((1, scored.shape[2]))
        _, nearest = tree.query(np.concatenate([unloaded, neighbourhood[loaded]]), k=neighbours)
        near = targets[nearest.reshape(-1, neighbours)]  # (m, K, 4)

        def share(of: NDArray[np.bool_], overall: NDArray[np.bool_]) -> NDArray[np.float64]:
            prior = (overall.sum() + 0.5) / (len(overall) + 1)
            result: NDArray[np.float64] = (of.sum(axis=1) + prior) / (neighbours + 1)
            return result[which]

        spread = max(float(near[..., 1].std(axis=1)[which].mean()), _MIN_SPREAD)
        return Prediction(
            never=share(near[..., 2] == 0, targets[:, 2] == 0),
            always=share(near[..., 3] == 1, targets[:, 3] == 1),
            mean=near[..., 1].mean(axis=1)[which],
            spread=np.full(scored.shape[1], spread),
        )


def _describe(
    features: Array, usable: NDArray[np.bool_], layout: SensorLayout
) -> NDArray[np.float64]:
    """Return the surroundings of each cell in each excerpt, ``[n, D, 8]``; NaN without two opposite
    usable cells."""
    grid = layout.grid(np.where(usable, features[:, :2], np.nan))  # (n, 2, pads, rows, cols)
    padded = np.pad(grid, ((0, 0), (0, 0), (0, 0), (2, 2), (2, 2)), constant_values=np.nan)
    rows = layout.rows
    cols = layout.cols

    def shifted(*offsets: tuple[int, int]) -> NDArray[np.float64]:
        return np.stack(
            [padded[..., 2 + r : 2 + r + rows, 2 + c : 2 + c + cols] for r, c in offsets]
        )

    beside = shifted((-1, 0), (0, -1))
    opposite = shifted((1, 0), (0, 1))
    diagonal = shifted((-1, -1), (-1, 1))
    across = shifted((1, 1), (1, -1))
    near = _mean(np.concatenate([beside, opposite]))
    far = _mean(np.concatenate([diagonal, across]))
    ring = _mean(
        shifted(*((r, c) for r in range(-2, 3) for c in range(-2, 3) if max(abs(r), abs(c)) == 2))
    )
    # A cell that has only adjacent, or only diagonal, neighbours is described by these.
    near, far = np.where(np.isnan(near), far, near), np.where(np.isnan(far), near, far)
    ring = np.where(np.isnan(ring), far, ring)
    pairs = np.minimum(np.concatenate([beside, diagonal]), np.concatenate([opposite, across]))
    # (n, 4, 2, pads, rows, cols)
    described = np.stack([near, far, ring, np.fmax.reduce(pairs)], axis=1)
    return np.moveaxis(described.reshape(len(features), 8, layout.n_cells), 1, 2)


def _mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``np.nanmean(values, axis=0)`` without its warning for columns of NaN."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.nansum(values, axis=0) / np.count_nonzero(~np.isnan(values), axis=0))
