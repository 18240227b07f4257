"""Prediction: the distribution of the loads of healthy cells in contact events, as the
neighbours of a cell give it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

OUTLIERS = 0.1  # share of events in which any load is equally likely (contamination)
MEDIAN_ERROR = 0.741  # median of |t| with 4 degrees of freedom
MIN_P_FLOOR = 0.002  # lower limit of the probabilities, however many events there are: models err


@dataclass(frozen=True)
class Prediction:
    """Predicted loads of healthy cells in each of n excerpts, given the predictors.

    Attributes:
        never: float ``[n, D]``, P(unloaded throughout).
        always: float ``[n, D]``, P(loaded throughout).
        mean: float ``[n, D]``, expected mean root load, 0 to 1.
        spread: float ``[D]``, scale of the Student t error of ``mean``; NaN: unknown.
    """

    never: NDArray[np.float64]
    always: NDArray[np.float64]
    mean: NDArray[np.float64]
    spread: NDArray[np.float64]

    def on(
        self, excerpts: NDArray[np.bool_] | slice, cells: NDArray[np.intp] | slice = slice(None)
    ) -> Prediction:
        """Return the prediction for some of the excerpts and cells."""
        never, always, mean = (
            values[excerpts][:, cells] for values in (self.never, self.always, self.mean)
        )
        return Prediction(never, always, mean, self.spread[cells])

    def within(
        self,
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        cells: NDArray[np.intp],
        inflation: NDArray[np.float64] | float = 1.0,
    ) -> NDArray[np.float64]:
        """Return P(low <= mean root load <= high), ``[n, k]``.

        A contaminated Student t distribution: 0.9 F_4((x - mean) / (inflation * spread)) + 0.1 of a
        uniform one; a uniform one alone where the spread is unknown.

        Args:
            low, high: root loads ``[k]``.
            cells: int ``[k]``.
            inflation: factor on the spread in each excerpt, ``[n]``.
        """
        mean = self.mean[:, cells]
        spread = self.spread[cells] * np.reshape(inflation, (-1, 1))
        likely = _student_t((high - mean) / spread) - _student_t((low - mean) / spread)
        p = (1 - OUTLIERS) * likely + OUTLIERS * (np.minimum(high, 1.0) - low)
        # Full scale has no width: a load of unknown size reaches it as often as a broken cell.
        any_load = np.where(np.isfinite(high), high - low, 1.0)
        return np.where(np.isnan(spread), any_load, p)

    @cached_property
    def states(self) -> NDArray[np.float64]:
        """P(never loaded), P(always loaded) and P(sometimes loaded), each at least 0.002,
        ``[3, n, D]``."""
        return np.clip(
            np.stack([self.never, self.always, 1 - self.never - self.always]), MIN_P_FLOOR, 1.0
        )

    def log_likelihood(self, features: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the log likelihood of what each cell did, ``[n, D]``, up to a constant.

        log P(its state) + log t_4(mean root load) where it was loaded: summed over cells, the
        pseudo-likelihood of the excerpts (Besag 1975). A load of a cell whose loads are unknown is
        an outlier.

        Args:
            features: ``[n, 4, D]``, of the excerpts (see ``Summary.features``).
        """
        did = np.where(features[:, 2] == 0, 0, np.where(features[:, 3] == 1, 1, 2))
        state = np.take_along_axis(np.log(self.states), did[None], axis=0)[0]
        error = np.nan_to_num((features[:, 1] - self.mean) / self.spread, nan=np.inf)
        log_likely: NDArray[np.float64] = state + np.where(
            did > 0, log_student_t(error, OUTLIERS), 0.0
        )
        return log_likely


def log_student_t(error: NDArray[Any], outliers: float) -> NDArray[Any]:
    """Return the log density of standardised errors, contaminated by a share of ``outliers``; up to
    a constant.

    ``log((1 - outliers) t_4(error) / t_4(0) + outliers)``, as ``scipy.stats.t(4).pdf``; the dtype
    of ``error`` is kept.
    """
    u = 1 + (error / 2) ** 2
    log_density: NDArray[Any] = np.log((1 - outliers) / (u * u * np.sqrt(u)) + outliers)
    return log_density


def _student_t(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``scipy.stats.t(4).cdf(x)`` in closed form, ten times as fast. Edges of objects make
    the tails heavy."""
    x = np.clip(x, -1e6, 1e6)
    u = x / np.sqrt(1 + x**2 / 4)
    return 0.5 + 0.375 * u * (1 - u**2 / 12)
