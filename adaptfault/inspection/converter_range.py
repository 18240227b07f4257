"""Readings that no converter gives count as missing. Needs no torch."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics import SensorLayout
from diagnostics.preprocessing.transport import invalid


def within_range(frames: NDArray[Any], layout: SensorLayout) -> tuple[NDArray[Any], int]:
    """Return readings ``[..., D]`` in the layout's unit with NaN where no converter gives such a
    value.

    That is: infinite, or more than one full scale outside 0 to full scale, as in a diagnosis.

    Returns:
        The readings (the same array where all are in range), and the number of readings replaced.
    """
    wrong = invalid(frames, layout.full_scale)
    return (
        (frames, 0)
        if wrong is None
        else (np.where(wrong, np.nan, frames), int(np.count_nonzero(wrong)))
    )
