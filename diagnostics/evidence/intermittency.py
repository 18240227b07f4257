"""Temporal evidence of cells that move, but wrongly: those that blink, and those with excess noise.

Counted segment by segment against what healthy cells do, as a cumulated sum of log likelihood ratios that never falls
below 0: so a fault is found whenever it begins, and forgotten when it has gone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.constant_runs import segments
from diagnostics.events.contact_events import SEGMENT
from diagnostics.layout import SensorLayout

if TYPE_CHECKING:
    from diagnostics.preprocessing.scale import Array, Scale

Floats = NDArray[np.float64]

_LOADED = 0.05  # of full scale: a load that a contact could lose
_BLINK_RATE = 0.05  # blinks in a loaded frame of a loose contact
_LONGEST_BLINK = 6  # frames
_ON_ROW, _ON_COLUMN = [3, 4], [1, 6]  # of the cells beside one, see SensorLayout
_SHORTEST = 8  # frames of a segment in which noise can be told
# Of the unrest of a cell: so much of it those beside it have as well, where a finger is lifted or slides.
_SHARED = 0.3
_ALIKE = 0.3  # of a load: as far as it may have moved on during a blink, which goes farther
_RAREST = 2e-4  # healthy blinks in a loaded frame, at least
_UNKNOWN_BLINKS, _UNKNOWN_NOISE = 2e-3, 0.05  # of a loaded frame, and of full scale, where no reference tells
_RESTLESS = 0.8  # of the segments of a noisy cell are noisier than healthy ones
_NOISIER = 0.002  # of healthy segments are noisier than what is called noisy
_LEVELS = np.array([0.0, 0.05, 0.2, 0.4, 0.6, 0.8])  # of the mean root load: noise grows with load
_ALONE = 0.3  # share of the loaded cells that may be as restless: more, and it is the grasp that moves
_CROWD = 0.2  # of all cells: so many are not noisy by themselves
_ENOUGH = 14.0  # summed log ratio from which on a cell is faulty: one in a thousand cells, and proven
_FULL = 40.0  # more than that is not kept: a cell that works again must be able to show it
# To be faulty it takes so many times what healthy cells reached in the reference: all but one in a hundred of them,
# which may be faulty there already.
_MARGIN, _HEALTHY = 1.5, 0.99


@dataclass(frozen=True)
class HealthyRates:
    """How restless healthy cells are.

    Unrest comes in bursts: where fingers scratch, one cell blinks again and again. So evidence counts for less, the
    more of it healthy cells have reached (a quasi-likelihood, as of counts that are dispersed more than Poisson's).

    Attributes:
        blinks: in a loaded frame.
        noise: float ``[levels]``, share of full scale: healthy segments are hardly ever noisier.
        blinks_count, noise_counts: share of the evidence of either that counts.
        alone: only unrest counts that the cells beside do not share, as where fingers scratch.
    """

    blinks: float
    noise: Floats
    blinks_count: float = 1.0
    noise_counts: float = 1.0
    alone: bool = True

    @classmethod
    def fit(cls, recordings: Sequence[Floats], scale: Scale, layout: SensorLayout) -> HealthyRates:
        """Count over fault-free recordings, ``[T, D]`` each."""
        usual = cls._counted(recordings, scale, layout, alone=False)
        if usual.blinks_count == usual.noise_counts == 1:
            return usual
        # Much of it is the touch. To ask the cells beside costs faults that lie side by side: not without need.
        return cls._counted(recordings, scale, layout, alone=True)

    @classmethod
    def _counted(cls, recordings: Sequence[Floats], scale: Scale, layout: SensorLayout, alone: bool) -> HealthyRates:
        every = np.arange(layout.n_cells)
        blinks = loaded = 0.0
        noise: list[list[Floats]] = [[] for _ in _LEVELS]
        for recording in recordings:
            for first in range(0, len(recording), SEGMENT):
                frames = recording[first : first + SEGMENT]
                low, high, under_load, restless, level = _measure(
                    frames, scale.root_load(frames), scale, every, layout, alone
                )
                blinks += float((low + high).sum())
                loaded += float(under_load.sum())
                if len(frames) >= _SHORTEST:
                    for k in range(len(_LEVELS)):
                        noise[k].append(restless[level == k])
        limit = np.zeros(len(_LEVELS))
        for k, of_level in enumerate(noise):
            # Few samples do not tell what is rare: with one more, as noisy as an unknown array may be.
            limit[k] = np.quantile(np.concatenate([*of_level, [_UNKNOWN_NOISE]]), 1 - _NOISIER)
        limit = np.maximum.accumulate(np.maximum(limit, scale.near / scale.full_scale))
        # With one more blink, in as many frames as an unknown array would need for it: where little was loaded, little
        # is known.
        usual = cls(max(_RAREST, (blinks + 1) / (loaded + 1 / _UNKNOWN_BLINKS)), limit, alone=alone)
        intermittency = Intermittency.begin(layout)
        reached = np.stack([intermittency.blinking, intermittency.noisy])
        for recording in recordings:
            for frames, numbers, start in segments(recording, SEGMENT, scale.near / 2):
                still = start <= numbers[0]
                intermittency = intermittency.extend(
                    frames, scale.root_load(frames), numbers, scale, usual, still, np.inf
                )
                reached = np.maximum(reached, [intermittency.blinking, intermittency.noisy])
        counts = _ENOUGH / np.maximum(_ENOUGH, _MARGIN * np.quantile(reached, _HEALTHY, axis=1))
        return replace(usual, blinks_count=float(counts[0]), noise_counts=float(counts[1]))

    @classmethod
    def unknown(cls, scale: Scale) -> HealthyRates:
        """Stand in for a reference: rather calm, so that only gross unrest counts."""
        return cls(_UNKNOWN_BLINKS, np.full(len(_LEVELS), _UNKNOWN_NOISE))


@dataclass(frozen=True)
class Intermittency:
    """The cumulated evidence.

    Attributes:
        layout: the array.
        blinking, noisy: float ``[D]``, log likelihood ratios against healthy.
        blinks: int ``[D]``, since ``blinking`` was last 0; high: how many of them to full scale.
        blinks_since, noisy_since: int ``[D]``, number of the frame at which each sum was last 0.
    """

    layout: SensorLayout
    blinking: Floats
    noisy: Floats
    blinks: NDArray[np.intp]
    high: NDArray[np.intp]
    blinks_since: NDArray[np.intp]
    noisy_since: NDArray[np.intp]

    @classmethod
    def begin(cls, layout: SensorLayout) -> Intermittency:
        """Nothing seen yet."""
        zero, none = np.zeros(layout.n_cells), np.zeros(layout.n_cells, np.intp)
        return cls(layout, zero, zero, none, none, none, none)

    def extend(
        self,
        frames: Floats,
        root: Array,
        numbers: NDArray[np.intp],
        scale: Scale,
        usual: HealthyRates,
        still: NDArray[np.bool_],
        full: float = _FULL,
    ) -> Intermittency:
        """Return the evidence after more frames, ``[t, D]``, and their root loads, likewise.

        ``still`` cells (bool ``[D]``) have no part in it. More evidence than ``full`` is not kept.
        """
        if len(frames) < _SHORTEST or still.all():
            return self
        moving = np.flatnonzero(~still)
        low, high, loaded, restless, level = _measure(frames, root, scale, moving, self.layout, usual.alone)
        events = low + high
        crowd = max(1.0, _ALONE * float((loaded > 0).sum()))
        if (events > 0).sum() > crowd:
            events = np.zeros_like(events)
        gain = events * np.log(_BLINK_RATE / usual.blinks) - loaded * (_BLINK_RATE - usual.blinks)
        blinking = self.blinking.copy()
        blinking[moving] = np.clip(blinking[moving] + usual.blinks_count * gain, 0.0, full)
        noisier = restless > usual.noise[level]
        if usual.alone and noisier.any():
            every, which = np.zeros(len(still)), np.flatnonzero(noisier)
            every[moving] = restless
            neighbours = self.layout.beside[moving[which]]
            noisier[which] = ~_shared(neighbours, every[neighbours], restless[which])
        if noisier.sum() > max(crowd, _CROWD * len(still)):
            noisier[:] = False
        gain = np.where(noisier, np.log(_RESTLESS / _NOISIER), 0.0)
        gain[events > 1] = 0.0  # what blinks is restless too
        noisy = self.noisy + usual.noise_counts * np.log((1 - _RESTLESS) / (1 - _NOISIER))
        noisy[moving] = np.where(noisier, self.noisy[moving] + usual.noise_counts * gain, noisy[moving])
        noisy = np.clip(noisy, 0.0, full)
        blinks, to_full = np.zeros(len(still), np.intp), np.zeros(len(still), np.intp)
        blinks[moving], to_full[moving] = events, np.where(events > 0, high, 0)
        calm, quiet = self.blinking == 0, self.noisy == 0
        return Intermittency(
            self.layout,
            blinking,
            noisy,
            np.where(calm, 0, self.blinks) + blinks,
            np.where(calm, 0, self.high) + to_full,
            np.where(calm, numbers[0], self.blinks_since),
            np.where(quiet, numbers[0], self.noisy_since),
        )

    @property
    def intermittent(self) -> NDArray[np.bool_]:
        """bool ``[D]``, cells that blink."""
        found: NDArray[np.bool_] = (self.blinking >= _ENOUGH) & (self.blinking > self.noisy)
        return found

    @property
    def excess(self) -> NDArray[np.bool_]:
        """bool ``[D]``, cells with excess noise that do not blink."""
        found: NDArray[np.bool_] = (self.noisy >= _ENOUGH) & ~self.intermittent
        return found


def _measure(
    frames: Floats, root: Array, scale: Scale, cells: NDArray[np.intp], layout: SensorLayout, alone: bool
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats, Floats, NDArray[np.intp]]:
    """Return for each of the ``cells``: blinks to rest, blinks to full scale, loaded frames, noise, level of load.

    Where ``alone``, blinks that the cells beside share do not count.
    """
    every, frames, root, scale = frames, frames[:, cells], root[:, cells], scale.of(cells)
    x = (frames - scale.baseline).astype(np.float32)
    if np.isnan(x).any():
        x = np.nan_to_num(x)
    near, top = scale.near, scale.full_scale - scale.near
    loaded = x > _LOADED * scale.full_scale
    rests, full = x <= near, frames >= top
    moderate = loaded & ~full

    def blinks(initial: NDArray[np.bool_], away: NDArray[np.bool_]) -> NDArray[np.intp]:
        # Gone in one step and back in one step, to about the load that was there: as no finger could.
        count = np.zeros(x.shape[1], np.intp)
        went = initial[:-1] & away[1:]
        if not went.any():
            return count
        some = np.flatnonzero(went.any(axis=0) & (away[:-1] & initial[1:]).any(axis=0))
        if not len(some):
            return count
        there, gone, of = initial[:, some], away[:, some], x[:, some]
        missing = gone
        for gap in range(1, min(_LONGEST_BLINK, len(x) - 2) + 1):
            before, after = of[: -gap - 1], of[gap + 1 :]
            matching = np.abs(after - before) <= _ALIKE * before
            when, which = np.nonzero(there[: -gap - 1] & missing[1:-1] & there[gap + 1 :] & matching)
            which = some[which]
            if alone and len(which):
                neighbours = layout.beside[cells[which]]
                change = np.abs(every[when[:, None] + 1, neighbours] - every[when[:, None], neighbours])
                which = which[~_shared(neighbours, change, x[when, which])]
            np.add.at(count, which, 1)
            missing = missing[:-1] & gone[gap:]
        return count

    step = x[1:] - x[:-1]
    bend = np.abs(step[1:] - step[:-1]) if len(x) > 2 else np.zeros((1, x.shape[1]), np.float32)
    restless = _median(bend) / scale.full_scale
    level = np.searchsorted(_LEVELS, root.sum(axis=0) / np.float32(len(root)), side="right") - 1
    # A load near to full scale is soon there by itself.
    far = moderate & ((1 + _ALIKE) * x < np.float32(top))
    low, high = blinks(moderate, rests), blinks(far, full)
    return low, high, loaded.sum(axis=0, dtype=np.float64), restless, np.maximum(level, 0)


def _shared(neighbours: NDArray[np.intp], change: Floats, own: Floats | Array) -> NDArray[np.bool_]:
    """Return which changes of single cells, ``[n]``, those beside them share, but for both neighbours on a bad wire.

    Args:
        around: the cells beside each, int ``[n, 8]``, see ``SensorLayout.beside``.
        change: how much those change, ``[n, 8]``; NaN: not known. own: how much the cells themselves do, ``[n]``.
    """
    much = (neighbours >= 0) & (change >= _SHARED * own[:, None])
    of_wire = [much[:, on].all(axis=1) & (much.sum(axis=1) == 2) for on in (_ON_ROW, _ON_COLUMN)]
    return np.asarray(much.any(axis=1) & ~of_wire[0] & ~of_wire[1])


def _median(values: NDArray[np.float32]) -> Floats:
    """Return the median over the first axis, in a quarter of NumPy's time: cell by cell, with no search for NaN."""
    ordered = np.sort(np.ascontiguousarray(values.T), axis=1)  # of so few values faster than a partition
    below, above = ordered[:, (len(values) - 1) // 2], ordered[:, len(values) // 2]
    median: Floats = (below.astype(np.float64) + above) / 2
    return median
