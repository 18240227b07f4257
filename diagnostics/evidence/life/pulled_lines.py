"""Lines that a shorted crossing pulls: do the cells on its row and its column read a share of their
load?

Where the layers of a cell touch, a resistive array reads the rest of its row and column through it:
a part of their load each, and ghosts. They read less together, and so agree with each other.
Statistic of a wire, over the pieces in which the cells off it predict a load::

    d = log(sum of the mean root load of its cells / sum of the predicted mean)

A line is pulled where d lies below the 0.05 quantile of a normal distribution with the median and
the robust standard deviation (1.48 median absolute deviations) of the other wires, and its load
below two thirds.

Not detected: a short of more than about a kiloohm, arrays with few wires, lines that the log does
not load, ghosts on a line that reads as much as it should.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.life.healthy_table import UNLOADED, Floats, Mask
from diagnostics.evidence.life.levels_in_log import LifeLog
from diagnostics.preprocessing.levels import FEWEST

_OUTLYING = 1.645 * 1.48  # median absolute deviations: one-sided, 5 %
_PULLED = float(np.log(2 / 3)) / 2  # of the root load


def pulled_lines(log: LifeLog, shorted: NDArray[np.intp], known: Mask) -> Mask:
    """Return the cells on pulled lines, bool ``[D]``.

    Args:
        log: the levels of the log.
        shorted: the cells that are shorted, ``[n]``.
        known: bool ``[D]``, cells that predict others and tell of their wire.
    """
    pulled = np.zeros(len(known), bool)
    wires = log.model.wires
    if wires is None or not len(shorted):
        return pulled
    of_shorted = wires.on[:, shorted].any(axis=1)
    lines = known & ~wires.on[of_shorted].any(axis=0)
    # Those on the lines in question tell nothing of the others.
    expected = wires.expected(log.model.means, log.loads, lines, known)
    ratio = _log_ratio(wires.means(log.loads, known), expected)
    others = ratio[~of_shorted & np.isfinite(ratio)]
    if len(others) < FEWEST:
        return pulled
    middle = np.median(others)
    least = middle - _OUTLYING * np.median(np.abs(others - middle))
    low = of_shorted & (ratio < least) & (ratio < middle + _PULLED)
    pulled |= wires.on[low].any(axis=0)
    return pulled


def _log_ratio(own: Floats, expected: Floats) -> Floats:
    """Return the log ratio of the sums of own and expected loads, ``[W]`` of ``[n, W]``; NaN for
    fewer than eight pieces with a load."""
    loaded = expected > UNLOADED
    sums = [np.where(loaded, loads, 0.0).sum(axis=0) for loads in (own, expected)]
    enough = loaded.sum(axis=0) >= FEWEST
    least = np.maximum(sums, UNLOADED)
    return np.where(enough, np.log(least[0] / least[1]), np.nan)
