"""Whether cells move together with those beside them, from sums that are merged by adding.

In each recording a cell is compared with the mean of the cells beside it, by Pearson's correlation
over the frames. A cell **answers** where it moves by 5 % of the usual range and this correlation is
at least 0.5. It answers in a log where it does so in three recordings, and in most of those in
which it moves.

That shows contact; it is no proof that a cell measures it rightly. Not detected: cells that are
late by little, copy another one, read a part of their load, are clamped, noisy or drift, or fail
now and then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import LIGHT, LOW, MAJORITY
from diagnostics.when.spans import Spans, first_pieces

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

_CORRELATED = 0.5
_RECORDINGS = 3
_BLOCK = 1 << 16  # readings that are summed at a time, as they fit into a cache: a size

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Together:
    """Sums over the frames of each recording, of each cell and of the mean of those beside it.

    Attributes:
        sums: float ``[6, n, D]``: number of frames in which both are known, sum of the cell, of its
            square, of those beside it, of their square, and of the product.
    """

    sums: Floats

    @classmethod
    def of(cls, recordings: Sequence[NDArray[Any]], layout: SensorLayout) -> Together:
        """Return the sums of recordings ``[T, D]``; NaN = missing."""
        step = max(1, _BLOCK // layout.n_cells)
        each = []
        for frames in recordings:
            blocks = [frames[first : first + step] for first in range(0, len(frames), step)]
            total = np.zeros((6, layout.n_cells))
            for block in blocks:
                total += _sums(np.asarray(block, np.float64), layout)
            each.append(total)
        return cls(np.stack(each, axis=1))

    @classmethod
    def joined(cls, parts: Sequence[Together]) -> Together:
        """Return the sums of all parts as one."""
        return cls(np.concatenate([part.sums for part in parts], axis=1))

    def whole(self, pieces: Sequence[int], lengths: Sequence[int]) -> Together:
        """Return the sums of whole recordings, of which these are pieces; arguments as for
        :meth:`Spans.whole`."""
        if list(pieces) == list(lengths):
            return self
        return Together(np.add.reduceat(self.sums, first_pieces(pieces, lengths), axis=1))

    def of_cells(self, cells: NDArray[np.intp]) -> Together:
        """Return the sums of some cells."""
        return Together(self.sums[:, :, cells])

    @property
    def correlation(self) -> Floats:
        """Of each cell with those beside it in each recording, ``[n, D]``; 0 where nothing
        tells."""
        n, x, xx, m, mm, xm = self.sums
        n = np.maximum(n, 1)
        variance = np.maximum(xx - x**2 / n, 0.0)
        beside = np.maximum(mm - m**2 / n, 0.0)
        scale = np.sqrt(variance * beside)
        # below, only rounding is left
        told = scale > 1e-9 * np.sqrt(xx * mm)
        found: Floats = np.where(told, (xm - x * m / n) / np.where(told, scale, 1.0), 0.0)
        return found

    def moves(self, spans: Spans) -> Bools:
        """Return where cells move by 5 % of the usual range, bool ``[n, D]``."""
        ranges = spans.ranges
        moving = ranges[ranges > 0]
        if not len(moving):
            return np.zeros(ranges.shape, bool)
        return np.asarray(ranges > LIGHT * float(np.quantile(moving, 1 - LOW)))

    def answers(self, spans: Spans) -> Bools:
        """Return which cells answer together with those beside them, bool ``[D]``."""
        moves = self.moves(spans)
        answers = moves & (self.correlation >= _CORRELATED)
        times = answers.sum(axis=0)
        return np.asarray((times >= _RECORDINGS) & (times > MAJORITY * moves.sum(axis=0)))


def _sums(frames: Floats, layout: SensorLayout) -> Floats:
    """Return the sums of some frames, ``[6, D]``."""
    # a row a cell, as neighbours are then whole rows; the last one stands for no cell, which is -1
    cells = np.zeros((frames.shape[1] + 1, len(frames)))
    cells[:-1] = frames.T
    known = np.isfinite(cells)
    values = np.where(known, cells, 0.0)
    known[-1] = False
    total = np.zeros(frames.T.shape)
    count = np.zeros(frames.T.shape)
    for other in layout.beside.T:
        total += values[other]
        count += known[other]
    known = known[:-1]
    values = values[:-1]
    beside = total / np.maximum(count, 1)
    both = known & (count > 0)
    x = np.where(both, values, 0.0)
    m = np.where(both, beside, 0.0)
    squares = np.einsum("dt,dt->d", x, x)
    squares_beside = np.einsum("dt,dt->d", m, m)
    products = np.einsum("dt,dt->d", x, m)
    counts = both.sum(axis=1)
    return np.stack([counts, x.sum(axis=1), squares, m.sum(axis=1), squares_beside, products])
