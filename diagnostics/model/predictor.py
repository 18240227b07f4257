"""P(level of a cell | the others, and what it read a piece ago): one small network for all cells.

Its inputs are the conditional means, the mean loads around the cell, of its pad and of the array,
how often the cell is loaded, and its own load a piece ago. As it knows the cell's past, the
surprises of successive pieces are independent: a contact that the others do not explain counts
once, when it begins.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.special import expit

from diagnostics.layout import SensorLayout
from diagnostics.model.conditional_mean import ConditionalMean, loaded
from diagnostics.model.record import Array, Cells, Mask
from diagnostics.model.symbols import NOTHING
from diagnostics.preprocessing.levels import FEWEST

_GUESS = 0.002  # of a uniform distribution in any prediction: models err
_BLUR = 0.02  # of a level that is one further up, or down
_INPUTS = 21
_HIDDEN = (32, 32)
_BATCH = 2048
_STEPS = 1000
_FEWEST_STEPS = 50
_STEPS_OF_ROUND = 10  # after which the weights count for the average
_AVERAGED = 0.3  # of the last steps (Polyak and Juditsky 1992)
_EPOCHS = 12  # at most
_RATE = 0.02
_AT_ONCE = 16_384  # predictions
_LEAST_ERROR = 0.02  # of a root load: none is expected more exactly
_RINGS = {1: (1,), 2: (2,), 4: (4, 5, 8)}  # squared distances of the cells of a ring


@dataclass(frozen=True)
class Network:
    """A perceptron with the softmax over levels, which errs now and then.

    Attributes:
        mean, deviation: of the inputs.
        weights, biases: of the layers.
    """

    mean: Array
    deviation: Array
    weights: tuple[Array, ...]
    biases: tuple[Array, ...]

    @classmethod
    def fit(
        cls, inputs: Array, level: NDArray[np.integer], n_levels: int, most: float = 1.0
    ) -> Network:
        """Fit to inputs ``[n, k]``, which are overwritten, and levels int ``[n]``; the same every
        time. ``most``: share of the usual steps."""
        from sklearn.neural_network import MLPClassifier

        z = inputs
        mean = z.mean(axis=0)
        deviation = np.stack([column.std() for column in z.T]) + np.float32(1e-6)
        z -= mean
        z /= deviation
        rng = np.random.default_rng(0)
        steps = int(max(_FEWEST_STEPS, min(_EPOCHS * len(z) / _BATCH, most * _STEPS)))
        fit = MLPClassifier(_HIDDEN, learning_rate_init=_RATE, alpha=1e-6, random_state=0)
        fit.batch_size = min(_BATCH, len(z))
        rounds = -(-steps // _STEPS_OF_ROUND)
        averaged: list[list[Array]] = []
        for number in range(rounds):
            pick = rng.integers(0, len(z), _STEPS_OF_ROUND * fit.batch_size)
            fit.partial_fit(z[pick], level[pick], classes=np.arange(n_levels))
            if number >= rounds * (1 - _AVERAGED):
                averaged.append([layer.copy() for layer in [*fit.coefs_, *fit.intercepts_]])
        layers = [np.mean(of_rounds, axis=0) for of_rounds in zip(*averaged, strict=True)]
        half = len(layers) // 2
        return cls(mean, deviation, tuple(layers[:half]), tuple(layers[half:]))

    def __call__(self, inputs: Array) -> Array:
        """Return P(level) ``[..., K]`` of inputs ``[..., k]``."""
        # inputs, and levels, come first: sums over them are sums of long rows
        columns = np.moveaxis(inputs, -1, 0).reshape(inputs.shape[-1], -1)
        found = np.empty((len(self.biases[-1]), columns.shape[1]), np.float32)
        for begin in range(0, columns.shape[1], _AT_ONCE):
            part = np.s_[:, begin : begin + _AT_ONCE]
            found[part] = self._of_columns(columns[part])
        return np.moveaxis(found.reshape(-1, *inputs.shape[:-1]), 0, -1)

    def _of_columns(self, inputs: Array) -> Array:
        hidden = (inputs - self.mean[:, None]) / self.deviation[:, None]
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = weight.T @ hidden
            hidden += bias[:, None]
            np.maximum(hidden, 0, out=hidden)
        logits = self.weights[-1].T @ hidden
        logits += self.biases[-1][:, None]
        logits -= logits.max(axis=0)
        found = np.exp(logits, out=logits)
        found /= found.sum(axis=0)
        return _errs(len(found)) @ found


@dataclass(frozen=True)
class CrossFittedNetwork(Network):
    """Networks of which none has learned from the recordings that it predicts.

    Attributes:
        networks: without each of the folds; the first one stands for all.
        fold: int ``[n]``, of each piece.
    """

    networks: Sequence[Network]
    fold: Cells

    @classmethod
    def of(cls, networks: Sequence[Network], fold: Cells) -> CrossFittedNetwork:
        """Return the networks as one."""
        return cls(**vars(networks[0]), networks=networks, fold=fold)

    def __call__(self, inputs: Array) -> Array:
        """Return P(level) ``[n, D, K]`` of inputs ``[n, D, k]``, of the first pieces."""
        fold = self.fold[: len(inputs)]
        found = np.zeros((*inputs.shape[:2], len(self.networks[0].biases[-1])), np.float32)
        for k in np.unique(fold).tolist():
            of_fold = fold == k
            found[of_fold] = self.networks[k](inputs[of_fold])
        return found


@dataclass
class Predictor:
    """The distribution of the level of each cell.

    Attributes:
        living: bool ``[D]``, cells that have a load at all.
        pad: int ``[D]``, pad of each cell.
        around: int ``[D, k]`` each, the living cells beside each one, by distance; -1: none.
        beside: int ``[D, k]``, cells beside each one; -1: none.
        usual: ``[D, k]``, how often and how much each cell is loaded.
        mean: the conditional mean; those of the folds while the model is fitted.
        error: ``[D]``, root mean square error of the conditional mean of the load of each cell
            while it is loaded; infinite: it never is.
        network: None: not fitted yet.
    """

    living: Mask
    pad: NDArray[np.intp]
    around: tuple[Cells, ...]
    beside: Cells
    usual: Array
    mean: ConditionalMean
    error: Array
    network: Network | None = None

    @classmethod
    def of(
        cls, load: Array, layout: SensorLayout, living: Mask, mean: ConditionalMean
    ) -> Predictor:
        """Return the predictor without its network, for root loads ``[n, D]`` of the reference."""
        on = load > NOTHING
        share = on.mean(axis=0)
        often = np.log((share + 0.002) / (1.002 - share))
        much = load.sum(axis=0) / np.maximum(on.sum(axis=0), 1)
        usual = np.stack([often, much, load.std(axis=0)], axis=1).astype(np.float32)
        around = _around(layout, living)
        error = _error(load, mean.predict(load, living)[0])
        return cls(living, layout.pad_of, around, layout.beside, usual, mean, error)

    def inputs(self, load: Array, own: Array, first: Mask, known: Mask) -> Array:
        """Return the inputs of the network, ``[n, D, k]``.

        Args:
            load: root loads ``[n, D]`` that the ``known`` cells (bool ``[D]``) tell.
            own: root loads ``[n, D]`` of the cells themselves.
            first: bool ``[n]``, a recording begins.
            known: the cells that tell.
        """
        found = np.empty((_INPUTS, *load.shape), np.float32)
        for place, column in zip(found, self._columns(load, own, first, known), strict=True):
            place[...] = column
        return np.moveaxis(found, 0, -1)

    def _columns(self, load: Array, own: Array, first: Mask, known: Mask) -> Iterator[NDArray[Any]]:
        """Yield each input, ``[n, D]`` or what has its shape once it is repeated; arguments as of
        :meth:`inputs`."""
        told = np.where(known, load, 0).astype(np.float32)
        on = loaded(told)
        telling = known.astype(np.float32)
        mean, surely = self.mean.predict(load, known)
        mean = np.clip(mean, -0.2, 1)
        surely = np.clip(surely, -0.3, 1.3)
        yield from (mean, np.sqrt(np.maximum(mean, 0)), surely)
        for ring in self._rings:
            count = np.maximum(ring @ telling, 1)
            yield (ring @ told.T).T / count
            yield (ring @ on.T).T / count
        yield np.minimum(self._rings[0] @ telling, 4)
        count = np.maximum(self.on_pad(telling), 1)
        yield self.on_pad(told) / count
        yield self.on_pad(on) / count
        yield told.mean(axis=1, keepdims=True)
        yield from self.usual.T
        last = _before(own, first)
        yield from (last, loaded(last), _before(mean, first), _before(surely, first))
        yield first[:, None]

    @cached_property
    def _rings(self) -> list[csr_array]:
        """Which cells lie around each one, sparse ``[D, D]`` for each ring."""
        return [_matrix(cells) for cells in self.around]

    @property
    def rests(self) -> Array:
        """Return the share of the pieces of the reference in which each cell rests, ``[D]``."""
        found: Array = expit(-self.usual[:, 0])
        return found

    def on_pad(self, values: Array) -> Array:
        """Return the sum of values ``[..., D]`` over the pad of each cell, ``[..., D]``."""
        found: Array = (values @ self._of_pad)[..., self.pad]
        return found

    @cached_property
    def _of_pad(self) -> Array:
        """Return which cells each pad has, ``[D, pads]``."""
        found: Array = np.equal(self.pad[:, None], np.arange(self.pad.max() + 1)).astype(np.float32)
        return found

    def __call__(self, load: Array, own: Array, first: Mask, known: Mask) -> Array:
        """Return P(level) ``[n, D, K]``; arguments as for :meth:`inputs`."""
        if self.network is None:
            raise ValueError("the predictor has no network yet")
        return self.network(self.inputs(load, own, first, known))


@cache
def _errs(n: int) -> Array:
    """Return P(level | level that is predicted), ``[n, n]``: a share lies one further up or down,
    a few anywhere."""
    blur = (1 - 2 * _BLUR) * np.eye(n) + _BLUR * (np.eye(n, k=1) + np.eye(n, k=-1))
    blur[[0, -1], [0, -1]] += _BLUR
    found: Array = ((1 - _GUESS) * blur + _GUESS / n).astype(np.float32)
    return found


def _error(load: Array, expected: Array) -> Array:
    """Return the root mean square error of the expected root load of each cell, ``[D]`` of
    ``[n, D]``, where it is loaded; infinite: it never is."""
    on = load > NOTHING
    pieces = on.sum(axis=0)
    squares = np.where(on, (load - expected) ** 2, 0).sum(axis=0)
    usual = np.sqrt(squares.sum() / max(1, pieces.sum()))
    error = np.sqrt(squares / np.maximum(pieces, 1))
    error = np.maximum(np.where(pieces < FEWEST, 2 * usual, error), _LEAST_ERROR)
    return np.where(pieces > 0, error, np.inf).astype(np.float32)


def _before(values: Array, first: Mask) -> Array:
    """Return the values a piece ago; 0: a recording begins."""
    found = np.roll(values, 1, axis=0)
    found[first] = 0
    return found


def _around(layout: SensorLayout, living: Mask) -> tuple[Cells, ...]:
    """Return the living cells around each living one, int ``[D, k]`` for each ring; -1: none."""
    shape = (layout.pads, layout.rows, layout.cols)
    pad, row, col = np.unravel_index(np.arange(layout.n_cells), shape)
    reach = int(np.sqrt(max(max(distances) for distances in _RINGS.values())))
    found: dict[int, list[Cells]] = {ring: [] for ring in _RINGS}
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            inside = (row + down >= 0) & (row + down < layout.rows)
            inside &= (col + right >= 0) & (col + right < layout.cols)
            other = np.ravel_multi_index((pad, row + down, col + right), shape, mode="clip")
            lives = inside & living & living[other]
            for ring, distances in _RINGS.items():
                if down**2 + right**2 in distances:
                    found[ring].append(np.where(lives, other, -1))
    return tuple([np.stack(cells, axis=1) for cells in found.values()])


def _matrix(cells: Cells) -> csr_array:
    """Return a sparse matrix ``[D, D]`` with ones at the cells ``[D, k]`` of each row."""
    there = cells >= 0
    row = np.nonzero(there)[0]
    ones = np.ones(len(row), np.float32)
    return csr_array((ones, (row, cells[there])), shape=(len(cells), len(cells)))
