"""Calibration: log likelihood ratios to probabilities, fitted on faults injected into the
fault-free recordings.

Estimates, for each of three kinds of constant cells (never moved; came to rest; came to hold a
load),

    log odds = logit(prevalence) + a q + b spatial + d temporal

Raw ratios are overconfident, because events are few and correlated and models err at edges of
objects. The reference is split; models of one part diagnose logs made of the other part, with known
faults. Equals Platt scaling (Platt 1999), scikit-learn's
``CalibratedClassifierCV(method="sigmoid")``, with the default weights as prior means of b and d. q
is 1; in a cold start it is 0 for cells of which no event tells anything: these keep their prior.
The prevalence is not calibrated: it is estimated from each log by expectation maximisation (Saerens
et al. 2002). The faulty set is the largest one whose expected false discovery rate meets the limit
(:func:`faulty_at`). Faults unlike the injected ones are calibrated as well as these only by
assumption.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from diagnostics.events.tiles import MOST_CELLS
from diagnostics.evidence.drift import drift_counts
from diagnostics.evidence.reference import Reference
from diagnostics.evidence.spatial import Exclusion
from diagnostics.evidence.stream_state import StreamState
from diagnostics.faults import Fault, FaultKind
from diagnostics.healthy.calibration_subset import calibration_subset
from diagnostics.healthy.cross_fitting import FOLDS
from diagnostics.preprocessing.levels import (
    EXPECTED,
    EXPECTED_CELLS,
    EXPECTED_LATE,
    FEWEST,
    SUSPICIOUS,
)
from diagnostics.simulation.injection import inject

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

# simulated logs: sizes; large arrays have more cells in each
_LOGS = 192
_LOGS_OF_LARGE = 32
_LOG_SIZES = 1 << np.arange(4)  # recordings in each, in turn
_DEAD_SHARES = 0.04 * _LOG_SIZES  # of the cells, in turn
_ENOUGH = 100  # recordings that are held out in all, over the splits
_FEW = 32  # recordings: fewer are cut into pieces, so that one long recording can be split
_PIECE = 100  # frames of a piece, at least
# of fitting a reference, in diagnoses of a simulated log; for the progress only
_REFERENCE_TIME = 50
_MOST_FRAMES = 600  # of a recording in one simulated log: a size
# of the slopes; recordings held out that halve it (one split)
_MAX_DISCOUNT = 0.5
_HALF_DISCOUNT = 22.0
_PRIOR_VARIANCE = 10.0  # of the weights
_CLIP = 6.0  # raw log ratios are clipped here for the fit: outliers must not steer the slope

Floats = NDArray[np.float64]


class _Trial(NamedTuple):
    """Evidence of the constant cells of a simulated log, ``[n]`` each, and of drift of the working
    cells."""

    kind: NDArray[np.intp]
    ratio: Floats
    temporal: Floats
    broken: NDArray[np.bool_]
    offset: float  # the highest log evidence of an offset
    gain: float  # the same, of another gain


@dataclass(frozen=True)
class Calibrator:
    """Calibrated log ratio of each kind of constant cell; the defaults are those of too few
    recordings to fit any.

    Kind 0 never moved in the log, kind 1 came to rest, kind 2 came to hold a load.

    Attributes:
        offset: a, by kind.
        slope: b, by kind.
        temporal: d, by kind.
        gains: factor on the evidence of a changed gain.
        baselines: the same, of an offset.
    """

    offset: tuple[float, ...] = (0.0, -1.0, -1.0)
    slope: tuple[float, ...] = (0.6, 0.6, 0.6)
    temporal: tuple[float, ...] = (1.0, 0.5, 0.5)
    gains: float = 1.0
    baselines: float = 1.0

    @classmethod
    def cold(cls) -> Calibrator:
        """Return the calibration of a cold start; kind 3 never moved and holds a load.

        That of kind 0 is fitted to simulated grasps and postures
        (``benchmarks/cold_calibration.py``).
        """
        return cls((-1.4, -1.0, -1.0, 0.0), (1.0, 0.6, 0.6, 0.6), (1.0, 0.5, 0.5, 1.0))

    @classmethod
    def fit(
        cls,
        recordings: Sequence[Floats],
        layout: SensorLayout,
        *,
        progress: Callable[[float], None] = lambda share: None,
    ) -> Calibrator:
        """Fit to fault-free recordings, ``[T, D]`` each; fewer than 8 give the defaults.

        ``progress`` receives the share of the work that is done, 0 to 1.
        """
        rng = np.random.default_rng(0)
        n_logs = _LOGS if layout.present.sum() <= MOST_CELLS else _LOGS_OF_LARGE
        recordings, layout = calibration_subset(recordings, layout)
        cuts = -(-_FEW // len(recordings)) if recordings else 0
        # Pieces of one recording are correlated: they stay on the same side of a split.
        recordings = [
            piece
            for i in rng.permutation(len(recordings)).tolist()
            for piece in np.array_split(
                recordings[i], np.clip(len(recordings[i]) // _PIECE, 1, cuts)
            )
        ]
        if len(recordings) < FEWEST:
            return cls()
        order = np.arange(len(recordings))
        n_training = round((FOLDS - 1) / FOLDS * len(order))  # the others make the simulated logs
        held_out = len(order) - n_training
        # Repeated splits, more with fewer recordings: so unusual events are held out at least once.
        turns = max(2, min(len(order), _ENOUGH) // held_out)
        parts = [np.split(np.roll(order, k * held_out), [n_training]) for k in range(turns)]
        stages = (n_logs // 3, n_logs)
        n_steps = _REFERENCE_TIME * turns + sum(stages)
        references = []
        for k, (those, _) in enumerate(parts, 1):
            references.append(Reference.fit([recordings[i] for i in those], layout))
            progress(_REFERENCE_TIME * k / n_steps)
        logs = []
        for i in range(n_logs):
            turn = (i + i // len(_LOG_SIZES)) % turns
            size = min(int(_LOG_SIZES[i % len(_LOG_SIZES)]), held_out)
            drawn = rng.choice(parts[turn][1], size, replace=False).tolist()
            log = np.concatenate([_excerpt(recordings[j], rng) for j in drawn])
            share = float(_DEAD_SHARES[i // len(_LOG_SIZES) % len(_DEAD_SHARES)])
            onset = int(rng.uniform(0, 0.8) * len(log)) if i % 2 else None
            logs.append((log, _random_faults(layout, share, onset, rng), layout, references[turn]))
        # Evidence depends on the exclusion threshold and that on the calibration: fit roughly, then
        # with all logs.
        weights = default = cls()
        done = _REFERENCE_TIME * turns
        for n in stages:
            trials = []
            for simulated in logs[:n]:
                trials.append(
                    _trial(*simulated, weights.exclusion._replace(baselines=1.0, gains=1.0))
                )
                done += 1
                progress(done / n_steps)
            weights = cls._of(trials)
        # Few held-out recordings contain few unusual events; repeated splits are correlated and
        # count for less.
        counts = 1 - _MAX_DISCOUNT / (1 + turns * (held_out / _HALF_DISCOUNT) ** 2)
        measured = np.array(weights.slope) != default.slope
        slope = np.where(measured, counts * np.array(weights.slope), weights.slope)
        return replace(weights, slope=tuple(slope.tolist()))

    @classmethod
    def _of(cls, trials: Sequence[_Trial]) -> Calibrator:
        """Fit to simulated logs; a kind with too few broken or healthy cells keeps the defaults."""
        *measured, offset_reached, gain_reached = zip(*trials, strict=True)
        kind, ratio, temporal, dead = (np.concatenate(column) for column in measured)
        kind = np.where(kind == 3, 0, kind)
        evidence = np.column_stack([np.clip(ratio, -_CLIP, _CLIP), temporal])
        default = cls()
        found = list(zip(default.offset, default.slope, default.temporal, strict=True))
        for k in range(len(found)):
            of = kind == k
            same_origin = (kind > 0) == (k > 0)
            if min(dead[of].sum(), (~dead[of]).sum()) >= FEWEST:
                base = float(logit(dead[same_origin].mean()))
                found[k] = _bounded_logistic(evidence[of], dead[of], base, found[k][1:])
        offset, slope, temporal_share = zip(*found, strict=True)
        baselines, gains = drift_counts(max(offset_reached), max(gain_reached))
        return cls(offset, slope, temporal_share, gains, baselines)

    @property
    def exclusion(self) -> Exclusion:
        """The raw log ratio from which on a cell is excluded from the predictors, and the factors
        of drift."""
        return Exclusion(
            (SUSPICIOUS - self.offset[0]) / max(self.slope[0], 1e-9), self.baselines, self.gains
        )

    def calibrate(
        self,
        ratio: Floats,
        temporal: Floats,
        kind: NDArray[np.intp],
        tested: NDArray[np.bool_] | bool = True,
    ) -> Floats:
        """Return the calibrated log likelihood ratio faulty : healthy, ``[D]``.

        Args:
            ratio: float ``[D]``, spatial log likelihood ratio stuck : healthy.
            temporal: float ``[D]``, temporal log likelihood ratio.
            kind: int ``[D]``, see the class.
            tested: bool ``[D]``, of which cells the events tell anything, q.
        """
        known = np.where(kind < len(self.slope), kind, 0)
        offset, slope, share = (
            np.array(of)[known] for of in (self.offset, self.slope, self.temporal)
        )
        log_ratio: Floats = offset * tested + slope * ratio + share * temporal
        return log_ratio

    def probability(
        self, log_ratio: Floats, kind: NDArray[np.intp], scored: NDArray[np.bool_]
    ) -> Floats:
        """Return P(stuck), ``[D]``.

        Args:
            log_ratio: float ``[D]``, calibrated log likelihood ratio.
            kind: int ``[D]``, see the class.
            scored: bool ``[D]``, constant cells; the others move: 0.
        """
        probability = np.zeros(len(log_ratio))
        began = (kind == 1) | (kind == 2)  # its run within the log
        late = scored & began
        early = scored & ~began
        probability[late] = _posterior(log_ratio[late], EXPECTED_LATE, EXPECTED_CELLS)
        # Cells that never moved failed before the log, or in it at the same rate as cells that
        # moved.
        broke = probability[late].sum() / (began.sum() + EXPECTED_CELLS)
        probability[early] = _posterior(log_ratio[early], EXPECTED + float(broke), EXPECTED_CELLS)
        return probability


def _posterior(log_ratio: Floats, expected: float, cells: float) -> Floats:
    """Return P(faulty) ``[n]``; prevalence by EM, with the prior share ``expected`` worth ``cells``
    cells."""
    share = expected
    for _ in range(100):
        posterior = expit(log_ratio + logit(share))
        share, before = (posterior.sum() + expected * cells) / (len(log_ratio) + cells), share
        if abs(share - before) < 1e-6:
            break
    probability: Floats = expit(log_ratio + logit(share))
    return probability


def _bounded_logistic(
    evidence: Floats, dead: NDArray[np.bool_], base: float, expected: Sequence[float]
) -> tuple[float, float, float]:
    """Return a, b and d of a logistic regression with a <= 0, b >= 0, 0 <= d <= 1.

    Without evidence the log ratio is never above 0, however few healthy cells a small reference has
    in this state. Where one kind of evidence tells all cells apart, the other keeps about its
    expected weight.

    Args:
        evidence: ``[n, 2]``, spatial and temporal log ratio.
        dead: bool ``[n]``.
        base: log odds of a fault in these logs.
        expected: b and d beforehand.
    """
    from scipy.optimize import minimize

    x = np.column_stack([np.ones(len(evidence)), evidence])
    beforehand = np.array([0.0, *expected])

    def loss(weights: Floats) -> tuple[float, Floats]:
        odds = base + x @ weights
        residual = expit(odds) - dead
        differs = np.where([False, True, True], weights - beforehand, 0.0)
        value = (
            np.logaddexp(0, odds).sum()
            - odds[dead].sum()
            + 0.5 * (differs @ differs) / _PRIOR_VARIANCE
        )
        return float(value), x.T @ residual + differs / _PRIOR_VARIANCE

    bounds = [(None, 0.0), (0.0, None), (0.0, 1.0)]  # a jump alone proves no fault
    offset, slope, temporal = minimize(loss, [0.0, 1.0, 0.5], jac=True, bounds=bounds).x.tolist()
    return offset, slope, temporal


def _excerpt(recording: Floats, rng: np.random.Generator) -> Floats:
    """Return a recording ``[T, D]``, or a random part of a long one."""
    begin = int(rng.integers(len(recording) - _MOST_FRAMES)) if len(recording) > _MOST_FRAMES else 0
    return recording[begin : begin + _MOST_FRAMES]


def kinds(stream: StreamState) -> NDArray[np.intp]:
    """Return the kind of each cell, ``[D]``, see :class:`Calibrator`."""
    rests = stream.rests()
    return np.where(stream.runs.moved, np.where(rests, 1, 2), np.where(rests, 0, 3))


def _trial(
    log: Floats,
    faults: Sequence[Fault],
    layout: SensorLayout,
    reference: Reference,
    exclusion: Exclusion,
) -> _Trial:
    """Return the evidence of a log with ``faults`` injected."""
    stream = StreamState(layout, reference, exclusion)
    stream.extend(inject(log, faults, layout))
    stream = stream.complete()
    spatial = stream.spatial()
    broken = np.zeros(layout.n_cells, bool)
    broken[[c for fault in faults for c in fault.cells]] = True
    scored = spatial.scored
    offset, gain = (
        float(np.where(broken, 0.0, evidence).max()) for evidence in (spatial.offset, spatial.gain)
    )
    constant = (
        kinds(stream)[scored],
        spatial.evidence[scored],
        stream.temporal()[scored],
        broken[scored],
    )
    return _Trial(*constant, offset, gain)


def faulty_at(probability: Floats, false_discovery_rate: float) -> NDArray[np.bool_]:
    """Return the faulty set at a Bayesian false discovery rate, bool ``[D]`` (Newton et al. 2004).

    Cells are taken in order of P(faulty) while the expected number of false ones, sum(1 - P), is as
    near as possible to rate times size: an excess is accepted up to the shortfall before it,
    because sets are small and always stopping below would meet only a fraction of the rate. The
    first cell must meet the rate, and each has P(faulty) > 0.5.
    """
    order = np.argsort(-probability, kind="stable")
    false = np.cumsum(1 - probability[order])  # expected among the first 1, 2, ...
    accepted = false_discovery_rate * np.arange(1, len(order) + 1)
    excess = false - accepted
    shortfall = accepted - np.concatenate([[0.0], false[:-1]])
    shortfall[:1] = 0.0
    within = np.logical_and.accumulate(excess <= np.maximum(shortfall, 0.0))
    chosen = np.zeros(len(probability), bool)
    chosen[order[within]] = True
    return chosen & (probability > 0.5)


def _random_faults(
    layout: SensorLayout, share: float, onset: int | None, rng: np.random.Generator
) -> list[Fault]:
    """Draw stuck cells: a third open, a third short, a third at any value."""
    cells = np.flatnonzero(layout.present)
    count = max(1, round(share * len(cells)))
    kinds = rng.choice([FaultKind.OPEN, FaultKind.SHORT, FaultKind.STUCK], count)
    values = rng.uniform(0, layout.full_scale, count)
    return [
        Fault(
            kind, (int(cell),), value=float(value) if kind == FaultKind.STUCK else None, onset=onset
        )
        for cell, kind, value in zip(
            rng.choice(cells, count, replace=False), kinds, values, strict=True
        )
    ]
