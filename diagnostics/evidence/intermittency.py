"""Intermittency and noise: cells that move, but blink to a rail or have excess noise.

Detects both with a CUSUM of log likelihood ratios over segments of 32 frames (Page 1954), so that a
fault is found whenever it begins, and cleared when it has gone::

    S <- clip(S + c g, 0, 40),    faulty if S >= 14
    blinks:  g = n log(0.05 / r) - m (0.05 - r)
             n blinks in m loaded frames, Poisson, healthy rate r
    noise:   g = log(0.8 / 0.002) if noisier than the limit of its load, else log(0.2 / 0.998)
             Bernoulli

A blink leaves a load in one step and returns to it in one step within 6 frames. The load must
exceed 1.5 times the lowest load that any cell shows: where a threshold hides small loads, weak ones
come and go in one step. Cells at the edge of most contacts blink more often than others: r is the
posterior mean of a cell under a gamma prior with the mean of the array and shape 1/2, that of
Jeffreys' prior of a Poisson rate (1946). Noise is the median absolute second difference. The factor
c <= 1 keeps all but 1 % of healthy cells below 14 / 1.5, at the rates of other recordings
(overdispersion, as in a quasi-likelihood: McCullagh and Nelder 1989). Segments in which many cells
blink or are noisy together do not count: the contact moves. Blinks without load, and noise of
constant cells, are not detected; nor is either in recordings of fewer than five frames: there is
no time between the frames of two recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.constant_runs import SHORTEST_RUN, segments
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import LIGHT, MARGIN
from diagnostics.preprocessing.readings import SEGMENT

if TYPE_CHECKING:
    from diagnostics.preprocessing.scale import Array, Scale

Cells = NDArray[np.intp]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FOLDS = 4
_BLINK_RATE = 0.05  # blinks per loaded frame of a loose contact
LONGEST_BLINK = 6  # frames
# neighbours on the same row and column, see SensorLayout.beside
_ON_ROW = [3, 4]
_ON_COLUMN = [1, 6]
# of a load: largest change during a blink; and of its change: a neighbour that changes as much
# shares it
ALIKE = 0.3
_PRIOR_BLINKS = 0.5  # shape of the gamma prior of the rates
# healthy blinks per loaded frame, in a cold start; share of healthy segments above the limit of
# noise
_RARE = 0.002
_NOISY_SHARE = 0.8  # share of the segments of a noisy cell above the limit
# of the mean root load, bin edges: noise grows with load
_LEVELS = np.array([0.0, 0.05, 0.2, 0.4, 0.6, 0.8])
# share of the loaded cells, and of all, that may be noisy together: with more the contact moves
_CROWD = 0.25
_THRESHOLD = 14.0  # of the CUSUM: a prior of one in a thousand, and P(faulty) = 0.999
_QUIET = float(np.log((1 - _NOISY_SHARE) / (1 - _RARE)))  # log ratio of a segment below the limit
_MAX = 40.0  # upper limit of the CUSUM, so that a repaired cell is cleared soon
_HEALTHY = 0.99  # quantile of the cells, of the largest CUSUM in the reference


class _Counts(NamedTuple):
    """Blinks and loaded frames of each cell in one recording, ``[D]``; noise and load level by
    segment, ``[n]``."""

    blinks: Floats
    loaded: Floats
    noise: Floats
    level: Cells

    @classmethod
    def of(
        cls, recording: Floats, scale: Scale, layout: SensorLayout, alone: bool, lowest: float
    ) -> _Counts:
        """Count; ``alone``, ``lowest``: see :func:`_measure`."""
        every = np.arange(layout.n_cells)
        blinks = np.zeros(layout.n_cells)
        loaded = np.zeros(layout.n_cells)
        noise = [np.zeros(0)]
        levels = [np.zeros(0, np.intp)]
        for first in range(0, len(recording), SEGMENT):
            frames = recording[first : first + SEGMENT]
            low, high, under_load, noise_level, level = _measure(
                frames, scale.root_load(frames), scale, every, layout, alone, lowest
            )
            blinks = blinks + low + high
            loaded = loaded + under_load
            if len(frames) >= SHORTEST_RUN:
                noise.append(noise_level)
                levels.append(level)
        return cls(blinks, loaded, np.concatenate(noise), np.concatenate(levels))


@dataclass(frozen=True)
class HealthyRates:
    """Rates of blinks and noise of healthy cells.

    Attributes:
        blinks: blinks per loaded frame, mean of the array.
        noise: float ``[levels]``, limit of the noise by load, as a share of full scale.
        blinks_count, noise_counts: factor c of either evidence.
        alone: count only changes that no neighbour shares, as needed where fingers slide.
        lowest: lowest load that is no noise, in the layout's unit; inf: unknown.
        of_cells: float ``[D]``, blinks per loaded frame of each cell, r; None: all have the mean.
    """

    blinks: float
    noise: Floats
    blinks_count: float = 1.0
    noise_counts: float = 1.0
    alone: bool = True
    lowest: float = np.inf
    of_cells: Floats | None = None

    @classmethod
    def fit(cls, recordings: Sequence[Floats], scale: Scale, layout: SensorLayout) -> HealthyRates:
        """Fit to fault-free recordings, ``[T, D]`` each."""
        usual = cls._counted(recordings, scale, layout, alone=False)
        if usual.blinks_count == usual.noise_counts == 1:
            return usual
        # Contacts cause blinks and noise here. Comparing neighbours misses adjacent faults: only
        # where needed.
        return cls._counted(recordings, scale, layout, alone=True)

    @classmethod
    def _counted(
        cls, recordings: Sequence[Floats], scale: Scale, layout: SensorLayout, alone: bool
    ) -> HealthyRates:
        lowest = min((_lowest_load(recording, scale) for recording in recordings), default=np.inf)
        counts = [_Counts.of(recording, scale, layout, alone, lowest) for recording in recordings]
        # Cross-fitting: new recordings may exceed the rates of few others.
        reached = np.zeros((2, layout.n_cells))
        every = np.random.default_rng(0).permutation(len(recordings))
        for fold in np.array_split(every, min(_FOLDS, len(every))):
            others = np.setdiff1d(every, fold) if len(fold) < len(every) else fold
            usual = cls._of([counts[i] for i in others], scale, alone, lowest)
            intermittency = Intermittency.begin(layout)
            for i in fold.tolist():
                for frames, numbers, runs in segments(recordings[i], scale):
                    constant = runs.start <= numbers[0]
                    intermittency = intermittency.extend(
                        frames, scale.root_load(frames), numbers, scale, usual, constant, np.inf
                    )
                    reached = np.maximum(reached, [intermittency.blinking, intermittency.noisy])
        factors = _THRESHOLD / np.maximum(
            _THRESHOLD, MARGIN * np.quantile(reached, _HEALTHY, axis=1)
        )
        usual = cls._of(counts, scale, alone, lowest)
        return replace(usual, blinks_count=float(factors[0]), noise_counts=float(factors[1]))

    @classmethod
    def _of(
        cls, counts: Sequence[_Counts], scale: Scale, alone: bool, lowest: float
    ) -> HealthyRates:
        """Return the rates in some recordings."""
        limit = np.zeros(len(_LEVELS))
        for k in range(len(_LEVELS)):
            # One pseudo-sample with the noise of a cold start: rare noise is not seen in few
            # samples.
            samples = [c.noise[c.level == k] for c in counts]
            limit[k] = np.quantile(np.concatenate([*samples, [LIGHT]]), 1 - _RARE)
        # Readings within +- tolerance (near / 2) have second differences up to 2 near.
        limit = np.maximum.accumulate(np.maximum(limit, 2 * scale.near / scale.full_scale))
        blinks = sum(c.blinks for c in counts)
        loaded = sum(c.loaded for c in counts)
        # One pseudo-blink, in as many frames as it takes at the rate of a cold start.
        mean = max(0.1 * _RARE, (float(np.sum(blinks)) + 1) / (float(np.sum(loaded)) + 1 / _RARE))
        of_cells = np.maximum(
            0.1 * _RARE, (blinks + _PRIOR_BLINKS) / (loaded + _PRIOR_BLINKS / mean)
        )
        return cls(mean, limit, alone=alone, lowest=lowest, of_cells=of_cells)

    def with_noise(self, shared: float) -> HealthyRates:
        """Return the rates where noise that all cells share raises the limits by ``shared`` of full
        scale."""
        return replace(self, noise=self.noise + shared) if shared else self

    @classmethod
    def unknown(cls) -> HealthyRates:
        """Return the rates of a cold start, at which only gross faults count."""
        return cls(_RARE, np.full(len(_LEVELS), LIGHT))


@dataclass(frozen=True)
class Intermittency:
    """The CUSUM of each cell.

    Attributes:
        layout: the array.
        blinking, noisy: float ``[D]``, CUSUM of the log likelihood ratio against healthy.
        blinks: int ``[D]``, number of blinks since ``blinking`` was last 0.
        high: int ``[D]``, number of these to full scale.
        lowest: lowest load so far that is no noise.
        blinks_since, noisy_since: int ``[D]``, number of the frame at which either sum was last 0.
    """

    layout: SensorLayout
    blinking: Floats
    noisy: Floats
    blinks: Cells
    high: Cells
    blinks_since: Cells
    noisy_since: Cells
    lowest: float = np.inf

    @classmethod
    def begin(cls, layout: SensorLayout) -> Intermittency:
        """Return the state before any frame."""
        zero = np.zeros(layout.n_cells)
        none = np.zeros(layout.n_cells, np.intp)
        return cls(layout, zero, zero, none, none, none, none)

    def extend(
        self,
        frames: Floats,
        root: Array,
        numbers: Cells,
        scale: Scale,
        usual: HealthyRates,
        constant: Mask,
        full: float = _MAX,
        begins: Mask | None = None,
    ) -> Intermittency:
        """Return the sums after one more segment.

        Args:
            frames: ``[t, D]``.
            root: root loads of the frames, ``[t, D]``.
            numbers: int ``[t]``, of the frames.
            scale: baseline and full scale.
            usual: rates of healthy cells.
            constant: bool ``[D]``, cells that do not move in these frames, and do not count.
            full: upper limit of the sums.
            begins: bool ``[t]``, frames that begin a recording; None: all follow each other.
        """
        recording = None
        if begins is not None and begins.any():
            frames, root, recording = _of_some_length(frames, root, np.cumsum(begins))
        if len(frames) < SHORTEST_RUN or constant.all():
            return self
        moving = np.flatnonzero(~constant)
        lowest = min(self.lowest, usual.lowest)
        if not np.isfinite(usual.lowest):
            lowest = min(lowest, _lowest_load(frames[:, moving], scale.of(moving)))
        low, high, loaded, noise_level, level = _measure(
            frames, root, scale, moving, self.layout, usual.alone, lowest, recording
        )
        events = low + high
        crowd = max(1.0, _CROWD * float((loaded > 0).sum()))
        if (events > 0).sum() > crowd:
            events = np.zeros_like(events)
        rate = usual.blinks if usual.of_cells is None else usual.of_cells[moving]
        gain = events * np.log(_BLINK_RATE / rate) - loaded * (_BLINK_RATE - rate)
        blinking = self.blinking.copy()
        blinking[moving] = np.clip(blinking[moving] + usual.blinks_count * gain, 0.0, full)
        noisier = self._noisier(noise_level, usual.noise[level], moving, usual.alone)
        if noisier.sum() > max(crowd, _CROWD * len(constant)):
            noisier[:] = False
        odds = np.where(noisier, np.log(_NOISY_SHARE / _RARE), _QUIET)
        blinks = np.zeros((2, len(constant)), np.intp)
        blinks[:, moving] = events, np.where(events > 0, high, 0)
        calm = self.blinking == 0
        return Intermittency(
            self.layout,
            blinking,
            np.clip(self.noisy + usual.noise_counts * odds, 0.0, full),
            np.where(calm, 0, self.blinks) + blinks[0],
            np.where(calm, 0, self.high) + blinks[1],
            np.where(calm, numbers[0], self.blinks_since),
            np.where(self.noisy == 0, numbers[0], self.noisy_since),
            lowest,
        )

    def _noisier(self, noise: Floats, limit: Floats, moving: Cells, alone: bool) -> Mask:
        """Return which of the ``moving`` cells have more noise than the limit, bool ``[D]``;
        ``alone``: unshared."""
        noisier = np.zeros(self.layout.n_cells, bool)
        noisier[moving] = noise > limit
        if alone and noisier.any():
            every = np.zeros(self.layout.n_cells)
            every[moving] = noise
            which = np.flatnonzero(noisier)
            neighbours = self.layout.beside[which]
            noisier[which] = ~_shared(neighbours, every[neighbours], every[which])
        return noisier

    @property
    def intermittent(self) -> Mask:
        """bool ``[D]``, intermittent cells."""
        found: Mask = (self.blinking >= _THRESHOLD) & (self.blinking > self.noisy)
        return found

    @property
    def excess(self) -> Mask:
        """bool ``[D]``, cells with excess noise that are not intermittent."""
        found: Mask = (self.noisy >= _THRESHOLD) & ~self.intermittent
        return found


def _of_some_length(frames: Floats, root: Array, recording: Cells) -> tuple[Floats, Array, Cells]:
    """Return the frames, root loads and numbers ``[t]`` of the recordings without those of which
    there are too few frames here to tell of time."""
    enough = np.bincount(recording)[recording] >= SHORTEST_RUN
    return frames[enough], root[enough], recording[enough]


def _measure(
    frames: Floats,
    root: Array,
    scale: Scale,
    cells: Cells,
    layout: SensorLayout,
    alone: bool,
    lowest: float,
    recording: Cells | None = None,
) -> tuple[Cells, Cells, Floats, Floats, Cells]:
    """Return for each of the ``cells``: blinks to the baseline, blinks to full scale, loaded
    frames, noise, load level.

    With ``alone``, blinks that a neighbour shares do not count. Only frames of one ``recording``
    (int ``[t]``, its number; None: all are of one) are compared.
    """
    every = frames if alone else None
    frames = frames.take(cells, axis=1)
    root = root.take(cells, axis=1)
    scale = scale.of(cells)
    x = (frames - scale.baseline).astype(np.float32)
    if np.isnan(x).any():
        x = np.nan_to_num(x)
    top = scale.full_scale - scale.near
    near = scale.near
    loaded = x > max(LIGHT * scale.full_scale, MARGIN * lowest, MARGIN * near)
    rests = x <= near
    full = frames >= top
    moderate = loaded & ~full

    step = x[1:] - x[:-1]
    curvature = (
        np.abs(step[1:] - step[:-1]) if len(x) > 2 else np.zeros((1, x.shape[1]), np.float32)
    )
    if recording is not None:
        curvature = curvature[recording[2:] == recording[:-2]]
    noise_level = _median(curvature) / scale.full_scale
    level = np.searchsorted(_LEVELS, root.sum(axis=0) / np.float32(len(root)), side="right") - 1
    # A load near full scale may reach it without a fault.
    far = moderate & ((1 + ALIKE) * x < (top - scale.baseline).astype(np.float32))
    low = _blinks(x, moderate, rests, recording, every, layout.beside, cells)
    high = _blinks(x, far, full, recording, every, layout.beside, cells)
    return low, high, loaded.sum(axis=0, dtype=np.float64), noise_level, np.maximum(level, 0)


def _blinks(
    x: Array,
    initial: Mask,
    away: Mask,
    recording: Cells | None,
    every: Floats | None,
    beside: Cells,
    cells: Cells,
) -> Cells:
    """Return how often each cell is away in one step and back in one step, to about the same load
    ``x [t, n]``: no contact does that.

    Args:
        x, initial, away: ``[t, n]``: loads, where they may be left, and where they are away.
        recording: as for :func:`_measure`.
        every: ``[t, D]``, frames of all cells, whose neighbours may share a change, which does not
            count then; None: all count.
        beside: of the layout.
        cells: int ``[n]``.
    """
    count = np.zeros(x.shape[1], np.intp)
    left = initial[:-1] & away[1:]
    if not left.any():
        return count
    some = np.flatnonzero(left.any(axis=0) & (away[:-1] & initial[1:]).any(axis=0))
    if not len(some):
        return count
    loaded_before = initial[:, some]
    absent = away[:, some]
    of = x[:, some]
    missing = absent
    for gap in range(1, min(LONGEST_BLINK, len(x) - 2) + 1):
        before = of[: -gap - 1]
        after = of[gap + 1 :]
        same_load = np.abs(after - before) <= ALIKE * before
        if recording is not None:
            same_load &= (recording[gap + 1 :] == recording[: -gap - 1])[:, None]
        when, which = np.nonzero(
            loaded_before[: -gap - 1] & missing[1:-1] & loaded_before[gap + 1 :] & same_load
        )
        which = some[which]
        if every is not None and len(which):
            neighbours = beside[cells[which]]
            change = np.abs(every[when[:, None] + 1, neighbours] - every[when[:, None], neighbours])
            which = which[~_shared(neighbours, change, x[when, which])]
        np.add.at(count, which, 1)
        missing = missing[:-1] & absent[gap:]
    return count


def _lowest_load(frames: Floats, scale: Scale) -> float:
    """Return the lowest load above the noise in frames ``[t, D]``, in the layout's unit; inf
    without any."""
    load = frames - scale.baseline
    return float(np.min(load, where=load > scale.near, initial=np.inf))


def _shared(neighbours: Cells, change: Floats, own: Floats | Array) -> Mask:
    """Return which changes of single cells a neighbour shares, bool ``[n]``.

    Exactly both neighbours on one row, or on one column, do not count: they may lie on the same bad
    wire.

    Args:
        neighbours: int ``[n, 8]``, see ``SensorLayout.beside``.
        change: ``[n, 8]``, change of each neighbour; NaN: unknown.
        own: ``[n]``, change of the cell.
    """
    much = (neighbours >= 0) & (change >= ALIKE * own[:, None])
    of_wire = [much[:, on].all(axis=1) & (much.sum(axis=1) == 2) for on in (_ON_ROW, _ON_COLUMN)]
    return np.asarray(much.any(axis=1) & ~of_wire[0] & ~of_wire[1])


def _median(values: NDArray[np.float32]) -> Floats:
    """Return ``np.median(values, axis=0)`` in a quarter of its time; without NaN."""
    # faster than a partition for so few values
    ordered = np.sort(np.ascontiguousarray(values.T), axis=1)
    below = ordered[:, (len(values) - 1) // 2]
    above = ordered[:, len(values) // 2]
    median: Floats = (below.astype(np.float64) + above) / 2
    return median
