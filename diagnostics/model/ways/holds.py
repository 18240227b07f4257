"""Holds a value to the end of the log, from the start or from some piece on: stuck, open, short.

r = log P(at the value) - log P(level | others, a piece ago), and how flat the piece is, given the
one before: a healthy cell flickers, or moves while it is loaded.

Not detected: a cell that rests where the others say no load; which cell of a pair that rests in
turn.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from diagnostics.model.observed import HELD, Log, Observed
from diagnostics.model.over_time import Units, for_good, since
from diagnostics.model.record import Array, Cells
from diagnostics.model.symbols import MOVES
from diagnostics.model.ways.way import MISS, Way, asked_once

_CONSTANT = 0.5  # share of the pieces whose flatness counts as independent
_EXPECTED = np.log([0.2, 0.4])  # P(value): anywhere in between; at rest or at an end


@asked_once
def _ratio(observed: Observed, *, dithers: bool) -> Array:
    log = observed.log
    matches = log.holds & (log.flat != MOVES)
    holds = np.log(1 - MISS) - log.agree - observed.of_level
    # another value denies it, however still the pad is
    ratio = np.where(matches, holds * observed.tells, np.log(MISS))
    constancy = _CONSTANT * observed.constancy(dithers=dithers)
    found: Array = (ratio + constancy) * log.record.received
    return found


def expected(log: Log) -> Array:
    """Return log P(the value at which a cell is stuck) ``[D]``, of the one it holds."""
    rest = log.symbols.rest
    at_rest = np.abs(log.value - rest.level) <= rest.near + log.symbols.tolerance
    tolerance = log.symbols.tolerance
    at_end = (log.value >= rest.full - tolerance) | (log.value <= tolerance)
    found: Array = _EXPECTED[(at_rest | at_end).astype(np.intp)]
    return found


def _evidence(observed: Observed, units: Units, *, dithers: bool) -> Array:
    log = observed.log
    found: Array = for_good(_ratio(observed, dithers=dithers), units) + expected(log)
    return np.where(log.run >= HELD, found, np.minimum(found, 0))


def _since(observed: Observed, units: Units, *, dithers: bool) -> Cells:
    return since(_ratio(observed, dithers=dithers), units)


def _way(prior: float, *, dithers: bool) -> Way:
    return Way(None, prior, partial(_evidence, dithers=dithers), partial(_since, dithers=dithers))


HOLDS = _way(0.35, dithers=False)
DITHERS = _way(0.15, dithers=True)
