"""Disturbances that the cells of a pad share: hum, ramps, crosstalk, noise, coarse steps, saturation, sentinels.

A cell is judged by what the others do, so what all of them share must be explained first. Each disturbance is a
statistic of a recording, compared between the log and the reference by the test of Kolmogorov and Smirnov
(``scipy.stats.ks_2samp``, p < 1e-4) and by its size, as a change of the sensor is
(:mod:`diagnostics.evidence.sensor_change`).

- **Common mode** (hum, ramp, crosstalk): c_t, the median over the cells of a pad of reading less rest. The excess is
  c_t beyond the range that it has in the reference. It can be taken out of every cell that follows it: over pairs of
  frames with different excess, the median of the ratio of both differences is above one half. A cell that is stuck does
  not follow it and keeps its readings.
- **Noise**: the robust standard deviation from second differences, median over cells.
- **Quantised**: the smallest difference of two readings.
- **Saturated**: the share of readings that equal the highest one of all cells, below full scale.
- **Normalised**: nearly every frame reaches both the lowest and the highest reading of the log, at changing cells.
- **Sentinel**: one number outside the converter's range, again and again.
- **Silent**: no reading of any cell ever changes, although those of the reference do.

Not detected: a common mode where a contact loads half of the cells of a pad, changes of gain that come and go, and
what fewer than five recordings show.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import ks_2samp

from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import LOW, MAJORITY, MARGIN, P_MIN, RARE

Name = Literal["hum", "ramp", "crosstalk", "noise", "quantised", "saturated", "normalised", "sentinel", "silent_array"]

Floats = NDArray[np.float64]
Recordings = Sequence[Floats]

_FEWEST = 5  # recordings
_PAIRS = 4000  # of frames, that tell whether a cell follows the common mode: a size
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
    """Return the common mode of a log; None where it stays within the range of the reference.

    Args:
        recordings: ``[T, D]`` each, in the layout's unit; NaN = missing.
        reference: healthy recordings, likewise.
        layout: the array.
    """
    rest = _rest(reference, layout)
    usual = np.concatenate([_common(frames, rest, layout) for frames in reference])
    low, high = np.nanquantile(usual, [RARE, 1 - RARE], axis=0)
    margin = _step(reference, layout) / 2
    common = [_common(frames, rest, layout) for frames in recordings]
    excess = [np.nan_to_num(c - np.clip(c, low - margin, high + margin)) for c in common]
    share = np.mean([(np.abs(one) > 0).any() for one in excess])
    if share <= LOW:
        return None
    every = np.concatenate(excess)
    size = float(np.ptp(every, axis=0).max())
    follows = _follows(np.concatenate(recordings), every, layout)
    name, what = _told(recordings, excess, common, rest, layout)
    reason = f"{what} of {size:.3g} {layout.unit}, which the cells of a pad share, in {share:.0%} of the recordings"
    return CommonMode(tuple(excess), follows, Disturbance(name, size, reason))


def find_disturbances(recordings: Recordings, reference: Recordings, layout: SensorLayout) -> list[Disturbance]:
    """Return the other disturbances of a log; arguments as of :func:`find_common_mode`."""
    found = [
        _normalised(recordings, layout),
        _silent(recordings, reference, layout),
        _noise(recordings, reference, layout),
        _quantised(recordings, reference, layout),
        _saturated(recordings, reference, layout),
    ]
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
        outside = np.isfinite(given) & (np.abs(given - layout.full_scale / 2) > 1.5 * layout.full_scale)
        values, times = np.unique(given[outside], return_counts=True)
        counts.update(dict(zip(values.tolist(), times.tolist(), strict=True)))
        readings += given.size
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
    low: Floats = np.nanmedian([np.nanquantile(frames, LOW, axis=0) for frames in reference], axis=0)
    return np.where(layout.present.ravel(), low, np.nan)


def _common(frames: Floats, rest: Floats, layout: SensorLayout) -> Floats:
    """Return the median over the cells of each pad of reading less rest, ``[T, pads]``."""
    above = frames - rest
    of_pad = [above[:, (layout.pad_of == pad) & ~np.isnan(rest)] for pad in range(layout.pads)]
    return np.stack([_median(one) for one in of_pad], axis=1)


def _median(values: Floats) -> Floats:
    """Return the median of each row; NaN where nothing was read."""
    read = ~np.isnan(values).all(axis=1)
    median = np.full(len(values), np.nan)
    if values.shape[1]:
        median[read] = np.nanmedian(values[read], axis=1)
    return median


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
        follows[cells] = np.nan_to_num(np.nanmedian(ratios, axis=0)) > MAJORITY
    return follows


def _told(
    recordings: Recordings, excess: list[Floats], common: list[Floats], rest: Floats, layout: SensorLayout
) -> tuple[Name, str]:
    """Return the name of a common mode, and what it is in words."""
    every = np.concatenate(excess)
    load = np.concatenate([np.nanmean(frames - rest, axis=1) for frames in recordings])[:, None]
    load = load - np.concatenate(common)  # of the cells that a contact loads
    strongest = int(np.ptp(every, axis=0).argmax())
    of_pad = every[:, strongest]
    if np.ptp(of_pad) > 0 and np.ptp(load[:, strongest]) > 0:
        together = np.corrcoef(of_pad, np.nan_to_num(load[:, strongest]))[0, 1]
        if together > 1 - MAJORITY / 2:
            return "crosstalk", "a reading that grows with the load of the pad"
    within = np.mean([one[:, strongest].std() for one in excess])
    between = np.std([one[:, strongest].mean() for one in excess])
    return ("hum", "an oscillation") if within > between else ("ramp", "a shift")


def _differs(new: Floats, old: Floats) -> bool:
    """Return whether the statistic of the recordings of a log is larger than that of the reference, not by chance."""
    new, old = new[np.isfinite(new)], old[np.isfinite(old)]
    if min(len(new), len(old)) < _FEWEST or np.median(new) <= np.median(old):
        return False
    return bool(ks_2samp(new, old).pvalue < P_MIN)


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
    return float(np.median(np.nanmedian(curvature[:, received], axis=0))) / (float(ndtri(0.75)) * np.sqrt(6))


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
    rest = _rest(reference, layout)
    near = 0.02 * layout.full_scale
    every = np.concatenate(recordings)
    moving = layout.present.ravel() & (np.nanmax(every, axis=0) - np.nanmin(every, axis=0) > near)
    if not moving.any():
        return None
    top = float(np.nanmax(every[:, moving]))

    def share(given: Recordings, level: float) -> Floats:
        shares = []
        for frames in given:
            loaded = (frames - rest > near)[:, moving]
            shares.append((loaded & (frames[:, moving] >= level)).sum() / max(1, loaded.sum()))
        return np.array(shares)

    before = float(max(np.nanmax(frames[:, moving]) for frames in reference))
    new, old = share(recordings, top), share(reference, min(before, layout.full_scale))
    cells = int((every[:, moving] >= top).any(axis=0).sum())
    if not _differs(new, old) or np.median(new) < MARGIN * LOW or cells < 3:
        return None
    size = float(np.median(new))
    return Disturbance("saturated", size, f"{size:.0%} of the loaded readings are at the end of the range, {top:g}")


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
        return bool((np.nanmax(given, axis=0, initial=-np.inf) > np.nanmin(given, axis=0, initial=np.inf)).any())

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
