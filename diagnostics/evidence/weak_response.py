"""Weak response: cells that work, but read so little that no contact event can tell them from a
broken cell.

Detects, in a cold start, cells whose readings follow the loads of their neighbours and stay below
what counts as load. With x the readings of a cell and l the mean load of its eight neighbours, each
less its mean over a segment of the log::

    r    = sum x l / sqrt(sum x^2 sum l^2)          correlation
    z    = sqrt(n) r                                standard normal, if the cell is broken
    gain = sum x l / sum l^2                        regression of the readings on the loads

A cell works if z exceeds 4.4 (six in a million), as in a test of Pearson's correlation
(``scipy.stats.pearsonr``). Its response is weak if gain times the highest l is no load. That a cell
with a weak response reads no load is no evidence of a fault.

A cell is shown to be alive if r is one half or more: what floats, comes late or is latched moves,
too. It does not detect cells that respond with less than their noise, and takes a broken cell for a
working one where crosstalk makes it follow its neighbours, or where it is a copy of one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from diagnostics.preprocessing.levels import CERTAIN_RATIO

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

_FOLLOWS = 0.5  # correlation from which on a cell is shown to be alive
_CERTAIN = float(-ndtri(np.exp(-CERTAIN_RATIO)))  # z from which on a cell follows its neighbours

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class WeakResponse:
    """Sums over the segments so far, ``[D]`` each, in the layout's unit.

    Attributes:
        readings: float, sum x^2.
        loads: float, sum l^2.
        products: float, sum x l.
        highest: float, highest l, not less its mean.
        frames: their number, less one a segment.
    """

    readings: Floats
    loads: Floats
    products: Floats
    highest: Floats
    frames: int = 0

    @classmethod
    def begin(cls, n_cells: int) -> WeakResponse:
        """Return the state before any frame."""
        return cls(*np.zeros((4, n_cells)))

    def extend(self, frames: Floats, loads: Floats, layout: SensorLayout) -> WeakResponse:
        """Return the sums after one more segment.

        Args:
            frames: readings ``[t, D]``, NaN = missing.
            loads: ``[t, D]``, readings above the baseline; 0 without load.
            layout: the array.
        """
        around = _mean_of_neighbours(loads, layout)
        of_load = around - around.mean(axis=0)
        x = np.nan_to_num(frames - frames[0])  # exactly 0 for a constant cell
        x -= x.mean(axis=0)
        return WeakResponse(
            self.readings + (x * x).sum(axis=0),
            self.loads + (of_load * of_load).sum(axis=0),
            self.products + (x * of_load).sum(axis=0),
            np.maximum(self.highest, around.max(axis=0)),
            self.frames + len(frames) - 1,
        )

    @property
    def follows(self) -> NDArray[np.bool_]:
        """The cells that move with those around them, bool ``[D]``."""
        return self._correlate(_FOLLOWS)

    def untestable(self, near: float) -> NDArray[np.bool_]:
        """Return the cells that work and respond by at most ``near``, bool ``[D]``."""
        certain = _CERTAIN / np.sqrt(max(1, self.frames))
        weak = self.products * self.highest <= near * self.loads
        return self._correlate(certain) & weak

    def _correlate(self, least: float) -> NDArray[np.bool_]:
        """Return the cells whose correlation with those around exceeds ``least``, bool ``[D]``."""
        return np.asarray(self.products > least * np.sqrt(self.readings * self.loads))


def _mean_of_neighbours(loads: Floats, layout: SensorLayout) -> Floats:
    """Return the mean load ``[t, D]`` of the eight neighbours; those beyond an edge count as
    unloaded."""
    grid = np.pad(layout.grid(loads), ((0, 0), (0, 0), (1, 1), (1, 1)))
    rows = layout.rows
    cols = layout.cols
    block = np.zeros((*grid.shape[:2], rows, cols))
    for down in range(3):
        for right in range(3):
            block += grid[..., down : down + rows, right : right + cols]
    return (block.reshape(loads.shape) - loads) / 8
