"""Rest of a log: where the cells of a cold start rest, and how far rests vary, without a reference.

Estimates, over the cells that moved::

    baseline_i = min(lowest reading of cell i, highest of these lowest readings)
    near       = 4 * mean over segments of q25 over cells of
                     (highest reading in the segment - lowest reading ever)

Minimum statistics as in offset tracking (Martin 2001); the least loaded quarter of the cells shows
noise and wandering rests alone, and 4 is the margin from such a cell to any cell. Lowest readings
that are outliers (three robust standard deviations above the median, Hampel 1974) and exceed 5 % of
full scale are loads that were held throughout. It does not recognise them where most cells hold a
load throughout.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import LEAST_LOADED, LIGHT
from diagnostics.preprocessing.scale import Scale, usual_limit

_MARGIN = 4.0  # from the mean of such a cell to the highest reading of any cell at rest

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RestOfLog:
    """What the log so far shows of the rests.

    Attributes:
        varies: sum over the segments of how far the least loaded cells exceed their lowest
            readings.
        segments: number of these segments.
    """

    varies: float = 0.0
    segments: int = 0

    def extend(self, frames: Floats, lowest: Floats, light: float) -> RestOfLog:
        """Return the state after one more segment; one in which nearly all cells are loaded does
        not count.

        Args:
            frames: ``[t, n]``, NaN = missing, of the n cells that moved.
            lowest: ``[n]``, lowest reading of each of them so far.
            light: readings so far above the lowest one may be noise or a rest that wanders.
        """
        above = np.fmax.reduce(frames) - lowest
        above = above[np.isfinite(above)]
        typical = float(np.quantile(above, LEAST_LOADED)) if len(above) else np.inf
        if typical > light:
            return self
        return RestOfLog(self.varies + typical, self.segments + 1)

    def scale(self, plain: Scale, lowest: Floats, moved: NDArray[np.bool_]) -> Scale:
        """Return the scale of the log: at least baseline and noise of ``plain``.

        Args:
            plain: the scale without knowledge of the log.
            lowest: ``[D]``, lowest reading of each cell so far; inf: none.
            moved: bool ``[D]``, cells that moved. A cell that never moved may be stuck, and rests
                no higher than these.
        """
        known = lowest[moved]
        if not len(known):
            return plain
        highest = float(
            known.max(initial=0.0, where=known <= max(LIGHT * plain.full_scale, usual_limit(known)))
        )
        near = _MARGIN * self.varies / max(self.segments, 1)
        baseline = np.maximum(plain.baseline, np.minimum(lowest, highest))
        return replace(plain, baseline=baseline, near=max(plain.near, near))
