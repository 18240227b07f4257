"""Shows what the others said some pieces ago.

Not detected: a delay of less than half a piece, or of more than two.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from diagnostics.faults import FaultKind
from diagnostics.model.observed import Observed
from diagnostics.model.over_time import Units, for_good, since
from diagnostics.model.record import Array, Cells
from diagnostics.model.ways.way import Way


def _ratio(observed: Observed, lag: int) -> Array:
    return (observed.delayed(lag) - observed.of_level) * observed.tells


def _evidence(observed: Observed, units: Units, *, lag: int) -> Array:
    return for_good(_ratio(observed, lag), units)


def _since(observed: Observed, units: Units, *, lag: int) -> Cells:
    return since(_ratio(observed, lag), units)


def _value(observed: Observed, *, lag: int) -> Array:
    record = observed.log.record
    frames = round(lag * record.n_frames / len(record))
    return np.full(record.mean.shape[1], frames, np.float32)


def _way(lag: int) -> Way:
    return Way(
        FaultKind.LATE,
        0.05,
        partial(_evidence, lag=lag),
        partial(_since, lag=lag),
        value=partial(_value, lag=lag),
        decides=False,
    )


LATE = _way(1)
LATER = _way(2)
