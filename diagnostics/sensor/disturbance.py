"""Disturbances of all cells: noise, coarse steps, saturation, scaled frames, sentinels, silence.

A cell is judged by what the others do, so what all of them share must be explained first. Each
disturbance is a statistic of a recording, compared between the log and the reference by the test of
Kolmogorov and Smirnov (``scipy.stats.ks_2samp``, p < 1e-4) and by its size, as a change of the
sensor is (:mod:`diagnostics.sensor.sensor_change`).

- **Noise**: the robust standard deviation from second differences, median over cells.
- **Quantised**: the smallest difference of two readings.
- **Saturated**: the share of readings that equal the highest one of all cells, below full scale.
- **Normalised**: nearly every frame reaches both the lowest and the highest reading of the log, at
  changing cells.
- **Sentinel**: one number outside the converter's range, again and again.
- **Silent**: no reading of any cell ever changes, although those of the reference do in the tenth
  of the frames with the least load. Where these do not, as without noise, the log may be one
  without contact.

What the cells of a pad share is found beside it (:mod:`diagnostics.sensor.common_mode`). Not
detected: changes of gain that come and go, and what fewer than five recordings show.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.baseline import deviation
from diagnostics.preprocessing.levels import (
    LEAST_LOADED,
    LOW,
    MAJORITY,
    MARGIN,
    P_MIN,
    RARE,
    SLIGHT,
)
from diagnostics.preprocessing.quantiles import known_quantile
from diagnostics.preprocessing.transport import invalid
from diagnostics.sensor.sensor_change import differ

Name = Literal[
    "hum",
    "ramp",
    "offset",
    "crosstalk",
    "noise",
    "quantised",
    "saturated",
    "normalised",
    "sentinel",
    "silent_array",
]

Floats = NDArray[np.float64]
Recordings = Sequence[Floats]

_FEWEST = 5  # recordings
_TIMES = 2.0  # by which a statistic must differ


@dataclass(frozen=True)
class Disturbance:
    """A disturbance of a log.

    Attributes:
        name: its kind.
        size: in the layout's unit; a share for "saturated", "normalised" and "sentinel".
        reason: one sentence.
    """

    name: Name
    size: float
    reason: str


def find_disturbances(
    recordings: Recordings, reference: Recordings, layout: SensorLayout
) -> list[Disturbance]:
    """Return the other disturbances of a log; the reference may be empty.

    Args:
        recordings: ``[T, D]`` each, in the layout's unit; NaN = missing.
        reference: healthy recordings, likewise.
        layout: the array.
    """
    found = [_normalised(recordings, layout)]
    if reference:
        found += [
            test(recordings, reference, layout)
            for test in (_silent, _noise, _quantised, _saturated)
        ]
    return [one for one in found if one is not None]


def find_sentinel(recordings: Recordings, layout: SensorLayout) -> Disturbance | None:
    """Return the number outside the converter's range that a driver writes where it has no value;
    None without one.

    Args:
        recordings: as they came, ``[T, D]`` each.
        layout: the array.
    """
    counts: Counter[float] = Counter()
    readings = 0
    for frames in recordings:
        given = np.asarray(frames, dtype=np.float64)[:, layout.is_cell]
        readings += given.size
        outside = invalid(given, layout.full_scale)
        if outside is not None:
            values, how_often = np.unique(given[outside & np.isfinite(given)], return_counts=True)
            counts.update(dict(zip(values.tolist(), how_often.tolist(), strict=True)))
    if not counts:
        return None
    value, times = counts.most_common(1)[0]
    if times < _FEWEST or times < MAJORITY * counts.total():
        return None
    share = times / readings
    reason = (
        f"{times} readings ({share:.1%}) are {value:g}, outside the range: the driver has no value"
        " there"
    )
    return Disturbance("sentinel", share, reason)


def rest_of(reference: Recordings, layout: SensorLayout) -> Floats:
    """Return the reading of each cell without contact, ``[D]``: the median over recordings of its
    low quantile."""
    lows = np.stack([known_quantile(frames, LOW, axis=0) for frames in reference])
    return np.where(layout.is_cell, known_quantile(lows, 0.5, axis=0), np.nan)


def extremes_of(recordings: Recordings) -> tuple[Floats, Floats]:
    """Return the lowest and the highest reading of each cell, ``[D]``; NaN for a cell without
    any."""
    lowest = np.fmin.reduce([np.fmin.reduce(frames) for frames in recordings])
    highest = np.fmax.reduce([np.fmax.reduce(frames) for frames in recordings])
    return lowest, highest


def _moving_cells(recordings: Recordings, layout: SensorLayout) -> tuple[NDArray[np.bool_], Floats]:
    """Return the cells whose readings differ, bool ``[D]``, and the highest reading of each,
    ``[D]``."""
    low, high = extremes_of(recordings)
    return layout.is_cell & (high - low > SLIGHT * layout.full_scale), high


def _differs(new: Floats, old: Floats) -> bool:
    """Return whether the statistic of the recordings of a log is larger than that of the reference,
    not by chance."""
    new = new[np.isfinite(new)]
    old = old[np.isfinite(old)]
    return differ(new, old) and bool(np.median(new) > np.median(old))


def _noise(
    recordings: Recordings, reference: Recordings, layout: SensorLayout
) -> Disturbance | None:
    new, old = (
        np.array([_deviation(frames, layout) for frames in given])
        for given in (recordings, reference)
    )
    least = _step(reference, layout) / 2
    if not _differs(new, old) or np.nanmedian(new) + least < _TIMES * (np.nanmedian(old) + least):
        return None
    size = float(np.nanmedian(new))
    before = float(np.nanmedian(old))
    reason = (
        f"the noise of all cells has a standard deviation of {size:.3g} {layout.unit}, {before:.3g}"
        " in the reference"
    )
    return Disturbance("noise", size, reason)


def _deviation(frames: Floats, layout: SensorLayout) -> float:
    """Return the standard deviation of the noise, median over cells; NaN for fewer than eight
    frames."""
    if len(frames) < 8:
        return np.nan
    curvature = np.abs(np.diff(frames[:, layout.is_cell], 2, axis=0))
    received = ~np.isnan(curvature).all(axis=0)
    if not received.any():
        return np.nan
    return deviation(float(np.median(np.nanmedian(curvature[:, received], axis=0))))


def _step(recordings: Recordings, layout: SensorLayout) -> float:
    """Return the smallest difference of two readings; 0 without any."""
    sample = np.concatenate([frames[:: max(1, len(frames) // 20)] for frames in recordings])
    values = np.unique(sample[:, layout.is_cell])
    gaps = np.diff(values[np.isfinite(values)])
    gaps = gaps[gaps > 1e-9 * layout.full_scale]
    return float(np.quantile(gaps, LOW)) if len(gaps) else 0.0


def _quantised(
    recordings: Recordings, reference: Recordings, layout: SensorLayout
) -> Disturbance | None:
    new = _step(recordings, layout)
    old = _step(reference, layout)
    if len(recordings) < _FEWEST or old == 0 or new < 4 * old or new < RARE * layout.full_scale:
        return None
    reason = (
        f"readings differ by {new:.3g} {layout.unit} at least, {old:.3g} in the reference: the"
        " converter lost bits"
    )
    return Disturbance("quantised", new, reason)


def _saturated(
    recordings: Recordings, reference: Recordings, layout: SensorLayout
) -> Disturbance | None:
    rest = rest_of(reference, layout)
    near = SLIGHT * layout.full_scale
    moving, high = _moving_cells(recordings, layout)
    if not moving.any():
        return None
    top = float(high[moving].max())
    at_top = high[moving] >= top
    before = float(np.nanmax(extremes_of(reference)[1][moving]))
    new, old = (
        np.array([_share_at(frames[:, moving], level, rest[moving] + near) for frames in given])
        for given, level in ((recordings, top), (reference, before))
    )
    if not _differs(new, old) or np.median(new) < MARGIN * LOW or at_top.mean() < LEAST_LOADED:
        return None
    size = float(np.median(new))
    return Disturbance(
        "saturated", size, f"{size:.0%} of the loaded readings are at the end of the range, {top:g}"
    )


def _share_at(frames: Floats, level: float, loaded_from: Floats) -> float:
    """Return the share of the received readings above ``loaded_from`` that are at least ``level``;
    0 without any."""
    loaded = frames > loaded_from
    return float((frames[loaded] >= level).mean()) if loaded.any() else 0.0


def _normalised(recordings: Recordings, layout: SensorLayout) -> Disturbance | None:
    every = np.concatenate(recordings)[:, layout.is_cell]
    lowest = np.nanmin(every)
    highest = np.nanmax(every)
    if not highest > lowest or every.shape[1] < 3:
        return None
    at_low = every == lowest
    at_high = every == highest
    both = float((at_low.any(axis=1) & at_high.any(axis=1)).mean())
    # Not one broken cell at either end: the places change.
    places = min(len(np.unique(at.argmax(axis=1)[at.any(axis=1)])) for at in (at_low, at_high))
    alone = float((at_high.sum(axis=1) == 1).mean())
    if both < 1 - LOW or places < 3 or alone < MAJORITY:
        return None
    reason = (
        f"{both:.0%} of the frames reach {lowest:g} and {highest:g}: each was scaled by its own"
        " extremes"
    )
    return Disturbance("normalised", both, reason)


def _silent(
    recordings: Recordings, reference: Recordings, layout: SensorLayout
) -> Disturbance | None:
    present = layout.is_cell

    def changes(frames: Floats) -> bool:
        given = frames[:, present]
        return bool((np.fmax.reduce(given) > np.fmin.reduce(given)).any())

    def changes_at_rest(frames: Floats) -> bool:
        load = np.nan_to_num(frames[:, present]).mean(axis=1)
        return changes(frames[load <= np.quantile(load, LOW)])

    if any(changes(frames) for frames in recordings):
        return None
    usual = np.mean([changes_at_rest(frames) for frames in reference])
    idle = (1 - usual) ** len(recordings)
    if idle >= P_MIN:
        return None
    values = np.concatenate(recordings)[:, present]
    reason = (
        f"no reading of any cell changes in {len(recordings)} recordings: no cell is connected, or"
        " none was touched"
    )
    return Disturbance("silent_array", float(np.nanmedian(values)) if values.size else 0.0, reason)
