"""Drift: cells that move, but never return to their baseline (offset), or scale every load wrongly
(gain).

The evidence of an offset is the sum of -log P(loaded throughout | other cells) over the last
events, as far as the cell is loaded throughout each; repeated events count for less
(``ConditionalTest.novelty``). That of a gain g is the log likelihood ratio

    log sum_{g, s} P(g) P(s) L_s(g) / max_{1/1.3 <= h <= 1.3} L_s(h),
    L_s(g) = prod_{e >= s} t_4(y_e; sqrt(g) m_e)

over gains g and change points s, for root loads y and predicted means m, with a contaminated
Student t: Bayesian change point detection (Barry and Hartigan 1993) for one change of scale. Both
need several events, because objects have edges and a reading may hold a residue of the last load.
Offsets below 2 % of full scale and gains between 1/1.3 and 1.3 are not detected.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from diagnostics.healthy.prediction import MEDIAN_ERROR, log_student_t
from diagnostics.preprocessing.levels import MARGIN, P_MIN, RARE, SLIGHT

if TYPE_CHECKING:
    from diagnostics.healthy.prediction import Prediction
    from diagnostics.preprocessing.scale import Array

FEWEST_EVENTS = 3  # fewer prove no gain
# share of events that are independent of gain and offset: none brings more than log 20
_OUTLIERS = 0.05
_GAIN = float(-np.log(RARE))  # log evidence from which on a cell has another gain: three events
# the same, of an offset: four events, as a reading may hold a residue of the last load
_OFFSET = float(-np.log(P_MIN))
_GAINS = np.array([0.1, 0.2, 0.35, 0.5, 2.0, 3.0])  # faulty gains: a grid
GAIN = 1.3  # up or down: a smaller change is no fault, the mean may err by as much

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def offset_evidence(whole: Array, always: Floats, moving: Mask, counts: Floats | float) -> Floats:
    """Return the log likelihood ratio ``[D]`` that a moving cell never returns to its baseline.

    Args:
        whole: features ``[n, 4, D]`` of n events (see ``Summary.features``), in time order.
        always: ``[n, D]``, P(loaded throughout) of a healthy cell.
        moving: bool ``[D]``, cells that move.
        counts: ``[n, 1]``, weight of each event, see :func:`drift_counts`.
    """
    loaded = (whole[:, 3] == 1) & (whole[:, 1] ** 2 >= SLIGHT)
    lasting = np.logical_and.accumulate(loaded[::-1])[::-1]  # unbroken up to the end
    surprisal = -np.log(np.maximum(always, _OUTLIERS))
    return np.where(moving, np.where(lasting, counts * surprisal, 0.0).sum(axis=0), 0.0)


class Gain(NamedTuple):
    """Gain of each cell relative to the reference, ``[D]`` each.

    Attributes:
        evidence: float, log likelihood ratio of a changed gain; 0: too few events.
        factor: float, the most likely gain relative to the reference.
        since: int, index of the event from which on it holds.
        events: int, number of events from there on that test the gain.
    """

    evidence: Floats
    factor: Floats
    since: NDArray[np.intp]
    events: NDArray[np.intp]


def gain_evidence(
    whole: Array, expected: Prediction, moved: Mask, root_near: float, counts: Floats | float = 1.0
) -> Gain:
    """Return the evidence of a changed gain.

    Events that leave a cell unloaded do not count (the spatial test covers these). A prediction
    that is not specific to the cell (``Prediction.own``: not in a cold start) carries no evidence
    of its gain.

    Args:
        whole: features ``[n, 4, D]`` of n events (see ``Summary.features``), in time order.
        expected: prediction for healthy cells.
        moved: bool ``[n, D]``, events before the constant run of each cell.
        root_near: the root load from which on a cell counts as loaded.
        counts: ``[n, 1]``, weight of each event, see :func:`drift_counts`.
    """
    informative = (
        moved
        & np.isfinite(expected.spread)
        & expected.own
        & (whole[:, 2] > 0)
        & (expected.mean > MARGIN * root_near)
    )
    n, d = informative.shape
    result = Gain(np.zeros(d), np.ones(d), np.zeros(d, np.intp), np.zeros(d, np.intp))
    cells = np.flatnonzero(informative.sum(axis=0) >= FEWEST_EVENTS)
    if not len(cells):
        return result
    informative = informative[:, cells]
    root = whole[:, 1, cells]
    mean, spread = (
        of.astype(np.float32) for of in (expected.mean[:, cells], expected.spread[cells])
    )
    # The error of the predictions in this log is estimated from all cells.
    spread *= max(1.0, float(np.median(np.abs((root - mean) / spread)[informative])) / MEDIAN_ERROR)

    def log_likelihood(gain: float) -> Array:
        """Return the log likelihood of a gain from each event on, ``[n, k]``."""
        of_event = log_student_t((root - np.float32(np.sqrt(gain)) * mean) / spread, _OUTLIERS)
        return np.where(informative, counts * of_event, 0.0)[::-1].cumsum(axis=0)[::-1]

    # A wrong gain is as likely wrong from the start of the log as from any later event.
    chance = np.full(n, 0.5 / max(n - 1, 1))
    chance[0] = 0.5
    wrong = np.stack([log_likelihood(gain) for gain in _GAINS]) - np.max(
        [log_likelihood(gain) for gain in (1 / GAIN, 1.0, GAIN)], axis=0
    )
    wrong += np.log(chance / len(_GAINS)).astype(np.float32)[:, None]  # (gains, n, k)
    likeliest = wrong.max(axis=1).argmax(axis=0)
    result.evidence[cells] = logsumexp(wrong, axis=(0, 1))
    result.factor[cells] = _GAINS[likeliest]
    result.since[cells] = since = wrong[likeliest, :, np.arange(len(cells))].argmax(axis=1)
    result.events[cells] = (informative & (np.arange(n)[:, None] >= since)).sum(axis=0)
    return result


def drift_counts(offset: float, gain: float) -> tuple[float, float]:
    """Return the factors on the evidence that keep ``offset`` and ``gain``, the most of healthy
    cells, below a limit.

    That is the threshold / 1.5. Events may be correlated, contacts so small that the neighbours do
    not determine the load of a cell, and cells always loaded where those beside them are not.
    """
    return _OFFSET / max(_OFFSET, MARGIN * offset), _GAIN / max(_GAIN, MARGIN * gain)


def drifting(offset: Floats, gain: Floats | float = 0.0) -> Mask:
    """Return the cells whose evidence of an offset or a gain, ``[D]`` each, exceeds the threshold,
    bool ``[D]``."""
    certain: Mask = (offset >= _OFFSET) | (gain >= _GAIN)
    return certain


def misleading(offset: Floats, gain: Floats, known: Mask) -> Mask:
    """Return the drifting cells to exclude next from the predictors, bool ``[D]``, without those
    ``known`` already.

    A wrong gain makes the gains of its neighbours look wrong: only the cell with most evidence is
    excluded at a time.
    """
    gain = np.where(known, 0.0, gain)
    strongest = np.arange(len(gain)) == gain.argmax()
    return drifting(np.where(known, 0.0, offset), np.where(strongest, gain, 0.0))
