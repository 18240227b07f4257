"""How the crossings of an array answer a scan of its read-out, and whether current can reach them
on other ways than their own.

A read-out that lets the lines float which it neither drives nor reads sends current through other
crossings, so that an open one answers, too. The resistances R between a row and a column are then
those of one network, and such resistances are a metric (Klein and Randic 1993)::

    R_ij <= R_il + R_kl + R_kj        for all rows k and columns l

A crossing that conducts less than three others in series refutes that its lines float. Leakage to
ground takes from the current through others, so that open crossings conduct less, too: several
crossings have to, without those of one line, which may be cut, or one that does not conduct at all.

Where lines float, and leak to ground more than ten times as well as an untouched crossing conducts,
open ones may still pass for held ones that conduct little (``examples/read_out_bench.py``).
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

_LEAST_SPREAD = 0.5  # standard deviation of log r of healthy crossings
_IN_PROPORTION = 0.25  # ratio - 1
_FAINT = 0.03  # of the usual response: a line on ground
_FEWEST = 3  # crossings of such a line
_OF_MEDIAN = 1.25  # standard error of a median, in those of a mean
_REFUTING = 0.04  # share of the crossings that conduct less than others in series
_FEWEST_REFUTING = 5

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


def holds_lines(
    response: Floats, least: Floats, answers: Mask, silent: Mask, layout: SensorLayout
) -> bool:
    """Return whether crossings show that lines which are not selected do not float.

    False says nothing where crossings conduct alike: three of them in series conduct less.

    Args:
        response: of each crossing, ``[D]``.
        least: what it is certain to, ``[D]``.
        answers, silent: bool ``[D]``.
        layout: the array.
    """
    if not layout.is_matrix:
        return True
    known = np.where(answers, np.maximum(response - least, 0.0), 0.0)
    weaker = response + least < _through_three(layout.grid(known)).reshape(-1)
    if (weaker & silent).any():
        return True
    refuting = layout.grid(weaker & answers)
    of_one_line = max(refuting.sum(axis=2).max(), refuting.sum(axis=1).max())
    needed = max(_FEWEST_REFUTING, _REFUTING * int(answers.sum()))
    return bool(refuting.sum() - of_one_line >= needed)


def _through_three(conductance: Floats) -> Floats:
    """Return what the best three crossings in series conduct that lead from a row to a column, each
    ``[pads, rows, cols]``."""
    ohms = np.full_like(conductance, np.inf)
    np.divide(1.0, conductance, out=ohms, where=conductance > 0)
    best = np.empty_like(ohms)
    for pad, one in enumerate(ohms):
        between = (one[:, :, None] + one.T[None]).min(axis=1)  # of two rows, by a column
        best[pad] = (between[:, :, None] + one[None]).min(axis=1)
    found: Floats = 1 / best
    return found
