"""Spatial evidence: would a healthy cell hold this value while the other cells do what they do?

For each cell that ends the log still, at value v from frame s on, two explanations compete. Stuck: it reads v whatever
happens. Healthy: it reads v as often as healthy cells do when the others look as they do now. Every recording adds

    log 1 / P(v | healthy, others)                        averaged over the least likely half of its frames

because the frames of one grasp are not independent: evidence adds up over grasps, hardly over the frames of one. How
likely a stuck cell is to be stuck at just this v is charged once: a cell held still under a constant load also reads
one value, but it is an arbitrary one, while the rails are where broken cells go.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from diagnostics.reference import Expectation
from diagnostics.temporal import LastRuns

_SHORTEST_RUN = 5  # frames; shorter stillness is not worth a question
_BLOCK = 100  # frames; a longer recording counts as several
_RAIL_SHARE = 0.4  # of broken cells stick to the low rail, as many to the high one, the rest anywhere
_SUSPICIOUS = 2.0  # log evidence from which on a cell is left out when others are judged


def stuck_evidence(
    log: NDArray[np.float64],
    lengths: Sequence[int],
    runs: LastRuns,
    expectation: Expectation,
    present: NDArray[np.bool_],
    full_scale: float,
    tolerance: float,
) -> NDArray[np.float64]:
    """Return the log likelihood ratio stuck : healthy for each cell, ``[D]``; 0 where there is nothing to ask.

    Cells that moved answer first; still cells whose value proved normal are then put back, and those that look
    stuck are left out, before the final judgement.

    Args:
        log: ``[T, D]``, the recordings one after the other.
        lengths: of each recording, in frames; they sum to T.
        runs: the still stretch that ends each cell's log.
        expectation: what healthy looks like.
        present: bool ``[D]``: where there is a cell.
        full_scale: of the layout.
        tolerance: how near to v counts as v.
    """
    asked = np.flatnonzero(present & (runs.start <= len(log) - _SHORTEST_RUN) & np.isfinite(runs.value))
    evidence = np.zeros(log.shape[1])
    if not len(asked):
        return evidence
    trusted = present & runs.moved
    for _ in range(2):
        evidence[asked] = _judge(log, lengths, runs, asked, trusted, expectation, full_scale, tolerance)
        trusted = present & (evidence < _SUSPICIOUS)
    return evidence


def _judge(
    log: NDArray[np.float64],
    lengths: Sequence[int],
    runs: LastRuns,
    asked: NDArray[np.intp],
    trusted: NDArray[np.bool_],
    expectation: Expectation,
    full_scale: float,
    tolerance: float,
) -> NDArray[np.float64]:
    value, start = runs.value[asked], runs.start[asked]
    at_rail = (value <= tolerance) | (value >= full_scale - tolerance)
    elsewhere = (1 - 2 * _RAIL_SHARE) * 2 * tolerance / full_scale
    evidence = np.log(np.where(at_rail, _RAIL_SHARE, elsewhere))
    share = expectation.share_at(log, trusted, asked, value, 2 * tolerance)  # (T, asked)
    for first, last in _blocks(lengths):
        counted = np.arange(first, last)[:, None] >= start  # frames of the still stretch
        ranked = np.sort(np.where(counted, share[first:last], np.inf), axis=0)
        half = (counted.sum(axis=0) + 1) // 2
        least_likely = np.arange(last - first)[:, None] < half
        mean = np.where(least_likely, ranked, 0.0).sum(axis=0) / np.maximum(half, 1)
        evidence -= np.log(np.where(half > 0, mean, 1.0))
    return evidence


def _blocks(lengths: Sequence[int]) -> list[tuple[int, int]]:
    """Return (first, last + 1) frame of each recording, long ones in parts of nearly equal length."""
    blocks: list[tuple[int, int]] = []
    first = 0
    for length in lengths:
        cuts = np.linspace(first, first + length, max(1, round(length / _BLOCK)) + 1).astype(int)
        blocks += [(int(a), int(b)) for a, b in zip(cuts[:-1], cuts[1:], strict=True) if b > a]
        first += length
    return blocks
