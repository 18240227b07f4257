"""Lower limit: cells that read less without contact than any healthy cell.

Detects open cells without contact. On arrays whose cells rest above 0, a cell that lost its wire
reads a constant value below the lower limit. With h the highest reading in a constant run, the
limit is the 0.001 quantile of h over cells and recordings of the reference, less two tolerances; of
cells that rest in most recordings also their own baseline plus the 0.001 quantile of h above it,
less half of its distance from the median. It detects nothing where noise permits no constant run.
Where cells rest at 0 an open cell looks like any unloaded one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.term import untouched_evidence
from diagnostics.preprocessing.levels import FEWEST, LIGHT, MAJORITY, MARGIN, RARE
from diagnostics.preprocessing.readings import SEGMENT

if TYPE_CHECKING:
    from diagnostics.events.constant_runs import ConstantRuns
    from diagnostics.evidence.term import ConstantCells
    from diagnostics.preprocessing.baseline import Baseline

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LowerLimit:
    """Lower limit of the highest reading of a healthy cell in a constant run.

    Attributes:
        reading: float ``[D]``, in the layout's unit; full scale where noise permits no constant
            run; -inf: unknown.
        usual: the lowest median, over recordings, of unloaded readings above ``reading``; -inf:
            unknown.
    """

    reading: Floats
    usual: float

    @classmethod
    def unknown(cls, n_cells: int) -> LowerLimit:
        """Return the limit of a cold start: no reading is too low."""
        return cls(np.full(n_cells, -np.inf), -np.inf)

    @classmethod
    def fit(
        cls, rest: Baseline, present: NDArray[np.bool_], tolerance: float, full_scale: float
    ) -> LowerLimit:
        """Fit to the baseline of fault-free recordings."""
        low, most, noise, last, peaks = rest
        if np.isnan(noise):
            return cls.unknown(len(low))
        if noise > tolerance:
            return cls(np.full(len(low), full_scale), -np.inf)
        highest = peaks[:, present]
        reading = np.full(
            len(low),
            np.quantile(highest[np.isfinite(highest)], RARE, method="lower") - 2 * tolerance,
        )
        # Where most cells rest at 0, a cell that always reads more is loaded.
        peak = peaks - low
        unloaded = peak < LIGHT * full_scale
        peak_values = peak[unloaded & present]
        if len(peaks) >= FEWEST and np.median(low[present]) > tolerance and len(peak_values):
            often = np.count_nonzero(unloaded, axis=0) >= MAJORITY * len(peaks)
            rare = float(np.quantile(peak_values, RARE, method="lower"))
            margin = max((MARGIN - 1) * (float(np.median(peak_values)) - rare), tolerance)
            reading = np.where(often, np.maximum(reading, low + rare - margin), reading)
        above = (
            np.median((row - reading)[rests])
            for row in last
            if (rests := present & (row <= most)).any()
        )
        return cls(reading, float(min(above, default=-np.inf)))

    def lower(self, runs: ConstantRuns, rests: NDArray[np.bool_]) -> float:
        """Return by how much all cells that rest (bool ``[D]``) read less than ever in the
        reference, 0 or below."""
        if not (np.isfinite(self.usual) and rests.any()):
            return 0.0
        return min(0.0, float(np.median((runs.value - self.reading)[rests])) - self.usual)

    def evidence(self, cells: ConstantCells) -> Floats:
        """Return the log likelihood ratio open : healthy, ``[D]``.

        12 for a run below the limit and below that of all cells, -3 for a usual one, 0 else.
        """
        runs = cells.runs
        present = cells.present
        received = present & np.isfinite(runs.value)
        least = self.reading + cells.lower
        less = received & (runs.length >= SEGMENT) & (runs.high < least)
        open_ = (runs.high <= 2 * cells.tolerance) | (runs.high < least[present].min())
        as_ever = cells.rests & received & (runs.high >= least) & (least > cells.tolerance)
        return untouched_evidence(less, less & open_, as_ever, present)
