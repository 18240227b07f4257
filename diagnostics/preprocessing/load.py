"""Loads: readings of sensors that fall with load, or rest in the middle, as readings that rise with
it from 0::

    low      load = reading
    high     load = full scale - reading
    middle   load = |reading - rest|
             rest: median of the quiet readings of each cell in the healthy recordings

Everything after this sees loads only; faults are reported as readings. ``learn`` decides for one of
the three, for the whole array: of the cells that move, it compares how far each goes above its
median with how far it goes below. Sensors that are loaded most of the time have no rest that
repeats; they count as low, as do sensors without a reference and all doubtful ones: a direction
that is known is better declared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import MAJORITY, SLIGHT
from diagnostics.preprocessing.readings import CELLS, RecordingBlocks, spread
from diagnostics.preprocessing.transport import invalid

if TYPE_CHECKING:
    from diagnostics.layout import Rest, SensorLayout

_MOVES = 0.1  # of full scale: range of a cell that was loaded
# of the range, at most: rest from its end where load moves cells one way, from its middle where
# both
_ASIDE = 0.15

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LoadDirection:
    """How readings become loads, in the layout's unit.

    Attributes:
        direction: ``"high"`` or ``"middle"``; readings of sensors that rest low are loads already.
        rest: float ``[D]``, what each cell reads without load.
        full_scale: of the layout.
    """

    direction: str
    rest: Floats
    full_scale: float

    @classmethod
    def declared(cls, layout: SensorLayout) -> LoadDirection | None:
        """Return the direction without any recording: cells that rest in the middle rest at half of
        full scale."""
        direction = "middle" if layout.axes > 1 and layout.rest == "learn" else layout.rest
        if direction not in ("high", "middle"):
            return None
        share = 1.0 if direction == "high" else 0.5
        return cls(direction, np.full(layout.n_cells, share * layout.full_scale), layout.full_scale)

    @classmethod
    def fit(cls, recordings: Sequence[NDArray[Any]], layout: SensorLayout) -> LoadDirection | None:
        """Learn what the layout leaves open from fault-free recordings, ``[T, D]`` each; None:
        readings are loads."""
        readings = RecordingBlocks.of(recordings)
        if layout.rest == "learn" and layout.axes == 1:
            layout = replace(layout, rest=_learned(readings, layout))
        found = cls.declared(layout)
        if found is not None and found.direction == "middle":
            for some in np.split(np.arange(layout.n_cells), range(CELLS, layout.n_cells, CELLS)):
                sample = readings.thinned(some)
                received = ~np.isnan(sample).all(axis=0)
                found.rest[some[received]] = np.nanmedian(sample[:, received], axis=0)
        return found

    def check(self, layout: SensorLayout) -> None:
        """Raise ValueError unless this is a direction of ``layout``."""
        if (
            self.direction not in ("high", "middle")
            or self.rest.shape != (layout.n_cells,)
            or not self.full_scale > 0
        ):
            raise ValueError(
                f"expected a direction of load, high or middle, of {layout}; got {self.direction!r}"
            )

    def loads(self, frames: Floats) -> Floats:
        """Return the loads of readings ``[T, D]``; readings that no converter gives stay so."""
        if self.direction == "high":
            return self.full_scale - frames
        wrong = invalid(frames, self.full_scale)
        loads: Floats = np.abs(frames - self.rest)
        return loads if wrong is None else np.where(wrong, np.inf, loads)

    def readings(self, loads: Floats, below: NDArray[np.bool_]) -> Floats:
        """Return the readings of loads ``[D]``; ``below`` (bool ``[D]``): cells that read less than
        at rest."""
        down = below | (self.direction == "high")
        return np.clip(np.where(down, self.rest - loads, self.rest + loads), 0.0, self.full_scale)


def _learned(readings: RecordingBlocks, layout: SensorLayout) -> Rest:
    """Return the direction of load of the array, see the module."""
    low, high = readings.extremes()
    moved = spread(np.flatnonzero(layout.is_cell & (high - low > _MOVES * layout.full_scale)))
    if not len(moved):
        return "low"
    low = low[moved]
    high = high[moved]
    sample = readings.thinned(moved)
    rest = np.nanmedian(sample, axis=0)
    up = float(np.median((high - rest) / (high - low)))
    quiet = float(np.median((np.abs(sample - rest) <= SLIGHT * layout.full_scale).mean(axis=0)))
    # Where a load is held most of the time, it differs between cells more than the readings without
    # it do.
    if up >= 1 - _ASIDE or quiet < MAJORITY or _quartile_range(rest) > _quartile_range(low):
        return "low"
    return "high" if up <= _ASIDE else "middle" if abs(up - 0.5) <= _ASIDE else "low"


def _quartile_range(values: NDArray[np.float64]) -> float:
    """Return ``scipy.stats.iqr(values)``, which is slow to import."""
    lower, upper = np.percentile(values, [25, 75])
    return float(upper - lower)
