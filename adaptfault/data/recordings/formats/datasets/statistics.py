"""Statistics of valid readings, in the form of LeRobot's ``stats.json``.

Dead cells spoil what every policy normalises with. Minimum, maximum, mean, standard deviation and
quantiles are therefore those of valid readings, cell by cell. A cell without any gets the median of
those of the other cells of its feature: a constant that is no reading must not become the unit.
Quantiles of more than 65,536 frames are those of evenly spaced ones.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_MOST = 1 << 16  # frames from which quantiles are taken: a size
_QUANTILE = re.compile(r"q(\d\d)")

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class Statistics:
    """Statistics of one feature, frames taken in piece by piece.

    Args:
        sizes: of a frame.
    """

    def __init__(self, sizes: tuple[int, ...]) -> None:
        self.sizes = sizes
        self.frames = 0
        self._n = np.zeros(sizes, np.int64)
        self._mean = np.zeros(sizes)
        self._squares = np.zeros(sizes)  # of what differs from the mean
        self._low = np.full(sizes, np.inf)
        self._high = np.full(sizes, -np.inf)
        self._sample: list[Floats] = []
        self._every = 1

    def add(self, readings: NDArray[Any], valid: Bools) -> None:
        """Take in frames ``[n, ...]``, and which of their readings are valid."""
        x = np.where(valid & np.isfinite(readings), readings, np.nan).astype(np.float64)
        known = np.isfinite(x)
        n = known.sum(axis=0)
        mean = np.divide(np.nansum(x, axis=0), n, out=np.zeros(self.sizes), where=n > 0)
        squares = np.nansum((x - mean) ** 2, axis=0)
        total = self._n + n
        apart = mean - self._mean
        share = np.divide(n, total, out=np.zeros(self.sizes), where=total > 0)
        self._squares += squares + apart**2 * self._n * share  # Chan et al. 1983
        self._mean += apart * share
        self._n = total
        self._low = np.fmin(self._low, np.fmin.reduce(x, axis=0, initial=np.inf))
        self._high = np.fmax(self._high, np.fmax.reduce(x, axis=0, initial=-np.inf))
        self._sample.append(x[-self.frames % self._every :: self._every])
        self.frames += len(x)
        while sum(map(len, self._sample)) > _MOST:
            self._sample = [np.concatenate(self._sample)[::2]]
            self._every *= 2

    def as_told(self, told: Mapping[str, Any]) -> dict[str, Any]:
        """Return statistics with the names and forms of those ``told`` before; names that are not
        known here keep their values."""
        return {name: self._told(name, value) for name, value in told.items()}

    def _told(self, name: str, before: Any) -> Any:
        shape = np.shape(before)
        pooled = self._pooled(shape)
        if name == "count" or pooled is None or not (self._n > 0).any():
            return before
        n = self._n.sum(axis=pooled)
        values = self._value(name, pooled)
        if values is None:
            return before
        seen = n > 0
        values = np.where(seen, values, np.median(values[seen]))
        return values.reshape(shape).tolist() if shape else float(values)

    def _pooled(self, shape: tuple[int, ...]) -> tuple[int, ...] | None:
        """Return the axes of a frame that statistics of a shape take together: LeRobot's are of the
        last axis alone; None where the shape is of something else."""
        axes = len(self.sizes)
        if np.prod(shape) == np.prod(self.sizes):
            return ()
        if np.prod(shape) == 1:
            return tuple(range(axes))
        left = axes - len(shape)
        return tuple(range(left)) if left > 0 and self.sizes[left:] == shape else None

    def _value(self, name: str, pooled: tuple[int, ...]) -> Floats | None:
        """Return a statistic over some axes of a frame; 0 or infinite where no reading is
        valid."""
        if name in ("min", "max"):
            of_cells, reduce = (self._low, np.min) if name == "min" else (self._high, np.max)
            extremes: Floats = reduce(of_cells, axis=pooled)
            return np.where(np.isfinite(extremes), extremes, 0.0)
        n = np.maximum(self._n.sum(axis=pooled, keepdims=True), 1)
        mean = (self._n * self._mean).sum(axis=pooled, keepdims=True) / n
        squares = self._squares + self._n * (self._mean - mean) ** 2
        if name == "mean":
            return np.asarray(mean).squeeze(pooled)
        if name == "std":
            variance = np.asarray(squares.sum(axis=pooled, keepdims=True) / n)
            return np.asarray(np.sqrt(variance)).squeeze(pooled)
        quantile = _QUANTILE.fullmatch(name)
        if quantile is None:
            return None
        sample = np.concatenate(self._sample)
        known = np.isfinite(sample).any(axis=(0, *(axis + 1 for axis in pooled)))
        sample = np.moveaxis(sample, [axis + 1 for axis in pooled], range(1, 1 + len(pooled)))
        sample = sample.reshape(-1, *known.shape)
        found = np.zeros(known.shape)
        found[known] = np.nanquantile(sample[:, known], int(quantile[1]) / 100, axis=0)
        return found


def of_masks(valid: Statistics) -> dict[str, Any]:
    """Return the least statistics of a feature: those that each library asks for."""
    names = dict.fromkeys(("min", "max", "mean", "std"), np.zeros(valid.sizes).tolist())
    return {**valid.as_told(names), "count": [valid.frames]}
