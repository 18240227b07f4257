"""Trends of many series at once: what drifts beyond chance, how fast, and when it crosses its
limit.

Each series is tested by the rank statistic of Mann (1945) and Kendall (1975) with its exact
distribution, which holds for any noise:

    S = sum_{i<j} sign(y_j - y_i),    p = P(|S'| >= |S|) over all orders of the runs

Ties make the test conservative. Where successive runs are correlated, with r the median
autocorrelation of all series, z(p) is multiplied by sqrt((1 - r) / (1 + r)) (Hamed and Rao 1998).
The false discovery rate over all series is at most 5 % (Benjamini and Yekutieli 2001: any
dependence, as cells have). On a stable robot, this is the chance of any trend at all.

Of the series that drift, a robust line gives rate and level (Huber's M-estimator,
``statsmodels.RLM``), and Fieller's interval (1954) the time at which the line crosses a limit. With
R of m series selected, the level of all intervals is 1 - 0.1 R / m: of those shown, 90 % hold the
truth (false coverage rate; Benjamini and Yekutieli 2005).

Not detected: drift in fewer than 9 runs or so, sudden steps as such, drift that returns to where it
began.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri
from scipy.stats import median_abs_deviation
from scipy.stats import t as student

FALSE = 0.05
"""False discovery rate: on a stable robot, the probability of any trend."""

COVERAGE = 0.9
"""Share of the intervals that hold the truth."""

_FEWEST = 5  # runs in which a series must be known
_GROUPS = 60  # more runs are grouped, and each group is its median: a size
_MOST_CORRELATED = 0.9
_LONG_ENOUGH = 8  # runs from which an autocorrelation is estimated

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Trend:
    """The drift of one series. Times are counted from the last run, in the unit of ``when``.

    Attributes:
        series: index of the series.
        runs: number of runs (or groups of runs) in which it is known.
        p: adjusted for the number of series; at most 0.05.
        now: level of the line at the last run.
        rate: change per unit of time.
        rate_low, rate_high: interval of the rate.
        limit: the limit towards which it drifts; None without one.
        crossing: expected time until the limit is crossed, 0 if it is crossed already; None without
            a limit.
        crossing_low, crossing_high: interval of that time; ``crossing_high`` is None where no end
        can be stated.
    """

    series: int
    runs: int
    p: float
    now: float
    rate: float
    rate_low: float
    rate_high: float
    limit: float | None = None
    crossing: float | None = None
    crossing_low: float | None = None
    crossing_high: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return asdict(self)


@dataclass(frozen=True)
class Trends:
    """The series that drift.

    Attributes:
        found: one entry for each series that drifts, by p.
        tested: number of series that vary and are known in five runs.
        correlation: autocorrelation of successive runs.
    """

    found: tuple[Trend, ...]
    tested: int
    correlation: float

    @property
    def fewest_runs(self) -> int:
        """Number of runs from which a steady drift of one series alone can be told from chance."""
        harmonic = sum(1 / i for i in range(1, self.tested + 1))
        most = FALSE / max(1.0, self.tested * harmonic)
        return next(n for n in range(_FEWEST, 200) if 2 / math.factorial(n) <= most)


def trends(when: Floats, values: Floats, low: Floats, high: Floats) -> Trends:
    """Return the series that drift beyond chance.

    Args:
        when: times of the runs ``[n]``, ascending.
        values: ``[n, m]``; NaN = not known in this run.
        low, high: limits ``[m]``; infinite: none.

    Raises:
        ValueError: shapes do not fit, or times do not ascend.
    """
    when = np.asarray(when, np.float64)
    values = np.asarray(values, np.float64)
    if (
        values.ndim != 2
        or when.shape != values.shape[:1]
        or low.shape != high.shape
        or low.shape != values.shape[1:]
    ):
        raise ValueError(
            f"expected times [n], values [n, m] and limits [m], got {when.shape}, {values.shape},"
            f" {low.shape}"
        )
    if (np.diff(when) < 0).any():
        raise ValueError("expected times of runs that ascend")
    if not len(when):
        return Trends((), 0, 0.0)
    when, values = _grouped(when - when[-1], values)
    known = ~np.isnan(values)
    vary = np.fmax.reduce(values, axis=0) > np.fmin.reduce(values, axis=0)
    tested = np.flatnonzero((known.sum(axis=0) >= _FEWEST) & vary)
    if not len(tested):
        return Trends((), 0, 0.0)
    correlation = _correlation(when, values[:, tested])
    p = _deflated(_mann_kendall(values[:, tested]), correlation)
    from statsmodels.stats.multitest import multipletests

    drifts, adjusted, *_ = multipletests(p, FALSE, method="fdr_by")
    level = 1 - (1 - COVERAGE) * int(drifts.sum()) / len(tested)
    found = []
    for k in np.flatnonzero(drifts)[np.argsort(p[drifts], kind="stable")]:
        series = int(tested[k])
        y = values[:, series]
        line = _Line.fit(when[known[:, series]], y[known[:, series]], correlation, level)
        found.append(
            line.trend(series, float(adjusted[k]), float(low[series]), float(high[series]))
        )
    return Trends(tuple(found), len(tested), correlation)


def _grouped(when: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return medians of successive runs where there are more than 60; the last group stays at time
    0 at most."""
    if len(when) <= _GROUPS:
        return when, values
    parts = np.array_split(np.arange(len(when)), _GROUPS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a group in which a series is never known
        return (
            np.array([np.median(when[part]) for part in parts]),
            np.stack([np.nanmedian(values[part], axis=0) for part in parts]),
        )


def _mann_kendall(values: Floats) -> Floats:
    """Return the exact two-sided p-value of each series, ``[m]``."""
    s = np.zeros(values.shape[1])
    n = np.count_nonzero(~np.isnan(values), axis=0)
    for i in range(len(values) - 1):
        s += np.nansum(np.sign(values[i + 1 :] - values[i]), axis=0)
    return np.array([_tail(int(k))[int(abs(of))] for k, of in zip(n, s, strict=True)])


@cache
def _tail(n: int) -> Floats:
    """Return P(|S| >= s) for s = 0 .. n (n - 1) / 2, over all orders of n distinct values."""
    chance = np.ones(1)
    for k in range(2, n + 1):
        # the k-th value is out of order with 0 .. k - 1 others
        chance = np.convolve(chance, np.full(k, 1 / k))
    pairs = n * (n - 1) // 2
    tail = np.cumsum(chance[::-1])[::-1]  # of the number of pairs in order, at least
    at_least = tail[(pairs + np.arange(pairs + 1)) // 2]
    return np.minimum(1.0, 2 * at_least)


def _correlation(when: Floats, values: Floats) -> float:
    """Return the median autocorrelation of successive runs about the least-squares lines, at least
    0."""
    known = ~np.isnan(values)
    n = known.sum(axis=0)
    long = n >= _LONG_ENOUGH
    if not long.any():
        return 0.0
    values = values[:, long]
    known = known[:, long]
    n = n[long]
    x = np.where(known, when[:, None], np.nan)
    x = x - np.nanmean(x, axis=0)
    y = values - np.nanmean(values, axis=0)
    squares = np.nansum(x * x, axis=0)
    slope = np.divide(np.nansum(x * y, axis=0), squares, out=np.zeros(len(n)), where=squares > 0)
    residual = y - slope * x
    total = np.nansum(residual**2, axis=0)
    varies = total > 1e-20 * np.nansum(y**2, axis=0)
    if not varies.any():
        return 0.0
    # Two parameters of the line lower the estimate by about 2 / n.
    r = np.nansum(residual[1:] * residual[:-1], axis=0)[varies] / total[varies] + 2 / n[varies]
    return float(np.clip(np.median(r), 0.0, _MOST_CORRELATED))


def _deflated(p: Floats, correlation: float) -> Floats:
    """Return the p-values of correlated runs."""
    if correlation == 0:
        return p
    return np.asarray(2 * ndtr(ndtri(p / 2) * np.sqrt((1 - correlation) / (1 + correlation))))


@dataclass(frozen=True, eq=False)
class _Line:
    """A robust line with the covariance of level (at time 0) and rate, and the quantile of its
    intervals."""

    runs: int
    level: float
    rate: float
    covariance: Floats
    quantile: float

    @classmethod
    def fit(cls, when: Floats, y: Floats, correlation: float, level: float) -> _Line:
        from statsmodels.api import OLS, RLM, add_constant

        design = add_constant(when, has_constant="add")
        result = OLS(y, design).fit()
        parameters = result.params
        covariance = result.cov_params()
        if median_abs_deviation(result.resid) > 1e-9 * np.ptp(y):  # RLM needs a scale
            with warnings.catch_warnings():
                # it warns where it stops early, with a good line all the same
                warnings.simplefilter("ignore")
                robust = RLM(y, design).fit()
            if np.isfinite(robust.bcov_scaled).all() and robust.scale > 0:
                parameters = robust.params
                covariance = robust.bcov_scaled
        inflated = np.asarray(covariance) * (1 + correlation) / (1 - correlation)
        quantile = float(student.ppf((1 + level) / 2, len(y) - 2))
        return cls(len(y), float(parameters[0]), float(parameters[1]), inflated, quantile)

    def trend(self, series: int, p: float, low: float, high: float) -> Trend:
        margin = self.quantile * float(np.sqrt(self.covariance[1, 1]))
        limit = high if self.rate > 0 else low
        rates = (self.rate, self.rate - margin, self.rate + margin)
        if not np.isfinite(limit):
            return Trend(series, self.runs, p, self.level, *rates)
        ahead = (limit - self.level) / self.rate
        first, last = self._crossing(limit)
        end = None if last is None else max(0.0, last)
        return Trend(
            series, self.runs, p, self.level, *rates, limit, max(0.0, ahead), max(0.0, first), end
        )

    def _crossing(self, limit: float) -> tuple[float, float | None]:
        """Return Fieller's interval of the time at which the line crosses a limit; None: no end."""
        q2 = self.quantile**2
        distance = self.level - limit
        (of_level, both), (_, of_rate) = self.covariance
        a = self.rate**2 - q2 * of_rate
        b = self.rate * distance - q2 * both
        c = distance**2 - q2 * of_level
        root = b * b - a * c
        if a > 0:
            width = np.sqrt(max(0.0, root))
            return float((-b - width) / a), float((-b + width) / a)
        if a == 0 or root < 0:
            return 0.0, None
        early = float((-b + np.sqrt(root)) / a)
        late = float((-b - np.sqrt(root)) / a)
        return (0.0 if early > 0 else late), None  # all times but those between the roots
