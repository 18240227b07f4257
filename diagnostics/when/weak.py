"""Cells that read little of what the cells on both sides of them read, in nearly every contact.

A contact that moves two opposite neighbours moves the cell between them. With m the lesser range
of the two in a recording, the share of a cell is its own range over m. A cell is suspect where its
share stays below one half in 19 of 20 recordings in which both neighbours move, of eight or more,
for one of the four pairs around it. It needs no reference, and does not tell which of the three is
wrong.

In 304 healthy logs of 8 to 80 recordings of five real arrays and three simulated ones, one cell of
45,000 is suspect. In logs of 40, .57, .41 and .16 of the cells that read .1, .2 and .35 of their
load are; on soles, the largest of these arrays, .87, .87 and .83.

Not detected: cells at the corners of a pad, worn ones on either side in each direction, a share
that is above one half in some contacts, as that of narrow ones in the middle of the cell.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import FEWEST, LIGHT, LOW, MAJORITY
from diagnostics.preprocessing.quantiles import known_quantile
from diagnostics.when.spans import Spans

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout


Floats = NDArray[np.float64]


def shares_of_load(spans: Spans, layout: SensorLayout) -> Floats:
    """Return the median range of suspect cells over the mean of their neighbours', ``[D]``; NaN: of
    the others.

    Args:
        spans: of n recordings.
        layout: the array, each axis of a pad as a pad of its own.
    """
    found = np.full(layout.n_cells, np.nan)
    ranges = spans.ranges
    moving = ranges[ranges > 0]
    if len(spans) < FEWEST or not len(moving):
        return found
    light = LIGHT * float(np.quantile(moving, 1 - LOW))
    present = layout.is_cell
    pairs = layout.beside.shape[1] // 2
    for one, other in zip(layout.beside.T[:pairs], layout.beside.T[::-1], strict=False):
        between = np.flatnonzero((one >= 0) & (other >= 0) & present)
        lesser = np.minimum(ranges[:, one[between]], ranges[:, other[between]])
        mean = (ranges[:, one[between]] + ranges[:, other[between]]) / 2
        told = (lesser > light) & spans.known[:, between]
        of_lesser = np.where(told, ranges[:, between] / np.maximum(lesser, light), np.nan)
        of_mean = np.where(told, ranges[:, between] / np.maximum(mean, light), np.nan)
        most = known_quantile(of_lesser, 1 - LOW, axis=0)
        suspect = (told.sum(axis=0) >= FEWEST) & (most < MAJORITY)
        usual = known_quantile(of_mean, MAJORITY, axis=0)
        found[between] = np.fmin(found[between], np.where(suspect, usual, np.nan))
    return found
