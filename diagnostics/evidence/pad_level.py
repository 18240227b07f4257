"""Pad level: cells that read less than the other cells of their pad do at the same time.

Detects open cells without contact, where all cells of a pad rest elsewhere in each recording: as
its supply sags or its converter warms. The level of a pad is

    level = min(0, q25 over its cells of (highest reading in the segment - baseline))

and the statistic is the highest reading of a constant run, relative to the baseline of the cell and
to the highest level of its pad during the run. Its limit is the 0.001 quantile over cells and
recordings of the reference, less two tolerances; a run at the low rail that lies below has a log
likelihood ratio of 12, every other one 0. The quantile over cells is that of offset tracking, a
minimum statistic (Martin 2001).

Where the recordings of the reference rest at levels of their own
(:mod:`~diagnostics.preprocessing.offset`), with the range m, it detects cells that hold any value
while the others rise. Contacts raise no level then:

    level = min(m, minimum over the segment of q25 over its cells of (reading - baseline))

It detects nothing in pads that rest at 0, in segments in which they do, where more than a quarter
of the cells of a pad are open or contacts load more than three quarters of them, and with
references of less than eight recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.term import untouched_evidence
from diagnostics.preprocessing.baseline import half_segment_peaks
from diagnostics.preprocessing.levels import FEWEST, LEAST_LOADED, RARE
from diagnostics.preprocessing.offset import least_loaded
from diagnostics.preprocessing.readings import SEGMENT, RecordingBlocks, spread

if TYPE_CHECKING:
    from diagnostics.events.constant_runs import ConstantRuns
    from diagnostics.evidence.term import ConstantCells
    from diagnostics.layout import SensorLayout
    from diagnostics.preprocessing.baseline import Baseline

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PadLimit:
    """Lower limit of a constant run of a healthy cell, relative to its pad.

    Attributes:
        least: float ``[D]``, highest reading above the baseline and the level of the pad, in the
            layout's unit; -inf: unknown.
        most: highest level of a pad, m.
    """

    least: Floats
    most: float = 0.0

    @classmethod
    def unknown(cls, n_cells: int, most: float = 0.0) -> PadLimit:
        """Return the limit of a cold start: no cell reads too little."""
        return cls(np.full(n_cells, -np.inf), most)

    @classmethod
    def fit(
        cls,
        recordings: Sequence[Floats],
        rest: Baseline,
        layout: SensorLayout,
        tolerance: float,
        levels: float = 0.0,
    ) -> PadLimit:
        """Fit to fault-free recordings, ``[T, D]`` each, with the baseline ``rest`` and the range
        of their levels."""
        limit = cls.unknown(layout.n_cells, levels)
        if len(recordings) < FEWEST:
            return limit
        readings = RecordingBlocks.of(recordings)
        present = layout.present.ravel()
        pads = [np.flatnonzero(present & (layout.pad_of == pad)) for pad in range(layout.pads)]
        pads = [
            cells
            for cells in pads
            if len(cells) and (levels > 0 or np.median(rest.low[cells]) > tolerance)
        ]
        lowest = []
        for cells in pads:
            some = spread(cells)
            for i in readings.some:
                above = readings.piece(i, slice(None), some) - rest.highest[some]
                tops = half_segment_peaks(above)
                length = min(SEGMENT // 2, len(above))
                halves = (above[k * length :][:length] for k in range(len(tops)))
                level = np.array([_level(half, levels) for half in halves])
                lowest.append(np.fmin.reduce(tops - level[:, None]))
        if not lowest:
            return limit
        every = np.concatenate(lowest)
        every = every[np.isfinite(every)]
        if len(every):
            limit.least[np.concatenate(pads)] = (
                np.quantile(every, RARE, method="lower") - 2 * tolerance
            )
        return limit

    def evidence(self, cells: ConstantCells, baseline: Floats, level: Floats) -> Floats:
        """Return the log likelihood ratio open : healthy, ``[D]``: 12 or 0.

        Args:
            cells: what every term is given.
            baseline: float ``[D]``, reading without contact.
            level: float ``[D]``, see :class:`PadLevel`.
        """
        runs = cells.runs
        present = cells.present
        constant = present & np.isfinite(runs.value) & (runs.length >= SEGMENT)
        less = constant & (runs.high - baseline - level < self.least)
        at_rail = runs.high <= 2 * cells.tolerance
        return untouched_evidence(
            less, less & (at_rail | (self.most > 0)), np.zeros_like(less), present
        )


@dataclass(frozen=True)
class PadLevel:
    """The highest level of the pad of each cell in the segments of its constant run.

    Attributes:
        level: float ``[D]``, in the layout's unit; -inf: none yet.
    """

    level: Floats

    @classmethod
    def begin(cls, n_cells: int) -> PadLevel:
        """Return the state before any frame."""
        return cls(np.full(n_cells, -np.inf))

    def extend(
        self,
        frames: Floats,
        runs: ConstantRuns,
        first: int,
        baseline: Floats,
        layout: SensorLayout,
        most: float = 0.0,
    ) -> PadLevel:
        """Return the state after one more segment.

        A run that began within the segment has no level yet: the pad may have fallen with the cell.

        Args:
            frames: ``[t, D]``, NaN = missing.
            runs: the constant runs after these frames.
            first: number of the first of these frames.
            baseline: float ``[D]``, reading without contact.
            layout: the array.
            most: highest level.
        """
        above = frames - baseline
        present = layout.present.ravel()
        now = np.array(
            [_level(above[:, present & (layout.pad_of == pad)], most) for pad in range(layout.pads)]
        )
        before = np.where(runs.start < first, self.level, -np.inf)
        return PadLevel(
            np.where(runs.start > first, -np.inf, np.maximum(before, now[layout.pad_of]))
        )


def _level(above: Floats, most: float) -> float:
    """Return the level of a pad with these readings above the baseline in a segment, ``[t, n]``;
    see the module."""
    if most == 0:
        return min(0.0, least_loaded(np.fmax.reduce(above)))
    known = np.where(np.isfinite(above), above, np.inf)
    k = int(LEAST_LOADED * (known.shape[1] - 1))
    lowest = float(np.partition(known, k, axis=1)[:, k].min())
    return min(most, lowest) if np.isfinite(lowest) else 0.0
