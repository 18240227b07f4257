"""Where a contact ends: what the loads around a cell say of its own, learned once for all cells of a skin.

The regressions of a cell know that cell, from the few touches that reached it. How a contact fades from cell to cell is
the same everywhere: a small network, shared by all cells, corrects what each cell's own regressions foresee by what the
three rings of cells around it do. Fitted on touches that the regressions were not fitted on, so that it learns how far
those can be believed. Few touches teach no network: the fewer there are, the more two logistic regressions count beside
it, which stay near to what the cell's own foresee.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout
    from diagnostics.preprocessing.scale import Array

_SURE = 8.0  # log odds that a cell's own regressions are taken for at most
# Of a ring's cells: so much the mean of the whole array counts, all there is where none is trusted.
_EMPTY = np.float32(0.5)
_RIDGE = 1.0  # of the regressions, towards believing the cells' own
_HIDDEN, _DECAY, _EPOCHS, _BATCH, _RATE = 32, 0.3, 20, 512, 2e-3  # of the network: units, penalty, training
_FEW = 20  # touches from which the network learns as much as the regressions
_LEAST_SCALE = 1e-3
_RARE = 0.005  # share that a cell was ever found loaded in, at least and at most
N_FEATURES = 28  # of a cell, see around

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RegressionOutput:
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
class Stacking:
    """The regressions and the network, both part of the same log odds of never and of always loaded.

    Attributes:
        mean, scale: of what goes in, ``[k]``.
        weight: ``[k, 2]``; bias: ``[2]``.
        hidden: ``[k, h]``, of the network's units; threshold: ``[h]``; out: ``[h, 2]``.
        touches: how many taught it.
    """

    mean: Floats
    scale: Floats
    weight: Floats
    bias: Floats
    hidden: Floats
    threshold: Floats
    out: Floats
    events: int

    @classmethod
    def fit(
        cls, samples: NDArray[np.float64], never: NDArray[np.bool_], always: NDArray[np.bool_], events: int
    ) -> Stacking:
        """Fit on samples of cells that were not asked.

        Args:
            samples: ``[m, k]``, see :func:`neighbourhood`; never, always: bool ``[m]``, what they did.
            touches: that they are of.
        """
        mean, scale = samples.mean(axis=0), np.maximum(samples.std(axis=0), _LEAST_SCALE)
        z = (samples - mean) / scale
        fitted = [_corrected(z, did, column, mean, scale) for column, did in enumerate((never, always))]
        weight, bias = (np.stack(column, axis=-1) for column in zip(*fitted, strict=True))
        hidden, threshold, out, net_bias = _network(z, np.stack([never, always], axis=1))
        share = events / (events + _FEW)
        weight, bias, out = (1 - share) * weight, (1 - share) * bias + share * net_bias, share * out
        return cls(mean, scale, weight, bias, hidden, threshold, out, events)

    def predict(self, samples: Array) -> tuple[Floats, Floats]:
        """Return P(unloaded throughout) and P(loaded throughout), ``[...]`` each, of samples ``[k, ...]``."""
        weight = np.concatenate([self.weight, self.hidden], axis=1) / self.scale[:, None]
        bias = np.concatenate([self.bias, self.threshold]) - self.mean @ weight
        said = weight.T.astype(np.float32) @ samples.reshape(len(samples), -1)
        said += bias.astype(np.float32)[:, None]
        odds, units = said[:2], np.maximum(said[2:], 0, out=said[2:])
        odds += self.out.T.astype(np.float32) @ units
        never, always = expit(odds).astype(np.float64).reshape(2, *samples.shape[1:])
        return never, always


def neighbourhood(
    regressed: RegressionOutput,
    features: Array,
    predictors: NDArray[np.bool_],
    layout: SensorLayout,
    cells: NDArray[np.intp] | None = None,
) -> Array:
    """Return what there is to know of each of k cells in each stretch, itself apart, ``[28, k, n]``.

    Args:
        foreseen: by the cells' own regressions.
        features: ``[n, 4, D]`` (see ``Summary.features``).
        trusted: bool ``[D]``, the cells that may be asked.
        layout: the array.
        cells: int ``[k]``, ascending, those wanted; None: all D.
    """
    scored = (predictors & layout.present.ravel()).astype(np.float32)
    n, wanted = len(features), slice(None) if cells is None or len(cells) == layout.n_cells else cells
    # Four features of the trusted cells, and where these are. Stretches come last: long inner loops are fast.
    known = np.empty((5, *layout.shape, n), np.float32)
    by_cell = known.reshape(5, -1, n)
    np.multiply(features.transpose(1, 2, 0), scored[:, None], out=by_cell[:4])
    by_cell[4] = scored[:, None]

    def of(values: Array) -> Array:
        """Take the wanted of ``[..., pads, rows, cols, n]``."""
        return values.reshape(*values.shape[:-4], layout.n_cells, values.shape[-1])[..., wanted, :]

    cross, three, five = map(of, _windows(known))
    corners, itself = three - cross, of(known)
    # Means over the pad and over the array leave the cell itself out, as the rings do.
    pads = known.sum(axis=(2, 3))  # (5, pads, n)
    pad = np.repeat(pads, layout.rows * layout.cols, axis=1)[:, wanted] - itself
    whole = pads.sum(axis=1, keepdims=True) - itself
    known_values = np.empty((N_FEATURES, *itself.shape[1:]), np.float32)
    of_cells, of_place, *rings, on_pad, overall = known_values.reshape(7, 4, *itself.shape[1:])
    own = (
        np.clip(regressed.never[:, wanted], -_SURE, _SURE),
        np.clip(regressed.always[:, wanted], -_SURE, _SURE),
        regressed.mean[:, wanted],
        logit(np.clip(regressed.usual[:, wanted], _RARE, 1 - _RARE)),
    )
    for values, said in zip(of_cells, own, strict=True):
        values[:] = said.T
    of_place[0], of_place[1], of_place[2], of_place[3] = (
        cross[4],
        corners[4],
        of(_inside(layout)),
        of(enclosed(known[1])),
    )
    np.divide(whole[:4], np.maximum(whole[4:], 1), out=overall)
    np.divide(pad[:4] + _EMPTY * overall, pad[4:] + _EMPTY, out=on_pad)
    for total, ring in zip((cross, corners, five - three - itself), rings, strict=True):
        np.divide(total[:4] + _EMPTY * on_pad, total[4:] + _EMPTY, out=ring)
    return known_values


def _windows(known: Array) -> tuple[Array, Array, Array]:
    """Return sums ``[..., rows, cols, n]`` over the four next cells, the eight next, and all 25 within two steps."""
    rows, cols = known.shape[2:4]
    padded = np.pad(known, ((0, 0), (0, 0), (2, 2), (2, 2), (0, 0)))

    def beside(values: Array, axis: int, size: int, reach: int) -> Array:
        def moved(by: int) -> Array:
            part = slice(2 + by, 2 + by + size)
            return values[:, :, :, part] if axis == 3 else values[:, :, part]

        total: Array = moved(-reach) + moved(reach)
        return total

    inner = slice(2, 2 + rows)
    centre = padded[:, :, :, 2 : 2 + cols]
    across = beside(padded, 3, cols, 1)  # (5, pads, rows + 4, cols, n)
    in_row = across + centre
    cross = across[:, :, inner] + beside(centre, 2, rows, 1)
    three = across[:, :, inner] + beside(in_row, 2, rows, 1)
    wide = in_row + beside(padded, 3, cols, 2)
    five = wide[:, :, inner] + beside(wide, 2, rows, 1) + beside(wide, 2, rows, 2)
    return cross, three, five


def _inside(layout: SensorLayout) -> Array:
    """Return 1 for cells with four neighbours, 0 at the border of what the skin covers, ``[pads, rows, cols, 1]``."""
    there = np.pad(layout.present, ((0, 0), (1, 1), (1, 1)))
    inside = there[:, 2:, 1:-1] & there[:, :-2, 1:-1] & there[:, 1:-1, 2:] & there[:, 1:-1, :-2]
    return inside[..., None].astype(np.float32)


def enclosed(load: NDArray[Any]) -> NDArray[Any]:
    """Return how well the loads ``[pads, rows, cols, n]`` around each cell enclose it; of bool: whether they do.

    That is the smaller of two opposite ones; the best of four pairs counts.
    """
    padded = np.pad(load, ((0, 0), (1, 1), (1, 1), (0, 0)))
    rows, cols = load.shape[1:3]
    best = np.zeros_like(load)
    for r, c in ((0, 1), (1, 0), (1, 1), (1, -1)):
        one, other = (padded[:, 1 + s * r : 1 + s * r + rows, 1 + s * c : 1 + s * c + cols] for s in (1, -1))
        np.maximum(best, np.minimum(one, other), out=best)
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

    def curvature(weights: Floats) -> Floats:
        p = expit(x @ weights)
        bent: Floats = x.T @ (x * (p * (1 - p))[:, None]) + _RIDGE * np.eye(len(start))
        return bent

    # Few weights and many samples: second derivatives are cheap, and a handful of steps is all it takes.
    found = minimize(loss, start, jac=True, hess=curvature, method="trust-exact").x
    return found[:-1], float(found[-1])


def _network(z: Floats, did: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats, Floats]:
    """Fit a network with one hidden layer; return its weights ``[k, h]``, ``[h]``, ``[h, 2]``, ``[2]``."""
    from sklearn.neural_network import MLPClassifier

    # Not trained to the end, which would be to learn these few touches by heart.
    network = MLPClassifier(
        (_HIDDEN,),
        alpha=_DECAY,
        batch_size=min(_BATCH, len(z)),
        learning_rate_init=_RATE,
        shuffle=False,  # done here, for all batches at once: a third faster
        random_state=0,
    )
    inputs, targets, rng = z.astype(np.float32), did.astype(int), np.random.default_rng(0)
    for _ in range(_EPOCHS):
        order = rng.permutation(len(z))
        network.partial_fit(inputs[order], targets[order], classes=[0, 1])
    (hidden, out), (threshold, bias) = network.coefs_, network.intercepts_
    return hidden.astype(np.float64), threshold.astype(np.float64), out.astype(np.float64), bias.astype(np.float64)
