"""Reads as at rest now and then while the others say a load: a loose contact, one that opens under
load, recordings in which the cell was dead.

Not detected: what is away for parts of a piece; a fault in fewer units than a healthy cell is odd
in.
"""

from __future__ import annotations

import numpy as np

from diagnostics.faults import FaultKind
from diagnostics.model.observed import Observed
from diagnostics.model.over_time import Units, now_and_then
from diagnostics.model.record import Array
from diagnostics.model.symbols import MOVES
from diagnostics.model.ways.way import MISS, Way


def _evidence(observed: Observed, units: Units) -> Array:
    log = observed.log
    quiet = (log.level == 0) & (log.flat != MOVES)
    away = np.log(1 - MISS) - observed.of_level
    ratio = np.where(quiet, away, np.log(MISS))
    return now_and_then(ratio * observed.tells, units)


def _rest(observed: Observed) -> Array:
    return observed.log.symbols.rest.level


COMES_AND_GOES = Way(FaultKind.INTERMITTENT, 0.1, _evidence, value=_rest)
