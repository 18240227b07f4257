"""A change of the whole sensor: gain, or offset, of all cells at once. No single cell stands out, so no fault is found.

Statistic, per recording r over the healthy cells: the baseline b_r is the median over cells of each cell's 5 % quantile
over time; the load l_r is the 99 % quantile of all readings above the baseline. With n new recordings and m reference
recordings, the gain is exp(median log l_new - median log l_ref) and the offset is median b_new - median b_ref. A change
is reported where it exceeds four standard errors, each from the median absolute deviation (Rousseeuw and Croux 1993),
and a size that matters.

Not detected: a change with fewer than five recordings of contact, a change below the limits, swapped cells, and a
change of the gain of single cells. Other objects or tasks than in the reference look like a change of the gain.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation

from diagnostics.evidence.drift import GAIN
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.scale import LIGHT

_LEAST = 5  # recordings, new and reference, for a standard error that can be trusted
_ERRORS = 4.0  # standard errors
_LOW, _HIGH = 0.05, 0.99  # quantiles: baseline of a cell, load of a recording


@dataclass(frozen=True)
class SensorChange:
    """How the readings of all cells differ from the reference.

    Attributes:
        gain: ratio of the loads, new : reference; 1 where no change was found.
        offset: difference of the baselines in the layout's unit; 0 where no change was found.
        recordings: number of new recordings that were compared.
        reason: one sentence.
    """

    gain: float
    offset: float
    recordings: int
    reason: str


def sensor_change(
    recordings: Iterable[NDArray[Any]],
    reference: Iterable[NDArray[Any]],
    layout: SensorLayout,
    healthy: NDArray[np.intp],
) -> SensorChange | None:
    """Compare recordings with healthy ones; None where no change of the whole sensor is found.

    Args:
        recordings: ``[T, D]`` each, in the layout's unit; NaN = missing.
        reference: healthy recordings, likewise.
        layout: the array.
        healthy: the cells to compare, int ``[n]``.
    """
    new, old = (_statistics(given, healthy) for given in (recordings, reference))
    offset, error = _shift(new[:, 0], old[:, 0])
    if abs(offset) < max(LIGHT * layout.full_scale, _ERRORS * error):
        offset = 0.0
    contact = LIGHT * layout.full_scale
    loads = [np.log(given[given[:, 1] > contact, 1]) for given in (new, old)]
    change, error = _shift(*loads)
    gain = float(np.exp(change)) if abs(change) >= max(np.log(GAIN), _ERRORS * error) else 1.0
    if gain == 1.0 and offset == 0.0:
        return None
    parts = []
    if gain != 1.0:
        parts.append(f"readings are about {gain:.2g}x of what they were")
    if offset != 0.0:
        parts.append(f"the readings of idle cells are shifted by {offset:+.2g} {layout.unit}")
    return SensorChange(gain, offset, len(new), f"sensor changed: {' and '.join(parts)}")


def _statistics(recordings: Iterable[NDArray[Any]], healthy: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return baseline and load of each recording with a reading, ``[n, 2]``."""
    rows = []
    for recording in recordings:
        frames = np.asarray(recording)[:, healthy]
        frames = frames[:, ~np.isnan(frames).all(axis=0)] if len(frames) else frames
        if frames.size:
            baseline = float(np.median(np.nanquantile(frames, _LOW, axis=0)))
            rows.append((baseline, float(np.nanquantile(frames, _HIGH)) - baseline))
    return np.array(rows, dtype=np.float64).reshape(-1, 2)


def _shift(new: NDArray[np.float64], old: NDArray[np.float64]) -> tuple[float, float]:
    """Return the difference of two medians and its standard error; 0 and infinite for too few values."""
    if min(len(new), len(old)) < _LEAST:
        return 0.0, np.inf
    # The variance of a median of n normal values is pi / 2 / n of theirs.
    variances = [np.pi / 2 * float(median_abs_deviation(v, scale="normal")) ** 2 / len(v) for v in (new, old)]
    return float(np.median(new) - np.median(old)), float(np.sqrt(sum(variances)))
