"""Gain of the whole array: all its cells read more, or less, than in the reference, as with another
cover, another supply or heavier objects.

The load of a recording is the upper quartile, over the cells that move in it, of highest less low
reading, both above the median of all cells in the frame. The gain is the ratio of the median loads
of log and reference; it is 1 where the test of Kolmogorov and Smirnov finds no difference
(p < 1e-4), and between 1 / 1.3 and 1.3. Cells are judged after it is taken out, where that explains
more of them.

Not detected: fewer than five recordings with contact, and a gain that comes and goes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.drift import GAIN
from diagnostics.preprocessing.levels import LEAST_LOADED, LOW, MAJORITY
from diagnostics.preprocessing.quantiles import known_quantile
from diagnostics.sensor.sensor_change import differ

Floats = NDArray[np.float64]


def loads_of(recordings: Sequence[NDArray[Any]], near: float, present: NDArray[np.bool_]) -> Floats:
    """Return the load of each recording in which a cell moves, ``[n]``.

    Args:
        recordings: loads ``[T, D]`` each; NaN = missing.
        near: changes up to this count as none.
        present: bool ``[D]``, where there is a cell.
    """
    loads = []
    for given in recordings:
        frames = np.asarray(given, dtype=np.float64)[:, present]
        if not len(frames):
            continue
        # A hum or a ramp of all cells is no load.
        frames = frames - known_quantile(frames, MAJORITY, axis=1)[:, None]
        size = np.fmax.reduce(frames) - known_quantile(frames, LOW, axis=0)
        moving = size[size > 2 * near]
        if len(moving):
            loads.append(float(np.quantile(moving, 1 - LEAST_LOADED)))
    return np.array(loads, dtype=np.float64)


def gain_of(new: Floats, usual: Floats) -> float:
    """Return the ratio of the loads of recordings and the usual ones, ``[n]`` each; 1 where they do
    not differ."""
    if not differ(new, usual):
        return 1.0
    gain = float(np.median(new) / np.median(usual))
    return gain if max(gain, 1 / gain) >= GAIN else 1.0


def without_gain(recordings: Sequence[NDArray[Any]], gain: float, rest: Floats) -> list[Floats]:
    """Return recordings of loads ``[T, D]`` as they were with a gain of 1; ``rest``: ``[D]``.

    A cell that never moves reads what it reads.
    """
    taken_out = []
    low = np.fmin.reduce([np.fmin.reduce(frames) for frames in recordings])
    high = np.fmax.reduce([np.fmax.reduce(frames) for frames in recordings])
    moves = high > low
    for frames in recordings:
        loads = np.asarray(frames, dtype=np.float64)
        taken_out.append(np.where(moves, rest + (loads - rest) / gain, loads))
    return taken_out
