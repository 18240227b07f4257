"""Where a contact ends: what the loads around a cell say of its own, learned once for all cells of a skin.

The regressions of a cell know that cell, from the few touches that reached it. How a contact fades from cell to cell is
the same everywhere: two logistic regressions, shared by all cells, correct what each cell's own regressions foresee by
what the three rings of cells around it do. Fitted on touches that the others were not fitted on, so that they learn
how far those can be believed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from diagnostics.layout import SensorLayout
from diagnostics.touches import Array

_SURE = 8.0  # log odds that a cell's own regressions are taken for at most
_EMPTY = 0.5  # of a ring's cells: so much the mean of the whole array counts, all there is where none is trusted
_RIDGE = 1.0  # towards believing the cells' own regressions
_LEAST_SCALE = 1e-3
_RARE = 0.005  # share that a cell was ever found loaded in, at least and at most
INPUTS = 28  # of a cell, see around

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Foreseen:
    """What the regressions of each cell say of n stretches, ``[n, D]`` each.

    Attributes:
        never, always: log odds that it stays unloaded, or loaded, throughout.
        mean: expected mean root load.
        usual: share of the touches of the reference in which it is loaded.
    """

    never: Floats
    always: Floats
    mean: Floats
    usual: Floats


@dataclass(frozen=True)
class Rim:
    """The two regressions.

    Attributes:
        mean, scale: of what goes in, ``[k]``.
        weight: ``[k, 2]``, never loaded and always loaded; bias: ``[2]``.
    """

    mean: Floats
    scale: Floats
    weight: Floats
    bias: Floats

    @classmethod
    def fit(
        cls,
        samples: NDArray[np.float64],
        never: NDArray[np.bool_],
        always: NDArray[np.bool_],
    ) -> Rim:
        """Fit on samples ``[m, k]`` of cells that were not asked (see :func:`around`), and what they did, ``[m]``."""
        mean, scale = samples.mean(axis=0), np.maximum(samples.std(axis=0), _LEAST_SCALE)
        z = (samples - mean) / scale
        fitted = [_corrected(z, did, column, mean, scale) for column, did in enumerate((never, always))]
        weight, bias = (np.stack(column, axis=-1) for column in zip(*fitted, strict=True))
        return cls(mean, scale, weight, bias)

    def believe(self, samples: Floats) -> tuple[Floats, Floats]:
        """Return P(unloaded throughout) and P(loaded throughout), ``[...]`` each, of samples ``[..., k]``."""
        odds = ((samples - self.mean) / self.scale) @ self.weight + self.bias
        p: Floats = expit(odds)
        return p[..., 0], p[..., 1]


def around(foreseen: Foreseen, features: Array, trusted: NDArray[np.bool_], layout: SensorLayout) -> Floats:
    """Return what there is to know of each cell in each stretch, itself apart, ``[n, D, k]``.

    Args:
        foreseen: by the cells' own regressions.
        features: ``[n, 4, D]`` (see ``Summary.features``).
        trusted: bool ``[D]``, the cells that may be asked.
        layout: the array.
    """
    from scipy.ndimage import correlate1d

    asked = (trusted & layout.present.ravel()).astype(np.float32)
    known = layout.grid(
        np.concatenate([features * asked, np.broadcast_to(asked, (len(features), 1, len(asked)))], axis=1)
    )

    def window(values: Array, width: int) -> Array:
        ones = np.ones(width, np.float32)
        rows: Array = correlate1d(values, ones, axis=-2, mode="constant")
        both: Array = correlate1d(rows, ones, axis=-1, mode="constant")
        return both

    beside = np.array([1, 0, 1], np.float32)
    cross = correlate1d(known, beside, axis=-1, mode="constant") + correlate1d(known, beside, axis=-2, mode="constant")
    three, five = window(known, 3), window(known, 5)
    # Means over the pad and over the array leave the cell itself out, as the rings do.
    pads = known.sum(axis=(-2, -1), keepdims=True)  # (n, 5, pads, 1, 1)
    pad, whole = pads - known, pads.sum(axis=2, keepdims=True) - known

    def means(total: Array, of: Array) -> Array:
        mean: Array = (total[:, :4] + _EMPTY * of) / (total[:, 4:] + _EMPTY)
        return mean

    overall = whole[:, :4] / np.maximum(whole[:, 4:], 1)
    on_pad = means(pad, overall)
    rings = [means(total, on_pad) for total in (cross, three - known - cross, five - three)]
    loads = np.concatenate([*rings, on_pad, overall], axis=1).reshape(len(features), -1, layout.n_cells)
    place = np.stack(
        [cross[:, 4], three[:, 4] - known[:, 4] - cross[:, 4], _inside(layout)[None].repeat(len(known), 0)]
    )
    enclosed = _enclosed(known[:, 1])
    beyond = np.concatenate([place, enclosed[None]]).reshape(4, len(features), -1)
    own = (
        np.clip(foreseen.never, -_SURE, _SURE),
        np.clip(foreseen.always, -_SURE, _SURE),
        foreseen.mean,
        logit(np.clip(foreseen.usual, _RARE, 1 - _RARE)),
    )
    return np.concatenate([np.stack(own, axis=2), np.moveaxis(beyond, 0, 2), np.moveaxis(loads, 1, 2)], axis=2)


def _inside(layout: SensorLayout) -> Array:
    """Return 1 for cells with four neighbours, 0 at the border of what the skin covers, ``[pads, rows, cols]``."""
    there = np.pad(layout.present, ((0, 0), (1, 1), (1, 1)))
    inside = there[:, 2:, 1:-1] & there[:, :-2, 1:-1] & there[:, 1:-1, 2:] & there[:, 1:-1, :-2]
    return inside.astype(np.float32)


def _enclosed(load: Array) -> Array:
    """Return how well the loads around each cell enclose it: the smaller of two opposite ones, the best pair counts."""
    padded = np.pad(load, ((0, 0), (0, 0), (1, 1), (1, 1)))
    rows, cols = load.shape[2:]
    pairs = []
    for r, c in ((0, 1), (1, 0), (1, 1), (1, -1)):
        one, other = (padded[..., 1 + s * r : 1 + s * r + rows, 1 + s * c : 1 + s * c + cols] for s in (1, -1))
        pairs.append(np.minimum(one, other))
    best: Array = np.maximum.reduce(pairs)
    return best


def _corrected(z: Floats, did: NDArray[np.bool_], column: int, mean: Floats, scale: Floats) -> tuple[Floats, float]:
    """Return weights ``[k]`` and bias of one logistic regression, near to those that repeat input ``column``."""
    from scipy.optimize import minimize

    start = np.zeros(z.shape[1] + 1)
    start[column], start[-1] = scale[column], mean[column]
    x = np.column_stack([z, np.ones(len(z))])

    def loss(weights: Floats) -> tuple[float, Floats]:
        odds, change = x @ weights, weights - start
        value = np.logaddexp(0, odds).sum() - odds[did].sum() + 0.5 * _RIDGE * (change @ change)
        return float(value), x.T @ (expit(odds) - did) + _RIDGE * change

    found = minimize(loss, start, jac=True, method="L-BFGS-B").x
    return found[:-1], float(found[-1])
