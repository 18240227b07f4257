"""Another sensor in some of the recordings: their cells rest and answer otherwise, each in its way.

Each recording has a signature: the low quantile of each cell, and the mean log ratio of its load to
what the model of the array expects from the other cells, less what the cells of the pad share. The
reference tells how signatures vary: the covariance of its low quantiles (Ledoit and Wolf 2004)
whitens them, and the variance of a cell's ratios weighs these. Two groups of recordings are found
by two-means, pad by pad. A recording is scored by the log likelihood ratio of the groups, learned
without it, in which one cell counts 4 at most. The log is of two sensors where

- each group has three recordings, half of them score 12 for it, and all together 192;
- the recordings of the reference belong to one group: what it shows itself now and then, as the
  rest of a pad beside one that is loaded, is no other sensor;
- most cells take part: either half of each group gives them the same differences, by a standard
  deviation of log 1.3 or 0.5 % of full scale (:mod:`diagnostics.sensor.recalibration`), or all
  cells of the pad rest 10 % of full scale apart, evenly;
- neighbours differ independently: what lies on the array is no sensor.

Where cells or wires are found faulty that another sensor would explain, less is enough
(:mod:`diagnostics.sensor.other_gains`).

Not detected: fewer than three recordings of a sensor, sensors that read alike, and gains where
thresholds leave few loaded cells in a recording.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.stats import median_abs_deviation
from sklearn.covariance import ledoit_wolf

from diagnostics.preprocessing.levels import CERTAIN_RATIO, FEWEST, LIGHT, MAJORITY, SLIGHT
from diagnostics.preprocessing.readings import complete
from diagnostics.sensor.gain import GAIN
from diagnostics.sensor.other_gains import outliers_of_others
from diagnostics.sensor.recalibration import (
    Fit,
    common_spread,
    neighbours_agree,
)
from diagnostics.sensor.rewiring import LIMIT
from diagnostics.when.recording_numbers import ranges

if TYPE_CHECKING:
    from diagnostics.evidence.reference import Reference
    from diagnostics.layout import SensorLayout

_FEWEST = 3  # recordings of a sensor
_PROVEN = 8 * LIMIT  # log likelihood ratio, all recordings together
_MOST = 4.0  # standard deviations, and log likelihood ratio, of one cell in one recording
_STRAY = 0.05  # share of the reference that may look like the other group
_AXES = 3  # principal axes along which groups are looked for: a size
_ROUNDS = 10  # of two-means: a size
_LEAST_RATIO = 0.05  # spread of the mean log ratio of a cell between recordings
_MOST_COMPARED = 64  # recordings of the reference: a size
_TINY = 1e-9

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class AnotherSensor:
    """Recordings of a log that come from another sensor than the others.

    Attributes:
        recordings: their numbers, from 0.
        of: number of recordings in the log.
        pads: whose cells differ.
        n_pads: number of pads of the array.
        gains: whether gains differ too, not the rests alone.
        is_certain: whether no other reason is known; else the cells of this one may have changed.
        unlike: cells that differ by more than those of another sensor.
    """

    recordings: tuple[int, ...]
    of: int
    pads: tuple[int, ...]
    n_pads: int
    gains: bool
    is_certain: bool = True
    unlike: tuple[int, ...] = ()

    @property
    def reason(self) -> str:
        """One sentence."""
        by = ""
        if len(self.pads) < self.n_pads:
            by = f" (by pad{'s' if len(self.pads) > 1 else ''} {', '.join(map(str, self.pads))})"
        what = f"another sensor{by}"
        if not self.gains:
            what += ", or from this one tared otherwise"
        if not self.is_certain:
            what += ", or from this one with many cells changed or touched otherwise,"
        if self.is_whole:
            return (
                f"the recordings come from {what} than the reference: cells are judged by what"
                " holds for any sensor; record healthy data with it and train anew"
            )
        return (
            f"recordings {ranges(self.recordings)} ({len(self.recordings)} of {self.of}) come from"
            f" {what}: they are left out, and cells judged by the others; keep recordings of two"
            " sensors apart"
        )

    @property
    def is_whole(self) -> bool:
        """Whether all recordings of the log come from it."""
        return len(self.recordings) == self.of

    def left_out(self, recordings: Sequence[NDArray[Any]]) -> list[NDArray[np.float64]]:
        """Return the log without readings in these recordings, ``[T, D]`` each."""
        return [
            np.full(frames.shape, np.nan) if i in self.recordings else frames
            for i, frames in enumerate(recordings)
        ]


def find_another_sensor(
    recordings: Sequence[NDArray[Any]],
    healthy: Sequence[NDArray[Any]],
    reference: Reference,
    layout: SensorLayout,
    excluded: Mask,
    *,
    suspect: bool = False,
    both_ways: bool = False,
) -> AnotherSensor | None:
    """Return which recordings of a log come from another sensor than the reference; None where the
    data do not tell.

    Args:
        recordings: of the log, loads ``[T, D]`` each; NaN = missing.
        healthy: those of the reference, likewise.
        reference: fitted to them.
        layout: the array.
        excluded: bool ``[D]``, cells that are faulty.
        suspect: cells or wires are found faulty that another sensor would explain.
        both_ways: load moves the readings up and down, so that their rests tell nothing.
    """
    if reference.model is None or not healthy:
        return None
    some = healthy[:: -(-len(healthy) // _MOST_COMPARED)]
    usual = complete(some, reference.scale.baseline)
    numbers = [i for i, one in enumerate(recordings) if np.isfinite(one).any()]
    log = complete([recordings[i] for i in numbers], reference.scale.baseline)
    if min(len(log), len(usual)) < FEWEST:
        return None
    used = layout.is_cell & (reference.dead == 0) & ~excluded
    fit = Fit.of(reference, layout, used, usual)
    both = _Readings.of([*usual, *log], len(usual), fit)
    pads = [_Pad.of(both, on, len(usual), fit) for on in fit.pads if (on & used).any()]
    other, differing = _split([] if both_ways else pads, len(log))
    foreign = [pad for pad in pads if not both_ways and pad.is_another(~other)]
    if foreign:  # so the others are, too
        differing = [pad for pad in pads if pad in foreign or pad in differing]
        other[:] = True
    if differing and not foreign:
        found = tuple(numbers[i] for i in np.flatnonzero(other))
        return AnotherSensor(found, len(recordings), *_of_pads(differing, other, layout))
    unlike = None
    if suspect:  # the pads that do not tell it by themselves
        told = {pad.number for pad in differing}
        rest = [one for i, one in enumerate(fit.pads) if i not in told]
        left = fit.used & np.any(rest, axis=0) if rest else np.zeros_like(fit.used)
        if left.any():
            unlike = outliers_of_others(both.ratio, both.precision, rest, left, len(usual))
    whole = tuple(range(len(recordings)))
    if unlike is not None:
        return AnotherSensor(
            whole,
            len(recordings),
            tuple(range(layout.pads)),
            layout.pads,
            gains=True,
            is_certain=bool(differing),
            unlike=tuple(np.flatnonzero(unlike).tolist()),
        )
    if not differing:
        return None
    return AnotherSensor(whole, len(recordings), *_of_pads(differing, other, layout))


def _of_pads(
    differing: Sequence[_Pad], other: Mask, layout: SensorLayout
) -> tuple[tuple[int, ...], int, bool]:
    """Return the numbers of pads, how many the array has, and whether gains differ."""
    gains = any(pad.gains_differ(pad.in_log(other), pad.usual) for pad in differing)
    return tuple(pad.number for pad in differing), layout.pads, gains


def _split(pads: Sequence[_Pad], n: int) -> tuple[Mask, list[_Pad]]:
    """Return which of ``n`` recordings of a log come from another sensor than the others, bool
    ``[n]``, and the pads that tell."""
    total = np.zeros(n)
    differing = []
    for pad in pads:
        scores = pad.split()
        if scores is not None:
            total += scores
            differing.append(pad)
    other = total > 0
    if not _enough(other, ~other):
        return np.zeros(n, bool), []
    return other, differing


@dataclass(frozen=True)
class _Readings:
    """What recordings tell of the cells.

    Attributes:
        low: ``[n, D]``, rest of the readings: low quantile, without the noise.
        ratio: ``[n, D]``, mean log ratio of the load above the rest to what is expected; 0:
            unknown.
        precision: ``[n, D]``, of ``ratio``; 0: unknown.
        rest, spread: ``[D]``, usual ``low``, and how far recordings are from it.
        rests: bool ``[D]``, cells that come to rest in each recording of the reference; elsewhere,
            contacts last as long as recordings.
    """

    low: Floats
    ratio: Floats
    precision: Floats
    rest: Floats
    spread: Floats
    rests: Mask

    @classmethod
    def of(cls, recordings: Sequence[Floats], n_usual: int, fit: Fit) -> _Readings:
        """Return it of recordings ``[T, D]``; the first ``n_usual`` are those of the
        reference."""
        low = np.stack([fit.rest([frames]) for frames in recordings])
        rest = np.array(np.median(low[:n_usual], axis=0))
        shared = np.zeros_like(low)
        for pad in fit.pads:
            if (pad & fit.used).any():
                of_pad: Floats = np.median((low - rest)[:, pad & fit.used], axis=1)
                shared[:, pad] = of_pad[:, None]
        own = low - rest - shared
        varies = median_abs_deviation(own[:n_usual], axis=0, scale="normal")
        rests: Mask = np.asarray(varies <= SLIGHT / 2 * fit.model.symbols.rest.full)
        size = max(2 * fit.reference.tolerance, SLIGHT / 10 * fit.layout.full_scale)
        away = median_abs_deviation(low[:n_usual], axis=0, scale="normal")
        spread: Floats = np.hypot(away, size)
        moved = shared + np.where(rests & (np.abs(own) > _MOST * spread), own, 0.0)
        loads = [frames - offset for frames, offset in zip(recordings, moved, strict=True)]
        return cls(low, *fit.by_recording(loads), rest, spread, rests)

    def among(self, some: Mask | slice) -> _Readings:
        """Return those of some recordings."""
        return replace(
            self, low=self.low[some], ratio=self.ratio[some], precision=self.precision[some]
        )

    def on(self, cells: NDArray[np.intp]) -> _Readings:
        """Return the same of some cells of a pad, with ratios less what these share."""
        ratio = self.ratio[:, cells]
        precision = self.precision[:, cells]
        total = np.maximum(precision.sum(axis=1, keepdims=True), _TINY)
        shared = (precision * ratio).sum(axis=1, keepdims=True) / total
        own = np.where(precision > 0, ratio - shared, 0.0)
        of_cells = self.rest[cells], self.spread[cells], self.rests[cells]
        return _Readings(self.low[:, cells], own, precision, *of_cells)


@dataclass(frozen=True)
class _Signatures:
    """Signatures of recordings: values and their precisions, ``[n, 2 cells]`` each."""

    value: Floats
    precision: Floats

    def scores(self, group: Mask, of: _Signatures | None = None) -> Floats:
        """Return the log likelihood ratio ``group`` (bool ``[n]``) : the others of each recording,
        learned without it, ``[n]``, or of other recordings."""
        each = of or self
        ratio = np.zeros(each.value.shape)
        known = each.precision > 0
        spread = 1 / np.maximum(each.precision, _TINY)
        for some, sign in ((group, 1.0), (~group, -1.0)):
            own = some[:, None] * self.precision if of is None else 0.0
            weight = self.precision[some].sum(axis=0) - own
            total = (self.precision[some] * self.value[some]).sum(axis=0) - own * each.value
            learned = weight > _TINY
            known = known & learned
            weight = np.where(learned, weight, 1.0)
            variance = spread + 1 / weight
            error = each.value - total / weight
            ratio -= sign * (error**2 / variance + np.log(variance)) / 2
        scores: Floats = np.where(known, np.clip(ratio, -_MOST, _MOST), 0.0).sum(axis=1)
        return scores

    def among(self, some: Mask | slice) -> _Signatures:
        """Return those of some recordings."""
        return _Signatures(self.value[some], self.precision[some])

    def starts(self) -> Iterator[Mask]:
        """Yield groups of recordings, bool ``[n]``, to begin with."""
        weighed = np.clip(self.value * np.sqrt(self.precision), -_MOST, _MOST)
        weighed -= weighed.mean(axis=0)
        n = len(weighed)
        _, axes = eigh(weighed @ weighed.T, subset_by_index=(max(0, n - _AXES), n - 1))
        for axis in axes.T[::-1]:
            yield axis > 0
            yield axis > np.median(axis)
        for share in (0.25, 0.5, 0.75):
            yield np.arange(n) >= share * n

    def settled(self, group: Mask) -> Mask:
        """Return groups of recordings, bool ``[n]``, once none changes sides any more."""
        for _ in range(_ROUNDS):
            if not _enough(group, ~group):
                break
            found = self.scores(group) > 0
            if (found == group).all():
                break
            group = found
        return group


@dataclass(frozen=True, eq=False)
class _Pad:
    """The recordings of a reference, ``[:n_usual]``, and of a log, as one pad shows them.

    Attributes:
        number: of the pad.
        cells: the cells that are compared, ``[cells]``.
        readings: of both.
        signatures: of both.
        n_usual: number of recordings of the reference.
        fit: of the reference.
    """

    number: int
    cells: NDArray[np.intp]
    readings: _Readings
    signatures: _Signatures
    n_usual: int
    fit: Fit

    @classmethod
    def of(cls, readings: _Readings, on: Mask, n_usual: int, fit: Fit) -> _Pad:
        """Return a pad; ``on``: its cells, bool ``[D]``."""
        cells = np.flatnonzero(on & fit.used)
        both = readings.on(cells)
        low = np.clip((both.low - both.rest) / both.spread, -_MOST, _MOST) * both.rests
        mean = _weighed(both.among(slice(n_usual)))
        given = (both.precision > 0) & np.isfinite(mean)
        error = 1 / np.maximum(both.precision, _TINY)
        ratio = np.where(given, both.ratio - mean, 0.0)
        beyond = np.where(given, ratio**2 - error, 0.0)[:n_usual].sum(axis=0)
        variance = np.maximum(beyond / np.maximum(given[:n_usual].sum(axis=0), 1), 0.0)
        precision = np.where(given, 1 / (error + variance + _LEAST_RATIO**2), 0.0)
        values = np.hstack([low @ _whitening(low[:n_usual]), ratio])
        precisions = np.hstack([np.ones(low.shape), precision])
        far = _MOST / np.sqrt(np.maximum(precisions, _TINY))
        signatures = _Signatures(np.clip(values, -far, far), precisions)
        return cls(int(fit.layout.pad_of[cells[0]]), cells, both, signatures, n_usual, fit)

    def split(self) -> Floats | None:
        """Return the scores of the recordings of the log, ``[n]``, positive where they come from
        another sensor than the reference; None: all come from one."""
        log = self.signatures.among(slice(self.n_usual, None))
        usual = self.signatures.among(slice(self.n_usual))
        found: dict[bytes, tuple[float, Floats]] = {}
        for start in log.starts():
            other = log.settled(start)
            if not _enough(other, ~other):
                continue
            scores = log.scores(other)
            of_usual = log.scores(other, usual)
            if np.median(of_usual) > 0:
                scores = -scores
                of_usual = -of_usual
            strays = (of_usual > 0).mean() > _STRAY or np.median(of_usual) > -CERTAIN_RATIO
            if not strays and _certain(scores, scores > 0):
                found[(scores > 0).tobytes()] = (float(np.abs(scores).sum()), scores)
        for _, scores in sorted(found.values(), key=lambda one: -one[0]):
            other = self.in_log(scores > 0)
            if self._differ(other, self.in_log(scores <= 0)):
                return scores
        return None

    def is_another(self, some: Mask) -> bool:
        """Return whether recordings of the log (bool ``[n]``) come from another sensor than the
        reference."""
        other = self.in_log(some)
        compared = other | self.usual
        if not _enough(other, self.usual):
            return False
        scores = self.signatures.among(compared).scores(other[compared])
        return _certain(scores, other[compared]) and self._differ(other, self.usual)

    @property
    def usual(self) -> Mask:
        """The recordings of the reference among all, bool ``[n]``."""
        return np.arange(len(self.readings.low)) < self.n_usual

    def in_log(self, some: Mask) -> Mask:
        """Return some recordings of the log, bool ``[n]``, among all."""
        return np.concatenate([np.zeros(self.n_usual, bool), some])

    def _differ(self, other: Mask, usual: Mask) -> bool:
        """Return whether most cells differ between recordings, by what matters, and not as under
        an object."""
        lows = [
            np.median(self.readings.low[one], axis=0) - np.median(self.readings.low[two], axis=0)
            for one, two in zip(_halves(other), _halves(usual), strict=True)
        ]
        of_cells = np.mean(lows, axis=0)
        uniform = self._is_uniform(of_cells)
        # What lies on cells loads neighbours alike.
        if not uniform and self._neighbours_agree(of_cells, self.readings.rests):
            return False
        spread = common_spread(lows[0], lows[1], self.readings.rests)
        most = self.readings.rests.mean() > MAJORITY
        rests = most and spread >= SLIGHT / 4 * self.fit.model.symbols.rest.full
        return uniform or rests or self.gains_differ(other, usual)

    def _neighbours_agree(self, values: Floats, known: Mask) -> bool:
        """Return whether values of neighbouring cells, ``[cells]``, are alike."""
        of_all = np.zeros(self.fit.layout.n_cells)
        of_all[self.cells] = values
        on = np.isin(np.arange(len(of_all)), self.cells[known])
        return neighbours_agree(of_all, on, self.fit.layout)

    def _is_uniform(self, offset: Floats) -> bool:
        """Return whether all cells that rest read more, or less, by as much: no load does that."""
        if self.readings.rests.mean() <= MAJORITY:
            return False
        of_cells = offset[self.readings.rests]
        shared = float(np.median(of_cells))
        even = np.abs(of_cells - shared).max() <= abs(shared) / 2
        return bool(even and abs(shared) >= 2 * LIGHT * self.fit.model.symbols.rest.full)

    def gains_differ(self, other: Mask, usual: Mask) -> bool:
        """Return whether the gains of most cells differ between recordings (bool ``[n]``)."""
        ratios = [
            _weighed(self.readings.among(one)) - _weighed(self.readings.among(two))
            for one, two in zip(_halves(other), _halves(usual), strict=True)
        ]
        known = np.isfinite(ratios[0]) & np.isfinite(ratios[1])
        if known.mean() <= MAJORITY:
            return False
        # Another object is pressed otherwise by neighbours.
        alike = self._neighbours_agree(np.mean(ratios, axis=0), known)
        return bool(not alike and common_spread(ratios[0], ratios[1], known) >= np.log(GAIN))


def _weighed(readings: _Readings) -> Floats:
    """Return the mean log ratio of each cell, ``[cells]``; NaN: unknown."""
    total = readings.precision.sum(axis=0)
    mean = (readings.precision * readings.ratio).sum(axis=0) / np.maximum(total, _TINY)
    return np.where(total > 0, mean, np.nan)


def _whitening(values: Floats) -> Floats:
    """Return the matrix ``[cells, cells]`` that gives values ``[n, cells]`` unit covariance, each
    staying nearest to its cell."""
    covariance, _ = ledoit_wolf(values, assume_centered=True)
    sizes, axes = eigh(covariance)
    white: Floats = axes / np.sqrt(np.maximum(sizes, _STRAY)) @ axes.T
    return white


def _halves(some: Mask) -> list[Mask]:
    """Return two halves of some recordings, bool ``[n]`` each, in turn."""
    number = np.cumsum(some) % 2
    return [some & (number == 1), some & (number == 0)]


def _certain(scores: Floats, other: Mask) -> bool:
    """Return whether scores ``[n]`` prove two groups."""
    signed = np.where(other, scores, -scores)
    least = min(np.median(signed[other]), np.median(signed[~other]))
    return bool(signed.sum() >= _PROVEN and least >= CERTAIN_RATIO)


def _enough(one: Mask, other: Mask) -> bool:
    """Return whether groups of recordings, bool ``[n]``, are large enough."""
    return bool(min(one.sum(), other.sum()) >= _FEWEST)
