"""Turns evidence into probability: fitted on faults of our own making, injected into the fault-free recordings.

The raw log likelihood ratio of ``spatial`` is too sure of itself: neighbours are few, frames are alike, and an object's
edge surprises everyone. So the reference is split, one half explains logs made of the other half, with known
faults in them, and a logistic regression learns what a ratio is worth. How common faults are is not learned there: it
is estimated from the log at hand (empirical Bayes), because it differs from one robot to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from diagnostics.faults import Fault, FaultKind
from diagnostics.injection import inject
from diagnostics.layout import SensorLayout
from diagnostics.reference import NearestFrames
from diagnostics.spatial import stuck_evidence
from diagnostics.temporal import last_runs

_LOGS = 24  # drawn to fit the weights
_LOG_SIZES = (1, 2, 4, 8)  # recordings in each, in turn
_DEAD_SHARE = 0.08
_FEWEST_RECORDINGS = 8  # below that the reference cannot be split
_PIECE = 100  # frames; longer recordings are cut, so that a single long one can be split too
_CLIP = 12.0  # log ratios beyond this say "certain"; they must not steer the fit
_EXPECTED_SHARE, _EXPECTED_CELLS = 0.02, 25.0  # faults expected before a log is seen: 2 %, worth 25 cells


@dataclass(frozen=True)
class Weights:
    """What a raw log likelihood ratio is worth: ``offset + slope * ratio``.

    The defaults serve a cold start; they were fitted in the same way, on 16 logs of simulated grasps.
    """

    offset: float = 0.0
    slope: float = 0.9

    @classmethod
    def fit(
        cls, recordings: Sequence[NDArray[np.float64]], layout: SensorLayout, tolerance: float, *, seed: int = 0
    ) -> Weights:
        """Fit on fault-free recordings, ``[T, D]`` each; too few of them give the defaults."""
        recordings = [piece for r in recordings for piece in np.array_split(r, max(1, len(r) // _PIECE))]
        if len(recordings) < _FEWEST_RECORDINGS:
            return cls()
        from sklearn.linear_model import LogisticRegression

        rng = np.random.default_rng(seed)
        order = rng.permutation(len(recordings))
        half = len(order) // 2
        expectation = NearestFrames.fit([recordings[i] for i in order[:half]], layout.full_scale, 2 * tolerance)
        ratios, dead = [], []
        for i in range(_LOGS):
            size = min(_LOG_SIZES[i % len(_LOG_SIZES)], len(order) - half)
            chosen = rng.choice(order[half:], size, replace=False)
            faults = _random_faults(layout, rng)
            parts = [inject(recordings[j], faults, layout) for j in chosen]
            log = np.nan_to_num(np.concatenate(parts))
            runs = last_runs(log, tolerance)
            present = layout.present.ravel()
            ratio = stuck_evidence(
                log, [len(p) for p in parts], runs, expectation, present, layout.full_scale, tolerance
            )
            judged = ratio != 0
            truth = np.zeros(layout.n_cells, bool)
            truth[[c for fault in faults for c in fault.cells]] = True
            ratios.append(ratio[judged])
            dead.append(truth[judged])
        x, y = np.clip(np.concatenate(ratios), -_CLIP, _CLIP), np.concatenate(dead)
        if y.all() or not y.any():
            return cls()
        model = LogisticRegression(C=10.0).fit(x[:, None], y)
        slope = float(model.coef_[0, 0])
        # The regression's offset holds how common faults were in its own logs: take that out again.
        offset = float(model.intercept_[0] - logit(y.mean()))
        return cls(offset, slope) if slope > 0 else cls()

    def probability(self, ratio: NDArray[np.float64], present: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return P(faulty) ``[D]`` for raw ratios ``[D]``, 0 where no cell is present.

        A ratio of exactly 0 means that the cell moved until the end: it is as good as alive.
        """
        weighed = np.where(ratio == 0, -_CLIP, self.offset + self.slope * ratio)[present]
        share = _EXPECTED_SHARE
        posterior = np.zeros(0)
        for _ in range(100):
            posterior = expit(weighed + logit(share))
            expected = posterior.sum() + _EXPECTED_SHARE * _EXPECTED_CELLS
            share, previous = expected / (len(posterior) + _EXPECTED_CELLS), share
            if abs(share - previous) < 1e-6:
                break
        probability = np.zeros(len(ratio))
        probability[present] = posterior
        return probability


def faulty_at(probability: NDArray[np.float64], false_discovery_rate: float) -> NDArray[np.bool_]:
    """Return the largest set of cells whose expected share of false alarms stays within the rate, bool ``[D]``.

    No cell that is rather alive than faulty is in it, however good the others look.
    """
    order = np.argsort(-probability, kind="stable")
    expected_false = np.cumsum(1 - probability[order]) / np.arange(1, len(order) + 1)
    chosen = np.zeros(len(probability), bool)
    chosen[order[expected_false <= false_discovery_rate]] = True
    return chosen & (probability > 0.5)


def _random_faults(layout: SensorLayout, rng: np.random.Generator) -> list[Fault]:
    """Draw stuck cells: a third open, a third short, a third at any value."""
    cells = np.flatnonzero(layout.present)
    count = max(1, round(_DEAD_SHARE * len(cells)))
    kinds = rng.choice([FaultKind.OPEN, FaultKind.SHORT, FaultKind.STUCK], count)
    return [
        Fault(kind, (int(cell),), value=float(rng.uniform(0, layout.full_scale)) if kind == FaultKind.STUCK else None)
        for cell, kind in zip(rng.choice(cells, count, replace=False), kinds, strict=True)
    ]
