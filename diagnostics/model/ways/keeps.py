"""Keeps its highest load until the recording ends: a cover that sticks, a charge that stays.

The mirror of a limit: a piece that reads what the cell read most before counts as any load up to
that one, and is as flat as a healthy cell rarely is. A reading below it denies it.

Not detected: one whose contacts all last to the end of their recordings; one at the end of the
range.
"""

from __future__ import annotations

import numpy as np

from diagnostics.faults import FaultKind
from diagnostics.model.observed import Observed
from diagnostics.model.over_time import Units, throughout
from diagnostics.model.record import Array, Mask
from diagnostics.model.symbols import MOVES
from diagnostics.model.ways.way import MISS, Way


def _evidence(observed: Observed, units: Units) -> Array:
    log = observed.log
    record = log.record
    most = _most_before(record.high, record.first)
    falls = record.low < most - log.finest
    top = log.symbols.top
    between = (log.level > 0) & (log.level < top)
    keeps = ~falls & (record.high <= most + log.finest) & between
    up_to = np.cumsum(observed.levels[..., : top + 1], -1)
    level = np.minimum(log.level, top)[..., None].astype(np.intp)
    no_more = np.take_along_axis(up_to, level, 2)[..., 0]
    kept = np.log(1 - MISS) + np.log(no_more) - observed.of_level
    kept -= np.where(log.flat != MOVES, observed.of_flatness, 0)
    ratio = np.where(falls, np.log(MISS), np.where(keeps, kept, 0))
    return throughout(ratio * observed.tells, units)


def _most_before(high: Array, first: Mask) -> Array:
    """Return the highest reading of its recording before each piece, ``[n, D]``; -inf: none."""
    found = np.full_like(high, -np.inf)
    for i in np.flatnonzero(~first).tolist():
        np.fmax(found[i - 1], high[i - 1], out=found[i])
    return found


KEEPS = Way(FaultKind.DRIFT, 0.02, _evidence, decides=False)
