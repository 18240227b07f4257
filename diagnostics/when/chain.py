"""How a fault comes and goes: priors of its recordings, and the likeliest of them."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import EXPECTED, EXPECTED_LATE
from diagnostics.when.log_gamma import log_beta

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ENDS = 0.1  # probability that a lasting fault ends with a recording
_SINGLE = EXPECTED  # pseudo-count of the recordings in which a loose unit is faulty


class Course(Protocol):
    """A prior of the recordings in which a unit is faulty."""

    def states(self, ratio: Floats) -> Mask:
        """Return the likeliest recordings, bool ``[n, units]``, of the log ratio
        faulty : healthy of each, ``[n, units]``."""

    def prior(self, states: Mask) -> Floats:
        """Return the log prior of some recordings (bool ``[n, units]``) over that of none,
        ``[units]``."""


class Lasting:
    """A fault goes on from one recording to the next: a two-state Markov chain."""

    def __init__(self, n: int) -> None:
        begins = np.full(n, EXPECTED_LATE)
        begins[0] = EXPECTED
        self._stays = np.log1p(-begins)
        self._begins = np.log(begins)
        self._ends = np.log(_ENDS)
        self._lasts = np.log1p(-_ENDS)

    def states(self, ratio: Floats) -> Mask:
        """Return the likeliest states (Viterbi)."""
        healthy = np.full(ratio.shape[1], self._stays[0])
        faulty = self._begins[0] + ratio[0]
        back = np.zeros((2, *ratio.shape), bool)
        for t in range(1, len(ratio)):
            stays = healthy + self._stays[t]
            ends = faulty + self._ends
            begins = healthy + self._begins[t]
            lasts = faulty + self._lasts
            np.greater(ends, stays, out=back[0, t])
            np.greater(lasts, begins, out=back[1, t])
            healthy = np.maximum(stays, ends)
            faulty = np.maximum(begins, lasts) + ratio[t]
        states = np.zeros(ratio.shape, bool)
        states[-1] = faulty > healthy
        for t in range(len(ratio) - 1, 0, -1):
            states[t - 1] = np.where(states[t], back[1, t], back[0, t])
        return states

    def prior(self, states: Mask) -> Floats:
        """Return the log prior of a path over that of the one that is always healthy."""
        stays = self._stays[:, None]
        begins = self._begins[:, None]
        first = np.where(states[0], begins[0], stays[0])
        after_fault = np.where(states[1:], self._lasts, self._ends)
        after_health = np.where(states[1:], begins[1:], stays[1:])
        steps = np.where(states[:-1], after_fault, after_health)
        found: Floats = first + steps.sum(axis=0) - stays.sum()
        return found


class Loose:
    """A fault comes in single recordings, in a share of them that is unknown (beta-binomial)."""

    def __init__(self, n: int) -> None:
        self._healthy = _SINGLE * (1 / EXPECTED_LATE - 1)
        self._n = n

    def states(self, ratio: Floats) -> Mask:
        """Return the recordings that are likelier faulty, with the share that they are of all."""
        share = np.full(ratio.shape[1], EXPECTED_LATE)
        for _ in range(2):
            states = np.asarray(ratio + np.log(share / (1 - share)) > 0)
            share = (states.sum(axis=0) + _SINGLE) / (self._n + _SINGLE + self._healthy)
        return states

    def prior(self, states: Mask) -> Floats:
        """Return the log prior of the recordings over that of none."""
        k = states.sum(axis=0)
        of_these = log_beta(_SINGLE + k, self._healthy + self._n - k)
        return np.asarray(of_these - log_beta(_SINGLE, self._healthy + self._n))
