"""Noise that all cells have, as it is now: what exceeds the noise of the reference is no contact.

Estimates the standard deviation of white noise in each segment from the second differences of each
cell,

    d_it  = x_{t+1} - 2 x_t + x_{t-1}
    sigma = q25 over cells of mean(middle half over t of |d_it - median over cells of d_it|) /
    (0.693 sqrt 6)

and takes its median over the last 5 segments. What all cells share, as hum, is in the median over
cells: it is no noise. A load changes slowly, so that its second difference is small, and most loads
leave a quarter of the cells alone. The mean of the middle half (an L-estimator with a breakdown
point of 25 %) has no steps where noise is as small as a converter step, as a median has; 0.693 is
its value for |N(0, 1)|.

Noise exceeds that of the reference where sigma is 1.5 times the largest of the reference, and half
a converter step larger. The excess then raises the reading from which on a cell counts as loaded by
eight standard deviations (readings that a converter cuts off at its lower end seem quieter than
they are). So does the step between readings, where it is twice that of the reference and more: the
smallest difference between two readings of a cell in the last 5 segments.

It does not detect noise of fewer than three quarters of the cells, hum and other noise that is slow
compared with the frame rate, nor what readings at the end of the range hide.
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
_DEVIATIONS = 8.0  # from the rest to the highest of many readings
_COARSER = 2.0  # times the step of the reference: readings are coarser than they were

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class NoiseNow:
    """The noise of the last segments.

    Attributes:
        of_segments: standard deviation of each of the last segments, in the layout's unit.
        steps: smallest difference between readings of a cell in each of the last segments in which
            they differ.
    """

    of_segments: tuple[float, ...] = ()
    steps: tuple[float, ...] = ()

    def extend(self, frames: Floats, present: NDArray[np.bool_]) -> NoiseNow:
        """Return the noise after one more segment; one that is too short, or misses readings of all
        cells, is none.

        Args:
            frames: ``[t, D]``, NaN = missing.
            present: bool ``[D]``.
        """
        given = _shown(frames, present)
        if given is None:
            return self
        step = _step(given)
        steps = self.steps if step is None else (*self.steps, step)[-_SEGMENTS:]
        return NoiseNow((*self.of_segments, _deviation(given))[-_SEGMENTS:], steps)

    @property
    def step(self) -> float:
        """The smallest difference between two readings of a cell; 0: unknown."""
        return min(self.steps) if len(self.steps) == _SEGMENTS else 0.0

    @property
    def deviation(self) -> float:
        """The standard deviation, median over the last segments; 0 before any."""
        return median(self.of_segments) if self.of_segments else 0.0

    @property
    def range(self) -> float:
        """From the lowest to the highest of many readings at rest."""
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
    def fit(
        cls, recordings: Iterable[Floats], present: NDArray[np.bool_], step: float
    ) -> UsualNoise:
        """Fit to fault-free recordings, ``[T, D]`` each; ``step``: of the converter."""
        most = 0.0
        now = NoiseNow()
        for recording in recordings:
            for first in range(0, len(recording), SEGMENT):
                now = now.extend(recording[first : first + SEGMENT], present)
                most = max(most, now.deviation)
        return cls(most, step)

    def raises(self, now: NoiseNow) -> float:
        """Return by how much the noise raises the reading from which on a cell is loaded; 0: it is
        as usual."""
        excess = now.deviation - self.most
        clear = now.deviation >= MARGIN * self.most and excess > self.step / 2
        by_noise = _DEVIATIONS * excess if clear else 0.0
        coarser = self.step > 0 and now.step > _COARSER * self.step
        return max(by_noise, now.step if coarser else 0.0)


def _shown(frames: Floats, present: NDArray[np.bool_]) -> Floats | None:
    """Return the readings of the cells that show the noise of all; None: there are too few."""
    cells = np.flatnonzero(present)
    cells = cells[:: max(1, len(cells) // _CELLS)]
    given = frames[:, cells]
    given = given[:, ~np.isnan(given).any(axis=0)]
    return given if len(given) >= _FEWEST and given.shape[1] else None


def _step(given: Floats) -> float | None:
    """Return the smallest difference between two readings of a cell; None: there is none."""
    differences = np.diff(np.sort(given, axis=0), axis=0)
    differ = differences[differences > 0]
    return float(differ.min()) if len(differ) else None


def _deviation(given: Floats) -> float:
    """Return the standard deviation of the noise in a segment."""
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
