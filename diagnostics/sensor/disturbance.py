"""Disturbances that the cells of a pad share: hum, ramps, crosstalk, noise, coarse steps,
saturation, sentinels.

A cell is judged by what the others do, so what all of them share must be explained first. Each
disturbance is a statistic of a recording, compared between the log and the reference by the test of
Kolmogorov and Smirnov (``scipy.stats.ks_2samp``, p < 1e-4) and by its size, as a change of the
sensor is (:mod:`diagnostics.sensor.sensor_change`).

- **Common mode** (hum, ramp, offset, crosstalk): c_t, the lower quartile over the cells of a pad of
  reading less rest; more cells than that are unloaded. Its extremes in a recording are compared.
  The excess is c_t beyond its range in the reference, and by how much the lowest c_t of successive
  recordings lies outside that of the reference. It can be taken out of every cell that follows it:
  over pairs of frames with different excess, the median of the ratio of both differences is above
  one half. A cell that is stuck does not follow it and keeps its readings.
- **Noise**: the robust standard deviation from second differences, median over cells.
- **Quantised**: the smallest difference of two readings.
- **Saturated**: the share of readings that equal the highest one of all cells, below full scale.
- **Normalised**: nearly every frame reaches both the lowest and the highest reading of the log, at
  changing cells.
- **Sentinel**: one number outside the converter's range, again and again.
- **Silent**: no reading of any cell ever changes, although those of the reference do in the tenth
  of the frames with the least load. Where these do not, as without noise, the log may be one
  without contact.

Not detected: a common mode where contacts load three quarters of the cells of a pad, one within the
range of the reference, changes of gain that come and go, and what fewer than five recordings show.
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
_NEAR = 4  # recordings before and after one, whose rest is compared with it
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


def find_common_mode(
    recordings: Recordings, reference: Recordings, layout: SensorLayout
) -> CommonMode | None:
    """Return the common mode of a log; None where it is as in the reference.

    Args:
        recordings: ``[T, D]`` each, in the layout's unit; NaN = missing.
        reference: healthy recordings, likewise.
        layout: the array.
    """
    rest = _rest(reference, layout)
    usual = [_common(frames, rest, layout) for frames in reference]
    # A cell that reads one number throughout the log, and not its rest, is stuck: it tells nothing
    # of the others.
    low, high = _extremes(recordings)
    stuck = (low == high) & ~(np.abs(low - rest) <= SLIGHT * layout.full_scale)
    common = [_common(frames, np.where(stuck, np.nan, rest), layout) for frames in recordings]
    telling = [
        pad
        for pad in range(layout.pads)
        if _is_unusual([c[:, pad] for c in common], usual, pad, layout)
    ]
    if not telling:
        return None
    lowest, highest = (
        known_quantile(np.concatenate(usual), share, axis=0) for share in (RARE, 1 - RARE)
    )
    rests = np.stack([np.fmin.reduce(one) for one in usual])
    shifts = _shifts(np.stack([np.fmin.reduce(one) for one in common]), rests)
    telling += [pad for pad in range(layout.pads) if shifts[:, pad].any()]
    excess = []
    for one, shift in zip(common, shifts, strict=True):
        moved = one - shift
        beyond = np.nan_to_num(shift + moved - np.clip(moved, lowest, highest))
        beyond[:, [pad not in telling for pad in range(layout.pads)]] = 0.0
        excess.append(beyond)
    every = np.concatenate(excess)
    size = float((np.fmax.reduce(every).clip(0) - np.fmin.reduce(every).clip(None, 0)).max())
    if size <= _LEAST * layout.full_scale:
        return None
    follows = _follows(np.concatenate(recordings), every, rest, layout)
    largest = int(np.abs(every).max(axis=0).argmax())
    name, what = _told(
        recordings, [one[:, largest] for one in excess], rest, layout.pad_of == largest
    )
    reason = f"{what} of {size:.3g} {layout.unit}, which the cells of a pad share"
    return CommonMode(tuple(excess), follows, Disturbance(name, size, reason))


def _shifts(new: Floats, rests: Floats) -> Floats:
    """Return by how much the common mode at rest differs in each recording, ``[R, pads]``.

    Compared are nine successive recordings: a contact that is held is no shift. 0 where three
    quarters of them are not outside the range of the reference, else their median. Pads that agree
    within this range have the same shift.

    Args:
        new: lowest common mode of each recording, ``[R, pads]``.
        rests: likewise, of the reference.
    """
    lowest = np.fmin.reduce(rests)
    highest = np.fmax.reduce(rests)
    near = [new[max(0, i - _NEAR) : i + _NEAR + 1] for i in range(len(new))]
    low, rest, high = (
        np.stack([known_quantile(few, share, axis=0) for few in near])
        for share in (LEAST_LOADED, 0.5, 1 - LEAST_LOADED)
    )
    shift = np.nan_to_num(rest - known_quantile(rests, 0.5, axis=0))
    middle = (shift.shape[1] - 1) // 2
    shared = np.take_along_axis(shift, np.argsort(np.abs(shift), axis=1), axis=1)[
        :, middle : middle + 1
    ]
    agrees = np.abs(shift - shared) <= highest - lowest
    outside = (high < lowest) | (low > highest)
    together = (outside & agrees).any(axis=1, keepdims=True)
    return np.where(outside | (agrees & together), np.where(agrees, shared, shift), 0.0)


def _is_unusual(common: list[Floats], usual: list[Floats], pad: int, layout: SensorLayout) -> bool:
    """Return whether the extremes of the common mode of a pad are those of the reference no
    more."""
    for extreme in (np.fmin.reduce, np.fmax.reduce):
        new = np.array([extreme(one) for one in common])
        old = np.array([extreme(one[:, pad]) for one in usual])
        new = new[np.isfinite(new)]
        old = old[np.isfinite(old)]
        if not differ(new, old):
            continue
        if (
            np.abs(np.quantile(new, _DECILES) - np.quantile(old, _DECILES)).max()
            > _LEAST * layout.full_scale
        ):
            return True
    return False


def find_disturbances(
    recordings: Recordings, reference: Recordings, layout: SensorLayout
) -> list[Disturbance]:
    """Return the other disturbances of a log; arguments as of :func:`find_common_mode`, the
    reference may be empty."""
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
    reason = (
        f"{times} readings ({share:.1%}) are {value:g}, outside the range: the driver has no value"
        " there"
    )
    return Disturbance("sentinel", share, reason)


def _rest(reference: Recordings, layout: SensorLayout) -> Floats:
    """Return the reading of each cell without contact, ``[D]``: the median over recordings of its
    low quantile."""
    lows = np.stack([known_quantile(frames, LOW, axis=0) for frames in reference])
    return np.where(layout.present.ravel(), known_quantile(lows, 0.5, axis=0), np.nan)


def _extremes(recordings: Recordings) -> tuple[Floats, Floats]:
    """Return the lowest and the highest reading of each cell, ``[D]``; NaN for a cell without
    any."""
    lowest = np.fmin.reduce([np.fmin.reduce(frames) for frames in recordings])
    highest = np.fmax.reduce([np.fmax.reduce(frames) for frames in recordings])
    return lowest, highest


def _common(frames: Floats, rest: Floats, layout: SensorLayout) -> Floats:
    """Return the lower quartile over the cells of each pad of reading less rest, ``[T, pads]``; NaN
    without a cell."""
    common = np.full((len(frames), layout.pads), np.nan)
    for pad in range(layout.pads):
        cells = (layout.pad_of == pad) & ~np.isnan(rest)
        if cells.any():
            common[:, pad] = known_quantile(frames[:, cells] - rest[cells], LEAST_LOADED, axis=1)
    return common


def _follows(
    frames: Floats, excess: Floats, rest: Floats, layout: SensorLayout
) -> NDArray[np.bool_]:
    """Return the cells that read the common mode, bool ``[D]``.

    Where it is constant, these are all that ever change, and those that read it beyond their rest
    (``[D]``). Where it changes, a cell whose baseline without it would lie below 0 does not follow.
    """
    rng = np.random.default_rng(0)
    lowest = np.fmin.reduce(frames)
    shifted = (
        np.abs(lowest - rest - np.median(excess, axis=0)[layout.pad_of])
        <= _LEAST * layout.full_scale
    )
    follows: NDArray[np.bool_] = shifted | (np.fmax.reduce(frames) > lowest)
    for pad in range(layout.pads):
        of_pad = excess[:, pad]
        first, second = rng.integers(len(of_pad), size=(2, 4 * _PAIRS))
        difference = of_pad[first] - of_pad[second]
        least = np.ptp(of_pad) / 2
        large = (np.abs(difference) >= least) & (difference != 0)
        if not large.any() or _is_constant(of_pad):
            continue
        first = first[large][:_PAIRS]
        second = second[large][:_PAIRS]
        difference = difference[large][:_PAIRS]
        cells = layout.pad_of == pad
        ratios = (frames[first][:, cells] - frames[second][:, cells]) / difference[:, None]
        # a missing reading follows nothing
        follows[cells] = np.median(np.nan_to_num(ratios), axis=0) > MAJORITY
        without = known_quantile(frames[:, cells] - of_pad[:, None], LOW, axis=0)
        follows[cells] &= ~(without < -_LEAST * layout.full_scale)
    return follows


def _is_constant(excess: Floats) -> bool:
    """Return whether the excess ``[T]`` of a pad is there in nearly every frame, and of about one
    size."""
    size = np.abs(excess)
    return bool(np.quantile(size, LOW) >= MAJORITY * np.quantile(size, 1 - LOW))


def _told(
    recordings: Recordings, excess: list[Floats], rest: Floats, of_pad: NDArray[np.bool_]
) -> tuple[Name, str]:
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
    if _is_constant(np.concatenate(excess)):
        return "offset", "a constant shift"
    within = np.mean([one.std() for one in excess])
    between = np.std([one.mean() for one in excess])
    return ("hum", "an oscillation") if within > between else ("ramp", "a shift")


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
    rest = _rest(reference, layout)
    near = SLIGHT * layout.full_scale
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
    return Disturbance(
        "saturated", size, f"{size:.0%} of the loaded readings are at the end of the range, {top:g}"
    )


def _share(frames: Floats, loaded_from: Floats, level: float) -> float:
    """Return the share of loaded readings at ``level``, 0 without any."""
    loaded = frames > loaded_from
    return float((frames[loaded] >= level).mean()) if loaded.any() else 0.0


def _normalised(recordings: Recordings, layout: SensorLayout) -> Disturbance | None:
    every = np.concatenate(recordings)[:, layout.present.ravel()]
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
    present = layout.present.ravel()

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
