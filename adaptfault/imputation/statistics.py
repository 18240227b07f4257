"""Mean and covariance of healthy frames, and the conditional mean of missing cells given the
others. Numpy only."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.windows import Windows, evenly
from diagnostics import FaultSet

if TYPE_CHECKING:
    from adaptfault.imputation.linear import AffineFill, NearestFill

_MOST_FRAMES = 20_000  # frames of a covariance; more are thinned evenly
_REFERENCE_FRAMES = 3_000  # frames for the kernel regression
# added to the variance: cells that never moved have covariance 0
_STILL = np.finfo(float).tiny ** 0.25


@dataclass(frozen=True)
class CellStatistics:
    """Moments of healthy frames, sufficient to impute any F.

    Attributes:
        mean: ``[D]``, on the 0..1 scale.
        covariance: ``[D, D]``, shrunk (Ledoit and Wolf 2004).
        frames: ``[M, D]``, a sample of the frames for the kernel regression.
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    frames: NDArray[np.float32]

    @classmethod
    def fit(cls, windows: Windows) -> CellStatistics:
        """Estimate from the frames of fault-free windows."""
        return cls.of_frames(windows.x.reshape(-1, windows.x.shape[2]))

    @classmethod
    def of_frames(cls, frames: NDArray[np.float32]) -> CellStatistics:
        """Estimate from healthy frames ``[M, D]`` on the 0..1 scale."""
        from sklearn.covariance import LedoitWolf

        estimate = LedoitWolf(store_precision=False).fit(
            frames[evenly(len(frames), _MOST_FRAMES)].astype(np.float64)
        )
        return cls(
            estimate.location_, estimate.covariance_, frames[evenly(len(frames), _REFERENCE_FRAMES)]
        )

    @staticmethod
    def reference(windows: Windows) -> NDArray[np.float32]:
        """Return the sample ``[M, D]`` of frames for the kernel regression."""
        frames = windows.x.reshape(-1, windows.x.shape[2])
        return frames[evenly(len(frames), _REFERENCE_FRAMES)]

    def linear(self, fault_set: FaultSet) -> AffineFill:
        """Return the linear front end for F, a torch module."""
        from adaptfault.imputation.linear import AffineFill

        return AffineFill(fault_set, *self.conditional_mean(fault_set))

    def nearest(self, fault_set: FaultSet) -> NearestFill:
        """Return the linear front end for F plus a kernel regression of its residuals, a torch
        module."""
        from adaptfault.imputation.linear import NearestFill

        return NearestFill(fault_set, self.linear(fault_set), self.frames)

    def conditional_mean(
        self, fault_set: FaultSet
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return ``weight [k, D-k]`` and ``bias [k]`` of E[missing | healthy] = weight @ healthy +
        bias.

        The Gaussian conditional mean, S_FR S_RR^-1, R being the healthy cells.
        """
        from scipy.linalg import cho_factor, cho_solve

        missing = np.flatnonzero(fault_set.mask)
        healthy = fault_set.healthy
        if not len(missing) or not len(healthy):
            return np.zeros((len(missing), len(healthy))), self.mean[missing]
        between = self.covariance[np.ix_(healthy, missing)]
        within = _regular(self.covariance[np.ix_(healthy, healthy)])
        weight = cho_solve(cho_factor(within), between).T
        return weight, self.mean[missing] - weight @ self.mean[healthy]

    @cached_property
    def precision(self) -> NDArray[np.float64]:
        """Inverse of the covariance, ``[D, D]``."""
        from scipy.linalg import cho_factor, cho_solve

        factor = cho_factor(_regular(self.covariance))
        return np.asarray(cho_solve(factor, np.eye(len(self.mean))))

    def expected(self, frames: NDArray[Any], missing: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the conditional mean ``[n, k]`` of the ``missing [D]`` cells of ``frames [n, D]``,
        not clipped.

        Equal to :meth:`conditional_mean`, computed from the precision P: mean_F - P_FF^-1 P_FR (x_R
        - mean_R). Faster for few missing cells that differ between frames.
        """
        deviation = np.where(missing, 0.0, frames - self.mean) @ self.precision[:, missing]
        within = self.precision[np.ix_(missing, missing)]
        # For a handful of cells numpy's solver is a few times faster than scipy's Cholesky.
        return np.asarray(self.mean[missing] - np.linalg.solve(within, deviation.T).T)


def _regular(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a covariance whose variances are raised by the error of its factorization (Higham
    2002, theorem 10.3).

    The shrinkage is 0 where every frame deviates as far from the mean as any other, as of readings
    of two levels.
    """
    n = len(covariance)
    error: float = (n + 1) * np.finfo(float).eps * np.trace(covariance)
    return covariance + (error + _STILL) * np.eye(n)
