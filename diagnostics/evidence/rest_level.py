"""Rest level: what cells read without contact in a log without a reference.

Detects, in a cold start, open cells that no contact tests: cells constant at the low rail of the
converter, where the cells that moved rest above it or have noise. With v the level of a constant
cell, and z whether all its readings are the same, the log likelihood ratio broken : healthy, beyond
the prior of a rail, is

    log P(v, z | broken) / P(rail | broken) - log P(v, z | healthy)
    P(v, z | healthy) = (1 - u) P + u max(P, m / n)        P = (k + p(v) p(z)) / (N + 1)

Of N cells that moved, k have rested within two tolerances of v before, with the same z as far as it
is known. p(v) is Student's t with 4 degrees of freedom about the median of their levels, scaled by
the median absolute deviation (Rousseeuw and Croux 1993). p(z) is the share of cells without noise,
with Jeffreys' pseudo-count; 1 for readings that differ. This is the predictive distribution of a
Dirichlet process of concentration 1 (Ferguson 1973).

Cells that nothing reached may rest elsewhere than those that moved: on another pad, or where cells
that moved were loaded throughout. u is the probability of that, from m of the n cells of the array
being constant near v: a uniform distribution of m against the beta-binomial distribution of the
number of broken cells, and as unlikely beforehand as a fault. For the same reason a level above the
rail only lowers the ratio. It detects nothing where healthy cells read a constant 0 without
contact, in pads where it would count against more than half of the cells, and where fewer than
eight cells moved and rested.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, stdtr

from diagnostics.events.constant_runs import SHORTEST_RUN
from diagnostics.preprocessing.levels import (
    ANYWHERE,
    CERTAIN_RATIO,
    EXPECTED,
    EXPECTED_CELLS,
    FEWEST,
    MAJORITY,
)
from diagnostics.preprocessing.readings import SEGMENT
from diagnostics.preprocessing.scale import robust_moments

if TYPE_CHECKING:
    from diagnostics.events.constant_runs import ConstantRuns
    from diagnostics.layout import SensorLayout

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class RestLevel:
    """What each cell showed in earlier constant runs, of those that lasted where a segment ends;
    ``[D]`` each.

    Attributes:
        level: float, lowest of the highest readings of these runs, in the layout's unit; inf: none.
        still: bool, whether a run lasted for a segment.
        exact: bool, whether in such a run all readings were the same.
    """

    level: Floats
    still: Mask
    exact: Mask

    @classmethod
    def begin(cls, n_cells: int) -> RestLevel:
        """Return the state before any frame."""
        no = np.zeros(n_cells, bool)
        return cls(np.full(n_cells, np.inf), no, no)

    def extend(self, runs: ConstantRuns, ended: Mask) -> RestLevel:
        """Return the state after the constant ``runs`` of some cells (bool ``[D]``) have ended."""
        level = np.where(
            ended & (runs.length >= SHORTEST_RUN), np.minimum(self.level, runs.high), self.level
        )
        still = ended & (runs.length >= SEGMENT)
        return RestLevel(level, self.still | still, self.exact | (still & (runs.low == runs.high)))

    def evidence(
        self, runs: ConstantRuns, rests: Mask, tolerance: float, layout: SensorLayout
    ) -> Floats:
        """Return the log likelihood ratio broken : healthy, ``[D]``; 0 for cells that are not
        constant at rest.

        Args:
            runs: the constant runs.
            rests: bool ``[D]``, cells whose run lies at their baseline.
            tolerance: readings within +- this of a value count as that value.
            layout: the array.
        """
        present = layout.is_cell
        ratio = np.zeros(layout.n_cells)
        known = np.flatnonzero(present & np.isfinite(self.level))
        tested = np.flatnonzero(present & rests & (runs.length >= SEGMENT))
        if len(known) < FEWEST or not len(tested):
            return ratio
        others = self.level[known]
        still = self.still[known]
        margin = 2 * tolerance
        level = runs.high[tested]
        exact = runs.low[tested] == runs.high[tested]
        with_noise = still & ~self.exact[known]
        middle, deviation = robust_moments(others)
        scale = max(deviation, tolerance)
        far = -np.abs(level - middle)
        p_level = stdtr(4, (far + margin) / scale) - stdtr(4, (far - margin) / scale)
        p_exact = (np.count_nonzero(still & ~with_noise) + 0.5) / (np.count_nonzero(still) + 1)
        k = _near(others, level, margin) - np.where(
            exact, _near(others[with_noise], level, margin), 0
        )
        like_others = (k + p_level * np.where(exact, p_exact, 1.0)) / (len(known) + 1)
        m = _near(level, level, margin)
        n = int(np.count_nonzero(present))
        faults = beta_binomial(m, n, EXPECTED * EXPECTED_CELLS, (1 - EXPECTED) * EXPECTED_CELLS)
        unlike = 1 / (1 + (1 / EXPECTED - 1) * (n + 1) * faults)
        healthy = (1 - unlike) * like_others + unlike * np.maximum(like_others, m / n)
        rail = level <= margin
        anywhere = ANYWHERE * 2 * margin / layout.full_scale
        # A cell that sticks anywhere may read differently within the tolerance; one at a rail does
        # not.
        broken = (rail + anywhere / ((1 - ANYWHERE) / 2)) * np.where(exact, 1 - ANYWHERE, ANYWHERE)
        ratio[tested] = np.minimum(np.log(broken / healthy), np.where(rail, CERTAIN_RATIO, 0.0))
        pad = layout.pad_of
        unusual = np.bincount(pad, ratio > 0) > MAJORITY * np.bincount(pad, present)
        return np.where(unusual[pad], np.minimum(ratio, 0.0), ratio)


def beta_binomial(k: NDArray[np.intp], n: int, a: float, b: float) -> Floats:
    """Return the probability of each ``k`` of n, as ``scipy.stats.betabinom(n, a, b).pmf``, which
    is slow to import."""
    log_choices = -np.log1p(n) - betaln(n - k + 1, k + 1)
    probability: Floats = np.exp(log_choices + betaln(k + a, n - k + b) - betaln(a, b))
    return probability


def _near(others: Floats, level: Floats, margin: float) -> NDArray[np.intp]:
    """Return how many of ``others`` lie within ``margin`` of each ``level``, int ``[n]``."""
    ordered = np.sort(others)
    low = np.searchsorted(ordered, level - margin)
    high = np.searchsorted(ordered, level + margin, side="right")
    return np.asarray(high - low)
