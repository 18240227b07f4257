"""Moves, but not with the others.

P(level, flatness) is half that of the cell's own pieces, this one left out, and half what its own
past says, as the predictor knows it: a load that a cell reads now it will read a piece later, dead
or not, and only what the others say tells the two apart.

Not detected: what moves so little that it reads as at rest; a copy of a cell that the others
predict.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from diagnostics.faults import FaultKind
from diagnostics.model.observed import Observed
from diagnostics.model.over_time import Units, for_good, since, since_middle
from diagnostics.model.record import Array, Cells
from diagnostics.model.symbols import MOVES
from diagnostics.model.ways.way import Way, asked_once

_WEIGHS = 2.0  # pieces that any symbol is worth
_LEAST = 0.02


@asked_once
def _ratio(observed: Observed) -> Array:
    log = observed.log
    n, d = log.level.shape
    kinds = log.symbols.n * (MOVES + 1)
    rests = log.level == 0
    # how flat a cell rests tells nothing of who moves it
    symbol = np.where(rests, 0, log.level.astype(np.intp) * (MOVES + 1) + log.flat)
    of_cell = symbol + kinds * np.arange(d)
    count = np.bincount(of_cell.ravel(), minlength=kinds * d)[of_cell] - 1
    own = (count + _WEIGHS / kinds + _LEAST) / (n - 1 + _WEIGHS + _LEAST * kinds)
    of_flatness = np.where(rests, 0, observed.of_flatness)
    either = np.logaddexp(np.log(own), observed.alone + of_flatness) - np.log(2)
    found: Array = either - observed.of_level - of_flatness
    return found * observed.tells


def _evidence(observed: Observed, units: Units) -> Array:
    return for_good(_ratio(observed), units)


def no_more_than_floats(observed: Observed, units: Units, told: Callable[[], Array]) -> Array:
    """Return the evidence ``[D]`` of a way to move by oneself that is ``told`` (asked where a cell
    floats at all): no more than that the cell floats, of which it is one."""
    floats = FLOATS.evidence(observed, units)
    if (floats <= 0).all():
        return floats
    return np.minimum(told(), floats)


def _since(observed: Observed, units: Units) -> Cells:
    return since(_ratio(observed), units)


def floats_lately(observed: Observed, units: Units) -> Array:
    """Return the evidence ``[D]`` that a cell floats in the later half of a log."""
    return since_middle(_ratio(observed), units)


FLOATS = Way(FaultKind.FLOATING, 0.2, _evidence, _since)
