"""A bound of how often a healthy sensor is blamed, from healthy recordings that were held out.

The recordings are divided into logs of n consecutive ones, and every other log is judged by a
diagnosis that is fitted to the rest. With k of m logs in which a healthy cell is in F, the bound at
confidence c is that of Clopper and Pearson (1934)::

    share of false alarms <= B(c; k + 1, m - k)

B is the quantile of a beta distribution (``scipy.stats.binomtest(k, m).proportion_ci`` one-sided).
Copies of recordings are left out before (:mod:`diagnostics.preprocessing.copies`). A fit to half of
the recordings blames rather more than one to all of them. It is no bound for logs
unlike those of the reference: other contacts, another temperature, disturbances.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

CONFIDENCE = 0.95
LOG = 4
"""Recordings of a log."""

FEWEST_LOGS = 5
"""With fewer, the bound would say nothing."""

Recordings = Sequence[NDArray[Any]]


@dataclass(frozen=True)
class Certificate:
    """How often a healthy log is blamed at most.

    Attributes:
        false_alarms: upper bound of the share of healthy logs with a healthy cell in F, 0 to 1.
        confidence: of the bound.
        n_recordings: of a log.
        n_logs: that were held out.
        n_alarms: of them with a cell in F.
    """

    false_alarms: float
    confidence: float
    n_recordings: int
    n_logs: int
    n_alarms: int

    @classmethod
    def of(cls, n_alarms: int, n_logs: int, n_recordings: int = LOG) -> Certificate:
        """Return the bound for a number of logs, and of alarms among them."""
        bound = 1.0
        if n_alarms < n_logs:
            bound = float(betaincinv(n_alarms + 1, n_logs - n_alarms, CONFIDENCE))
        return cls(bound, CONFIDENCE, n_recordings, n_logs, n_alarms)

    def __str__(self) -> str:
        return (
            f"at most {self.false_alarms:.1%} of healthy logs of {self.n_recordings} recordings"
            f" have a healthy cell in F ({self.confidence:.0%} confidence; {self.n_alarms} of"
            f" {self.n_logs} held out)"
        )


def certify(
    recordings: Recordings,
    excluded: NDArray[np.bool_],
    blamed: Callable[[Recordings, Sequence[Recordings]], Sequence[NDArray[np.bool_]]],
) -> Certificate | None:
    """Return the certificate of a fit; None with too few recordings.

    Args:
        recordings: healthy ones, ``[T, D]`` each, in time order.
        excluded: bool ``[D]``, cells that are dead in them, whose blame is no false alarm.
        blamed: returns F of each log, bool ``[D]``, by a fit to recordings; arguments: these
            recordings, the logs.
    """
    n = len(recordings) // LOG
    if n < FEWEST_LOGS:
        return None
    logs = [recordings[LOG * i : LOG * (i + 1)] for i in range(n)]
    alarms = 0
    for side in (0, 1):
        held = logs[side::2]
        rest = [one for log in logs[1 - side :: 2] for one in log]
        alarms += sum(bool((found & ~excluded).any()) for found in blamed(rest, held))
    return Certificate.of(alarms, n)
