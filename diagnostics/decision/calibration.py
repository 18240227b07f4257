"""Calibrated log likelihood ratios of a cold start, and the faulty set.

Summed evidence is no log likelihood ratio: events are correlated and models err. So in a cold start

    log(P(r, u | faulty) / P(r, u | healthy)) = a q + b r + d u

with the spatial evidence r, the temporal evidence u, and q = 1 for cells of which the events tell
anything; a, b and d for four kinds of constant cells: at rest or loaded, since before the log or
not. That of cells that never moved and rest is fitted to simulated grasps and postures
(``benchmarks/cold_calibration.py``), by logistic regression (Platt 1999). P(faulty) follows with
the prevalence of the log, estimated by expectation maximisation (Saerens et al. 2002). The faulty
set is the largest one whose expected false discovery rate meets the limit (:func:`faulty_at`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from diagnostics.preprocessing.levels import EXPECTED, EXPECTED_CELLS, EXPECTED_LATE

# a, b and d of cells that never moved, and that came to their level: at rest, loaded
OFFSET = np.array([[-1.4, 0.0], [-1.0, -1.0]])
_SLOPE = np.array([[1.0, 0.6], [0.6, 0.6]])
_TEMPORAL = np.array([[1.0, 1.0], [0.5, 0.5]])
_ROUNDS = 100  # of expectation maximisation, at most: a size
_AGREE = 1e-6

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def calibrated(
    spatial: Floats, temporal: Floats, moved: Mask, rests: Mask, *, tested: Mask
) -> Floats:
    """Return the calibrated log likelihood ratio faulty : healthy of constant cells, ``[D]``.

    Args:
        spatial, temporal: evidence, ``[D]``.
        moved: bool ``[D]``, cells that read something else before.
        rests: bool ``[D]``, cells at their baseline.
        tested: bool ``[D]``, cells of which the events tell anything, q.
    """
    kind = moved.astype(np.intp), (~rests).astype(np.intp)
    log_ratio: Floats = OFFSET[kind] * tested + _SLOPE[kind] * spatial + _TEMPORAL[kind] * temporal
    return log_ratio


def probability_of(log_ratio: Floats, moved: Mask, scored: Mask) -> Floats:
    """Return P(stuck), ``[D]``.

    Args:
        log_ratio: calibrated, ``[D]``.
        moved: bool ``[D]``, cells whose run began within the log.
        scored: bool ``[D]``, constant cells; the others move: 0.
    """
    probability = np.zeros(len(log_ratio))
    late = scored & moved
    early = scored & ~moved
    probability[late] = _posterior(log_ratio[late], EXPECTED_LATE, EXPECTED_CELLS)
    # Cells that never moved failed before the log, or in it at the same rate as cells that moved.
    broke = probability[late].sum() / (moved.sum() + EXPECTED_CELLS)
    probability[early] = _posterior(log_ratio[early], EXPECTED + float(broke), EXPECTED_CELLS)
    return probability


def _posterior(log_ratio: Floats, expected: float, cells: float) -> Floats:
    """Return P(faulty) ``[n]``; prevalence by EM, with the prior share ``expected`` worth ``cells``
    cells."""
    share = expected
    for _ in range(_ROUNDS):
        posterior = expit(log_ratio + logit(share))
        before = share
        share = (posterior.sum() + expected * cells) / (len(log_ratio) + cells)
        if abs(share - before) < _AGREE:
            break
    probability: Floats = expit(log_ratio + logit(share))
    return probability


def faulty_at(probability: Floats, false_discovery_rate: float) -> Mask:
    """Return the faulty set at a Bayesian false discovery rate, bool ``[D]`` (Newton et al. 2004).

    Cells are taken in order of P(faulty) while the expected number of false ones, sum(1 - P), is as
    near as possible to rate times size: an excess is accepted up to the shortfall before it,
    because sets are small and always stopping below would meet only a fraction of the rate. The
    first cell must meet the rate, and each has P(faulty) > 0.5.
    """
    order = np.argsort(-probability, kind="stable")
    false = np.cumsum(1 - probability[order])  # expected among the first 1, 2, ...
    accepted = false_discovery_rate * np.arange(1, len(order) + 1)
    excess = false - accepted
    shortfall = accepted - np.concatenate([[0.0], false[:-1]])
    shortfall[:1] = 0.0
    within = np.logical_and.accumulate(excess <= np.maximum(shortfall, 0.0))
    chosen = np.zeros(len(probability), bool)
    chosen[order[within]] = True
    return chosen & (probability > 0.5)
