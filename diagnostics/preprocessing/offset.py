"""Offset tracking: drift of the baselines since the reference, as with temperature, estimated and
removed.

Estimates two offsets above the reference baseline b::

    common(t) = q25 over cells of (x_i(t) - b_i - own_i)
                where it exceeds the usual one of the reference
    own_i     = min over t of (x_i(t) - b_i) - common           where it exceeds the noise

A quantile filter over cells and a running minimum over time, as in baseline correction by minimum
statistics (Martin 2001): of the last 512 frames, where most cells no longer come down to their
baseline, else of the whole log. Common offsets up to 5 % of full scale are removed, and own offsets
up to 2 %, or up to what is usual in the log: three robust standard deviations above the median of
all cells, at most 5 %. Larger ones are not tracked: such a cell is loaded or faulty.

Where the recordings of the reference rest at levels of their own, further apart than 5 % of full
scale, common offsets up to the range of these levels and 5 % more are removed. The level of
recording r is::

    level_r = q25 over cells of (q05 over t of x_i(t) - b_i),
    b_i = q05 over r of q05 over t of x_i(t)

and counts if the q05 over cells, in place of q25, exceeds 5 % in half of the recordings: no contact
loads nearly all cells throughout most recordings. Levels within a recording of the reference are
not recognised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.preprocessing.levels import LEAST_LOADED, LIGHT, LOW, MAJORITY, SLIGHT
from diagnostics.preprocessing.quantiles import known_quantile
from diagnostics.preprocessing.readings import RecordingBlocks, spread
from diagnostics.preprocessing.scale import usual_limit

if TYPE_CHECKING:
    from diagnostics.preprocessing.scale import Scale

Floats = NDArray[np.float64]

_RECENT = 16  # segments in which a cell rests at least once: offsets of cells creep


@dataclass(frozen=True)
class ReferenceOffset:
    """Common offsets in the reference, in the layout's unit.

    Attributes:
        mostly: median of the common offset, at most 0.
        most: largest common offset that counts as usual.
        levels: range of the levels at which recordings of the reference rest; 0: all rest at one.
    """

    mostly: float
    most: float
    levels: float = 0.0

    @classmethod
    def fit(
        cls,
        recordings: Sequence[Floats],
        scale: Scale,
        present: NDArray[np.bool_],
        levels: float = 0.0,
    ) -> ReferenceOffset:
        """Fit to fault-free recordings, ``[T, D]`` each, less their levels, which have the range
        ``levels``."""
        cells = spread(np.flatnonzero(present))
        above = RecordingBlocks.of(recordings).thinned(cells) - scale.baseline[cells]
        common = [least_loaded(frame) for frame in above]
        mostly = min(0.0, float(np.median(common)))
        return cls(
            mostly, max(mostly + scale.near / 2, float(np.quantile(common, 1 - LOW))), levels
        )

    def excess(self, offset: ArrayLike) -> Floats:
        """Return offsets ``[...]`` relative to the median of the reference; 0 for usual ones."""
        offset = np.asarray(offset, dtype=np.float64)
        return np.where(offset > self.most, offset - self.mostly, 0.0)

    def limit(self, full_scale: float) -> float:
        """Return the common offset from which on nearly all cells are loaded."""
        return LIGHT * full_scale + self.levels


@dataclass(frozen=True)
class OffsetTracker:
    """Offsets relative to the baseline of the reference, in the layout's unit.

    Attributes:
        lowest: float ``[D]``, lowest reading of each cell in the log above its baseline; inf: no
            reading.
        own: float ``[D]``, offset of each cell in addition to the common one.
        common: float ``[t]``, common offset in each of the last frames.
        recent: lowest reading of each cell above its baseline, ``[D]``, in each of the last calls.
    """

    lowest: Floats
    own: Floats
    common: Floats
    recent: tuple[Floats, ...] = ()

    @classmethod
    def begin(cls, n_cells: int) -> OffsetTracker:
        """Return the state before any frame."""
        return cls(np.full(n_cells, np.inf), np.zeros(n_cells), np.zeros(1))

    def extend(
        self, frames: Floats, scale: Scale, present: NDArray[np.bool_], usual: ReferenceOffset
    ) -> OffsetTracker:
        """Return the offsets after more frames.

        Args:
            frames: ``[t, D]``, NaN = missing.
            scale: baseline of the reference.
            present: bool ``[D]``.
            usual: common offsets of the reference.
        """
        now = np.fmin.reduce(frames) - scale.baseline
        lowest = np.fmin(self.lowest, now)
        recent = (*self.recent, now)[-_RECENT:]
        own = _own_offsets(
            _rests(lowest, np.fmin.reduce(recent), present, scale), scale, present, usual
        )
        # Usually there is no common offset: enough cells stay at their baseline throughout.
        calm = present & (np.fmax.reduce(frames) - scale.baseline - own <= usual.most)
        if np.count_nonzero(calm) > LEAST_LOADED * np.count_nonzero(present):
            return OffsetTracker(lowest, own, np.zeros(len(frames)), recent)
        common = usual.excess(
            [least_loaded(frame) for frame in (frames - scale.baseline - own)[:, present]]
        )
        last = self.common[-1]
        # nearly all cells are loaded: keep the last one
        for t in np.flatnonzero(common >= usual.limit(scale.full_scale)):
            common[t] = common[t - 1] if t else last
        return OffsetTracker(lowest, own, common, recent)

    def on(self, scale: Scale) -> Scale:
        """Return ``scale`` with the baseline of the last frame."""
        now = self.own + self.common[-1]
        return replace(scale, baseline=scale.baseline + now) if now.any() else scale

    def off(self, frames: Floats) -> Floats:
        """Return the last frames ``[t, D]`` with changes of the common offset removed."""
        drift = self.common - self.common[-1]
        return frames - drift[:, None] if drift.any() else frames


def levels(recordings: Sequence[Floats], present: NDArray[np.bool_], full_scale: float) -> Floats:
    """Return the level at which each recording rests, ``[recordings]``; 0 where all rest at one,
    see the module.

    Args:
        recordings: ``[T, D]`` each.
        present: bool ``[D]``.
        full_scale: of the layout.
    """
    readings = RecordingBlocks.of(recordings)
    cells = spread(np.flatnonzero(present))
    if not len(cells):
        return np.zeros(len(readings))
    low = _lows(readings, readings.some, cells)
    rest = np.nan_to_num(known_quantile(low, LOW, axis=0))
    lifted = known_quantile(low - rest, LOW, axis=1)
    lifted = lifted[~np.isnan(lifted)]
    if not len(lifted) or np.quantile(lifted, MAJORITY) <= LIGHT * full_scale:
        return np.zeros(len(readings))
    above = _lows(readings, range(len(readings)), cells) - rest
    return np.array([least_loaded(of_recording) for of_recording in above])


def levelled(recordings: Sequence[Floats], level: Floats) -> RecordingBlocks:
    """Return recordings less their levels (``[recordings]``); the same ones without any."""
    readings = RecordingBlocks.of(recordings)
    if not level.any():
        return readings
    return RecordingBlocks(
        [given - of_it for given, of_it in zip(readings.given, level, strict=True)]
    )


def _lows(readings: RecordingBlocks, which: range, cells: NDArray[np.intp]) -> Floats:
    """Return the low quantile of the readings of each of the ``cells``, ``[which, cells]``; NaN
    where one misses."""
    return np.stack(
        [np.quantile(readings.piece(i, slice(None), cells), LOW, axis=0) for i in which]
    )


def _rests(lowest: Floats, recent: Floats, present: NDArray[np.bool_], scale: Scale) -> Floats:
    """Return where each cell rests above its baseline, ``[D]``: the lowest reading ever, or the
    recent one.

    Where most cells no longer come down to their baseline, offsets creep; else a cell that does not
    is loaded.
    """
    known = present & np.isfinite(recent)
    creeping = known.any() and np.median(recent[known]) > scale.near / 2
    return recent if creeping else lowest


def _own_offsets(
    lowest: Floats, scale: Scale, present: NDArray[np.bool_], usual: ReferenceOffset
) -> Floats:
    """Return the offset of each cell in addition to the common one, ``[D]``, of its ``lowest``
    reading."""
    if not (lowest > scale.near / 2).any():
        return np.zeros(len(lowest))
    shared = usual.excess(least_loaded(lowest[present]))
    beyond = lowest - np.where(shared < usual.limit(scale.full_scale), shared, 0.0)
    usual_own = usual_limit(beyond[present & np.isfinite(beyond)]) / scale.full_scale
    limit = min(max(usual_own, SLIGHT), LIGHT) * scale.full_scale
    return np.where((beyond > scale.near / 2) & (beyond < limit), beyond, 0.0)


def least_loaded(above: Floats) -> float:
    """Return the 0.25 quantile of the readings above baseline, ``[n]``; 0 without any reading."""
    received = above[np.isfinite(above)]
    k = int(LEAST_LOADED * (len(received) - 1))
    return float(np.partition(received, k)[k]) if len(received) else 0.0
