"""Neighbourhood stacking: corrects the local regressions by the loads around each cell, with one
model for all cells.

Estimates log odds of "never loaded" and "always loaded" from 28 features: the outputs of the
regressions of the cell, its position, and mean loads of three rings of cells, of the pad and of the
array:

    log odds = b + out' max(hidden' x + threshold, 0)

Stacked generalization (Wolpert 1992) with scikit-learn's ``MLPClassifier`` as second level. Fitted
on events that the regressions were not fitted on (see :mod:`~diagnostics.healthy.cross_fitting`).
Loads beyond two rows or columns enter only as means.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from diagnostics.preprocessing.levels import RARE

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout
    from diagnostics.preprocessing.scale import Array

_MAX_ODDS = 8.0  # log odds of the regressions are clipped here
# pseudo-count of a ring: the mean of the pad; of the pad: the mean of the array
_PRIOR_CELLS = np.float32(0.5)
# units, L2 penalty, epochs, batch, learning rate
_HIDDEN = 32
_DECAY = 0.3
_EPOCHS = 20
_BATCH = 512
_RATE = 2e-3
N_FEATURES = 28  # per cell, see neighbourhood

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Stacking:
    """The fitted second level, for k features, h hidden units, and the outputs (never, always).

    Attributes:
        mean, scale: float ``[k]``, of the features.
        bias: float ``[2]``.
        hidden: float ``[k, h]``, input weights of the hidden units.
        threshold: float ``[h]``, their biases.
        out: float ``[h, 2]``, their output weights.
        events: number of events it was fitted on.
    """

    mean: Floats
    scale: Floats
    bias: Floats
    hidden: Floats
    threshold: Floats
    out: Floats
    events: int

    @classmethod
    def fit(cls, samples: Floats, did: NDArray[np.bool_], events: int) -> Stacking:
        """Fit to samples of cells that were no predictors.

        Args:
            samples: ``[m, k]``, see :func:`neighbourhood`.
            did: bool ``[m, 2]``, whether the cell stayed unloaded, and loaded, throughout.
            events: number of events behind the samples.
        """
        from sklearn.preprocessing import StandardScaler

        scaler = StandardScaler().fit(samples)
        hidden, threshold, out, bias = _network(scaler.transform(samples), did)
        return cls(scaler.mean_, scaler.scale_, bias, hidden, threshold, out, events)

    def predict(self, samples: Array) -> tuple[Floats, Floats]:
        """Return P(unloaded throughout) and P(loaded throughout), ``[...]`` each, of samples
        ``[k, ...]``."""
        weight = self.hidden / self.scale[:, None]
        units = weight.T.astype(np.float32) @ samples.reshape(len(samples), -1)
        units += (self.threshold - self.mean @ weight).astype(np.float32)[:, None]
        odds = (
            self.out.T.astype(np.float32) @ np.maximum(units, 0, out=units)
            + self.bias.astype(np.float32)[:, None]
        )
        never, always = expit(odds).astype(np.float64).reshape(2, *samples.shape[1:])
        return never, always


def neighbourhood(
    regressed: Floats,
    features: Array,
    predictors: NDArray[np.bool_],
    layout: SensorLayout,
    cells: NDArray[np.intp] | None = None,
) -> Array:
    """Return the stacking features of k cells in n excerpts, ``[28, k, n]``; none uses the reading
    of the cell itself.

    Args:
        regressed: ``[4, n, D]``, see ``predict_regressions``.
        features: ``[n, 4, D]`` (see ``Summary.features``).
        predictors: bool ``[D]``, the cells whose readings may be used.
        layout: the array.
        cells: int ``[k]``, ascending; None: all D.
    """
    usable = (predictors & layout.present.ravel()).astype(np.float32)
    n = len(features)
    selected = slice(None) if cells is None or len(cells) == layout.n_cells else cells
    # Four features of the predictors, and where these are. Excerpts come last: long inner loops are
    # fast.
    known = np.empty((5, *layout.shape, n), np.float32)
    by_cell = known.reshape(5, -1, n)
    np.multiply(features.transpose(1, 2, 0), usable[:, None], out=by_cell[:4])
    by_cell[4] = usable[:, None]

    def of(values: Array) -> Array:
        """Select the cells from ``[..., pads, rows, cols, n]``."""
        return values.reshape(*values.shape[:-4], layout.n_cells, values.shape[-1])[
            ..., selected, :
        ]

    cross, three, five = map(of, _windows(known))
    corners = three - cross
    itself = of(known)
    # Means over the pad and over the array leave the cell itself out, as the rings do.
    pads = known.sum(axis=(2, 3))  # (5, pads, n)
    pad = np.repeat(pads, layout.rows * layout.cols, axis=1)[:, selected] - itself
    whole = pads.sum(axis=1, keepdims=True) - itself
    described = np.empty((N_FEATURES, *itself.shape[1:]), np.float32)
    of_cells, of_place, *rings, on_pad, overall = described.reshape(7, 4, *itself.shape[1:])
    never, always, mean, usual = regressed[:, :, selected].transpose(0, 2, 1)
    of_cells[0], of_cells[1] = (np.clip(odds, -_MAX_ODDS, _MAX_ODDS) for odds in (never, always))
    of_cells[2] = mean
    of_cells[3] = logit(np.clip(usual, RARE, 1 - RARE))
    beside = layout.beside[selected][:, [1, 3, 4, 6]]  # on the row and the column
    of_place[0] = cross[4]
    of_place[1] = corners[4]
    of_place[2] = np.all(beside >= 0, axis=1, keepdims=True)
    of_place[3] = of(enclosed(known[1]))
    np.divide(whole[:4], np.maximum(whole[4:], 1), out=overall)
    np.divide(pad[:4] + _PRIOR_CELLS * overall, pad[4:] + _PRIOR_CELLS, out=on_pad)
    for total, ring in zip((cross, corners, five - three - itself), rings, strict=True):
        np.divide(total[:4] + _PRIOR_CELLS * on_pad, total[4:] + _PRIOR_CELLS, out=ring)
    return described


def _windows(known: Array) -> tuple[Array, Array, Array]:
    """Return sums ``[..., rows, cols, n]`` over the 4 adjacent cells, the 8 adjacent cells, and the
    5 x 5 block."""
    rows, cols = known.shape[2:4]
    padded = np.pad(known, ((0, 0), (0, 0), (2, 2), (2, 2), (0, 0)))

    def pair(values: Array, axis: int, size: int, reach: int) -> Array:
        def moved(by: int) -> Array:
            part = slice(2 + by, 2 + by + size)
            return values[:, :, :, part] if axis == 3 else values[:, :, part]

        total: Array = moved(-reach) + moved(reach)
        return total

    inner = slice(2, 2 + rows)
    centre = padded[:, :, :, 2 : 2 + cols]
    across = pair(padded, 3, cols, 1)  # (5, pads, rows + 4, cols, n)
    in_row = across + centre
    cross = across[:, :, inner] + pair(centre, 2, rows, 1)
    three = across[:, :, inner] + pair(in_row, 2, rows, 1)
    wide = in_row + pair(padded, 3, cols, 2)
    five = wide[:, :, inner] + pair(wide, 2, rows, 1) + pair(wide, 2, rows, 2)
    return cross, three, five


def enclosed(load: NDArray[Any]) -> NDArray[Any]:
    """Return how far the loads around each cell enclose it, ``[pads, rows, cols, n]``.

    That is the maximum over the four pairs of opposite neighbours of the smaller load of the pair.
    """
    padded = np.pad(load, ((0, 0), (1, 1), (1, 1), (0, 0)))
    rows, cols = load.shape[1:3]
    best = np.zeros_like(load)
    for r, c in ((0, 1), (1, 0), (1, 1), (1, -1)):
        one, other = (
            padded[:, 1 + s * r : 1 + s * r + rows, 1 + s * c : 1 + s * c + cols] for s in (1, -1)
        )
        np.maximum(best, np.minimum(one, other), out=best)
    return best


def _network(z: Floats, y: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats, Floats]:
    """Fit a network with one hidden layer; return its weights ``[k, h]``, ``[h]``, ``[h, 2]``,
    ``[2]``."""
    from sklearn.neural_network import MLPClassifier

    # Early stopping: training to convergence would overfit the few events.
    network = MLPClassifier(
        (_HIDDEN,),
        alpha=_DECAY,
        batch_size=min(_BATCH, len(z)),
        learning_rate_init=_RATE,
        shuffle=False,  # done below, for all batches at once: a third faster
        random_state=0,
    )
    inputs = z.astype(np.float32)
    targets = y.astype(int)
    rng = np.random.default_rng(0)
    for _ in range(_EPOCHS):
        order = rng.permutation(len(z))
        network.partial_fit(inputs[order], targets[order], classes=[0, 1])
    (hidden, out), (threshold, bias) = network.coefs_, network.intercepts_
    return (
        hidden.astype(np.float64),
        threshold.astype(np.float64),
        out.astype(np.float64),
        bias.astype(np.float64),
    )
