"""Change of the converter: an amplifier that saturates, a converter that lost bits.

Where the end of the range cuts readings off, or their steps are coarse, a healthy cell looks like
one that is stuck or blinks. The same can be done to the reference: then a log is judged by what
healthy cells read behind the same converter. Of a reading x of a cell::

    saturated:  y = r + g (x - r), within 0 and top
    quantised:  z = the highest level of the log that is at most y, or the nearest one

``top`` is the highest reading; r is where the cell rests, or 0 where cells rest higher now, as the
gain moves them. The gain g maps the quantile of the loads in the reference that the share of
readings at the top is in the log onto the top (quantile mapping). Bits that are cut off
leave the level below, rounding leaves the nearest one: that counts which leaves a share of the
readings in the lowest level nearer to that of the log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import SLIGHT
from diagnostics.sensor.disturbance import (
    Disturbance,
    Floats,
    Recordings,
    moving_cells,
    rest_of,
    share_at,
)

_CELLS = 3  # that read a level of the converter: others are noise of a broken cell


@dataclass(frozen=True)
class ConverterChange:
    """What a converter does to readings.

    Attributes:
        fixed: reading of each cell that the gain leaves as it is, ``[D]``.
        gain: of what is above.
        top: highest reading.
        levels: that it can read, ``[n]``, in order; None: as in the reference.
        bounds: lowest reading that gives each of the levels but the lowest, ``[n - 1]``.
    """

    fixed: Floats
    gain: float = 1.0
    top: float = np.inf
    levels: Floats | None = None
    bounds: Floats | None = None

    def of(self, recordings: Recordings) -> list[Floats]:
        """Return what it makes of recordings ``[T, D]`` each."""
        return [self._of(np.asarray(frames, dtype=np.float64)) for frames in recordings]

    def _of(self, frames: Floats) -> Floats:
        read = frames
        if np.isfinite(self.top):
            read = np.clip(self.fixed + self.gain * (frames - self.fixed), 0.0, self.top)
        if self.levels is None or self.bounds is None:
            return read
        level = self.levels[np.searchsorted(self.bounds, read, side="right")]
        return np.where(np.isnan(read), np.nan, level)

    def shifts(self, rest: Floats, now: Floats, cells: NDArray[np.bool_]) -> float:
        """Return by how much some cells (bool ``[D]``), which rested at ``rest``, rest elsewhere
        than it would make of that, ``[cells]`` both: the median."""
        fixed = self.fixed[cells]
        made = np.minimum(fixed + self.gain * (rest - fixed), self.top)
        return float(np.nanmedian(np.abs(made - now)))


def find_converter_change(
    recordings: Recordings,
    reference: Recordings,
    layout: SensorLayout,
    disturbances: Sequence[Disturbance],
) -> ConverterChange | None:
    """Return what the converter does that it did not do in the reference; None where no disturbance
    tells of it.

    Args:
        recordings: ``[T, D]`` each, in the layout's unit; NaN = missing.
        reference: healthy recordings, likewise.
        layout: the array.
        disturbances: of the log.
    """
    sizes = {one.name: one.size for one in disturbances}
    moving, high = moving_cells(recordings, layout)
    if not reference or not moving.any() or not {"quantised", "saturated"} & sizes.keys():
        return None
    rest = rest_of(reference, layout)
    change = ConverterChange(rest)
    log = np.concatenate(recordings)[:, moving]
    if "saturated" in sizes:
        top = float(high[moving].max())
        at_top = share_at(log, top)
        either = [_amplifying(fixed, top, at_top, reference, moving) for fixed in (rest, 0 * rest)]
        now = rest_of(recordings, layout)[moving]
        change = min(either, key=lambda one: one.shifts(rest[moving], now, moving))
    if sizes.get("quantised", 0.0) < 2 * change.gain:  # the gain makes such steps
        return change
    levels = _levels(log)
    if len(levels) < 2:
        return change
    nearest = (levels[1:] + levels[:-1]) / 2
    read = np.concatenate(change.of(reference))[:, moving]
    above = share_at(log, float(levels[1]))
    bounds = min((levels[1:], nearest), key=lambda one: abs(above - share_at(read, float(one[0]))))
    return replace(change, levels=levels, bounds=bounds)


def _amplifying(
    fixed: Floats, top: float, at_top: float, reference: Recordings, moving: NDArray[np.bool_]
) -> ConverterChange:
    """Return the change with which a share ``at_top`` of the readings of ``moving`` cells (bool
    ``[D]``) in the reference reaches the ``top``."""
    above = (np.concatenate(reference) - fixed)[:, moving]
    reached = float(np.nanquantile(above, 1 - at_top))
    gain = (top - float(np.median(fixed[moving]))) / max(reached, SLIGHT * top)
    return ConverterChange(fixed, gain, top)


def _levels(log: Floats) -> Floats:
    """Return what several cells read of a log ``[T, cells]``, in order."""
    of_cells = [np.unique(of_cell[np.isfinite(of_cell)]) for of_cell in log.T]
    values, cells = np.unique(np.concatenate(of_cells), return_counts=True)
    return np.asarray(values[cells >= min(_CELLS, log.shape[1])])
