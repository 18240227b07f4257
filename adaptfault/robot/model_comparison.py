"""Comparison of a candidate with the running model on held-out windows with the known faults
injected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.windows import Windows
from diagnostics import Fault, SensorLayout, inject

Predict = Callable[[NDArray[np.float32]], NDArray[np.int64]]

_DRAWS = 2000
_CONFIDENCE = 0.95  # share of the bootstrap draws that must agree
_COLLAPSE = 0.5  # a class collapses when it keeps less than this share of its recall


@dataclass(frozen=True)
class Judgement:
    """Accuracy of a candidate and of the running model under the same faults.

    Attributes:
        running, candidate: accuracies.
        gain: candidate - running.
        low, high: 5 % and 95 % quantiles of the gain, paired bootstrap over recordings.
        collapsed: classes of which the candidate keeps less than half of the running model's
            recall.
    """

    running: float
    candidate: float
    gain: float
    low: float
    high: float
    collapsed: tuple[int, ...]

    @property
    def better(self) -> bool:
        """Whether the lower limit of the gain is positive."""
        return self.low > 0

    def __str__(self) -> str:
        return (
            f"accuracy under these faults: running {self.running:.3f}, candidate"
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
    return Windows(x, windows.y, windows.recording)


def compare_candidate(
    running: Predict, candidate: Predict, windows: Windows, *, seed: int = 0
) -> Judgement:
    """Compare two classifiers on labelled windows with injected faults.

    Paired bootstrap over recordings, because windows of one recording are dependent (Efron and
    Tibshirani 1993)."""
    # [2, N]
    right = np.stack([running(windows.x) == windows.y, candidate(windows.x) == windows.y]).astype(
        float
    )
    recordings, inverse = np.unique(windows.recording, return_inverse=True)
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
        collapsed=_collapsed(right, windows.y, inverse, drawn),
    )


def _collapsed(
    right: NDArray[np.float64], y: NDArray[Any], inverse: NDArray[np.intp], drawn: NDArray[np.intp]
) -> tuple[int, ...]:
    """Return the classes whose recall is more than halved in at least 95 % of the bootstrap
    draws."""
    collapsed = []
    for label in np.unique(y):
        of_it = y == label
        kept = np.bincount(
            inverse[of_it],
            weights=right[1, of_it] - _COLLAPSE * right[0, of_it],
            minlength=drawn.shape[1],
        )
        if (kept[drawn].sum(axis=1) < 0).mean() >= _CONFIDENCE:
            collapsed.append(int(label))
    return tuple(collapsed)
