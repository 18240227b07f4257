"""Whether the cells of a log answer otherwise than in the reference, each in its own way: as those
of another sensor of the same kind do, whose gains differ too little for one cell to tell.

The difference of a cell is that of the means of its log ratio (of the load to what the model of the
array expects from the other cells, less what the cells of its pad share), in the log and in the
reference. The statistic is the mean square over the cells of differences in standard errors over
recordings. Its distribution for one sensor comes from the reference, split at random into two; the
log is of another one where it exceeds 99 % of that. A cell stands out where it differs by more than
four standard deviations of what cells of the log do, and its error: that is no other gain.

Another task may have the same effect: it is asked only where cells or wires are found faulty, and
tells that the reference does not suffice to judge them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import FEWEST

_LOADED = 4  # recordings that load a cell, of the log and of the reference: fewer prove no spread
_MOST = 4.0  # standard errors of one cell, which counts no more, and standard deviations
_SPLITS = 200  # of the reference: a size
_SURE = 0.99  # share of them that one sensor exceeds the less
_MEDIAN_DEVIATION = 0.6745  # of a normal distribution, in standard deviations
_TINY = 1e-12

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def outliers_of_others(
    ratio: Floats, precision: Floats, pads: Sequence[Mask], used: Mask, n_usual: int
) -> Mask | None:
    """Return which cells stand out in a log whose cells answer otherwise than those of the
    reference, bool ``[D]``; None: they do not.

    Args:
        ratio, precision: mean log ratios of the cells in all recordings, and their precisions,
            ``[n, D]`` each; precision 0: unknown.
        pads: bool ``[D]`` each.
        used: bool ``[D]``, cells that are compared.
        n_usual: recordings of the reference, which come first.
    """
    n = len(ratio)
    if min(n_usual, n - n_usual) < FEWEST:
        return None
    own = np.zeros_like(ratio)
    for pad in pads:
        weight = precision * (pad & used)
        shared = (weight * ratio).sum(axis=1) / np.maximum(weight.sum(axis=1), _TINY)
        own[:, pad] = (ratio - shared[:, None])[:, pad]
    own[precision == 0] = 0.0
    apart, variance = _apart(own, precision, np.arange(n_usual), np.arange(n_usual, n))
    found = _mean_square(apart[used], variance[used])
    if found is None:
        return None
    rng = np.random.default_rng(0)
    usual = []
    for _ in range(_SPLITS):
        one, other = np.array_split(rng.permutation(n_usual), 2)
        of_split = _mean_square(*_apart(own[:, used], precision[:, used], one, other))
        if of_split is None:
            return None
        usual.append(of_split)
    if found <= np.quantile(usual, _SURE):
        return None
    known = np.isfinite(variance)
    spread = float(np.median(np.abs(apart[known & used]))) / _MEDIAN_DEVIATION
    outlying: Mask = np.abs(apart) > _MOST * np.sqrt(variance + spread**2)
    return outlying & known


def _apart(
    ratio: Floats, precision: Floats, one: NDArray[np.intp], other: NDArray[np.intp]
) -> tuple[Floats, Floats]:
    """Return the differences of the cells between some recordings and others, and their variances,
    ``[cells]`` each; NaN: too few recordings load it."""
    first, of_first = _mean(ratio[one], precision[one])
    second, of_second = _mean(ratio[other], precision[other])
    return first - second, of_first + of_second


def _mean_square(apart: Floats, variance: Floats) -> float | None:
    """Return the mean square of differences in their standard errors; None where hardly a cell is
    loaded."""
    known = np.isfinite(variance)
    if known.sum() < FEWEST:
        return None
    errors = apart[known] / np.sqrt(variance[known] + _TINY)
    return float(np.mean(np.clip(errors, -_MOST, _MOST) ** 2))


def _mean(ratio: Floats, precision: Floats) -> tuple[Floats, Floats]:
    """Return the weighed mean of each cell, ``[cells]``, and its variance over recordings; NaN:
    too few of these."""
    loaded = (precision > 0).sum(axis=0)
    total = np.maximum(precision.sum(axis=0), _TINY)
    mean = (precision * ratio).sum(axis=0) / total
    spread = (precision**2 * (ratio - mean) ** 2).sum(axis=0) / total**2
    variance = np.where(loaded >= _LOADED, spread * loaded / np.maximum(loaded - 1, 1), np.nan)
    return mean, variance
