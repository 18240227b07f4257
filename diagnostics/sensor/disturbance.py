"""Disturbances that the cells of a pad share: hum, ramps, crosstalk, noise, coarse steps, saturation, sentinels.

A cell is judged by what the others do, so what all of them share must be explained first. Each disturbance is a
statistic of a recording, compared between the log and the reference by the test of Kolmogorov and Smirnov
(``scipy.stats.ks_2samp``, p < 1e-4) and by its size, as a change of the sensor is
(:mod:`diagnostics.evidence.sensor_change`).

- **Common mode** (hum, ramp, crosstalk): c_t, the lower quartile over the cells of a pad of reading less rest; more
  cells than that are unloaded. Its extremes in a recording are compared. The excess is c_t beyond its range in the
  reference. It can be taken out of every cell that follows it: over pairs of frames with different excess, the median
  of the ratio of both differences is above one half. A cell that is stuck does not follow it and keeps its readings.
- **Noise**: the robust standard deviation from second differences, median over cells.
- **Quantised**: the smallest difference of two readings.
- **Saturated**: the share of readings that equal the highest one of all cells, below full scale.
- **Normalised**: nearly every frame reaches both the lowest and the highest reading of the log, at changing cells.
- **Sentinel**: one number outside the converter's range, again and again.
- **Silent**: no reading of any cell ever changes, although those of the reference do.

Not detected: a common mode where contacts load three quarters of the cells of a pad, one within the range of the
reference, changes of gain that come and go, and what fewer than five recordings show.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.sensor_change import differ
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.baseline import deviation
from diagnostics.preprocessing.levels import LEAST_LOADED, LOW, MAJORITY, MARGIN, P_MIN, RARE, SLIGHT
from diagnostics.preprocessing.transport import invalid

Name = Literal["hum", "ramp", "crosstalk", "noise", "quantised", "saturated", "normalised", "sentinel", "silent_array"]

Floats = NDArray[np.float64]
Recordings = Sequence[Floats]

_FEWEST = 5  # recordings
_PAIRS = 4000  # of frames, that tell whether a cell follows the common mode: a size
_TIMES = 2.0  # by which a statistic must differ
_LEAST = 0.005  # of full scale: readings that differ by less agree
_DECILES = np.linspace(0.1, 0.9, 9)


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


@dataclass(frozen=True)
class CommonMode:
    """What the idle cells of each pad read beyond the range of the reference.

    Attributes:
        excess: ``[T, pads]`` of each recording, in the layout's unit.
        follows: bool ``[D]``, the cells that read it.
        disturbance: how it is told.
    """

    excess: tuple[Floats, ...]
    follows: NDArray[np.bool_]
    disturbance: Disturbance

    def undo(self, recordings: Recordings, layout: SensorLayout) -> list[Floats]:
        """Return recordings ``[T, D]`` without it, within 0 and full scale."""
        cleaned = []
        for frames, excess in zip(recordings, self.excess, strict=True):
            shared = np.where(self.follows, excess[:, layout.pad_of], 0.0)
            moved = np.clip(frames - shared, 0.0, layout.full_scale)
            cleaned.append(np.where(shared == 0, frames, moved))
        return cleaned


def find_common_mode(recordings: Recordings, reference: Recordings, layout: SensorLayout) -> CommonMode | None:
    """Return the common mode of a log; None where it is as in the reference.

    Args:
        recordings: ``[T, D]`` each, in the layout's unit; NaN = missing.
        reference: healthy recordings, likewise.
        layout: the array.
    """
    rest = _rest(reference, layout)
    usual = [_common(frames, rest, layout) for frames in reference]
    # A cell that reads one number throughout the log, and not its rest, is stuck: it tells nothing of the others.
    low, high = _extremes(recordings)
    stuck = (low == high) & ~(np.abs(low - rest) <= SLIGHT * layout.full_scale)
    common = [_common(frames, np.where(stuck, np.nan, rest), layout) for frames in recordings]
    telling = [pad for pad in range(layout.pads) if _is_unusual([c[:, pad] for c in common], usual, pad, layout)]
    if not telling:
        return None
    lowest, highest = np.nanquantile(np.concatenate(usual), [RARE, 1 - RARE], axis=0)
    excess = []
    for one in common:
        beyond = np.nan_to_num(one - np.clip(one, lowest, highest))
        beyond[:, [pad not in telling for pad in range(layout.pads)]] = 0.0
        excess.append(beyond)
    every = np.concatenate(excess)
    size = float(np.ptp(every, axis=0).max())
    if size == 0:
        return None
    follows = _follows(np.concatenate(recordings), every, layout)
    largest = int(np.abs(every).max(axis=0).argmax())
    name, what = _told(recordings, [one[:, largest] for one in excess], rest, layout.pad_of == largest)
    reason = f"{what} of {size:.3g} {layout.unit}, which the cells of a pad share"
    return CommonMode(tuple(excess), follows, Disturbance(name, size, reason))


def _is_unusual(common: list[Floats], usual: list[Floats], pad: int, layout: SensorLayout) -> bool:
    """Return whether the extremes of the common mode of a pad are those of the reference no more."""
    for extreme in (np.fmin.reduce, np.fmax.reduce):
        new = np.array([extreme(one) for one in common])
        old = np.array([extreme(one[:, pad]) for one in usual])
        new = new[np.isfinite(new)]
        old = old[np.isfinite(old)]
        if not differ(new, old):
            continue
        if np.abs(np.quantile(new, _DECILES) - np.quantile(old, _DECILES)).max() > _LEAST * layout.full_scale:
            return True
    return False


def find_disturbances(recordings: Recordings, reference: Recordings, layout: SensorLayout) -> list[Disturbance]:
    """Return the other disturbances of a log; arguments as of :func:`find_common_mode`, the reference may be empty."""
    found = [_normalised(recordings, layout)]
    if reference:
        found += [test(recordings, reference, layout) for test in (_silent, _noise, _quantised, _saturated)]
    return [one for one in found if one is not None]


def find_sentinel(recordings: Recordings, layout: SensorLayout) -> Disturbance | None:
    """Return the number outside the converter's range that a driver writes where it has no value; None without one.

    Args:
        recordings: as they came, ``[T, D]`` each.
        layout: the array.
    """
    counts: Counter[float] = Counter()
    readings = 0
    for frames in recordings:
        given = np.asarray(frames, dtype=np.float64)[:, layout.present.ravel()]
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
    reason = f"{times} readings ({share:.1%}) are {value:g}, outside the range: the driver has no value there"
    return Disturbance("sentinel", share, reason)


def _rest(reference: Recordings, layout: SensorLayout) -> Floats:
    """Return the reading of each cell without contact, ``[D]``: the median over recordings of its low quantile."""
    lows = np.stack([_low(frames) for frames in reference])
    rest = np.full(layout.n_cells, np.nan)
    read = layout.present.ravel() & ~np.isnan(lows).all(axis=0)
    rest[read] = np.nanmedian(lows[:, read], axis=0)
    return rest


def _low(frames: Floats) -> Floats:
    """Return a low quantile of the readings of each cell, ``[D]``; NaN for a cell without any."""
    low = np.full(frames.shape[1], np.nan)
    read = ~np.isnan(frames).all(axis=0)
    low[read] = np.nanquantile(frames[:, read], LOW, axis=0)
    return low


def _extremes(recordings: Recordings) -> tuple[Floats, Floats]:
    """Return the lowest and the highest reading of each cell, ``[D]``; NaN for a cell without any."""
    lowest = np.fmin.reduce([np.fmin.reduce(frames) for frames in recordings])
    highest = np.fmax.reduce([np.fmax.reduce(frames) for frames in recordings])
    return lowest, highest


def _common(frames: Floats, rest: Floats, layout: SensorLayout) -> Floats:
    """Return the lower quartile over the cells of each pad of reading less rest, ``[T, pads]``; NaN without a cell."""
    common = np.full((len(frames), layout.pads), np.nan)
    for pad in range(layout.pads):
        above = frames[:, (layout.pad_of == pad) & ~np.isnan(rest)] - rest[(layout.pad_of == pad) & ~np.isnan(rest)]
        read = ~np.isnan(above).all(axis=1)
        if above.shape[1] and read.any():
            common[read, pad] = np.nanquantile(above[read], LEAST_LOADED, axis=1)
    return common


def _follows(frames: Floats, excess: Floats, layout: SensorLayout) -> NDArray[np.bool_]:
    """Return the cells that read the common mode, bool ``[D]``; where it is constant, all."""
    rng = np.random.default_rng(0)
    follows = np.ones(layout.n_cells, bool)
    for pad in range(layout.pads):
        of_pad = excess[:, pad]
        first, second = rng.integers(len(of_pad), size=(2, 4 * _PAIRS))
        difference = of_pad[first] - of_pad[second]
        least = np.ptp(of_pad) / 2
        large = (np.abs(difference) >= least) & (difference != 0)
        if not large.any():
            continue
        first, second, difference = first[large][:_PAIRS], second[large][:_PAIRS], difference[large][:_PAIRS]
        cells = layout.pad_of == pad
        ratios = (frames[first][:, cells] - frames[second][:, cells]) / difference[:, None]
        follows[cells] = np.median(np.nan_to_num(ratios), axis=0) > MAJORITY  # a missing reading follows nothing
    return follows


def _told(recordings: Recordings, excess: list[Floats], rest: Floats, of_pad: NDArray[np.bool_]) -> tuple[Name, str]:
    """Return the name of a common mode, and what it is in words.

    Args:
        recordings, excess: ``[T, D]`` and ``[T]`` each.
        rest: ``[D]``.
        of_pad: bool ``[D]``, the cells of the pad.
    """
    cells = of_pad & ~np.isnan(rest)
    above = np.nan_to_num(np.concatenate(recordings)[:, cells] - rest[cells])
    quiet, loaded = np.quantile(above, [LEAST_LOADED, 1 - LOW], axis=1)  # what all share is in both
    every = np.abs(np.concatenate(excess))
    idle = loaded - quiet < np.quantile(loaded - quiet, LEAST_LOADED)
    if idle.any() and every[idle].mean() < LOW * every.mean():
        return "crosstalk", "a reading that comes and goes with the load of the pad"
    within = np.mean([one.std() for one in excess])
    between = np.std([one.mean() for one in excess])
    return ("hum", "an oscillation") if within > between else ("ramp", "a shift")


def _differs(new: Floats, old: Floats) -> bool:
    """Return whether the statistic of the recordings of a log is larger than that of the reference, not by chance."""
    new = new[np.isfinite(new)]
    old = old[np.isfinite(old)]
    return differ(new, old) and bool(np.median(new) > np.median(old))


def _noise(recordings: Recordings, reference: Recordings, layout: SensorLayout) -> Disturbance | None:
    new, old = (np.array([_deviation(frames, layout) for frames in given]) for given in (recordings, reference))
    least = _step(reference, layout) / 2
    if not _differs(new, old) or np.nanmedian(new) + least < _TIMES * (np.nanmedian(old) + least):
        return None
    size, before = float(np.nanmedian(new)), float(np.nanmedian(old))
    reason = (
        f"the noise of all cells has a standard deviation of {size:.3g} {layout.unit}, {before:.3g} in the reference"
    )
    return Disturbance("noise", size, reason)


def _deviation(frames: Floats, layout: SensorLayout) -> float:
    """Return the standard deviation of the noise, median over cells; NaN for fewer than eight frames."""
    if len(frames) < 8:
        return np.nan
    curvature = np.abs(np.diff(frames[:, layout.present.ravel()], 2, axis=0))
    received = ~np.isnan(curvature).all(axis=0)
    if not received.any():
        return np.nan
    return deviation(float(np.median(np.nanmedian(curvature[:, received], axis=0))))


def _step(recordings: Recordings, layout: SensorLayout) -> float:
    """Return the smallest difference of two readings; 0 without any."""
    sample = np.concatenate([frames[:: max(1, len(frames) // 20)] for frames in recordings])
    values = np.unique(sample[:, layout.present.ravel()])
    gaps = np.diff(values[np.isfinite(values)])
    gaps = gaps[gaps > 1e-9 * layout.full_scale]
    return float(np.quantile(gaps, LOW)) if len(gaps) else 0.0


def _quantised(recordings: Recordings, reference: Recordings, layout: SensorLayout) -> Disturbance | None:
    new, old = _step(recordings, layout), _step(reference, layout)
    if len(recordings) < _FEWEST or old == 0 or new < 4 * old or new < RARE * layout.full_scale:
        return None
    reason = f"readings differ by {new:.3g} {layout.unit} at least, {old:.3g} in the reference: the converter lost bits"
    return Disturbance("quantised", new, reason)


def _saturated(recordings: Recordings, reference: Recordings, layout: SensorLayout) -> Disturbance | None:
    rest, near = _rest(reference, layout), SLIGHT * layout.full_scale
    low, high = _extremes(recordings)
    moving = layout.present.ravel() & (high - low > near)
    if not moving.any():
        return None
    top = float(high[moving].max())
    at_top = high[moving] >= top
    before = float(np.nanmax(_extremes(reference)[1][moving]))
    new, old = (
        np.array([_share(frames[:, moving], rest[moving] + near, level) for frames in given])
        for given, level in ((recordings, top), (reference, before))
    )
    if not _differs(new, old) or np.median(new) < MARGIN * LOW or at_top.mean() < LEAST_LOADED:
        return None
    size = float(np.median(new))
    return Disturbance("saturated", size, f"{size:.0%} of the loaded readings are at the end of the range, {top:g}")


def _share(frames: Floats, loaded_from: Floats, level: float) -> float:
    """Return the share of loaded readings at ``level``, 0 without any."""
    loaded = frames > loaded_from
    return float((frames[loaded] >= level).mean()) if loaded.any() else 0.0


def _normalised(recordings: Recordings, layout: SensorLayout) -> Disturbance | None:
    every = np.concatenate(recordings)[:, layout.present.ravel()]
    lowest, highest = np.nanmin(every), np.nanmax(every)
    if not highest > lowest or every.shape[1] < 3:
        return None
    at_low, at_high = every == lowest, every == highest
    both = float((at_low.any(axis=1) & at_high.any(axis=1)).mean())
    # Not one broken cell at either end: the places change.
    places = min(len(np.unique(at.argmax(axis=1)[at.any(axis=1)])) for at in (at_low, at_high))
    alone = float((at_high.sum(axis=1) == 1).mean())
    if both < 1 - LOW or places < 3 or alone < MAJORITY:
        return None
    reason = f"{both:.0%} of the frames reach {lowest:g} and {highest:g}: each was scaled by its own extremes"
    return Disturbance("normalised", both, reason)


def _silent(recordings: Recordings, reference: Recordings, layout: SensorLayout) -> Disturbance | None:
    present = layout.present.ravel()

    def changes(frames: Floats) -> bool:
        given = frames[:, present]
        return bool((np.fmax.reduce(given) > np.fmin.reduce(given)).any())

    if any(changes(frames) for frames in recordings):
        return None
    usual = np.mean([changes(frames) for frames in reference])
    idle = (1 - usual) ** len(recordings)
    if idle >= P_MIN:
        return None
    values = np.concatenate(recordings)[:, present]
    reason = (
        f"no reading of any cell changes in {len(recordings)} recordings: no cell is connected, or none was touched"
    )
    return Disturbance("silent_array", float(np.nanmedian(values)) if values.size else 0.0, reason)
