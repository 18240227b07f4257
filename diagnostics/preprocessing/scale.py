"""What a reading means: where cells rest, and how hard they are loaded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Scale:
    """Where a cell rests, and from where on it is loaded.

    Attributes:
        resting: float ``[D]``, reading of an untouched cell.
        near: how far from that still counts as resting.
        full_scale: of the layout.
    """

    baseline: NDArray[np.float64]
    near: float
    full_scale: float

    def root_load(self, frames: NDArray[np.float64]) -> Array:
        """Return the square root of the load, 0..1, ``[..., D]``: noise grows with load, its root does not.

        A missing reading counts as resting.
        """
        load = ((frames - self.baseline) / self.full_scale).astype(np.float32)
        # What rests is no load at all, so that a little noise at rest means nothing. Not a number counts as none.
        root: Array = np.sqrt(np.where(load > np.float32(self.near / self.full_scale), load, np.float32(0)))
        return root

    def of(self, cells: NDArray[np.intp]) -> Scale:
        """Return the scale of some cells."""
        return Scale(self.baseline[cells], self.near, self.full_scale)

    @property
    def root_near(self) -> float:
        """The root load from which on a cell counts as loaded."""
        return float(np.sqrt(self.near / self.full_scale))
