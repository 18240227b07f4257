"""Cells that hold one value away from rest, again and again, while cells beside them move.

A cell **moves** in a recording where its lowest and its highest reading differ by 5 % of the usual
range, and **holds** a value where they are equal. Rest is what it reads at least in nearly all
recordings, at most where readings fall with load. Suspect is what holds one and the same value, 5 %
of the usual range and more than three steps of the converter away from rest, in three recordings or
more in which two cells beside it move: contacts hardly come back to the same number, a dead cell
does. It needs no reference and fewer recordings than :mod:`diagnostics.when.held`, and proves less:
the cell is not tested.

On the healthy recordings of five real arrays (1,824 recordings, 1,456 cells) no cell is suspect;
in 551 parts of them, of 6 to 64 recordings each, three cells of fingertips with 8 bits are.

Not detected: cells that are dead at rest, that dither, or whose cells beside do not move, and what
one recording or two show.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import LIGHT, LOW
from diagnostics.preprocessing.tolerance import least_step
from diagnostics.when.spans import Spans

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

_RECORDINGS = 3  # with the same value; of few counts, two agree by chance
_BESIDE = 2  # cells that move
_STEPS = 3  # of the converter: the noise of a cell at rest

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def held_again(spans: Spans, layout: SensorLayout) -> Bools:
    """Return where cells hold a value that they hold again and again, bool ``[n, D]``.

    Args:
        spans: of n recordings.
        layout: the array.
    """
    low = spans.low
    high = spans.high
    known = spans.known & layout.is_cell
    if not known.any():
        return np.zeros(low.shape, bool)
    rest = _rest(low, high, known)
    loads = np.fmax(np.abs(high - rest), np.abs(low - rest))
    light = LIGHT * float(np.quantile(loads[known], 1 - LOW))
    extremes = np.concatenate([low[known], high[known]])
    step = least_step(extremes, float(np.ptp(extremes)))
    with np.errstate(invalid="ignore"):
        moves = known & (high - low > light)
        away = np.abs(low - rest)
        holds = known & (high == low) & (away > light) & (away > _STEPS * step)
    beside = np.where(layout.beside >= 0, moves[:, layout.beside], False).sum(axis=2)
    return _again(holds & (beside >= _BESIDE), low)


def _rest(low: Floats, high: Floats, known: Bools) -> Floats:
    """Return what each cell reads without load, ``[D]``, from its extremes by recording.

    Most readings of an array are nearer to rest than to the strongest load, so that whichever end
    the middle of the extremes is nearer to is the end of rest.
    """
    lowest = np.where(known, low, np.inf)
    highest = np.where(known, high, -np.inf)
    ends = np.array([lowest.min(), highest.max()])
    middle = np.median(np.concatenate([low[known], high[known]]))
    falls = ends[1] - middle < middle - ends[0]
    ordered = np.sort(highest if falls else lowest, axis=0)
    place = int(LOW * (len(ordered) - 1))
    return np.asarray(ordered[-1 - place] if falls else ordered[place])


def _again(holds: Bools, value: Floats) -> Bools:
    """Return where cells hold a value that they hold in another recording, too."""
    again = np.zeros_like(holds)
    for cell in np.flatnonzero(holds.any(axis=0)).tolist():
        at = np.flatnonzero(holds[:, cell])
        _, which, times = np.unique(value[at, cell], return_inverse=True, return_counts=True)
        again[at, cell] = times[which.ravel()] >= _RECORDINGS
    return again
