"""Jumps: the size of the step into a constant run, compared with the steps of healthy cells.

Detects cells that broke under load. The statistic is
``log(0.5 + 0.5 p(jump | fault) / p(jump | healthy))``, at most 3, with a uniform density for faults
and a histogram with one pseudo-count a bin for healthy cells. A broken cell jumps by any amount; a
healthy cell is mostly released gradually, or together with its neighbours. It does not detect jumps
together with many cells, as at the end of a grasp, and cells that broke without load.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.constant_runs import SHORTEST_RUN, ConstantRuns, segments
from diagnostics.preprocessing.levels import SUSPICIOUS

if TYPE_CHECKING:
    from diagnostics.evidence.term import ConstantCells
    from diagnostics.preprocessing.scale import Scale

SUDDEN_JUMP = 1.0  # log ratio of a jump from which on a cell is no predictor
_JUMPS = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 1.0])  # of full scale, bin edges

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class JumpHistogram:
    """Sizes of the jumps of healthy cells into constant runs.

    Attributes:
        log_ratio: float ``[2, bins]``, log likelihood ratio fault : healthy of a fall and of a rise
            of each size.
    """

    log_ratio: Floats

    @classmethod
    def fit(cls, recordings: Sequence[Floats], scale: Scale) -> JumpHistogram:
        """Count the jumps in fault-free recordings, ``[T, D]`` each."""
        healthy = np.ones((2, len(_JUMPS) - 1))
        for recording in recordings:
            for _, _, runs in segments(recording, scale, SHORTEST_RUN):
                fresh = (
                    runs.moved
                    & (runs.length >= SHORTEST_RUN)
                    & (runs.length < 2 * SHORTEST_RUN)
                    & runs.alone
                )
                for up in (0, 1):
                    jumps = runs.jump[fresh & ((runs.jump > 0) == up)]
                    healthy[up] += np.histogram(np.abs(jumps) / scale.full_scale, _JUMPS)[0]
        ratio = np.diff(_JUMPS) / (healthy / healthy.sum(axis=1, keepdims=True))
        # A cell that was unloaded when it broke did not jump: half of the faults look healthy. A
        # jump proves no fault.
        return cls(np.minimum(np.log(0.5 + 0.5 * ratio), SUSPICIOUS))

    @classmethod
    def silent(cls) -> JumpHistogram:
        """Return the histogram of a cold start: no evidence from jumps."""
        return cls(np.zeros((2, len(_JUMPS) - 1)))

    def evidence(self, cells: ConstantCells) -> Floats:
        """Return the log likelihood ratio, ``[D]``; 0 for cells that never moved or jumped with
        others."""
        return np.where(cells.runs.alone, self.size(cells.runs, cells.full_scale), 0.0)

    def size(self, runs: ConstantRuns, full_scale: float) -> Floats:
        """Return the log likelihood ratio ``[D]`` as if each cell jumped alone; 0 where it never
        moved."""
        which = np.searchsorted(_JUMPS[1:-1], np.abs(runs.jump) / full_scale, side="right")
        return np.where(runs.moved, self.log_ratio[(runs.jump > 0).astype(np.intp), which], 0.0)
