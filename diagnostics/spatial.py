"""Spatial evidence: would a healthy cell hold this value while the other cells do what they do?

For each cell that ends the log still, at value v from frame s on, two explanations compete. Stuck: it reads v whatever
happens. Healthy: it reads v as often as healthy cells do when the others look as they do now. Every touch adds

    log 1 / P(v | healthy, others)

averaged over the least likely half of its frames, because the frames of one touch are not independent: evidence adds up
over touches, hardly over the frames of one. However long a static hold lasts, it is one touch. How likely a stuck cell
is to be stuck at just this v is charged once: a cell held still under a constant load also reads one value, but an
arbitrary one, while the rails are where broken cells go.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from diagnostics.reference import Expectation
from diagnostics.temporal import LastRuns

_SHORTEST_RUN = 5  # frames; shorter stillness is not worth a question
_BLOCK = 100  # frames; a longer recording may hold several touches
_FRAMES_PER_BLOCK = 32  # looked at, evenly spread: the frames between say the same
_SAME_TOUCH = 0.25  # blocks whose mean frames differ by less than this share of their size are one touch
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
    touches = _touches(log, lengths, trusted)
    frames = np.concatenate(touches)
    share = expectation.share_at(log[frames], trusted, asked, value, 2 * tolerance)  # (F, asked)
    counted = (frames[:, None] >= start) & ~np.isnan(log[np.ix_(frames, asked)])  # frames of the still stretch
    share = np.where(counted, share, np.inf)
    for of_touch in np.split(share, np.cumsum([len(touch) for touch in touches])[:-1]):
        ranked = np.sort(of_touch, axis=0)
        half = (np.isfinite(ranked).sum(axis=0) + 1) // 2
        mean = np.where(np.arange(len(ranked))[:, None] < half, ranked, 0.0).sum(axis=0) / np.maximum(half, 1)
        evidence -= np.log(np.where(half > 0, mean, 1.0))
    return evidence


def _touches(log: NDArray[np.float64], lengths: Sequence[int], trusted: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the frames of each touch: blocks of a recording, consecutive ones that look alike put together."""
    touches: list[list[NDArray[np.intp]]] = []
    last = None
    for first, end in _blocks(lengths):
        frames = np.unique(np.linspace(first, end - 1, min(end - first, _FRAMES_PER_BLOCK)).astype(np.intp))
        mean = np.sqrt(np.maximum(np.nan_to_num(log[np.ix_(frames, trusted)]), 0)).mean(axis=0)
        alike = last is not None and (
            np.linalg.norm(mean - last) <= _SAME_TOUCH * max(np.linalg.norm(mean), np.linalg.norm(last))
        )
        if alike:
            touches[-1].append(frames)
        else:
            touches.append([frames])
            last = mean
    return [np.concatenate(blocks) for blocks in touches]


def _blocks(lengths: Sequence[int]) -> list[tuple[int, int]]:
    """Return (first, last + 1) frame of each recording, long ones in parts of nearly equal length."""
    blocks: list[tuple[int, int]] = []
    first = 0
    for length in lengths:
        cuts = np.linspace(first, first + length, max(1, round(length / _BLOCK)) + 1).astype(int)
        blocks += [(int(a), int(b)) for a, b in pairwise(cuts) if b > a]
        first += length
    return blocks
