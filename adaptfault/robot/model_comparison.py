"""Comparison of a candidate with the running model on held-out windows with the known faults
injected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.determination import explained
from adaptfault.data.windows import Windows
from adaptfault.evaluation.class_recall import ClassRecall, class_recalls
from diagnostics import Fault, SensorLayout, inject

Predict = Callable[[NDArray[np.float32]], NDArray[Any]]

_DRAWS = 2000
_CONFIDENCE = 0.95  # share of the bootstrap draws that must agree
_COLLAPSE = 0.5  # a class or value collapses when it keeps less than this share of its score


@dataclass(frozen=True)
class Judgement:
    """Accuracy of a candidate and of the running model under the same faults; R2 of a regression.

    Attributes:
        running, candidate: accuracies, or R2.
        gain: candidate - running.
        low, high: 5 % and 95 % quantiles of the gain, paired bootstrap over recordings.
        collapsed: classes of which the candidate keeps less than half of the running model's
            recall; values of which it keeps less than half of the R2.
        measure: "accuracy" or "R2".
        recalls: of the running model, each class with a 95 % interval; none of a regression.
    """

    running: float
    candidate: float
    gain: float
    low: float
    high: float
    collapsed: tuple[int, ...]
    measure: str = "accuracy"
    recalls: tuple[ClassRecall, ...] = field(default=(), repr=False)

    @property
    def better(self) -> bool:
        """Whether the lower limit of the gain is positive."""
        return self.low > 0

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict, without the recalls."""
        return {name: value for name, value in vars(self).items() if name != "recalls"}

    def __str__(self) -> str:
        return (
            f"{self.measure} under these faults: running {self.running:.3f}, candidate"
            f" {self.candidate:.3f} (gain {self.gain:+.3f}, 90 % interval {self.low:+.3f} to"
            f" {self.high:+.3f})"
        )


def with_faults(
    windows: Windows, faults: Sequence[Fault], layout: SensorLayout, *, seed: int = 0
) -> Windows:
    """Return fault-free windows with these faults injected from the first frame on."""
    x = np.empty_like(windows.x)
    always = [Fault(f.kind, f.cells, line=f.line, value=f.value) for f in faults]  # no onset
    for number in np.unique(windows.recording):
        of_it = windows.recording == number
        frames = windows.x[of_it].reshape(-1, windows.x.shape[2]) * layout.full_scale
        broken = inject(frames, always, layout, seed=seed + int(number)) / layout.full_scale
        x[of_it] = broken.reshape(windows.x[of_it].shape)
    return replace(windows, x=x)


def measure_of(windows: Windows) -> str:
    """Return what models are compared by on these windows: "accuracy", or "R2" of values."""
    return "R2" if windows.y.ndim == 2 else "accuracy"


def score(predict: Predict, windows: Windows) -> float:
    """Return the accuracy of predictions for labelled windows, or R2 of values."""
    return float(_of_windows(windows.y, predict(windows.x)).mean())


def _of_windows(y: NDArray[Any], predicted: NDArray[Any]) -> NDArray[np.float64]:
    """Return the share of each window in the accuracy or R2, ``[N]``; the mean is the score."""
    if y.ndim == 2:
        shares: NDArray[np.float64] = explained(y, predicted).mean(axis=1)
        return shares
    return np.asarray(predicted == y, dtype=np.float64)


def compare_candidate(
    running: Predict, candidate: Predict, windows: Windows, *, seed: int = 0
) -> Judgement:
    """Compare two classifiers or regressions on labelled windows with injected faults.

    Paired bootstrap over recordings, because windows of one recording are dependent (Efron and
    Tibshirani 1993)."""
    predicted = running(windows.x), candidate(windows.x)
    # [2, N]
    right = np.stack([_of_windows(windows.y, given) for given in predicted])
    recordings, inverse = np.unique(windows.sources, return_inverse=True)
    size = np.bincount(inverse).astype(float)
    won = np.bincount(inverse, weights=right[1] - right[0])
    rng = np.random.default_rng(seed)
    drawn = rng.integers(len(recordings), size=(_DRAWS, len(recordings)))
    gains = won[drawn].sum(axis=1) / size[drawn].sum(axis=1)
    low, high = np.quantile(gains, [1 - _CONFIDENCE, _CONFIDENCE])
    return Judgement(
        running=float(right[0].mean()),
        candidate=float(right[1].mean()),
        gain=float(right[1].mean() - right[0].mean()),
        low=float(low),
        high=float(high),
        collapsed=_collapsed(predicted, windows.y, inverse, drawn),
        measure=measure_of(windows),
        recalls=_recalls(predicted[0], windows),
    )


def _recalls(predicted: NDArray[Any], windows: Windows) -> tuple[ClassRecall, ...]:
    if windows.y.ndim == 2:
        return ()
    return class_recalls(windows.y, predicted, windows.sources, new=np.inf)


def _collapsed(
    predicted: Sequence[NDArray[Any]],
    y: NDArray[Any],
    inverse: NDArray[np.intp],
    drawn: NDArray[np.intp],
) -> tuple[int, ...]:
    """Return the classes whose recall, or the values whose R2, is more than halved in at least 95 %
    of the bootstrap draws.

    An R2 below 0 has not to be kept: there the candidate collapses if it is worse.
    """
    collapsed = []
    every = np.ones(len(y), dtype=bool)
    for part in range(y.shape[1]) if y.ndim == 2 else np.unique(y):
        of_it = every if y.ndim == 2 else y == part
        column = [part] if y.ndim == 2 else slice(None)
        reached = []
        for given in predicted:
            weights = _of_windows(y[of_it][..., column], given[of_it][..., column])
            summed = np.bincount(inverse[of_it], weights, drawn.shape[1])
            reached.append(summed[drawn].sum(axis=1))
        before, after = reached
        if (after < np.minimum(before, _COLLAPSE * before)).mean() >= _CONFIDENCE:
            collapsed.append(int(part))
    return tuple(collapsed)
