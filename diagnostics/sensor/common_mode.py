"""Common mode: what the cells of a pad share beyond the reference (hum, ramps, offsets,
crosstalk).

c_t is the lower quartile over the cells of a pad of reading less rest; more cells than that are
unloaded. Its extremes in a recording are compared by the test of Kolmogorov and Smirnov
(:mod:`diagnostics.sensor.sensor_change`). The excess is c_t beyond its range in the reference, and
by how much the lowest c_t of successive recordings lies outside that of the reference.

It is told, not taken out: the model of the array finds for itself what a pad shares
(:mod:`diagnostics.model.rest`).

Not detected: a common mode where contacts load three quarters of the cells of a pad, one within the
range of the reference, and what fewer than five recordings show.
"""

from __future__ import annotations

import numpy as np

from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import LEAST_LOADED, LOW, MAJORITY, RARE, SLIGHT
from diagnostics.preprocessing.quantiles import known_quantile
from diagnostics.sensor.disturbance import (
    Disturbance,
    Floats,
    Name,
    Recordings,
    extremes_of,
    rest_of,
)
from diagnostics.sensor.sensor_change import differ

_NEAR = 4  # recordings before and after one, whose rest is compared with it
_LEAST = 0.005  # of full scale: readings that differ by less agree
_DECILES = np.linspace(0.1, 0.9, 9)


def find_common_mode(
    recordings: Recordings, reference: Recordings, layout: SensorLayout
) -> Disturbance | None:
    """Return the common mode of a log; None where it is as in the reference.

    Args:
        recordings: ``[T, D]`` each, in the layout's unit; NaN = missing.
        reference: healthy recordings, likewise.
        layout: the array.
    """
    rest = rest_of(reference, layout)
    usual = [_common(frames, rest, layout) for frames in reference]
    # A cell that reads one number throughout the log, and not its rest, is stuck: it tells nothing
    # of the others.
    low, high = extremes_of(recordings)
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
    largest = int(np.abs(every).max(axis=0).argmax())
    of_pad = [one[:, largest] for one in excess]
    cells = layout.pad_of == largest
    above = np.concatenate(recordings)[:, cells] - rest[cells]
    name, what = _told(of_pad, above)
    reason = f"{what} of {size:.3g} {layout.unit}, which the cells of a pad share"
    return Disturbance(name, size, reason)


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


def _common(frames: Floats, rest: Floats, layout: SensorLayout) -> Floats:
    """Return the lower quartile over the cells of each pad of reading less rest, ``[T, pads]``; NaN
    without a cell."""
    common = np.full((len(frames), layout.pads), np.nan)
    for pad in range(layout.pads):
        cells = (layout.pad_of == pad) & ~np.isnan(rest)
        if cells.any():
            common[:, pad] = known_quantile(frames[:, cells] - rest[cells], LEAST_LOADED, axis=1)
    return common


def _contact(above: Floats) -> Floats:
    """Return how much contacts load a pad in each frame, ``[T]``, of what its cells read above rest
    and common mode, ``[T, cells]``: the range from their lower quartile to the highest tenth."""
    quiet = known_quantile(above, LEAST_LOADED, axis=1)
    loaded = known_quantile(above, 1 - LOW, axis=1)
    return np.asarray(np.nan_to_num(loaded - quiet))


def _is_crosstalk(excess: Floats, contact: Floats) -> bool:
    """Return whether a common mode comes and goes with the load of its pad, ``[T]`` both: their
    ranks agree, and it is the smaller of both."""
    ranks = np.argsort(np.argsort([excess, contact], axis=1), axis=1)
    largest = np.abs(excess) >= np.quantile(np.abs(excess), 1 - LOW)
    smaller = np.median(contact[largest]) > np.median(np.abs(excess[largest]))
    agreement = np.corrcoef(ranks[0], ranks[1])
    return bool(smaller and np.asarray(agreement)[0, 1] > MAJORITY)


def _is_constant(excess: Floats) -> bool:
    """Return whether the excess ``[T]`` of a pad is there in nearly every frame, and of about one
    size."""
    size = np.abs(excess)
    return bool(np.quantile(size, LOW) >= MAJORITY * np.quantile(size, 1 - LOW))


def _is_slow(excess: list[Floats]) -> bool:
    """Return whether a common mode, ``[T]`` of each recording, changes from recording to recording
    rather than within them, and little between two that follow each other.

    The latter is the ratio of von Neumann (1941) of the means: 2 for means in random order.
    """
    means = np.array([one.mean() for one in excess])
    within = np.mean([one.std() for one in excess])
    successive = np.mean(np.diff(means) ** 2) if len(means) > 1 else 0.0
    return bool(means.std() >= within and successive < means.var())


def _told(excess: list[Floats], above: Floats) -> tuple[Name, str]:
    """Return the name of a common mode, and what it is in words; ``excess``: that of a pad, ``[T]``
    of each recording; ``above``: readings of its cells above rest, ``[T, cells]``."""
    of_pad = np.concatenate(excess)
    if _is_constant(of_pad):
        return "offset", "a constant shift"
    if _is_slow(excess):
        return "ramp", "a shift"
    if _is_crosstalk(of_pad, _contact(above - of_pad[:, None])):
        return "crosstalk", "a reading that comes and goes with the load of the pad"
    return "hum", "an oscillation"
