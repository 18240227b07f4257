"""Scale: readings as root loads, relative to the baseline of each cell and to full scale."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

_OUTLYING = 3.0  # standard deviations from the median

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Scale:
    """Baseline and full scale, in the layout's unit.

    Attributes:
        baseline: float ``[D]``, reading of each cell without contact.
        near: readings up to this far above the baseline count as unloaded.
        full_scale: of the layout.
    """

    baseline: NDArray[np.float64]
    near: float
    full_scale: float

    def root_load(self, frames: NDArray[np.float64]) -> Array:
        """Return ``sqrt((reading - baseline) / full_scale)``, ``[..., D]``; 0 up to ``near`` and
        where missing.

        The square root stabilises the variance of noise that grows with the load (Bartlett 1947).
        """
        load = ((frames - self.baseline) / self.full_scale).astype(np.float32)
        # Comparisons with NaN are False: a missing reading is no load.
        root: Array = np.sqrt(
            np.where(load > np.float32(self.near / self.full_scale), load, np.float32(0))
        )
        return root

    def of(self, cells: NDArray[np.intp] | slice) -> Scale:
        """Return the scale of some cells."""
        return replace(self, baseline=self.baseline[cells])

    def above(self, noise: float) -> Scale:
        """Return the scale where readings up to so much further above the baseline count as
        unloaded."""
        return replace(self, near=self.near + noise) if noise else self

    @property
    def root_near(self) -> float:
        """The root load above which a cell counts as loaded."""
        return float(np.sqrt(self.near / self.full_scale))


def usual_limit(values: NDArray[np.float64]) -> float:
    """Return the median of ``values`` ``[n]`` plus three robust standard deviations: higher ones
    are outliers.

    The filter of Hampel (1974); -inf without values.
    """
    if not len(values):
        return -np.inf
    middle, deviation = robust_moments(values)
    return middle + _OUTLYING * deviation


def robust_moments(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the median of ``values`` ``[n]`` and their robust standard deviation.

    The latter equals ``scipy.stats.median_abs_deviation(scale="normal")``, which is fifteen times
    as slow.
    """
    middle = np.median(values)
    return float(middle), float(np.median(np.abs(values - middle)) / ndtri(0.75))
