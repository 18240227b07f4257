"""Evidence of what is dead for a time: from when on, up to when, or above which load."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from diagnostics.evidence.life.healthy_table import Floats
from diagnostics.evidence.life.levels_in_log import LevelLog

_FAILS = 0.1  # probability per unit
_RECOVERS = 0.3  # probability per unit
_LIMITS = 4  # of the load from which on a contact opens


def opens_under_load(log: LevelLog, ratio: Floats, expected: NDArray[np.integer]) -> Floats:
    """Return the evidence ``[D]`` of what is dead where its load should exceed some level, and
    healthy below.

    Args:
        log: the levels of the log.
        ratio: float ``[n, D]``, log ratio dead : healthy of each piece.
        expected: int ``[n, D]``, level that the others predict.
    """
    evidence = []
    for level in np.linspace(1, len(log.table.predicted), _LIMITS).astype(np.intp):
        evidence.append(log.counted(np.where(expected >= level, ratio, 0.0)).sum(axis=0))
    found: Floats = logsumexp(evidence, axis=0) - np.log(_LIMITS)
    return found


def dies_and_recovers(
    dead: Floats, fails: float = _FAILS, recovers: float = _RECOVERS
) -> tuple[Floats, Floats]:
    """Return the log evidence ``[D]`` of a cell that dies and recovers, and P(dead) in each unit
    ``[units, D]``.

    Args:
        dead: float ``[units, D]``, log ratio dead : healthy, bounded.
        fails, recovers: probabilities per unit.
    """
    likelihood = np.exp(dead)
    gone = np.full(dead.shape[1], fails)
    dying = np.empty(dead.shape)
    total = np.empty(dead.shape)
    total_before = 1 + fails
    # The forward algorithm; the probabilities are scaled to a sum of 1 after each unit.
    gone /= total_before
    for u, ratio in enumerate(likelihood):
        stays = (1 - fails) - (1 - fails - recovers) * gone
        gone = (1 - stays) * ratio
        total[u] = stays + gone
        gone /= total[u]
        dying[u] = gone
    return np.log(total).sum(axis=0) + np.log(total_before), dying


def from_some_unit(dead: Floats) -> Floats:
    """Return the log evidence ``[D]`` of a cell that is dead from a unit on, half of them from the
    first."""
    before = np.cumsum(dead, axis=0)
    later = logsumexp(before[-1] - before, axis=0) - np.log(len(dead))
    found: Floats = np.logaddexp(before[-1], later) - np.log(2)
    return found


def up_to_some_unit(dead: Floats) -> Floats:
    """Return the log evidence ``[D]`` of a cell that was dead up to a unit, and works again."""
    before = np.cumsum(dead, axis=0)
    prior = np.log(_FAILS * _RECOVERS) - np.log(len(dead))
    found: Floats = logsumexp(before, axis=0) + prior
    return found


def since_it_works(dead: Floats) -> Floats:
    """Return the log ratio dead : healthy ``[D]`` after the unit up to which a cell was most likely
    dead, if any."""
    before = np.cumsum(dead, axis=0)
    found: Floats = before[-1] - np.maximum(before.max(axis=0), 0.0)
    return found
