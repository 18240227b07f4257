"""Offsets of a cold start: cells that move, but never return to their baseline.

The evidence is the sum of -log P(loaded throughout | other cells) over the last events, as far as
the cell is loaded throughout each; repeated events count for less
(``ConditionalTest.novelty``). It needs several events, because objects have edges and a reading may
hold a residue of the last load. Offsets below 2 % of full scale are not detected.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import P_MIN, SLIGHT

if TYPE_CHECKING:
    from diagnostics.preprocessing.scale import Array

_OUTLIERS = 0.05  # share of events that are independent of an offset: none brings more than log 20
# log evidence from which on a cell has an offset: four events, as a reading may hold a residue
_OFFSET = float(-np.log(P_MIN))

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def offset_evidence(whole: Array, always: Floats, moving: Mask, counts: Floats) -> Floats:
    """Return the log likelihood ratio ``[D]`` that a moving cell never returns to its baseline.

    Args:
        whole: features ``[n, 4, D]`` of n events (see ``Summary.features``), in time order.
        always: ``[n, D]``, P(loaded throughout) of a healthy cell.
        moving: bool ``[D]``, cells that move.
        counts: ``[n, 1]``, weight of each event.
    """
    loaded = (whole[:, 3] == 1) & (whole[:, 1] ** 2 >= SLIGHT)
    lasting = np.logical_and.accumulate(loaded[::-1])[::-1]  # unbroken up to the end
    surprisal = -np.log(np.maximum(always, _OUTLIERS))
    return np.where(moving, np.where(lasting, counts * surprisal, 0.0).sum(axis=0), 0.0)


def drifting(offset: Floats) -> Mask:
    """Return the cells whose evidence of an offset, ``[D]``, exceeds the threshold, bool
    ``[D]``."""
    certain: Mask = offset >= _OFFSET
    return certain
