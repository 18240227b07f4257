"""How the crossings of an array answer a scan of its read-out, and how much of it may come through
other crossings.

A read-out that lets the lines float which it neither drives nor reads sends current through other
crossings, so that an open one answers, too. Two levels do not tell: resistances answer in
proportion on any way. What tells is that all crossings share the ways through others. With the
conductances G of the crossings, and L from each line to ground, a crossing reads (Kirchhoff; Z is
the inverse of the matrix of G and L)::

    T_ij = Z_ij / (Z_ii Z_jj - Z_ij^2) = G_ij + S_ij     S: through others, the more the less L is

L is unknown: large where lines are held, small where they float; one read-out drives all pads. But
no S is more than what its crossing reads, so that one which reads little bounds L from below, and S
of all others from above. G is taken for what they read, then for what is left of it without S, and
the larger S counts. A crossing conducts for certain if it reads more than :data:`CERTAINLY` times
S. So a silent one proves that others conduct, and an open one, which reads S alone, is left
untested.

The part of a line beyond a cut leaks nothing, and joins the lines that cross it. Crossings that do
not conduct for certain may lie on one, and one of them may be shorted. Where a crossing is shorted,
it brings current also to lines that are held.

Not covered: leakages of lines that differ by more than a factor of ten, and a read-out that holds
rows and lets columns float, or the other way, beside a shorted crossing or a cut line. Open
crossings may then pass for held ones; a scan of such a read-out states ``holds_lines=False``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtri

from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import CERTAIN_RATIO, LOW

TOP = 0.98
"""Share of the converter's range from which on a reading is saturated."""

REPEATS = 4
"""Readings of a crossing at a level, at least."""

STANDS = 5.0
"""Standard errors that are no noise."""

CERTAINLY = 3.0
"""Times what may come through others: it covers leakages that differ by a factor of ten."""

_LEAST_SPREAD = 0.5  # standard deviation of log r of healthy crossings
_IN_PROPORTION = 0.25  # ratio - 1
_FAINT = 0.03  # of the usual response: a line on ground
_FEWEST = 3  # crossings of such a line
_OF_MEDIAN = 1.25  # standard error of a median, in those of a mean
_SHORTED = 1e3  # times the highest response
_LEAKS = (1e-4, 1e6)  # from each line, times what its crossings conduct together
_HELD = 100.0  # of a line that is held, the same
_PRECISE = 0.01  # of the logarithm of the leakage

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Level:
    """Mean and standard error of what each crossing reads at one level, ``[D]``."""

    mean: Floats
    error: Floats

    @classmethod
    def of(cls, readings: Floats, noise: float) -> Level:
        """Return that of readings ``[n, D]`` at one level; NaN: fewer than :data:`REPEATS`.

        Args:
            readings: shares of the converter's range; NaN: missing.
            noise: standard deviation of a reading.
        """
        known = np.isfinite(readings)
        count = known.sum(axis=0)
        total = np.where(known, readings, 0.0).sum(axis=0)
        enough = count >= REPEATS
        some = np.maximum(count, 1)
        return cls(
            np.where(enough, total / some, np.nan),
            np.where(enough, noise / np.sqrt(some), np.nan),
        )


@dataclass(frozen=True)
class Answer:
    """How each crossing answers the drive, ``[D]``."""

    response: Floats
    error: Floats
    ratio: Floats
    in_proportion: Mask

    @classmethod
    def of(cls, zero: Level, low: Level, full: Level, share: float) -> Answer:
        """Return that of what crossings read at three levels; ``share``: of the drive at the low
        one."""
        saturated = full.mean >= TOP
        slope = (full.mean - low.mean) / (1 - share)
        # what is left at no drive: nothing, or what is there where the row floats
        left = low.mean - share * slope
        base = np.where(np.abs(left) <= np.abs(left - zero.mean), 0.0, zero.mean)
        base = np.where(saturated & (low.mean < TOP), 0.0, base)
        of_low = (low.mean - base) / share
        error_of_low = np.hypot(low.error, zero.error) / share
        response = np.where(saturated, of_low, slope)
        error = np.where(saturated, error_of_low, np.hypot(full.error, low.error) / (1 - share))
        usable = response > 0
        ratio = np.divide(of_low, response, out=np.full_like(response, np.nan), where=usable)
        of_ratio = np.divide(
            error_of_low, response, out=np.full_like(response, np.inf), where=usable
        )
        apart = np.maximum(_IN_PROPORTION, STANDS * of_ratio)
        return cls(response, error, ratio, np.abs(ratio - 1) <= apart)


def on_faint_lines(response: Floats, healthy: Healthy, tells: Mask, layout: SensorLayout) -> Mask:
    """Return the crossings on rows and columns that answer faintly, bool ``[D]``."""
    found = np.zeros(layout.n_cells, bool)
    for line in layout.lines:
        cells = layout.cells_on(line)
        cells = cells[tells[cells]]
        if line.kind not in ("row", "column") or len(cells) < _FEWEST:
            continue
        least = healthy.faint(len(cells))
        if np.median(response[cells]) < least:
            found[cells[response[cells] < least]] = True
    return found


def in_parallel(short: Mask, layout: SensorLayout) -> Mask:
    """Return the crossings that shorted ones join in parallel with another one, bool ``[D]``: with
    (a, b) and (c, d) shorted, (a, d) and (c, b) lie between the same two wires."""
    if not layout.is_matrix:
        return np.zeros_like(short)
    grid = layout.grid(short)
    joined = grid.any(axis=2, keepdims=True) & grid.any(axis=1, keepdims=True) & ~grid
    found: Mask = joined.reshape(-1)
    return found


@dataclass(frozen=True)
class Healthy:
    """How healthy crossings answer: log response is normal.

    Attributes:
        usual: median response.
        spread: standard deviation of its logarithm, of the middle half.
        tail: the same, of the wider tail, which a line on ground may make.
    """

    usual: float
    spread: float
    tail: float

    @classmethod
    def of(cls, response: Floats) -> Healthy:
        """Return that of crossings which answer, ``[n]``."""
        log = np.log(response)
        middle = float(np.median(log))
        half = 1.4826 * float(np.median(np.abs(log - middle)))
        low, high = np.quantile(log, [LOW, 1 - LOW]).tolist()
        tail = max(middle - low, high - middle) / -float(ndtri(LOW))
        spread = max(_LEAST_SPREAD, half)
        return cls(float(np.exp(middle)), spread, max(spread, tail))

    def of_silence(self, least: Floats) -> Floats:
        """Return the evidence of crossings that answer less than ``least``: how many healthy ones
        do."""
        as_silent = (np.log(least) - np.log(self.usual)) / self.tail
        evidence: Floats = np.clip(-log_ndtr(as_silent), 0.0, CERTAIN_RATIO)
        return evidence

    def faint(self, crossings: int) -> float:
        """Return the median response of so many that is less than chance gives."""
        by_chance = STANDS * _OF_MEDIAN * self.spread / np.sqrt(crossings)
        return self.usual * float(min(_FAINT, np.exp(-by_chance)))


def through_others(
    response: Floats, least: Floats, tells: Mask, short: Mask, layout: SensorLayout, *, held: bool
) -> Floats:
    """Return the most that may come through other crossings, ``[D]``.

    Args:
        response: of each crossing, ``[D]``; NaN: not measured.
        least: what it is certain to, ``[D]``.
        tells, short: bool ``[D]``; what tells nothing conducts as the others on average.
        layout: the array.
        held: whether it is known that lines are held.
    """
    if not layout.is_matrix or not tells.any():
        return np.zeros_like(response)
    known = np.maximum(response[tells], 0.0)
    usual = float(known.mean())
    together = usual * max(layout.rows, layout.cols)
    if not together:
        return np.zeros_like(response)
    every = np.full_like(response, usual)
    every[tells] = known
    every[short] = _SHORTED * float(known.max())
    every[~layout.is_cell] = 0.0
    given = layout.grid(every)
    error = layout.grid(np.where(tells, least, np.inf))
    found = np.zeros_like(given)
    unproven = np.zeros_like(given)
    for _ in range(2):
        own = np.maximum(given - found, 0.0)
        leak = _HELD * together
        if not held:  # one read-out drives all pads
            leak = max(map(_least_leak, own, given + error, [together] * len(given)))
        seen = np.where(np.isfinite(error), own, usual)  # of two shorted crossings, one is seen
        parts = usual * unproven
        ways = [_ways(*of, leak) for of in zip(own, seen, parts, strict=True)]
        found = np.maximum(found, np.stack(ways))
        unproven = np.where(np.isfinite(error) & (given - error <= CERTAINLY * found), 1.0, 0.0)
    most: Floats = found.reshape(-1)
    return most


def _least_leak(own: Floats, most: Floats, together: float) -> float:
    """Return the least leakage of a line to ground with which no crossing of a pad would read more.

    Args:
        own: conductances of the crossings, ``[rows, cols]``.
        most: what comes to each through others at most, the same.
        together: what the crossings of a line conduct.
    """
    whole = np.zeros((sum(own.shape),) * 2)
    low, high = np.log(together) + np.log(_LEAKS)
    while high - low > _PRECISE:
        middle = (low + high) / 2
        if (_beside(own, np.exp(middle), whole) > most).any():
            low = middle
        else:
            high = middle
    return float(np.exp(low))


def _ways(own: Floats, seen: Floats, parts: Floats, leak: float) -> Floats:
    """Return the most that comes through other crossings of a pad, ``[rows, cols]``.

    Args:
        own: conductances of the crossings, ``[rows, cols]``.
        seen: the same, without the shorted ones.
        parts: of those that may lie on a part of a line that is cut off, 0 elsewhere.
        leak: from each line to ground.
    """
    rows = len(own)
    whole = np.zeros((sum(own.shape),) * 2)
    cut = whole.copy()
    cut[:rows, :rows] = _cut_off(parts)
    cut[rows:, rows:] = _cut_off(parts.T)
    ways = [_beside(own, leak, lines) for lines in (whole, cut)]
    ways += [_onto_shorted(seen, leak, parts), _onto_shorted(seen.T, leak, parts.T).T]
    found: Floats = np.maximum.reduce(ways)
    return found


def _onto_shorted(conductance: Floats, leak: float, part: Floats) -> Floats:
    """Return what comes from rows over columns onto the part of a row that is cut off, and by a
    shorted crossing of it, which nothing shows, to a column, ``[rows, cols]``.

    Args:
        conductance: of the crossings, ``[rows, cols]``.
        leak: from each line to ground.
        part: of the crossings that may lie on a part, 0 elsewhere, ``[rows, cols]``.
    """
    reached = conductance / (conductance.sum(axis=0) + leak)  # of the drive, on each column
    brought = reached @ part.T  # from row i onto the part of row k
    on_part = (part > 0) & ((part > 0).sum(axis=1, keepdims=True) > 1)
    found: Floats = (brought[:, :, None] * on_part).max(axis=1)
    return found


def _cut_off(parts: Floats) -> Floats:
    """Return the matrix of conductances between rows, ``[rows, rows]``, through parts of columns
    that are cut off.

    Such a part joins the rows of its crossings, which do not conduct to the column, and leaks
    nothing.

    Args:
        parts: conductance of a crossing that may lie on one, 0 elsewhere, ``[rows, cols]``.
    """
    together = parts.sum(axis=0)
    shares = np.divide(parts, together, out=np.zeros_like(parts), where=together > 0)
    found: Floats = np.diag(parts.sum(axis=1)) - shares @ parts.T
    return found


def _beside(conductance: Floats, leak: float, cut: Floats) -> Floats:
    """Return what comes through other crossings, ``[rows, cols]``.

    Args:
        conductance: of the crossings, ``[rows, cols]``.
        leak: from each line to ground.
        cut: matrix of the conductances between lines, ``[rows + cols, rows + cols]``.
    """
    rows = len(conductance)
    matrix = np.block(
        [
            [np.diag(conductance.sum(axis=1)), -conductance],
            [-conductance.T, np.diag(conductance.sum(axis=0))],
        ]
    )
    inverse = np.linalg.inv(matrix + cut + leak * np.eye(len(matrix)))
    own = np.diag(inverse)
    between = inverse[:rows, rows:]
    read = between / (own[:rows, None] * own[rows:] - between**2)
    found: Floats = np.maximum(read - conductance, 0.0)
    return found
