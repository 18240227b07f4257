"""Healthy up to a limit, and at it whatever the others say is more.

Not detected: a limit above what the log reaches, or near the top.
"""

from __future__ import annotations

import numpy as np

from diagnostics.faults import FaultKind
from diagnostics.model.observed import Observed
from diagnostics.model.over_time import Units, throughout
from diagnostics.model.record import Array
from diagnostics.model.ways.way import Way


def _limit(observed: Observed) -> Array:
    found: Array = np.fmax.reduce(observed.log.record.high)
    return found


def _evidence(observed: Observed, units: Units) -> Array:
    log = observed.log
    symbols = log.symbols
    limit = _limit(observed)
    at = (log.record.high >= limit - symbols.rest.full * 1e-5) & (log.level > 0)
    at &= limit < symbols.rest.high - symbols.tolerance
    loads = observed.levels[..., : symbols.top + 1]
    beyond = np.flip(np.cumsum(np.flip(loads, -1), -1), -1)
    level = np.minimum(log.level, symbols.top)[..., None].astype(np.intp)
    more = np.log(np.take_along_axis(beyond, level, 2)[..., 0])
    ratio = np.where(at, more - observed.of_level, 0)
    return throughout(ratio * log.record.received, units)


CLAMPED = Way(FaultKind.CLAMPED, 0.05, _evidence, value=_limit, decides=False)
