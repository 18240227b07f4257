"""Sets of classes that hold the true one with a stated probability, for this very F.

Split conformal prediction with the score 1 - p(true class) (least ambiguous sets, Sadinle et al.
2019), by recording: windows of one recording depend on each other, so each of the K validation
recordings has the weight 1 / (K + 1), shared by its windows, and a new recording the rest
(hierarchical conformal prediction, Lee, Barber and Willett 2023). The threshold is the 1 - alpha
quantile of these weighted scores, and a set holds each class with

    1 - p(class) <= threshold

For windows of a new recording that is exchangeable with the validation recordings, the set then
holds the true class with probability 1 - alpha or more, whatever the model is.

The scores come from validation windows with F taken away, and from heads that were fitted without
them. What breaks the assumption: objects, grips or loads that validation does not have, a cell that
is dead and not in F, a sensor that has aged. With fewer than 1 / alpha recordings each set holds
all classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_STEPS = 1000  # of the distribution that is stored


@dataclass(frozen=True, eq=False)
class PredictionSets:
    """The distribution of 1 - p(true class) over new recordings.

    Attributes:
        scores: float ``[n]``, ascending.
        weights: float ``[n]``, of each score; their sum is K / (K + 1).
    """

    scores: NDArray[np.float64]
    weights: NDArray[np.float64]

    @classmethod
    def fit(
        cls, likely: NDArray[Any], y: NDArray[np.int64], recording: NDArray[np.int64]
    ) -> PredictionSets:
        """Estimate from held-out windows.

        Args:
            likely: probabilities ``[N, n_classes]`` by a model that was fitted without the window.
            y: class of each window ``[N]``; those without one, -1, are left out.
            recording: of each window ``[N]``.
        """
        known = np.flatnonzero(y >= 0)
        _, inverse, counts = np.unique(recording[known], return_inverse=True, return_counts=True)
        weights = 1.0 / ((len(counts) + 1) * counts[inverse])
        scores = 1.0 - np.asarray(likely, dtype=np.float64)[known, y[known]]
        order = np.argsort(scores, kind="stable")
        return cls(scores[order], weights[order])

    def threshold(self, alpha: float) -> float:
        """Return the highest score of a class that is in the set; infinite where validation has too
        few recordings.

        Raises:
            ValueError: ``alpha`` is not between 0 and 1.
        """
        if not 0 < alpha < 1:
            raise ValueError(f"alpha is the share of wrong sets, between 0 and 1; got {alpha}")
        reached = np.cumsum(self.weights)
        place = int(np.searchsorted(reached, 1 - alpha - 1e-12))
        return float(self.scores[place]) if place < len(self.scores) else np.inf

    def sets(self, likely: NDArray[Any], alpha: float) -> NDArray[np.bool_]:
        """Return the sets, bool ``[N, n_classes]``, for probabilities ``[N, n_classes]``.

        Raises:
            ValueError: ``alpha`` is not between 0 and 1.
        """
        inside: NDArray[np.bool_] = 1.0 - np.asarray(likely, np.float64) <= self.threshold(alpha)
        return inside

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict of at most some thousand numbers: neighbouring scores are joined
        into the highest of them, so that sets get no smaller."""
        reached = np.cumsum(self.weights)
        step = np.append(np.floor(reached * _STEPS), np.inf)
        last = np.flatnonzero(np.diff(step))
        total = reached[last]
        return {
            "scores": self.scores[last].tolist(),
            "weights": np.diff(total, prepend=0.0).tolist(),
        }

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> PredictionSets:
        """Build from the dict of :meth:`to_dict`.

        Raises:
            KeyError, TypeError, ValueError: it is damaged.
        """
        scores = np.asarray(d["scores"], dtype=np.float64)
        weights = np.asarray(d["weights"], dtype=np.float64)
        if scores.ndim != 1 or scores.shape != weights.shape:
            raise ValueError("the scores of the sets of classes do not fit their weights")
        ordered = np.isfinite(scores).all() and (np.diff(scores) >= 0).all()
        if not ordered or not (weights >= 0).all():
            raise ValueError("the scores of the sets of classes are not in order")
        return cls(scores, weights)
