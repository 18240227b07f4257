"""Follows the others, but no longer comes to rest where it did: an offset that came, or creeps.

What is left of its readings above the lowest ones around gives its levels; these are compared with
what the others say. Such a cell moves by itself as well: there is no more evidence than of that.

Not detected: an offset below what counts as no load; one that all cells of the pad share.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.ndimage import minimum_filter1d

from diagnostics.faults import FaultKind
from diagnostics.model.observed import Observed
from diagnostics.model.over_time import Units, for_good, since
from diagnostics.model.record import Array, Cells
from diagnostics.model.symbols import root_load
from diagnostics.model.ways.way import Way, asked_once

_REST = 12  # pieces: in so many a cell comes to rest


def _offset(observed: Observed) -> Array:
    """Return how far above its rest each cell reads at least around each piece, ``[n, D]``: midway
    between what it did before and what it does after, as it creeps."""
    lowest = partial(minimum_filter1d, observed.log.above, _REST, axis=0, mode="nearest")
    before = lowest(origin=(_REST - 1) // 2)
    after = lowest(origin=-(_REST // 2))
    found: Array = np.maximum((before + after) / 2, 0)
    return found


@asked_once
def _ratio(observed: Observed) -> Array:
    log = observed.log
    symbols = log.symbols
    offset = _offset(observed)
    without = log.above - offset
    own = root_load(without, symbols.rest)
    levels = observed.predictor(log.load, own, log.record.first, observed.known)
    level = symbols.levels(log.record, without, log.holds).astype(np.intp)
    likely = np.log(np.take_along_axis(levels, level[..., None], 2)[..., 0])
    moved = offset > symbols.rest.near
    ratio = np.where(moved & ~observed.unwitnessed, likely - observed.of_level, 0)
    found: Array = ratio * observed.tells
    return found


def _evidence(observed: Observed, units: Units) -> Array:
    return for_good(_ratio(observed), units)


def _since(observed: Observed, units: Units) -> Cells:
    return since(_ratio(observed), units)


DRIFTS = Way(FaultKind.DRIFT, 0.03, _evidence, _since, decides=False, floats=True)
