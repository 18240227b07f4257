"""Healthy up to a limit, and still at it whatever the others say is more.

A load one level further up counts as at the limit: the loads of a healthy cell end somewhere, too.

Not detected: a limit above what the log reaches, or near the top; one a level below the loads.
"""

from __future__ import annotations

import numpy as np

from diagnostics.faults import FaultKind
from diagnostics.model.observed import Log, Observed
from diagnostics.model.over_time import Units, throughout
from diagnostics.model.record import Array, Cells, Mask, since_begin
from diagnostics.model.symbols import MOVES, SAME
from diagnostics.model.ways.floats import no_more_than_floats
from diagnostics.model.ways.way import Way

_NEAR = 2  # levels that may end at the limit


def _limit(observed: Observed) -> Array:
    found: Array = np.fmax.reduce(observed.log.record.high)
    return found


def _again(log: Log, at: Mask) -> Array:
    """Return the log ratio ``[n, D]`` of recordings that stay at the limit as an earlier one did;
    ``at``: bool ``[n, D]``, where readings are at it. The peaks of a healthy cell agree by chance.
    """
    at_before = np.roll(at, 1, axis=0) & ~log.record.first[:, None]
    at = at & at_before
    count = np.cumsum(at, axis=0)
    begins = np.arange(len(at)) - since_begin(log.record.first)
    before: Cells = (count - at)[begins]
    again = at & (count == before + 1) & (before > 0)
    found: Array = np.where(again, -log.same_by_chance, 0)
    return found


def _evidence(observed: Observed, units: Units) -> Array:
    log = observed.log
    symbols = log.symbols
    limit = _limit(observed)
    below = limit - log.record.high
    possible = (log.level > 0) & (limit < symbols.rest.high - symbols.tolerance)
    at = (below <= SAME * symbols.rest.full) & possible
    loads = observed.levels[..., : symbols.top + 1]
    at_least = np.flip(np.cumsum(np.flip(loads, -1), -1), -1)
    at_least = np.pad(at_least, ((0, 0), (0, 0), (0, _NEAR)))
    level = np.minimum(log.level, symbols.top)[..., None].astype(np.intp)
    more = np.take_along_axis(at_least, level, 2)[..., 0]
    much_more = np.take_along_axis(at_least, level + _NEAR, 2)[..., 0]
    near = np.log(np.maximum(more - much_more, np.exp(observed.of_level)))
    ratio = np.where(at, np.log(more) - near, 0) + _again(log, (below <= log.finest) & possible)
    still = ratio + np.where(at & (log.flat != MOVES), -observed.of_flatness, 0)
    # a healthy cell is still now and then, where it reads most
    moves_by_itself = no_more_than_floats(
        observed, units, lambda: throughout(still * observed.tells, units)
    )
    return np.maximum(throughout(ratio * observed.tells, units), moves_by_itself)


CLAMPED = Way(FaultKind.CLAMPED, 0.05, _evidence, value=_limit, decides=False)
