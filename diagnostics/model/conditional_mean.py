"""E[load | others] and E[loaded | others] of each cell, from one covariance of both (Ledoit and
Wolf 2004).

With P the inverse of the covariance among the known cells, and a, b, c its entries of the load and
the loadedness of cell i, both are left out together: the 2 x 2 block is inverted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri

from diagnostics.events.tiles import tiles
from diagnostics.layout import SensorLayout
from diagnostics.model.record import Array, Cells, Mask

_SURELY = 0.1  # root load that is surely one
_CONSTANT = 1e-3  # standard deviation of an input that tells nothing
_RIDGE = 1e-3
_KEPT = 2  # inverses

Floats = NDArray[np.float64]


def loaded(load: Array) -> Array:
    """Return how surely cells are loaded, 0 to 1: little load is little sure."""
    found: Array = np.minimum(load / _SURELY, 1).astype(np.float32)
    return found


def _both(load: Array) -> Floats:
    return np.hstack([load, loaded(load)]).astype(np.float64)


@dataclass(frozen=True)
class Tile:
    """Covariance of some cells, loads first, then how surely they are loaded.

    Attributes:
        inputs: int ``[k]``, the cells.
        place: int, place among them of the cells that are predicted.
        mean, deviation: ``[2 k]``; infinite: an input that tells nothing.
        covariance: ``[2 k, 2 k]``.
    """

    inputs: Cells
    place: Cells
    mean: Floats
    deviation: Floats
    covariance: Floats

    @classmethod
    def fit(cls, load: Array, inputs: Cells, outputs: Cells) -> Tile:
        """Fit to root loads ``[n, D]``."""
        from sklearn.covariance import LedoitWolf

        own = _both(load[:, inputs])
        mean = own.mean(axis=0)
        deviation = own.std(axis=0)
        deviation = np.where(deviation < _CONSTANT, np.inf, deviation)
        covariance = LedoitWolf(assume_centered=True).fit((own - mean) / deviation).covariance_
        covariance[np.diag_indices(len(covariance))] += _RIDGE
        return cls(inputs, np.searchsorted(inputs, outputs), mean, deviation, covariance)

    def predict(self, load: Array, known: Mask) -> tuple[Floats, Floats]:
        """Return both of the predicted cells, ``[n, k]`` each."""
        one = known[self.inputs]
        two = np.tile(one, 2)
        z = (_both(load[:, self.inputs]) - self.mean) / self.deviation
        found = np.zeros_like(z)
        if two.any():
            precision = self._precision(two)
            y = z[:, two] @ precision
            found[:, two] = z[:, two] - _left_out(y, precision)
            found[:, ~two] = y @ self.covariance[np.ix_(two, ~two)]
        scale = np.where(np.isinf(self.deviation), 0, self.deviation)
        found = found * scale + self.mean
        n = len(one)
        return found[:, :n][:, self.place], found[:, n:][:, self.place]

    def sums(self, load: Array, known: Mask, on: Mask, of: Mask) -> Floats:
        """Return the expected sum of the loads of some cells of each line, by those off it,
        ``[n, W]``.

        With P the inverse of the covariance C of the known cells, y = P z, and a those of them on
        the line, ``y - P_a (P_aa)^-1 y_a`` is what the others say.

        Args:
            load: root loads ``[n, D]``.
            known: bool ``[D]``, cells that tell.
            on: bool ``[W, D]``, cells on each line.
            of: bool ``[W, D]``, those of them that are summed up.
        """
        outputs = self.inputs[self.place]
        chosen = of[:, outputs].astype(float)
        total = np.zeros((len(load), len(on))) + chosen @ self.mean[self.place]
        two = np.tile(known[self.inputs], 2)
        lines = np.flatnonzero(chosen.any(axis=1))
        if not two.any():
            return total
        z = (_both(load[:, self.inputs]) - self.mean) / self.deviation
        precision = self._precision(two)
        scale = np.where(np.isinf(self.deviation), 0, self.deviation)[self.place]
        weight = self.covariance[np.ix_(two, self.place)] @ (chosen[lines] * scale).T
        explained = precision @ weight
        off = _solved(precision, np.tile(on[np.ix_(lines, self.inputs)], 2)[:, two], explained.T)
        weight -= off.T
        total[:, lines] += z[:, two] @ (precision @ weight)
        return total

    def _precision(self, two: Mask) -> Floats:
        """Return the inverse of the covariance of some inputs, bool ``[2 k]``."""
        key = two.tobytes()
        found = self._inverses.get(key)
        if found is None:
            found = _inverse(self.covariance[np.ix_(two, two)])
            while len(self._inverses) >= _KEPT:
                self._inverses.pop(next(iter(self._inverses)))
            self._inverses[key] = found
        return found

    @cached_property
    def _inverses(self) -> dict[bytes, Floats]:
        """The last inverses: many questions are asked of the same cells."""
        return {}


def _inverse(covariance: Floats) -> Floats:
    """Return the inverse of a positive definite matrix, by its Cholesky factor."""
    factor, failed = dpotrf(covariance, lower=1)
    if failed:
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    half, _ = dpotri(factor, lower=1)
    lower: Floats = np.tril(half)
    lower += np.tril(half, -1).T
    return lower


def _solved(matrix: Floats, own: Mask, values: Floats) -> Floats:
    """Return the solution x of ``matrix[own, own] x[own] = values[own]`` for each of several parts,
    ``[W, n]``; 0 elsewhere.

    Args:
        matrix: ``[n, n]``.
        own: bool ``[W, n]``.
        values: ``[W, n]``.
    """
    found = np.zeros(own.shape)
    sizes = own.sum(axis=1)
    for size in np.unique(sizes[sizes > 0]).tolist():
        alike = np.flatnonzero(sizes == size)
        at = np.nonzero(own[alike])[1].reshape(-1, size)
        blocks = matrix[at[:, :, None], at[:, None, :]]
        given = np.take_along_axis(values[alike], at, 1)
        found[alike[:, None], at] = np.linalg.solve(blocks, given[..., None])[..., 0]
    return found


def _left_out(y: Floats, precision: Floats) -> Floats:
    """Return what is left of each pair of inputs once the others are known."""
    n = len(precision) // 2
    i = np.arange(n)
    a = precision[i, i]
    b = precision[i, i + n]
    c = precision[i + n, i + n]
    determinant = a * c - b * b
    of_load = (c * y[:, :n] - b * y[:, n:]) / determinant
    of_loaded = (a * y[:, n:] - b * y[:, :n]) / determinant
    return np.hstack([of_load, of_loaded])


@dataclass(frozen=True)
class ConditionalMean:
    """The conditional means of all cells, tile by tile."""

    parts: tuple[Tile, ...]

    @classmethod
    def fit(cls, load: Array, layout: SensorLayout, living: Mask) -> ConditionalMean:
        """Fit to root loads ``[n, D]``; ``living``: bool ``[D]``, cells that have a load at all."""
        parts = []
        for tile in tiles(layout):
            inputs = tile.inputs[living[tile.inputs]]
            outputs = tile.outputs[living[tile.outputs]]
            if len(outputs):
                parts.append(Tile.fit(load, inputs, outputs))
        return cls(tuple(parts))

    def predict(self, load: Array, known: Mask) -> tuple[Array, Array]:
        """Return E[load | others] and E[loaded | others] by the ``known`` cells, ``[n, D]``
        each."""
        mean = np.zeros(load.shape, np.float32)
        surely = np.zeros(load.shape, np.float32)
        for part in self.parts:
            outputs = part.inputs[part.place]
            mean[:, outputs], surely[:, outputs] = part.predict(load, known)
        return mean, surely

    def sums(self, load: Array, known: Mask, on: Mask, of: Mask) -> Floats:
        """Return the expected sums ``[n, W]`` of the loads of the cells in ``of`` on each line, by
        the ``known`` ones off it: ``on`` and ``of`` bool ``[W, D]``."""
        found = np.zeros((len(load), len(on)))
        for part in self.parts:
            found += part.sums(load, known, on, of)
        return found


@dataclass(frozen=True)
class CrossFitted(ConditionalMean):
    """Conditional means of which none has seen the recordings that it predicts.

    Attributes:
        means: without each of the folds; the first one stands for all.
        fold: int ``[n]``, of each piece.
    """

    means: Sequence[ConditionalMean]
    fold: Cells

    @classmethod
    def of(cls, means: Sequence[ConditionalMean], fold: Cells) -> CrossFitted:
        """Return the means as one."""
        return cls(means[0].parts, means, fold)

    def predict(self, load: Array, known: Mask) -> tuple[Array, Array]:
        """Return what :meth:`ConditionalMean.predict` does; ``load``: of the first pieces."""
        mean = np.zeros(load.shape, np.float32)
        surely = np.zeros(load.shape, np.float32)
        fold = self.fold[: len(load)]
        for k in np.unique(fold).tolist():
            of_fold = fold == k
            mean[of_fold], surely[of_fold] = self.means[k].predict(load[of_fold], known)
        return mean, surely

    def sums(self, load: Array, known: Mask, on: Mask, of: Mask) -> Floats:
        """Return what :meth:`ConditionalMean.sums` does; ``load``: of the first pieces."""
        found = np.zeros((len(load), len(on)))
        fold = self.fold[: len(load)]
        for k in np.unique(fold).tolist():
            of_fold = fold == k
            found[of_fold] = self.means[k].sums(load[of_fold], known, on, of)
        return found
