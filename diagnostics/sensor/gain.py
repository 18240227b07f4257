"""Gain of the whole array: all its cells read more, or less, than in the reference, as with another
cover, another supply or heavier objects.

The size of a cell in a recording is its highest less its low reading, both above the median of all
cells in the frame. The gain is the median ratio of quantiles of the sizes of log and reference, of
all cells in recordings with contact, at the ranks at which those of the reference are loaded; it is
1 between 1 / 1.3 and 1.3. Other objects have the same effect: cells are judged, and wires compared,
after it is taken out where that explains more of them.

Not detected: fewer than five recordings with contact, and a gain that comes and goes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import LOW, MAJORITY
from diagnostics.preprocessing.quantiles import known_quantile

GAIN = 1.3  # up or down: a smaller change is no fault
_FEWEST = 5  # recordings, of the log and of the reference
# shares of the loaded sizes that are larger: less loaded ones are noise, the largest saturate
_LOADED = np.linspace(0.02, 0.5, 25)

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class UsualSizes:
    """How far the cells of a reference move.

    Attributes:
        ranks: float ``[n]``, of the loaded sizes.
        sizes: float ``[n]``, the quantiles.
    """

    ranks: Floats
    sizes: Floats

    @classmethod
    def of(
        cls, recordings: Sequence[NDArray[Any]], near: float, present: NDArray[np.bool_]
    ) -> UsualSizes | None:
        """Return those of healthy loads ``[T, D]``; None where hardly a cell is loaded.

        Args:
            recordings: ``[T, D]`` each; NaN = missing.
            near: changes up to this count as none.
            present: bool ``[D]``, where there is a cell.
        """
        sizes = _sizes_of(recordings, near, present)
        if sizes is None:
            return None
        ranks = 1 - _LOADED * float((sizes > 2 * near).mean())
        return cls(ranks, np.quantile(sizes, ranks))

    def gain(
        self, recordings: Sequence[NDArray[Any]], near: float, present: NDArray[np.bool_]
    ) -> float:
        """Return the gain of a log, as for :meth:`of`; 1 where it hardly differs, or is unknown."""
        sizes = _sizes_of(recordings, near, present)
        if sizes is None:
            return 1.0
        gain = float(np.median(np.quantile(sizes, self.ranks) / self.sizes))
        return gain if gain > 0 and max(gain, 1 / gain) >= GAIN else 1.0


def _sizes_of(
    recordings: Sequence[NDArray[Any]], near: float, present: NDArray[np.bool_]
) -> Floats | None:
    """Return the sizes of all cells in the recordings in which one is loaded, ``[n]``; None: too
    few of these."""
    sizes = []
    for given in recordings:
        frames = np.asarray(given, dtype=np.float64)[:, present]
        if not len(frames):
            continue
        # A hum or a ramp of all cells is no load.
        frames = frames - known_quantile(frames, MAJORITY, axis=1)[:, None]
        size = np.fmax.reduce(frames) - known_quantile(frames, LOW, axis=0)
        size = size[np.isfinite(size)]
        if len(size) and size.max() > 2 * near:
            sizes.append(size)
    return np.concatenate(sizes) if len(sizes) >= _FEWEST else None


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
