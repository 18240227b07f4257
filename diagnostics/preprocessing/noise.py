"""Noise that all cells have, as it is now: what exceeds the noise of the reference is no contact.

Estimates the standard deviation of white noise in each segment from the second differences of each cell,

    d_it  = x_{t+1} - 2 x_t + x_{t-1}
    sigma = q25 over cells of mean(middle half over t of |d_it - median over cells of d_it|) / (0.693 sqrt 6)

and takes its median over the last 5 segments. What all cells share, as hum, is in the median over cells: it is no
noise. A load changes slowly, so that its second difference is small, and most loads leave a quarter of the cells alone.
The mean of the middle half (an L-estimator with a breakdown point of 25 %) has no steps where noise is as small as a
converter step, as a median has; 0.693 is its value for |N(0, 1)|.

Noise exceeds that of the reference where sigma is 1.5 times the largest of the reference, and half a converter step
larger. The excess then raises the reading from which on a cell counts as loaded by six standard deviations.

It does not detect noise of fewer than three quarters of the cells, hum and other noise that is slow compared with the
frame rate, nor what readings at the end of the range hide.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import median

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import LEAST_LOADED, MARGIN
from diagnostics.preprocessing.readings import SEGMENT

_SEGMENTS = 5  # whose median counts: a size
_CELLS = 256  # that show the noise of all, evenly spread: a size
_FEWEST = 8  # frames in which a cell shows its noise
_MIDDLE_HALF = 0.693  # mean of the middle half of |N(0, 1)|
_DEVIATIONS = 6.0  # from the rest to the highest of many readings, as for the baseline

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class NoiseNow:
    """The noise of the last segments.

    Attributes:
        of_segments: standard deviation of each of the last segments, in the layout's unit.
    """

    of_segments: tuple[float, ...] = ()

    def extend(self, frames: Floats, present: NDArray[np.bool_]) -> NoiseNow:
        """Return the noise after one more segment; one that is too short, or misses readings of all cells, is none.

        Args:
            frames: ``[t, D]``, NaN = missing.
            present: bool ``[D]``.
        """
        found = _deviation(frames, present)
        if found is None:
            return self
        return NoiseNow((*self.of_segments, found)[-_SEGMENTS:])

    @property
    def deviation(self) -> float:
        """The standard deviation, median over the last segments; 0 before any."""
        return median(self.of_segments) if self.of_segments else 0.0

    @property
    def range(self) -> float:
        """From the lowest to the highest of many readings at rest: twelve standard deviations."""
        return 2 * _DEVIATIONS * self.deviation


@dataclass(frozen=True)
class UsualNoise:
    """The noise of the reference, in the layout's unit.

    Attributes:
        most: largest standard deviation.
        step: of the converter; 0: unknown.
    """

    most: float
    step: float

    @classmethod
    def fit(cls, recordings: Iterable[Floats], present: NDArray[np.bool_], step: float) -> UsualNoise:
        """Fit to fault-free recordings, ``[T, D]`` each; ``step``: of the converter."""
        most = 0.0
        now = NoiseNow()
        for recording in recordings:
            for first in range(0, len(recording), SEGMENT):
                now = now.extend(recording[first : first + SEGMENT], present)
                most = max(most, now.deviation)
        return cls(most, step)

    def raises(self, now: NoiseNow) -> float:
        """Return by how much the noise raises the reading from which on a cell is loaded; 0: it is as usual."""
        excess = now.deviation - self.most
        clear = now.deviation >= MARGIN * self.most and excess > self.step / 2
        return _DEVIATIONS * excess if clear else 0.0


def _deviation(frames: Floats, present: NDArray[np.bool_]) -> float | None:
    """Return the standard deviation of the noise in a segment; None: it does not tell."""
    cells = np.flatnonzero(present)
    cells = cells[:: max(1, len(cells) // _CELLS)]
    given = frames[:, cells]
    given = given[:, ~np.isnan(given).any(axis=0)]
    if len(given) < _FEWEST or not given.shape[1]:
        return None
    curvature = np.diff(given, 2, axis=0)
    half = curvature.shape[1] // 2
    shared = np.partition(curvature, half, axis=1)[:, half]
    own = np.abs(curvature - shared[:, None])
    own.sort(axis=0)
    outer = len(own) // 4
    middle = own[outer : len(own) - outer].mean(axis=0)
    middle.sort()
    quarter = middle[int(LEAST_LOADED * len(middle))]
    return float(quarter / (_MIDDLE_HALF * np.sqrt(6)))
