"""Shared prior: one translation-invariant logistic regression for all cells of a large array.

Estimates the log odds that a cell stays unloaded, or loaded, throughout an event from the 7 x 7
cells around it: ``log odds = bias + sum w[feature, row offset, column offset] x``, with
scikit-learn's ``LogisticRegression`` on the flattened neighbourhoods. A tile sees a few dozen
events, all tiles together thousands. The regression of each tile adds its own weights, shrunk
towards these (hierarchical shrinkage). The prior does not represent differences between places on
the array.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from diagnostics.healthy.local_regression import FEATURES
from diagnostics.preprocessing.scale import Array

if TYPE_CHECKING:
    from diagnostics.events.tiles import Tile
    from diagnostics.layout import SensorLayout

REACH = 3  # rows and columns
_UNLOADED = 0.2  # share of the samples without any load around, which are all equal
_RIDGE = 1e-3  # per sample: the weights of correlated neighbours are not determined without it


class Samples(NamedTuple):
    """Training samples.

    Attributes:
        neighbourhoods: features ``[n, 4, 7, 7]`` around a cell, 0 at the cell itself.
        did: ``[n, 2]``, 1 where the cell was never, or always, loaded.
    """

    neighbourhoods: Array
    did: Array

    @classmethod
    def of(
        cls, features: Array, tile: Tile, layout: SensorLayout, rng: np.random.Generator, most: int
    ) -> Samples:
        """Draw at most ``most`` loaded samples from excerpts of a tile, features
        ``[n, 4, inputs]``."""
        alone = tile.rectangle(layout)
        rows = alone.layout.rows
        cols = alone.layout.cols
        grid = np.zeros((len(features), FEATURES, rows + 2 * REACH, cols + 2 * REACH), np.float32)
        r = alone.cells // cols
        c = alone.cells % cols
        grid[:, :, r + REACH, c + REACH] = features
        windows = np.lib.stride_tricks.sliding_window_view(grid, (2 * REACH + 1,) * 2, axis=(2, 3))
        neighbourhoods = windows[:, :, r[tile.place], c[tile.place]].transpose(0, 2, 1, 3, 4)
        neighbourhoods = neighbourhoods.reshape(
            -1, *neighbourhoods.shape[2:]
        ).copy()  # (n * outputs, 4, 7, 7)
        own = neighbourhoods[:, :, REACH, REACH].copy()
        neighbourhoods[:, :, REACH, REACH] = 0
        loaded = neighbourhoods[:, 2].any(axis=(1, 2))
        some = np.flatnonzero(loaded)
        unloaded = np.flatnonzero(~loaded)
        some = rng.permutation(some)[:most]
        chosen = np.concatenate(
            [some, rng.permutation(unloaded)[: round(_UNLOADED * len(some)) + 1]]
        )
        did = np.stack([own[:, 2] == 0, own[:, 3] == 1], axis=1)[chosen]
        return cls(neighbourhoods[chosen], did.astype(np.float32))


@dataclass(frozen=True)
class SharedPrior:
    """The fitted prior.

    Attributes:
        weight: float64 ``[2, 4, 7, 7]``, never and always loaded, by feature and offset.
        bias: ``[2]``.
    """

    weight: NDArray[np.float64]
    bias: NDArray[np.float64]

    @classmethod
    def fit(cls, parts: list[Samples]) -> SharedPrior:
        """Fit to samples of many tiles; all is 0 without any."""
        from sklearn.linear_model import LogisticRegression

        side = 2 * REACH + 1
        if not parts:
            return cls(np.zeros((2, FEATURES, side, side)), np.zeros(2))
        neighbourhoods, did = (np.concatenate(of_tiles) for of_tiles in zip(*parts, strict=True))
        x = neighbourhoods.reshape(len(did), -1).astype(np.float64)
        weight = np.zeros((2, x.shape[1]))
        bias = np.zeros(2)
        for q, y in enumerate(did.T):
            if np.ptp(y):
                fit = LogisticRegression(C=1 / (len(x) * _RIDGE), solver="newton-cholesky").fit(
                    x, y
                )
                weight[q] = fit.coef_[0]
                bias[q] = fit.intercept_[0]
            else:  # no cell did, or all did
                bias[q] = logit((y.sum() + 1) / (len(y) + 2))
        return cls(weight.reshape(2, FEATURES, side, side), bias)

    def weights(self, down: NDArray[np.intp], across: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the weights for a tile, ``[4, inputs, 2, outputs]``.

        Args:
            down, across: int ``[inputs, outputs]``, rows and columns from each output to each
            input.
        """
        near = (np.abs(down) <= REACH) & (np.abs(across) <= REACH)
        found = np.zeros((FEATURES, len(down), 2, down.shape[1]))
        i, j = np.nonzero(near)
        found[:, i, :, j] = self.weight[:, :, down[i, j] + REACH, across[i, j] + REACH].transpose(
            2, 1, 0
        )
        return found
