"""Sets of classes that hold the true one with a stated probability, for this very F.

Split conformal prediction with the score 1 - p(true class) (least ambiguous sets, Sadinle et al.
2019), by recording: windows of one recording depend on each other, so each of the K validation
recordings has the weight 1 / (K + 1), shared by its windows, and a new recording the rest
(hierarchical conformal prediction, Lee, Barber and Willett 2023). The threshold is the 1 - alpha
quantile of these weighted scores, and a set holds each class with

    1 - p(class) <= threshold

For windows of a new recording that is exchangeable with the validation recordings, the set then
holds the true class with probability 1 - alpha or more, whatever the model is.

By class (Mondrian conformal prediction, Vovk et al. 2005), the threshold of a class comes from its
own K_c validation recordings alone, and the set then holds the true class of a window of class c
with probability 1 - alpha or more, for each c. A class with fewer than 1 / alpha - 1 recordings is
in every set.

The scores come from validation windows with F taken away, and from heads that were fitted without
them. What breaks the assumption: objects, grips or loads that validation does not have, a cell that
is dead and not in F, a sensor that has aged. With fewer than 1 / alpha recordings each set holds
all classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

ALPHA = 0.1
"""Share of wrong sets that :attr:`PredictionSets.size` is told for."""

_STEPS = 1000  # of the distribution that is stored


@dataclass(frozen=True, eq=False)
class PredictionSets:
    """The distribution of 1 - p(true class) over new recordings.

    Attributes:
        scores: float ``[n]``, ascending.
        weights: float ``[n]``, of each score; their sum is K / (K + 1).
        by_class: the distribution over new recordings of each class; none of a single class.
        size: mean number of classes in the sets of the validation windows, at alpha = 0.1; None:
            unknown.
    """

    scores: NDArray[np.float64]
    weights: NDArray[np.float64]
    by_class: tuple[PredictionSets, ...] = ()
    size: float | None = None

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
        likely = np.asarray(likely, dtype=np.float64)
        known = y >= 0
        whole = cls._of(likely[known], y[known], recording[known])
        by_class = []
        for label in range(likely.shape[1]):
            of_it = y == label
            by_class.append(cls._of(likely[of_it], y[of_it], recording[of_it]))
        size = float(whole.sets(likely, ALPHA).sum(axis=1).mean()) if known.any() else None
        return replace(whole, by_class=tuple(by_class), size=size)

    @classmethod
    def _of(
        cls, likely: NDArray[np.float64], y: NDArray[np.int64], recording: NDArray[np.int64]
    ) -> PredictionSets:
        """Return the distribution over recordings, of windows that have a class."""
        _, inverse, counts = np.unique(recording, return_inverse=True, return_counts=True)
        weights = 1.0 / ((len(counts) + 1) * counts[inverse])
        scores = 1.0 - likely[np.arange(len(y)), y]
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

    def sets(self, likely: NDArray[Any], alpha: float, by_class: bool = False) -> NDArray[np.bool_]:
        """Return the sets, bool ``[N, n_classes]``, for probabilities ``[N, n_classes]``.

        Args:
            likely: the probabilities.
            alpha: the share of windows whose true class may be missing, between 0 and 1.
            by_class: of the windows of each class, and not only of all.

        Raises:
            ValueError: ``alpha`` is not between 0 and 1, or nothing is stored of the classes.
        """
        if by_class and not self.by_class:
            raise ValueError("sets by class need validation by class, which was not stored here")
        of_class = [one.threshold(alpha) for one in self.by_class] if by_class else []
        threshold = np.array(of_class) if by_class else self.threshold(alpha)
        inside: NDArray[np.bool_] = 1.0 - np.asarray(likely, np.float64) <= threshold
        return inside

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict of at most some thousand numbers: neighbouring scores are joined
        into the highest of them, so that sets get no smaller."""
        reached = np.cumsum(self.weights)
        step = np.append(np.floor(reached * _STEPS), np.inf)
        last = np.flatnonzero(np.diff(step))
        total = reached[last]
        d: dict[str, Any] = {
            "scores": self.scores[last].tolist(),
            "weights": np.diff(total, prepend=0.0).tolist(),
        }
        if self.by_class:
            d["by_class"] = [one.to_dict() for one in self.by_class]
        return d if self.size is None else d | {"size": self.size}

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
        size = d.get("size")
        return cls(
            scores,
            weights,
            tuple(cls.from_dict(one) for one in d.get("by_class", ())),
            None if size is None else float(size),
        )
