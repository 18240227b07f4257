"""What healthy cells do in a contact event, as a model predicts it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_NOVEL = 0.1  # share of touches that resemble nothing known


@dataclass(frozen=True)
class Prediction:
    """What healthy cells would do in each of n stretches, given the trusted cells.

    Attributes:
        never: float ``[n, D]``, P(unloaded throughout).
        always: float ``[n, D]``, P(loaded throughout).
        mean: float ``[n, D]``, expected mean root load.
        spread: float ``[D]``, scale of the error of ``mean``; NaN: cells of which nothing is known.
        own: float ``[D]``, how far all that is of the very cell, and not of any that is surrounded alike, 0 to 1.
    """

    never: NDArray[np.float64]
    always: NDArray[np.float64]
    mean: NDArray[np.float64]
    spread: NDArray[np.float64]
    own: NDArray[np.float64]

    def on(self, excerpts: NDArray[np.bool_] | slice, cells: NDArray[np.intp] | slice = slice(None)) -> Prediction:
        """Return the same of some stretches and cells."""
        never, always, mean = (values[excerpts][:, cells] for values in (self.never, self.always, self.mean))
        return Prediction(never, always, mean, self.spread[cells], self.own[cells])

    def within(
        self,
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        cells: NDArray[np.intp],
        inflation: NDArray[np.float64] | float = 1.0,
    ) -> NDArray[np.float64]:
        """Return P(mean root load from ``low`` to ``high``), ``[n, k]``, of k ``cells``; the bounds are ``[k]``.

        ``inflation``: how many times as far as usual loads are off in each stretch, ``[n]``.
        """
        mean, spread = self.mean[:, cells], self.spread[cells] * np.reshape(inflation, (-1, 1))
        likely = _student_t((high - mean) / spread) - _student_t((low - mean) / spread)
        # Now and then a touch is like none before: then any load is as likely as any other.
        p = (1 - _NOVEL) * likely + _NOVEL * (np.minimum(high, 1.0) - low)
        return np.where(np.isnan(spread), 1.0, p)


def _student_t(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distribution function of Student's t with 4 degrees of freedom: objects have edges, edges surprise.

    In closed form, ten times as fast as the general one.
    """
    x = np.clip(x, -1e6, 1e6)
    u = x / np.sqrt(1 + x**2 / 4)
    return 0.5 + 0.375 * u * (1 - u**2 / 12)
