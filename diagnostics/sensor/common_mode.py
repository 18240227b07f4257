"""Common mode: what the cells of a pad share beyond the reference (hum, ramps, offsets,
crosstalk).

c_t is the lower quartile over the cells of a pad of reading less rest; more cells than that are
unloaded. Its extremes in a recording are compared by the test of Kolmogorov and Smirnov
(:mod:`diagnostics.sensor.sensor_change`). The excess is c_t beyond its range in the reference, and
by how much the lowest c_t of successive recordings lies outside that of the reference.

Each cell reads it with a gain of its own: a model of rank one. The gain is the median over pairs of
frames with different excess of the ratio of both differences, a Theil-Sen slope (Sen 1968), in the
frames in which contacts load the pad least. It is 1 where the gains of most cells differ by less
than an eighth, and where the excess comes with the load (crosstalk), for cells with a slope above
one half over all frames. A cell that is stuck has gain 0 and keeps its readings. Where cells creep
apart from recording to recording, what each rests higher by in nine successive ones is taken out.

Not detected: a common mode where contacts load three quarters of the cells of a pad, one within the
range of the reference, and what fewer than five recordings show.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

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
_PAIRS = 4000  # of frames, that tell whether a cell follows the common mode: a size
_LEAST = 0.005  # of full scale: readings that differ by less agree
_DECILES = np.linspace(0.1, 0.9, 9)


@dataclass(frozen=True)
class CommonMode:
    """What the idle cells of each pad read beyond the range of the reference.

    Attributes:
        excess: ``[T, pads]`` of each recording, in the layout's unit.
        gains: ``[D]``, how much of it each cell reads; 0 where it does not.
        rest: ``[D]``, reading of each cell without contact, in the layout's unit.
        creep: ``[R, D]``, by how much cells that creep apart rest higher in each recording: taken
            out in place of the excess. None: they do not.
        disturbance: how it is told.
    """

    excess: tuple[Floats, ...]
    gains: Floats
    rest: Floats
    disturbance: Disturbance
    creep: Floats | None = None

    def undo(self, recordings: Recordings, layout: SensorLayout) -> list[Floats]:
        """Return recordings ``[T, D]`` without it, within 0 and full scale."""
        cleaned = []
        for i, (frames, excess) in enumerate(zip(recordings, self.excess, strict=True)):
            shared = self.gains * excess[:, layout.pad_of]
            if self.creep is not None:
                shared = np.broadcast_to(self.creep[i], frames.shape)
            without = frames - shared
            # What it would move below its rest has less of it: clipped at 0, it would look stuck.
            low = known_quantile(without, LOW, axis=0)
            most = np.maximum(shared.max(axis=0), 0.0)
            moved = without + np.clip(np.nan_to_num(self.rest - low), 0.0, most)
            cleaned.append(np.where(shared == 0, frames, np.clip(moved, 0.0, layout.full_scale)))
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
    gains, comes_with_load = _gains(recordings, excess, rest, layout)
    largest = int(np.abs(every).max(axis=0).argmax())
    of_pad = [one[:, largest] for one in excess]
    name, what = _told(of_pad, comes_with_load=bool(comes_with_load[largest]))
    reason = f"{what} of {size:.3g} {layout.unit}, which the cells of a pad share"
    found = CommonMode(tuple(excess), gains, rest, Disturbance(name, size, reason))
    if name != "ramp" or np.isin(gains, [0, 1]).all():
        return found
    return replace(found, creep=np.where(gains > 0, _creep(recordings, rest), 0.0))


def _creep(recordings: Recordings, rest: Floats) -> Floats:
    """Return by how much each cell rests higher in each recording, ``[R, D]``: the median of its
    low quantile less ``rest``, at least 0, over up to nine successive recordings with that one in
    their middle."""
    low = np.stack([known_quantile(frames, LOW, axis=0) for frames in recordings]) - rest
    count = len(low)
    reach = [min(i, count - 1 - i, _NEAR) for i in range(count)]
    near = [low[i - n : i + n + 1] for i, n in enumerate(reach)]
    middle = np.stack([known_quantile(few, 0.5, axis=0) for few in near])
    return np.nan_to_num(middle).clip(0.0, None)


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


def _gains(
    recordings: Recordings, excess: list[Floats], rest: Floats, layout: SensorLayout
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return how much of the common mode each cell reads, ``[D]``, and whether that of each pad
    comes with its load, bool ``[pads]``.

    Where it is constant, all cells that ever change read it once, and so do those that read it
    beyond their rest.

    Args:
        recordings, excess: ``[T, D]`` and ``[T, pads]`` each.
        rest: ``[D]``.
        layout: the array.
    """
    frames = np.concatenate(recordings)
    every = np.concatenate(excess)
    lowest = np.fmin.reduce(frames)
    shifted = (
        np.abs(lowest - rest - np.median(every, axis=0)[layout.pad_of])
        <= _LEAST * layout.full_scale
    )
    gains = (shifted | (np.fmax.reduce(frames) > lowest)).astype(np.float64)
    comes_with_load = np.zeros(layout.pads, bool)
    for pad in range(layout.pads):
        cells = layout.pad_of == pad
        of_pad = every[:, pad]
        if _is_constant(of_pad):
            continue
        above = frames[:, cells] - rest[cells]
        slope = _slopes(above, of_pad)
        swings = not _is_slow([one[:, pad] for one in excess])
        comes_with_load[pad] = swings and _is_crosstalk(of_pad, _contact(above - of_pad[:, None]))
        if comes_with_load[pad]:
            gains[cells] = slope > MAJORITY
            continue
        contact = _contact(above - slope * of_pad[:, None])
        idle = contact <= np.quantile(contact, LEAST_LOADED)
        own = _slopes(above[idle], of_pad[idle])
        follows = own > LOW
        if not follows.any() or _spread(own[follows]) < LEAST_LOADED / 2:
            gains[cells] = own > MAJORITY
        else:
            gains[cells] = np.where(follows, own, 0.0)
    return gains, comes_with_load


def _spread(gains: Floats) -> float:
    """Return by which share of their median gains differ from it, the median of that."""
    middle = np.median(gains)
    return float(np.median(np.abs(gains / middle - 1)))


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


def _slopes(above: Floats, excess: Floats) -> Floats:
    """Return the median ratio of changes of each cell (``[T, cells]``) and of the common mode
    (``[T]``), ``[cells]``: over pairs of frames in which that differs by half of its range."""
    rng = np.random.default_rng(0)
    first, second = rng.integers(len(excess), size=(2, 4 * _PAIRS))
    difference = excess[first] - excess[second]
    large = (np.abs(difference) >= np.ptp(excess) / 2) & (difference != 0)
    if not large.any():
        return np.zeros(above.shape[1])
    first = first[large][:_PAIRS]
    second = second[large][:_PAIRS]
    ratios = (above[first] - above[second]) / difference[large][:_PAIRS, None]
    # a missing reading follows nothing
    return np.asarray(np.median(np.nan_to_num(ratios), axis=0))


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


def _told(excess: list[Floats], *, comes_with_load: bool) -> tuple[Name, str]:
    """Return the name of a common mode, and what it is in words; ``excess``: that of a pad,
    ``[T]`` of each recording."""
    if comes_with_load:
        return "crosstalk", "a reading that comes and goes with the load of the pad"
    if _is_constant(np.concatenate(excess)):
        return "offset", "a constant shift"
    return ("ramp", "a shift") if _is_slow(excess) else ("hum", "an oscillation")
