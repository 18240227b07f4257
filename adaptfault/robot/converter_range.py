"""Readings outside the range of the converter, which count as missing. Needs no torch."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics import SensorLayout

MARGIN = 0.05
"""Share of the full scale by which calibrated readings may lie outside the range."""


def within_range(frames: NDArray[np.float64], layout: SensorLayout) -> tuple[NDArray[np.float64], int]:
    """Return readings ``[..., D]`` in the layout's unit with NaN where no converter gives such a value.

    That is: infinite, or more than 5 % of the full scale outside 0 to ``layout.full_scale``.

    Returns:
        The readings (the same array where all are in range), and the number of readings replaced.
    """
    outside = outside_range(frames, layout)
    count = int(np.count_nonzero(outside))
    return (np.where(outside, np.nan, frames), count) if count else (frames, 0)


def outside_range(frames: NDArray[Any], layout: SensorLayout) -> NDArray[np.bool_]:
    """Return which readings ``[..., D]`` no converter gives, bool; False for missing ones (NaN)."""
    margin = MARGIN * layout.full_scale
    outside: NDArray[np.bool_] = (frames < -margin) | (frames > layout.full_scale + margin)
    return outside
