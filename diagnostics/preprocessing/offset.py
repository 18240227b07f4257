"""Offsets that have moved since the reference was recorded, as with temperature, told from touches and taken off.

What moves all cells is seen at those that are loaded least; what moves a single one, at its own lowest reading in the
log. Small offsets only, and of all cells together larger ones than the reference itself shows: a cell that reads more
all the time is loaded, or broken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.preprocessing.readings import RecordingBlocks

if TYPE_CHECKING:
    from diagnostics.preprocessing.scale import Scale

_LEAST_LOADED = 0.25  # share of the cells that is hardly ever loaded all at once, and more than are open
_COMMON, _OWN = 0.05, 0.02  # of full scale: the largest offset of all cells together, and of one beside that
_USUAL = 0.95  # quantile of the offsets in the reference
_FRAMES = 20  # of each recording that tell, about

Floats = NDArray[np.float64]


class ReferenceOffset(NamedTuple):
    """Offsets of all cells together that healthy skins show.

    Attributes:
        mostly: below 0 where cells mostly rest lower than they may, as their offsets wander.
        most: an offset that is as in the reference.
    """

    mostly: float
    most: float

    @classmethod
    def fit(cls, recordings: Sequence[Floats], scale: Scale, present: NDArray[np.bool_]) -> ReferenceOffset:
        """Look at a reference, recordings ``[T, D]`` each."""
        cells, some = RecordingBlocks.of(recordings).sample(present)
        common: list[float] = []
        for frames in some:
            if len(frames):
                above = frames - scale.baseline[cells]
                common += [_least_loaded(frame) for frame in above[:: max(1, len(above) // _FRAMES)]]
        common = common or [0.0]
        mostly = min(0.0, float(np.median(common)))
        return cls(mostly, max(mostly + scale.near / 2, float(np.quantile(common, _USUAL))))

    def excess(self, offset: ArrayLike) -> Floats:
        """Return how far offsets ``[...]`` lie above where cells mostly rest; 0 for those that are usual."""
        offset = np.asarray(offset, dtype=np.float64)
        return np.where(offset > self.most, offset - self.mostly, 0.0)


@dataclass(frozen=True)
class OffsetTracker:
    """How far untouched cells now read above where they rested in the reference.

    Attributes:
        lowest: float ``[D]``, the lowest reading of each cell in the log, above that; inf where there was none.
        own: float ``[D]``, the offset of each cell that follows from it, beside that of all.
        common: that of all cells together, beside their own, in each of the last frames ``[t]``.
    """

    lowest: Floats
    own: Floats
    common: Floats

    @classmethod
    def begin(cls, n_cells: int) -> OffsetTracker:
        """Nothing seen yet."""
        return cls(np.full(n_cells, np.inf), np.zeros(n_cells), np.zeros(1))

    def extend(self, frames: Floats, scale: Scale, present: NDArray[np.bool_], usual: ReferenceOffset) -> OffsetTracker:
        """Return the offsets after more frames.

        Args:
            frames: ``[t, D]``, NaN = missing.
            scale: where cells rested in the reference.
            present: bool ``[D]``.
            usual: what the reference shows.
        """
        lowest = np.fmin(self.lowest, np.fmin.reduce(frames) - scale.baseline)
        own = np.zeros(len(lowest))
        if (lowest > scale.near / 2).any():
            joined = usual.excess(_least_loaded(lowest[present]))
            alone = lowest - np.where(joined < _COMMON * scale.full_scale, joined, 0.0)
            own = np.where((alone > scale.near / 2) & (alone < _OWN * scale.full_scale), alone, 0.0)
        # Mostly all cells together have none: enough of them read no more than usual all through.
        calm = present & (np.fmax.reduce(frames) - scale.baseline - own <= usual.most)
        if np.count_nonzero(calm) > _LEAST_LOADED * np.count_nonzero(present):
            return OffsetTracker(lowest, own, np.zeros(len(frames)))
        common = usual.excess([_least_loaded(frame) for frame in (frames - scale.baseline - own)[:, present]])
        last = self.common[-1]
        for t in np.flatnonzero(common >= _COMMON * scale.full_scale):  # nearly all cells are loaded: it stays
            common[t] = common[t - 1] if t else last
        return OffsetTracker(lowest, own, common)

    def on(self, scale: Scale) -> Scale:
        """Return where cells rest now."""
        now = self.own + self.common[-1]
        return replace(scale, baseline=scale.baseline + now) if now.any() else scale

    def off(self, frames: Floats) -> Floats:
        """Return the last frames ``[t, D]`` with the offset of the last of them throughout."""
        drift = self.common - self.common[-1]
        return frames - drift[:, None] if drift.any() else frames


def _least_loaded(above: Floats) -> float:
    """Return how far the cells that are loaded least are above their rest, from that of all, ``[n]``."""
    received = above[np.isfinite(above)]
    k = int(_LEAST_LOADED * (len(received) - 1))
    return float(np.partition(received, k)[k]) if len(received) else 0.0
