"""Frames in which a group reads as one: the cells of one bus, converter or connector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

_MOST = 0.5  # of the cells are loaded: of one alone it may be noise
_NOISIER = 2  # single frames than their mean in a piece


@dataclass(frozen=True)
class AsOne:
    """Finds the frames in which all cells of a group read one value, and most of them are loaded,
    or are exactly equal though they have noise; or in which none changes, from the frame before or
    to the next one.

    Attributes:
        on: bool ``[G, D]``, cells of each group.
        unloaded: ``[D]``, highest reading of each without a load.
        tolerance: readings within +- this of a value are that value.
        noise: whether readings that do not change are rare in the reference.
    """

    on: Mask
    unloaded: NDArray[np.float32]
    tolerance: float
    noise: bool

    def __call__(self, frames: NDArray[np.floating]) -> Mask:
        """Return in which of successive frames ``[t, D]`` each group does, bool ``[t, G]``."""
        found = np.zeros((len(frames), len(self.on)), bool)
        for g, on in enumerate(self.on):
            own = frames[:, on]
            spread = own.max(axis=1) - own.min(axis=1)
            loaded = (own > self.unloaded[on]).mean(axis=1) > _MOST
            found[:, g] = (spread <= 2 * _NOISIER * self.tolerance) & loaded
            if self.noise:
                same = np.all(own[1:] == own[:-1], axis=1)
                found[:, g] |= spread == 0
                found[1:, g] |= same
                found[:-1, g] |= same
        return found
