"""Temporal evidence of cells that move, but wrongly: those that blink, and those with excess noise.

Counted segment by segment against what healthy cells do, as a cumulated sum of log likelihood ratios that never falls
below 0: so a fault is found whenever it begins, and forgotten when it has gone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnostics.touches import SEGMENT, Array, Scale

Floats = NDArray[np.float64]

_LOADED = 0.05  # of full scale: a load that a contact could lose
_BLINK_RATE = 0.05  # blinks in a loaded frame of a loose contact
_LONGEST_BLINK = 6  # frames
_SHORTEST = 8  # frames of a segment in which noise can be told
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


@dataclass(frozen=True)
class Usual:
    """How restless healthy cells are.

    Attributes:
        blinks: in a loaded frame.
        noise: float ``[levels]``, share of full scale: healthy segments are hardly ever noisier.
    """

    blinks: float
    noise: Floats

    @classmethod
    def fit(cls, recordings: Sequence[Floats], scale: Scale) -> Usual:
        """Count over fault-free recordings, ``[T, D]`` each."""
        blinks = loaded = 0.0
        noise: list[list[Floats]] = [[] for _ in _LEVELS]
        for recording in recordings:
            for first in range(0, len(recording), SEGMENT):
                frames = recording[first : first + SEGMENT]
                low, high, under_load, restless, level = _measure(frames, scale.root_load(frames), scale)
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
        return cls(max(_RAREST, (blinks + 1) / (loaded + 1 / _UNKNOWN_BLINKS)), limit)

    @classmethod
    def unknown(cls, scale: Scale) -> Usual:
        """Stand in for a reference: rather calm, so that only gross unrest counts."""
        return cls(_UNKNOWN_BLINKS, np.full(len(_LEVELS), _UNKNOWN_NOISE))


@dataclass(frozen=True)
class Unrest:
    """The cumulated evidence.

    Attributes:
        blinking, noisy: float ``[D]``, log likelihood ratios against healthy.
        blinks: int ``[D]``, since ``blinking`` was last 0; high: how many of them to full scale.
        blinks_since, noisy_since: int ``[D]``, number of the frame at which each sum was last 0.
    """

    blinking: Floats
    noisy: Floats
    blinks: NDArray[np.intp]
    high: NDArray[np.intp]
    blinks_since: NDArray[np.intp]
    noisy_since: NDArray[np.intp]

    @classmethod
    def begin(cls, n_cells: int) -> Unrest:
        """Nothing seen yet."""
        zero, none = np.zeros(n_cells), np.zeros(n_cells, np.intp)
        return cls(zero, zero, none, none, none, none)

    def extend(
        self,
        frames: Floats,
        root: Array,
        numbers: NDArray[np.intp],
        scale: Scale,
        usual: Usual,
        still: NDArray[np.bool_],
    ) -> Unrest:
        """Return the evidence after more frames, ``[t, D]``, and their root loads, likewise.

        ``still`` cells (bool ``[D]``) have no part in it.
        """
        if len(frames) < _SHORTEST or still.all():
            return self
        moving = np.flatnonzero(~still)
        low, high, loaded, restless, level = _measure(frames[:, moving], root[:, moving], scale.of(moving))
        events = low + high
        crowd = max(1.0, _ALONE * float((loaded > 0).sum()))
        if (events > 0).sum() > crowd:
            events = np.zeros_like(events)
        gain = events * np.log(_BLINK_RATE / usual.blinks) - loaded * (_BLINK_RATE - usual.blinks)
        blinking = self.blinking.copy()
        blinking[moving] = np.clip(blinking[moving] + gain, 0.0, _FULL)
        noisier = restless > usual.noise[level]
        if noisier.sum() > max(crowd, _CROWD * len(still)):
            noisier[:] = False
        gain = np.where(noisier, np.log(_RESTLESS / _NOISIER), 0.0)
        gain[events > 1] = 0.0  # what blinks is restless too
        noisy = self.noisy + np.log((1 - _RESTLESS) / (1 - _NOISIER))
        noisy[moving] = np.where(noisier, self.noisy[moving] + gain, noisy[moving])
        noisy = np.clip(noisy, 0.0, _FULL)
        blinks, to_full = np.zeros(len(still), np.intp), np.zeros(len(still), np.intp)
        blinks[moving], to_full[moving] = events, np.where(events > 0, high, 0)
        calm, quiet = self.blinking == 0, self.noisy == 0
        return Unrest(
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
    frames: Floats, root: Array, scale: Scale
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats, Floats, NDArray[np.intp]]:
    """Return for each cell ``[D]``: blinks to rest, blinks to full scale, loaded frames, noise, level of load."""
    x = (frames - scale.resting).astype(np.float32)
    if np.isnan(x).any():
        x = np.nan_to_num(x)
    near, top = scale.near, scale.full_scale - scale.near
    loaded = x > _LOADED * scale.full_scale
    rests, full = x <= near, frames >= top
    moderate = loaded & ~full

    def blinks(at_first: NDArray[np.bool_], away: NDArray[np.bool_]) -> NDArray[np.intp]:
        # Gone in one step and back in one step, to about the load that was there: as no finger could.
        count = np.zeros(x.shape[1], np.intp)
        went = at_first[:-1] & away[1:]
        if not went.any():
            return count
        some = np.flatnonzero(went.any(axis=0) & (away[:-1] & at_first[1:]).any(axis=0))
        if not len(some):
            return count
        there, gone, of = at_first[:, some], away[:, some], x[:, some]
        missing = gone
        for gap in range(1, min(_LONGEST_BLINK, len(x) - 2) + 1):
            before, after = of[: -gap - 1], of[gap + 1 :]
            alike = np.abs(after - before) <= _ALIKE * before
            count[some] += (there[: -gap - 1] & missing[1:-1] & there[gap + 1 :] & alike).sum(axis=0)
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


def _median(values: NDArray[np.float32]) -> Floats:
    """Return the median over the first axis, in a quarter of NumPy's time: cell by cell, with no search for NaN."""
    ordered = np.sort(np.ascontiguousarray(values.T), axis=1)  # of so few values faster than a partition
    below, above = ordered[:, (len(values) - 1) // 2], ordered[:, len(values) // 2]
    median: Floats = (below.astype(np.float64) + above) / 2
    return median
