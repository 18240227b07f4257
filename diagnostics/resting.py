"""Where cells rest, how far an untouched one wanders from there, and the least that any reads.

Skins that threshold their readings rest at one value. Others have noise, and their offsets wander from one recording to
the next: neither is to be taken for a touch. And on a skin whose cells rest above 0, or are never quite calm, a cell
that lost its wire gives itself away untouched, by a steady 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from diagnostics.readings import Readings
from diagnostics.temporal import StillRuns
from diagnostics.touches import SEGMENT

_LOW = 0.05  # quantile of all readings of a cell
_LEAST = 0.03  # quantile of its readings in one recording: where it rested in that, if it was let go at all
_LIGHT = 0.05  # of full scale: a cell that never read less above its rest than this was touched all through
_CALM = 0.25  # quantile of the noise of cells in recordings: touched cells have more
_NOISE = 6.0  # standard deviations from the low quantile to the highest of many readings
_RARE = 0.001  # of the cells in recordings: what so few did is taken for none
_WORTH = 12.0  # log likelihood ratio of reading less than any healthy cell
_CROWD = 0.5  # share of the cells: when so many read less than ever, their offset has moved
_BLOCK = 4096  # cells looked at together

Floats = NDArray[np.float64]


def resting(
    recordings: Sequence[Floats], present: NDArray[np.bool_], tolerance: float, full_scale: float
) -> tuple[Floats, float]:
    """Return the most that each cell reads untouched, ``[D]``, and the least that any healthy one reads.

    A cell without any reading rests at 0. Where the noise lets no cell hold still, the least is full scale; -inf: not
    known.

    Args:
        recordings: ``[T, D]`` each.
        present: bool ``[D]``, cells that tell how far they wander.
        tolerance: a cell is still while it stays within +- this; a wander within it counts as rest anyway.
        full_scale: of the layout.
    """
    low = _low(recordings)
    cells, some = Readings.of(recordings).sample(present)
    offsets, bends, least = [], [], []
    for frames in some:
        heard = ~np.isnan(frames).any(axis=0)
        if len(frames) > 2 and heard.any():
            whole = frames[:, heard]
            offsets.append(np.quantile(whole, _LEAST, axis=0) - low[cells[heard]])
            bends.append(np.median(np.abs(np.diff(whole, 2, axis=0)), axis=0))  # a load moves, but hardly bends
            least.append(whole.min(axis=0))
    if not offsets:
        return low, -np.inf
    offset = np.concatenate(offsets)
    light = offset[offset < _LIGHT * full_scale]
    noise = float(np.quantile(np.concatenate(bends), _CALM)) / (0.6745 * np.sqrt(6))
    wander = _highest(light) + _NOISE * noise
    lowest = float(np.quantile(np.concatenate(least), _RARE, method="lower"))
    return low + max(0.0, wander - tolerance), full_scale if noise > tolerance else lowest


def _highest(offset: Floats) -> float:
    """Return how far untouched cells wander up, from how far they wander down: light loads hide the other end.

    As far as from the lowest to the median again, if there is a sharp lowest; tails may reach half as far again.
    """
    if not len(offset):
        return 0.0
    usual = max(0.0, float(np.median(offset)))
    below = usual - float(np.quantile(offset, _RARE, method="lower"))
    return usual + min(max(below, usual), 2 * usual)


def less_than_healthy(runs: StillRuns, least: float, tolerance: float, present: NDArray[np.bool_]) -> Floats:
    """Return what holding less than the ``least`` of any healthy cell says, a log likelihood ratio ``[D]``."""
    value = np.nan_to_num(runs.value, nan=np.inf)
    less = present & (runs.length >= SEGMENT) & (value < least - 2 * tolerance)
    return np.where(less & (less.sum() <= _CROWD * present.sum()), _WORTH, 0.0)


def _low(recordings: Sequence[Floats]) -> Floats:
    """Return a low quantile of each cell's readings, ``[D]``; 0 for a cell without any."""
    readings, n_cells = Readings.of(recordings), recordings[0].shape[1]
    low = np.zeros(n_cells)
    for first in range(0, n_cells, _BLOCK):
        cells = np.arange(first, min(first + _BLOCK, n_cells))
        frames = np.concatenate([readings.piece(i, slice(None), cells) for i in range(len(readings))])
        heard = ~np.isnan(frames).all(axis=0)
        low[cells[heard]] = np.nanquantile(frames[:, heard], _LOW, axis=0)
    return low
