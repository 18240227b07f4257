"""Self-diagnosis: gathers the evidence, weighs it, finds the root causes, and says what was not tested."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.causes import root_causes
from diagnostics.layout import SensorLayout
from diagnostics.reference import Expectation, NearestFrames, PooledNeighbourhood
from diagnostics.spatial import stuck_evidence
from diagnostics.temporal import last_runs
from diagnostics.verdicts import Diagnosis
from diagnostics.weighing import Weights, faulty_at

Recording = NDArray[np.float64]

_TOLERANCE = 0.005  # of full scale: how far a stuck cell's reading may wander, a converter's dither
_STEPS = 1.5  # and at least so many converter steps


class SelfDiagnosis:
    """Finds the cells that hold one value whatever touches them, and the wires behind them.

    Not detected yet: cells that move but wrongly (aliased addresses, intermittent contacts, excess noise, drift).

    Args:
        layout: the array.
        false_discovery_rate: expected share of healthy cells in F; at most this is accepted.

    Attributes:
        expectation_: what healthy looks like, after :meth:`fit`.
        weights_: what evidence is worth, after :meth:`fit`.
        tolerance_: how near to a value counts as that value, in the layout's unit.
    """

    expectation_: NearestFrames | None = None
    weights_: Weights = Weights()
    tolerance_: float | None = None

    def __init__(self, layout: SensorLayout, *, false_discovery_rate: float = 0.01) -> None:
        self.layout = layout
        self.false_discovery_rate = false_discovery_rate

    def fit(self, recordings: ArrayLike | Sequence[ArrayLike]) -> SelfDiagnosis:
        """Learn from fault-free recordings, ``[T, D]`` or a list of them, what healthy looks like.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame.
        """
        healthy = _recordings(recordings, self.layout)
        self.tolerance_ = _tolerance(healthy, self.layout)
        self.expectation_ = NearestFrames.fit(healthy, self.layout.full_scale, 2 * self.tolerance_)
        self.weights_ = Weights.fit(healthy, self.layout, self.tolerance_)
        return self

    def diagnose(self, recordings: ArrayLike | Sequence[ArrayLike]) -> Diagnosis:
        """Judge every cell from a log: recordings ``[T, D]`` or a list of them, in time order.

        Without :meth:`fit`, cells are judged by the cells around them in the same log.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame.
        """
        log = _recordings(recordings, self.layout)
        tolerance = self.tolerance_ or _tolerance(log, self.layout)
        present = self.layout.present.ravel()
        frames = np.concatenate(log)
        silent = present & np.isnan(frames).all(axis=0)  # never delivered a reading
        arrived = ~np.isnan(frames[:, present & ~silent]).all(axis=1)  # a lost frame is evidence of nothing
        kept = np.flatnonzero(arrived)
        lengths = [int(n.sum()) for n in np.split(arrived, np.cumsum([len(r) for r in log])[:-1])]
        frames = frames[arrived]
        if not len(frames):
            raise ValueError("the recordings hold no frame with a reading: nothing to diagnose")
        runs = last_runs(frames, tolerance)
        expectation: Expectation = self.expectation_ or PooledNeighbourhood(self.layout, frames)
        ratio = stuck_evidence(frames, lengths, runs, expectation, present & ~silent, self.layout.full_scale, tolerance)
        probability = np.where(silent, 1.0, self.weights_.probability(ratio, present & ~silent))
        faulty = faulty_at(probability, self.false_discovery_rate) | silent
        alive = present & ~faulty & runs.moved
        causes = root_causes(faulty, alive, silent, probability, runs, kept, self.layout, tolerance)
        for fault in causes:
            cells = list(fault.cells)
            probability[cells] = np.maximum(probability[cells], fault.probability or 0.0)
        return Diagnosis(
            layout=self.layout,
            faults=causes,
            probability=probability,
            tested=alive | faulty,
            n_frames=sum(len(r) for r in log),
            n_recordings=len(log),
        )


def _recordings(recordings: ArrayLike | Sequence[ArrayLike], layout: SensorLayout) -> list[Recording]:
    """Return recordings as a list of ``[T, D]``, T >= 1."""
    given: Any = recordings
    single = isinstance(given, np.ndarray) and (given.shape[1:] == layout.shape or given.ndim <= 2)
    checked = [layout.check_recording(r, f"recording {i}") for i, r in enumerate([given] if single else given)]
    checked = [r for r in checked if len(r)]
    if not checked:
        raise ValueError("no frames: expected recordings [T, D] with T >= 1")
    return checked


def _tolerance(recordings: Sequence[Recording], layout: SensorLayout) -> float:
    """Return how near to a value counts as that value: what a converter's dither needs, whatever its step."""
    sample = np.concatenate([r[:: max(1, len(r) // 20)].ravel() for r in recordings])
    steps = np.diff(np.unique(sample[np.isfinite(sample)]))
    steps = steps[steps > 1e-6 * layout.full_scale]  # what is finer is rounding
    step = float(steps.min()) if len(steps) else 0.0
    return max(_TOLERANCE * layout.full_scale, min(_STEPS * step, 2 * _TOLERANCE * layout.full_scale))
