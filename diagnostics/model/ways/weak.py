"""Reads a share of its load, or more than it: worn, or another gain of its amplifier.

What the others say, and the past of the cell as it would read with its usual gain, give P(level);
the levels are then those of the other gain. It is estimated from the last contacts: gains fade.

Not detected: a gain between 0.7 and 1.4; one whose loads stay below those that count as none.
"""

from __future__ import annotations

import numpy as np

from diagnostics.faults import FaultKind
from diagnostics.model.observed import Observed
from diagnostics.model.over_time import Units, for_good, since
from diagnostics.model.record import Array, Cells
from diagnostics.model.symbols import Symbols
from diagnostics.model.ways.way import Way, asked_once

_GAINS = np.array([1 / 32, 1 / 16, 1 / 8, 0.18, 0.25, 0.35, 0.5, 1, 2, 2.8, 4], np.float32)
_WITHIN = (np.arange(16, dtype=np.float32) + 0.5) / 16  # places within a level
_LOADED = 0.15  # root load that the others surely expect
_LAST = 0.4  # of the pieces with such a load
_FEWEST = 5


def gain_of(observed: Observed) -> Array:
    """Return how many times its load each cell read at last, ``[D]``, in the median of pieces that
    weigh as much as the load; NaN: it was not loaded."""
    log = observed.log
    expected, _ = observed.predictor.mean.predict(log.load, observed.known)
    loaded = expected > _LOADED
    left = np.flip(np.cumsum(np.flip(loaded, 0), 0), 0)
    enough = loaded.sum(axis=0)
    last = loaded & (left <= np.maximum(_LAST * enough, _FEWEST))
    rest = log.symbols.rest
    # with what counts as no load, which root loads are without
    usual = expected**2 * rest.full + rest.near
    told = enough >= _FEWEST
    weights = np.where(last | ~told, usual, 0)
    found = np.quantile(log.above / usual, 0.5, axis=0, weights=weights, method="inverted_cdf")
    return np.where(told, found, np.nan).astype(np.float32)


def _scaled(load: Array, gain: Array | float, near: float) -> Array:
    """Return root loads with another gain; ``near``: of full scale, what counts as no load."""
    beyond = gain * (load**2 + near) - near
    found: Array = np.sqrt(np.clip(beyond, 0, 1)) * (load > 0)
    return found


def _levels(symbols: Symbols, gain: float, near: float) -> Array:
    """Return P(level with a gain | level without), ``[K, K]``."""
    found = np.eye(symbols.n, dtype=np.float32)
    ends = np.append(symbols.edges, [1.0, 1.0]).astype(np.float32)
    for level in range(1, symbols.top + 1):
        within = ends[level - 1] + _WITHIN * (ends[level] - ends[level - 1])
        reads = _scaled(within, gain, near)
        to = np.where(reads >= 1, symbols.top, np.searchsorted(symbols.edges, reads, "right"))
        found[level] = np.bincount(to, minlength=symbols.n) / len(within)
    return found


@asked_once
def _ratio(observed: Observed) -> Array:
    log = observed.log
    symbols = log.symbols
    near = float(np.median(symbols.rest.near) / symbols.rest.full)
    told = np.nan_to_num(gain_of(observed), nan=1.0)
    distance = np.abs(np.log(np.maximum(told, _GAINS[0] / 2))[:, None] - np.log(_GAINS))
    nearest = distance.argmin(axis=1)
    own = _scaled(log.load, 1 / _GAINS[nearest], near)
    usual = observed.predictor(log.load, own, log.record.first, observed.known)
    each = np.stack([_levels(symbols, gain, near) for gain in _GAINS.tolist()])
    levels = np.einsum("ndk,dkl->ndl", usual, each[nearest], optimize=True)
    ratio = log.likelihood(np.maximum(levels, usual.min())) - observed.of_level
    # a load beyond the range reads as the top with any gain
    tells = observed.tells & ~observed.unwitnessed & (log.level != symbols.top)
    return np.where(tells, ratio, 0)


def _evidence(observed: Observed, units: Units) -> Array:
    found: Array = for_good(_ratio(observed), units) - np.log(len(_GAINS))
    return found


def _since(observed: Observed, units: Units) -> Cells:
    return since(_ratio(observed), units)


WEAK = Way(FaultKind.WEAK, 0.05, _evidence, _since, value=gain_of, decides=False)
