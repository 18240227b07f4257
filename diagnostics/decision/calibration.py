"""Turns evidence into probability: fitted on faults of our own making, injected into the fault-free recordings.

A raw log likelihood ratio is too sure of itself: touches are few and alike, and an object's edge surprises everyone. So
the reference is split, one part explains logs made of the other, with known faults in them, and a logistic
regression learns what a ratio is worth: for cells that never moved in the log, that came to rest, and that came to hold
a load. How common faults are is not learned there: it is estimated from the log at hand (empirical Bayes), because it
differs from one robot to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from diagnostics.events.tiles import MOST_CELLS
from diagnostics.evidence.drift import gains_count
from diagnostics.evidence.spatial import Exclusion
from diagnostics.evidence.stream_state import StreamState
from diagnostics.faults import Fault, FaultKind
from diagnostics.healthy.calibration_subset import calibration_subset
from diagnostics.healthy.reference import Reference
from diagnostics.simulation.injection import inject

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

_LOGS, _LOGS_OF_LARGE = 192, 32  # drawn to fit the weights; large arrays have more cells in each
_LOG_SIZES = (1, 2, 4, 8)  # recordings in each, in turn
_DEAD_SHARES = (0.04, 0.08, 0.16, 0.32)  # of the cells, in turn
_FEWEST_RECORDINGS = 8  # below that the reference cannot be split
_FEWEST_CELLS = 10  # broken and healthy, that teach what evidence is worth
_ENOUGH = 100  # recordings that are held out, in turn where need be
_FEW = 32  # recordings: fewer are cut, so that a single long one can be split too
_PIECE = 100  # frames that are left of one, at least
_MOST_FRAMES = 600  # of a recording in one log
_LEARNED_SHARE = 0.75  # of the recordings teach what healthy looks like, the others make the logs
_MOST_TEMPORAL = 1.0  # what temporal evidence may be worth, whatever the logs say: a jump alone proves nothing
_KINDS = 3
_LOADED_THROUGHOUT = 3  # a cell that never moved and holds a load: weighed as kind 0, but for what is beyond
_SUSPICIOUS = 2.8  # log likelihood ratio from which on a cell is left out when others are judged
_SUSPICIOUS_BOUNDS = 1.0, 8.0  # of the raw one
_DOUBT, _STRANGE = 0.5, 22.0  # so much of the evidence does not count where few recordings were held out, and how few
_LOOSE = 10.0  # variance of the weights before any log is seen
_ODD = 0.003  # of the healthy cells may be held for certain to be faulty: with all recordings the model errs less
_CLIP = 6.0  # log ratios beyond this say "certain"; they must not steer the fit
_SURE = 24.0  # and beyond this, not even more certain
_EXPECTED, _EXPECTED_LATE = 0.02, 0.005  # share of faulty cells before a log is seen: from the start, and in it
_EXPECTED_CELLS, _EXPECTED_CELLS_LATE = 35.0, 25.0  # worth so many cells
_MOVING_ODDS = -10.0  # log odds of a fault that holds one value, for a cell that moves

Floats = NDArray[np.float64]


class _Trial(NamedTuple):
    """What a log with known faults says of its still cells, ``[n]`` each, and of the gains of all that work."""

    kind: NDArray[np.intp]
    ratio: Floats
    temporal: Floats
    broken: NDArray[np.bool_]
    gain: float  # the highest log evidence of another gain


@dataclass(frozen=True)
class Calibrator:
    """What raw log likelihood ratios are worth, for each kind of still cell.

    Kind 0 never moved in the log, kind 1 came to rest, kind 2 came to hold a load. The defaults serve a cold start.

    Attributes:
        offset, slope, temporal: log odds = ``offset + slope * spatial ratio + temporal * temporal ratio``, before how
            common faults are; of each kind.
        beyond: the slope for as much of the spatial ratio as says "certain"; of cells of kind 0 that hold a load it
            is the slope, as ever: what expects too many loads is no reason to doubt them.
        gains: share of the evidence of another gain that counts.
    """

    offset: tuple[float, ...] = (0.0, -1.0, -1.0)
    slope: tuple[float, ...] = (0.6, 0.6, 0.6)
    temporal: tuple[float, ...] = (1.0, 0.5, 0.5)
    tail_slope: tuple[float, ...] = (0.6, 0.6, 0.6)
    gains: float = 1.0

    @classmethod
    def fit(cls, recordings: Sequence[Floats], layout: SensorLayout, *, seed: int = 0) -> Calibrator:
        """Fit on fault-free recordings, ``[T, D]`` each; too few of them give the defaults."""
        rng = np.random.default_rng(seed)
        n_logs = _LOGS if layout.present.sum() <= MOST_CELLS else _LOGS_OF_LARGE
        recordings, layout = calibration_subset(recordings, layout)
        cuts = -(-_FEW // len(recordings)) if recordings else 0
        # What one recording holds is alike: its pieces stay together, here as when others are held out.
        recordings = [
            piece
            for i in rng.permutation(len(recordings)).tolist()
            for piece in np.array_split(recordings[i], np.clip(len(recordings[i]) // _PIECE, 1, cuts))
        ]
        if len(recordings) < _FEWEST_RECORDINGS:
            return cls()
        order = np.arange(len(recordings))
        fit_stacking = round(_LEARNED_SHARE * len(order))
        held_out = len(order) - fit_stacking
        # Others are held out in turn, the more often the fewer there are: strange touches are among them the sooner.
        turns = max(2, min(len(order), _ENOUGH) // held_out)
        parts = [np.split(np.roll(order, k * held_out), [fit_stacking]) for k in range(turns)]
        references = [Reference.fit([recordings[i] for i in those], layout) for those, _ in parts]
        logs = []
        for i in range(n_logs):
            turn = (i + i // len(_LOG_SIZES)) % turns
            size = min(_LOG_SIZES[i % len(_LOG_SIZES)], held_out)
            drawn = rng.choice(parts[turn][1], size, replace=False).tolist()
            log = np.concatenate([_excerpt(recordings[j], rng) for j in drawn])
            share = _DEAD_SHARES[i // len(_LOG_SIZES) % len(_DEAD_SHARES)]
            onset = int(rng.uniform(0, 0.8) * len(log)) if i % 2 else None
            logs.append((log, _random_faults(layout, share, onset, rng), layout, references[turn]))
        # Evidence depends on who is suspected, and that on what evidence is worth: first roughly, then well.
        weights = default = cls()
        for n in (n_logs // 3, n_logs):
            weights = cls._of([_trial(*log, weights.exclusion._replace(gains=1.0)) for log in logs[:n]])
        # Few meet the strange touches; those held out in turn teach one another, and count for fewer.
        counts = 1 - _DOUBT / (1 + turns * (held_out / _STRANGE) ** 2)
        measured = np.array(weights.slope) != default.slope
        slope, tail_slope = (
            np.where(measured, counts * np.array(of), of) for of in (weights.slope, weights.tail_slope)
        )
        return replace(weights, slope=tuple(slope.tolist()), tail_slope=tuple(tail_slope.tolist()))

    @classmethod
    def _of(cls, trials: Sequence[_Trial]) -> Calibrator:
        """Fit on trials; a kind of which they hold too few broken or healthy cells keeps the defaults."""
        *measured, gain = zip(*trials, strict=True)
        kind, ratio, temporal, dead = (np.concatenate(column) for column in measured)
        evidence = np.column_stack([np.clip(ratio, -_CLIP, _CLIP), temporal])
        default = cls()
        found = list(zip(default.offset, default.slope, default.temporal, default.tail_slope, strict=True))
        for k in range(_KINDS):
            of, matching = kind % _KINDS == k, (kind % _KINDS > 0) == (k > 0)
            if min(dead[of].sum(), (~dead[of]).sum()) >= _FEWEST_CELLS:
                base = float(logit(dead[matching].mean()))
                fitted = _bounded_logistic(evidence[of], dead[of], base)
                if fitted[1] > 0:
                    these = kind == k
                    odds = base + fitted[0] + evidence[these] @ fitted[1:]
                    found[k] = (*fitted, _slope_beyond(ratio[these], odds, dead[these], fitted[1]))
        offset, slope, temporal_share, tail_slope = zip(*found, strict=True)
        return cls(offset, slope, temporal_share, tail_slope, gains_count(max(gain)))

    @property
    def exclusion(self) -> Exclusion:
        """The ratio from which on a cell is no longer asked about the others, and what gains are worth."""
        missing = _SUSPICIOUS - self.offset[0] - self.slope[0] * _CLIP  # where evidence says "certain"
        threshold = _CLIP + missing / (self.slope[0] if missing < 0 else max(self.tail_slope[0], 1e-9))
        return Exclusion(float(np.clip(threshold, *_SUSPICIOUS_BOUNDS)), self.gains)

    def calibrate(self, ratio: Floats, temporal: Floats, kind: NDArray[np.intp]) -> Floats:
        """Return the calibrated log likelihood ratio faulty : healthy, ``[D]``.

        Args:
            ratio: float ``[D]``, spatial log likelihood ratio stuck : healthy.
            temporal: float ``[D]``, temporal log likelihood ratio.
            kind: int ``[D]``, see the class.
        """
        weights = self.offset, self.slope, self.temporal, self.tail_slope
        offset, slope, share, tail_slope = (np.array(of)[kind % _KINDS] for of in weights)
        tail_slope = np.where(kind == _LOADED_THROUGHOUT, slope, tail_slope)
        certain = np.clip(ratio - _CLIP, 0.0, _SURE - _CLIP)
        calibrate: Floats = offset + slope * np.clip(ratio, -_SURE, _CLIP) + tail_slope * certain + share * temporal
        return calibrate

    def probability(self, calibrate: Floats, kind: NDArray[np.intp], scored: NDArray[np.bool_]) -> Floats:
        """Return P(holds one value for ever) ``[D]``, from what the evidence is worth.

        Only the cells that were ``scored`` (bool ``[D]``) are still; the others move, and are as good as alive.
        """
        probability = np.full(len(calibrate), float(expit(_MOVING_ODDS)))
        began = kind % _KINDS > 0  # to be still
        late, early = scored & began, scored & ~began
        probability[late] = _posterior(calibrate[late], _EXPECTED_LATE, _EXPECTED_CELLS_LATE)
        # Of the cells that never moved as many broke in the log as of those that did, or they were broken before.
        broke = probability[late].sum() / (began.sum() + _EXPECTED_CELLS)
        probability[early] = _posterior(calibrate[early], _EXPECTED + float(broke), _EXPECTED_CELLS)
        return probability


def _posterior(calibrate: Floats, expected: float, cells: float) -> Floats:
    """Return P(faulty) ``[n]``; the share of faulty cells is found in these, ``expected`` counts like so many more."""
    share = expected
    for _ in range(100):
        posterior = expit(calibrate + logit(share))
        share, before = (posterior.sum() + expected * cells) / (len(calibrate) + cells), share
        if abs(share - before) < 1e-6:
            break
    probability: Floats = expit(calibrate + logit(share))
    return probability


def _bounded_logistic(evidence: Floats, dead: NDArray[np.bool_], base: float) -> tuple[float, float, float]:
    """Return offset, slope and the weight of the temporal ratio of a logistic regression, within bounds.

    Evidence ``[n, 2]`` never speaks for what it speaks against, and none at all never speaks for a fault, however few
    healthy cells a small reference shows in this state.

    Args:
        evidence: spatial and temporal ratio.
        dead: bool ``[n]``.
        base: log odds of a fault, before the evidence; how common faults were in these logs.
    """
    bounds = [(None, 0.0), (0.0, None), (0.0, _MOST_TEMPORAL)]
    offset, slope, temporal = _logistic(evidence, dead, base, np.array([0.0, 1.0, 0.5]), bounds, _LOOSE)
    return offset, slope, temporal


def _slope_beyond(ratio: Floats, odds: Floats, dead: NDArray[np.bool_], default: float) -> float:
    """Return what as much of a ratio is worth as says more than "certain", 0 to ``default``.

    Args:
        ratio: ``[n]``, of cells of one kind.
        odds: log odds of a fault by all that is said up to there, ``[n]``.
        dead: bool ``[n]``.
        usual: what a ratio is worth up to there.
    """
    certain = ratio > _CLIP
    if np.count_nonzero(certain & ~dead) <= _ODD * np.count_nonzero(~dead):
        return default
    more = np.minimum(ratio[certain, None], _SURE) - _CLIP
    # That it is less certain than said is another matter than what more of it is worth.
    _, slope = _logistic(more, dead[certain], odds[certain], np.zeros(2), [(None, 0.0), (0.0, default)])
    return slope


def _logistic(
    evidence: Floats,
    dead: NDArray[np.bool_],
    base: Floats | float,
    start: Floats,
    bounds: Sequence[tuple[float | None, float | None]],
    loose: float = np.inf,
) -> list[float]:
    """Return offset and weights of a logistic regression, within ``bounds``.

    Args:
        evidence: ``[n, k]``.
        dead: bool ``[n]``.
        base: log odds before the evidence, of all or of each ``[n]``.
        start: ``[1 + k]``, where to begin.
        bounds: of each of these.
        loose: variance of the weights before any of it is seen.
    """
    from scipy.optimize import minimize

    x = np.column_stack([np.ones(len(evidence)), evidence])

    def loss(weights: Floats) -> tuple[float, Floats]:
        odds = base + x @ weights
        slack = expit(odds) - dead
        value = np.logaddexp(0, odds).sum() - odds[dead].sum() + 0.5 * (weights[1:] @ weights[1:]) / loose
        return float(value), x.T @ slack + np.array([0, *weights[1:]]) / loose

    found: list[float] = minimize(loss, start, jac=True, bounds=bounds).x.tolist()
    return found


def _excerpt(recording: Floats, rng: np.random.Generator) -> Floats:
    """Return a recording, ``[T, D]``, or part of a long one."""
    begin = int(rng.integers(len(recording) - _MOST_FRAMES)) if len(recording) > _MOST_FRAMES else 0
    return recording[begin : begin + _MOST_FRAMES]


def kinds(stream: StreamState) -> NDArray[np.intp]:
    """Return the kind of each cell, ``[D]``, see :class:`Calibrator`."""
    rests = stream.rests()
    return np.where(stream.runs.moved, np.where(rests, 1, 2), np.where(rests, 0, _LOADED_THROUGHOUT))


def _trial(
    log: Floats, faults: Sequence[Fault], layout: SensorLayout, reference: Reference, exclusion: Exclusion
) -> _Trial:
    """Return what is said when ``faults`` are in a log."""
    stream = StreamState(layout, reference, exclusion)
    stream.extend(inject(log, faults, layout))
    stream = stream.complete()
    spatial = stream.spatial().finish()
    broken = np.zeros(layout.n_cells, bool)
    broken[[c for fault in faults for c in fault.cells]] = True
    scored, gain = spatial.scored, float(np.where(broken, 0.0, spatial.gain).max())
    return _Trial(kinds(stream)[scored], spatial.evidence[scored], stream.temporal()[scored], broken[scored], gain)


def faulty_at(probability: Floats, false_discovery_rate: float) -> NDArray[np.bool_]:
    """Return the set of cells whose expected share of false alarms comes near to the rate, bool ``[D]``.

    Near, and not below: few cells are found in one log, each is a bigger step than the last, and to stop short of the
    rate every time would be to keep to a fraction of it: as far beyond it is as good. But the first keeps to it: most
    robots are healthy. No cell that is rather alive than faulty is in the set, however good the others look.
    """
    order = np.argsort(-probability, kind="stable")
    false = np.cumsum(1 - probability[order])  # expected among the first 1, 2, ...
    accepted = false_discovery_rate * np.arange(1, len(order) + 1)
    tail_slope, short = false - accepted, accepted - np.concatenate([[0.0], false[:-1]])
    short[:1] = 0.0
    within = np.logical_and.accumulate(tail_slope <= np.maximum(short, 0.0))
    chosen = np.zeros(len(probability), bool)
    chosen[order[within]] = True
    return chosen & (probability > 0.5)


def _random_faults(layout: SensorLayout, share: float, onset: int | None, rng: np.random.Generator) -> list[Fault]:
    """Draw stuck cells: a third open, a third short, a third at any value."""
    cells = np.flatnonzero(layout.present)
    count = max(1, round(share * len(cells)))
    kinds = rng.choice([FaultKind.OPEN, FaultKind.SHORT, FaultKind.STUCK], count)
    values = rng.uniform(0, layout.full_scale, count)
    return [
        Fault(kind, (int(cell),), value=float(value) if kind == FaultKind.STUCK else None, onset=onset)
        for cell, kind, value in zip(rng.choice(cells, count, replace=False), kinds, values, strict=True)
    ]
