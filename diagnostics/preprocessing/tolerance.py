"""How far the readings of a constant cell are apart, from the step of the converter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import MARGIN
from diagnostics.preprocessing.readings import RecordingBlocks, spread

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

# of full scale: half the range of a stuck cell's reading, the dither of a converter
TOLERANCE = 0.005
_ROUNDING = 1e-6


def tolerance_of(recordings: Sequence[NDArray[np.float64]], layout: SensorLayout) -> float:
    """Return the half range of a constant reading: 1.5 converter steps, within 0.5 to 1 % of full
    scale."""
    step = converter_step(recordings, layout)
    return max(TOLERANCE * layout.full_scale, min(MARGIN * step, 2 * TOLERANCE * layout.full_scale))


def converter_step(recordings: Sequence[NDArray[Any]], layout: SensorLayout) -> float:
    """Return the smallest difference of two readings, 0 without any."""
    readings = RecordingBlocks.of(recordings)
    sample = readings.thinned(spread(np.flatnonzero(layout.present)))
    return least_step(sample[np.isfinite(sample)], layout.full_scale)


def least_step(values: NDArray[Any], scale: float) -> float:
    """Return the smallest difference of two values, 0 without any; what is less than a millionth of
    the ``scale`` is rounding."""
    steps = np.diff(np.unique(values))
    steps = steps[steps > _ROUNDING * scale]
    return float(steps.min()) if len(steps) else 0.0
