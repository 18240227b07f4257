"""Drift: cells that move, but never come back to rest, or read too little or too much of every load.

An offset shows in touches that load nothing around the cell, a gain in those that load all of it. One touch says little
of either: objects have edges, and a reading may hold a residue of the last load.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

if TYPE_CHECKING:
    from diagnostics.healthy.prediction import Prediction
    from diagnostics.preprocessing.scale import Array

_OFFSET = 9.5  # log evidence from which on a cell that does not come to rest is faulty: four touches
_LEAST_OFFSET = 0.02  # of full scale, at the mean: a smaller one does no harm
_MOST_OFFSET = 3.0  # log evidence of one touch that a moving cell does not come to rest
_GAIN = 7.0  # log evidence from which on a cell with another gain is faulty: three touches
_FEWEST = 3  # touches: fewer cannot prove it
_MARGIN = 1.5  # so many times what any healthy cell reached, to be faulty
_STRANGE = 0.05  # share of touches that tell nothing of a gain: so none says more than log 20
_GAINS = np.array([0.1, 0.2, 0.35, 0.5, 2.0, 3.0])  # that are tried, times what it was
_AS_GOOD = np.array([0.75, 1.0, 1.33])  # that are no fault, or what is expected of this cell may be off by as much
_LOADED = 2.0  # times the least load: expected of a cell by a touch that tells its gain
_ALL_THROUGH = 0.5  # chance that a wrong gain was wrong all through the log, not from a later touch on

_MEDIAN = 0.741  # of the size of Student's t with 4 degrees of freedom

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def offset_evidence(whole: Array, always: Floats, moving: Mask) -> Floats:
    """Return the log likelihood ratio that a moving cell never comes back to rest, ``[D]``, over the last touches.

    Args:
        whole: features ``[n, 4, D]`` of n touches (see ``Summary.features``), in time order.
        always: ``[n, D]``, P(loaded throughout) of a healthy cell.
        moving: bool ``[D]``, the cells that are judged.
    """
    loaded = (whole[:, 3] == 1) & (whole[:, 1] ** 2 >= _LEAST_OFFSET)
    lasting = np.logical_and.accumulate(loaded[::-1])[::-1]  # unbroken up to the end
    surprisal = -np.log(np.maximum(always, np.exp(-_MOST_OFFSET)))
    return np.where(moving, np.where(lasting, surprisal, 0.0).sum(axis=0), 0.0)


class Gain(NamedTuple):
    """How cells read a load, ``[D]`` each.

    Attributes:
        evidence: float, log likelihood ratio of another gain than in the reference; 0: too few touches tell.
        factor: float, how many times the gain of the reference it is most likely to be.
        since: int, the touch from which on.
        touches: int, how many tell, from that one on.
    """

    evidence: Floats
    factor: Floats
    since: NDArray[np.intp]
    events: NDArray[np.intp]


def gain_evidence(
    whole: Array, expected: Prediction, moved: Mask, root_near: float, counts: Floats | float = 1.0
) -> Gain:
    """Look for cells that are loaded when the others say, but not as much.

    Whether a cell is loaded at all is another question (see ``spatial``): touches that leave it unloaded do not count.
    What holds of cells in general (cold start) tells nothing of the gain of one; where few touches taught what to
    expect of it, evidence counts for less.

    Args:
        whole: features ``[n, 4, D]`` of n touches (see ``Summary.features``), in time order.
        expected: what healthy cells would have done in them.
        moved: bool ``[n, D]``, the touches up to which each cell has moved.
        root_near: the root load from which on a cell counts as loaded.
        counts: ``[n, 1]``, share of what each says that counts, see :func:`gains_count`.
    """
    tells = (
        moved
        & np.isfinite(expected.spread)
        & (expected.own > 0)
        & (whole[:, 2] > 0)
        & (expected.mean > _LOADED * root_near)
    )
    n, d = tells.shape
    result = Gain(np.zeros(d), np.ones(d), np.zeros(d, np.intp), np.zeros(d, np.intp))
    cells = np.flatnonzero(tells.sum(axis=0) >= _FEWEST)
    if not len(cells):
        return result
    tells, root = tells[:, cells], whole[:, 1, cells]
    mean, spread = (of.astype(np.float32) for of in (expected.mean[:, cells], expected.spread[cells]))
    # How far what is expected errs in this log, all cells tell together.
    spread *= max(1.0, float(np.median(np.abs((root - mean) / spread)[tells])) / _MEDIAN)

    def said(gain: float) -> Array:
        """Return what each touch and those after it say for a gain, ``[n, k]``."""
        u = 1 + ((root - np.float32(np.sqrt(gain)) * mean) / (2 * spread)) ** 2
        of_event = np.log((1 - _STRANGE) / (u * u * np.sqrt(u)) + _STRANGE)  # as Student's t with 4 degrees
        return np.where(tells, counts * of_event, 0.0)[::-1].cumsum(axis=0)[::-1]

    chance = np.full(n, (1 - _ALL_THROUGH) / max(n - 1, 1))
    chance[0] = _ALL_THROUGH
    wrong = np.stack([said(gain) for gain in _GAINS]) - np.max([said(gain) for gain in _AS_GOOD], axis=0)
    wrong += np.log(chance / len(_GAINS)).astype(np.float32)[:, None]  # (gains, n, k)
    likeliest = wrong.max(axis=1).argmax(axis=0)
    result.evidence[cells] = expected.own[cells] * logsumexp(wrong, axis=(0, 1))
    result.factor[cells] = _GAINS[likeliest]
    result.since[cells] = since = wrong[likeliest, :, np.arange(len(cells))].argmax(axis=1)
    result.events[cells] = (tells & (np.arange(n)[:, None] >= since)).sum(axis=0)
    return result


def gains_count(reached: float) -> float:
    """Return what share of the evidence of gains counts where healthy cells reached so much of it.

    Touches may be alike, or a contact so small that its neighbours do not tell how hard a cell is pressed.
    """
    return _GAIN / max(_GAIN, _MARGIN * reached)


def drifting(offset: Floats, gain: Floats | float = 0.0) -> Mask:
    """Return the cells of which the evidence, ``[D]`` each, leaves no doubt."""
    doubtless: Mask = (offset >= _OFFSET) | (gain >= _GAIN)
    return doubtless


def misleading(offset: Floats, gain: Floats, known: Mask) -> Mask:
    """Return the drifting cells to be left out next when others are judged, ``[D]``; not those that are ``known``.

    Beside a wrong gain all gains look wrong: they are left out one at a time, the surest first.
    """
    gain = np.where(known, 0.0, gain)
    p_floor = np.arange(len(gain)) == gain.argmax()
    return drifting(np.where(known, 0.0, offset), np.where(p_floor, gain, 0.0))
