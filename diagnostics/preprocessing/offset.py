"""Offset tracking: drift of the baselines since the reference, as with temperature, estimated and removed.

Estimates two offsets above the reference baseline b:

    common(t) = q25 over cells of (x_i(t) - b_i - own_i)        where it exceeds the usual one of the reference
    own_i     = min over t of (x_i(t) - b_i) - common           where it exceeds the noise

A quantile filter over cells and a running minimum over time, as in baseline correction by minimum statistics (Martin
2001). Common offsets up to 5 % of full scale are removed, and own offsets up to 2 %, or up to what is usual in the log:
three robust standard deviations above the median of all cells, at most 5 %. Larger ones are not
tracked: such a cell is loaded or faulty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.preprocessing.levels import LEAST_LOADED, LIGHT, LOW, SLIGHT
from diagnostics.preprocessing.readings import RecordingBlocks, spread
from diagnostics.preprocessing.scale import usual_limit

if TYPE_CHECKING:
    from diagnostics.preprocessing.scale import Scale

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ReferenceOffset:
    """Common offsets in the reference, in the layout's unit.

    Attributes:
        mostly: median of the common offset, at most 0.
        most: largest common offset that counts as usual.
    """

    mostly: float
    most: float

    @classmethod
    def fit(cls, recordings: Sequence[Floats], scale: Scale, present: NDArray[np.bool_]) -> ReferenceOffset:
        """Fit to fault-free recordings, ``[T, D]`` each."""
        cells = spread(np.flatnonzero(present))
        above = RecordingBlocks.of(recordings).thinned(cells) - scale.baseline[cells]
        common = [least_loaded(frame) for frame in above]
        mostly = min(0.0, float(np.median(common)))
        return cls(mostly, max(mostly + scale.near / 2, float(np.quantile(common, 1 - LOW))))

    def excess(self, offset: ArrayLike) -> Floats:
        """Return offsets ``[...]`` relative to the median of the reference; 0 for usual ones."""
        offset = np.asarray(offset, dtype=np.float64)
        return np.where(offset > self.most, offset - self.mostly, 0.0)


@dataclass(frozen=True)
class OffsetTracker:
    """Offsets relative to the baseline of the reference, in the layout's unit.

    Attributes:
        lowest: float ``[D]``, lowest reading of each cell in the log above its baseline; inf: no reading.
        own: float ``[D]``, offset of each cell in addition to the common one.
        common: float ``[t]``, common offset in each of the last frames.
    """

    lowest: Floats
    own: Floats
    common: Floats

    @classmethod
    def begin(cls, n_cells: int) -> OffsetTracker:
        """Return the state before any frame."""
        return cls(np.full(n_cells, np.inf), np.zeros(n_cells), np.zeros(1))

    def extend(self, frames: Floats, scale: Scale, present: NDArray[np.bool_], usual: ReferenceOffset) -> OffsetTracker:
        """Return the offsets after more frames.

        Args:
            frames: ``[t, D]``, NaN = missing.
            scale: baseline of the reference.
            present: bool ``[D]``.
            usual: common offsets of the reference.
        """
        lowest = np.fmin(self.lowest, np.fmin.reduce(frames) - scale.baseline)
        own = self.own if np.array_equal(lowest, self.lowest) else _own_offsets(lowest, scale, present, usual)
        # Usually there is no common offset: enough cells stay at their baseline throughout.
        calm = present & (np.fmax.reduce(frames) - scale.baseline - own <= usual.most)
        if np.count_nonzero(calm) > LEAST_LOADED * np.count_nonzero(present):
            return OffsetTracker(lowest, own, np.zeros(len(frames)))
        common = usual.excess([least_loaded(frame) for frame in (frames - scale.baseline - own)[:, present]])
        last = self.common[-1]
        for t in np.flatnonzero(common >= LIGHT * scale.full_scale):  # nearly all cells are loaded: keep the last one
            common[t] = common[t - 1] if t else last
        return OffsetTracker(lowest, own, common)

    def on(self, scale: Scale) -> Scale:
        """Return ``scale`` with the baseline of the last frame."""
        now = self.own + self.common[-1]
        return replace(scale, baseline=scale.baseline + now) if now.any() else scale

    def off(self, frames: Floats) -> Floats:
        """Return the last frames ``[t, D]`` with changes of the common offset removed."""
        drift = self.common - self.common[-1]
        return frames - drift[:, None] if drift.any() else frames


def _own_offsets(lowest: Floats, scale: Scale, present: NDArray[np.bool_], usual: ReferenceOffset) -> Floats:
    """Return the offset of each cell in addition to the common one, ``[D]``, of its ``lowest`` reading."""
    if not (lowest > scale.near / 2).any():
        return np.zeros(len(lowest))
    shared = usual.excess(least_loaded(lowest[present]))
    beyond = lowest - np.where(shared < LIGHT * scale.full_scale, shared, 0.0)
    usual_own = usual_limit(beyond[present & np.isfinite(beyond)]) / scale.full_scale
    limit = min(max(usual_own, SLIGHT), LIGHT) * scale.full_scale
    return np.where((beyond > scale.near / 2) & (beyond < limit), beyond, 0.0)


def least_loaded(above: Floats) -> float:
    """Return the 0.25 quantile of the readings above baseline, ``[n]``; 0 without any reading."""
    received = above[np.isfinite(above)]
    k = int(LEAST_LOADED * (len(received) - 1))
    return float(np.partition(received, k)[k]) if len(received) else 0.0
