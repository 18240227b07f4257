"""Survival of wires and cells over a fleet, and the robots that are likely to fail next. Statistics
alone.

A unit (a wire, a cell) enters at the age at which its robot is first watched, and leaves at its
first fault or at the last run (left truncation, right censoring). Three estimates::

    curve     Kaplan and Meier (1958), ``statsmodels.SurvfuncRight``, with log(-log) intervals
    Weibull   H(t) = (t / scale)^shape, maximum likelihood; with fewer than 5 faults
                                               shape = 1, a constant hazard
    robot     multiplier ~ Gamma(a + k, a + E), with k faults where H expects E

The spread 1 / a between robots is the maximum likelihood estimate of a negative binomial, so that
robots with few data stay near the fleet. Faults of one robot are not independent where robots
differ: all variances are multiplied by 1 + sum E^2 / (a sum E), which equals the overdispersion of
the negative binomial.

By hand, where there is lifelines: its Weibull fit gives the same shape, scale and error to six
digits, 300 times as slowly, and is imported in seconds.

Not detected: what no run has tested, effects of use where age does not measure it, second faults of
a repaired unit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import gammaln
from scipy.stats import chi2, gamma, norm

COVERAGE = 0.9
"""Share of the intervals that hold the truth."""

_FEWEST = 5  # faults from which a shape is estimated
_SHAPES = (0.1, 20.0)  # of the Weibull distribution: bounds of the search
_SPREADS = np.geomspace(0.05, 1000, 60)  # a, a grid: 1000 means that robots do not differ
_Z = float(norm.ppf((1 + COVERAGE) / 2))

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Lifetimes:
    """Ages of units, one entry for ``units`` equal ones of a robot, ``[n]`` each.

    Attributes:
        entry: age from which on they are watched, in days.
        end: age at the first fault, or at the last run without one, in days; more than ``entry``.
        failed: bool, whether they failed.
        robot: int, number of the robot.
        units: int, how many.
    """

    entry: Floats
    end: Floats
    failed: NDArray[np.bool_]
    robot: NDArray[np.intp]
    units: NDArray[np.intp]

    def __post_init__(self) -> None:
        shapes = {
            np.shape(of) for of in (self.entry, self.end, self.failed, self.robot, self.units)
        }
        if len(shapes) != 1 or len(next(iter(shapes))) != 1:
            raise ValueError(f"expected five arrays of one length, got {sorted(shapes)}")
        if not ((self.entry >= 0) & (self.end > self.entry) & (self.units >= 1)).all():
            raise ValueError("expected 0 <= entry < end and at least one unit in each entry")

    @property
    def faults(self) -> int:
        """Number of units that failed."""
        return int(self.units[self.failed].sum())


@dataclass(frozen=True, eq=False)
class Survival:
    """Estimates from lifetimes.

    Attributes:
        lifetimes: from which they are.
        ages, survival, low, high: float ``[k]``, the curve: the share without a fault after each
        age with a fault.
        shape: of the hazard; above 1 it rises with age (wear), below 1 it falls. With its interval.
        shape_low, shape_high: equal to ``shape`` where it is not estimated.
        scale: days until 63 % have failed; infinite without a fault.
        rate_low, rate_high: interval of the number of faults of each unit in 1000 days, over the
        ages seen.
        spread: 1 / a, variance of the hazard between robots.
    """

    lifetimes: Lifetimes
    ages: Floats
    survival: Floats
    low: Floats
    high: Floats
    shape: float
    shape_low: float
    shape_high: float
    scale: float
    rate_low: float
    rate_high: float
    spread: float

    @classmethod
    def fit(cls, lifetimes: Lifetimes) -> Survival:
        """Estimate curve, hazard and spread between robots.

        Raises:
            ValueError: no lifetime is given.
        """
        if not len(lifetimes.end):
            raise ValueError(
                "expected at least one lifetime: no run of these robots has used recordings"
            )
        shape, scale, error = _weibull(lifetimes)
        expected, faults = _by_robot(lifetimes, shape, scale)
        a = _gamma_shape(expected, faults)
        over = 1 + float((expected**2).sum() / (a * expected.sum())) if expected.sum() else 1.0
        ages, survival, low, high = _curve(lifetimes, over)
        margin = np.exp(_Z * error * np.sqrt(over))
        n = lifetimes.faults
        exposure = float((lifetimes.units * (lifetimes.end - lifetimes.entry)).sum())
        # n / over independent faults: the exact interval of a Poisson mean, widened.
        few = chi2.ppf((1 - COVERAGE) / 2, 2 * n / over) / 2 if n else 0.0
        many = chi2.ppf((1 + COVERAGE) / 2, 2 * n / over + 2) / 2
        rates = 1000 * over * np.array([few, many]) / exposure
        return cls(
            lifetimes=lifetimes,
            ages=ages,
            survival=survival,
            low=low,
            high=high,
            shape=shape,
            shape_low=float(shape / margin),
            shape_high=float(shape * margin),
            scale=scale,
            rate_low=float(rates[0]),
            rate_high=float(rates[1]),
            spread=1 / a,
        )

    def hazard(self, age: Floats | float) -> Floats:
        """Return the cumulative hazard H of a unit of the average robot at an age in days."""
        return np.asarray((np.asarray(age, np.float64) / self.scale) ** self.shape)

    def at(self, age: float) -> tuple[float, float, float]:
        """Return the share without a fault at an age, and its interval, by the curve."""
        i = int(np.searchsorted(self.ages, age, side="right")) - 1
        return (
            (1.0, 1.0, 1.0)
            if i < 0
            else (float(self.survival[i]), float(self.low[i]), float(self.high[i]))
        )

    def next_faults(self, days: float) -> tuple[Floats, Floats, Floats]:
        """Return the expected number of faults of each robot in the coming days, and its interval,
        ``[robots]`` each.

        Robots are counted from 0 to the largest number in the lifetimes.
        """
        life = self.lifetimes
        a = 1 / self.spread
        expected, faults = _by_robot(life, self.shape, self.scale)
        left = ~life.failed
        coming = life.units * (self.hazard(life.end + days) - self.hazard(life.end))
        ahead = np.bincount(life.robot[left], coming[left], len(expected))
        of = gamma(a + faults, scale=1 / (a + expected))
        factors = (of.mean(), of.ppf((1 - COVERAGE) / 2), of.ppf((1 + COVERAGE) / 2))
        mean, low, high = (np.asarray(ahead * factor, np.float64) for factor in factors)
        return mean, low, high

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {
            "units": int(self.lifetimes.units.sum()),
            "faults": self.lifetimes.faults,
            "shape": self.shape,
            "shape_interval": [self.shape_low, self.shape_high],
            "scale_days": self.scale if np.isfinite(self.scale) else None,
            "faults_in_1000_days": [self.rate_low, self.rate_high],
            "spread": self.spread,
            "curve": [
                {"days": float(t), "survival": float(s), "interval": [float(low), float(high)]}
                for t, s, low, high in zip(
                    self.ages, self.survival, self.low, self.high, strict=True
                )
            ],
        }


def _weibull(life: Lifetimes) -> tuple[float, float, float]:
    """Return shape, scale and the standard error of the logarithm of the shape; 0 where it is not
    estimated."""
    n = life.faults
    w = life.units
    if not n:
        return 1.0, np.inf, 0.0
    longest = float(life.end.max())
    end = life.end / longest
    entry = life.entry / longest
    logs = float((w * np.log(end))[life.failed].sum())

    def total(shape: float) -> float:
        return float((w * (end**shape - entry**shape)).sum())

    def loss(log_shape: float) -> float:
        shape = float(np.exp(log_shape))
        return float(-(n * np.log(shape) - n * np.log(total(shape)) + (shape - 1) * logs))

    if n < _FEWEST:
        return 1.0, longest * total(1.0) / n, 0.0
    best = float(minimize_scalar(loss, bounds=tuple(np.log(_SHAPES)), method="bounded").x)
    step = 1e-3
    information = (
        loss(best + step) - 2 * loss(best) + loss(best - step)
    ) / step**2  # of the profile likelihood
    shape = float(np.exp(best))
    error = 1 / np.sqrt(information) if information > 0 else np.inf
    return shape, longest * float((total(shape) / n) ** (1 / shape)), float(error)


def _by_robot(life: Lifetimes, shape: float, scale: float) -> tuple[Floats, Floats]:
    """Return the expected and the observed number of faults of each robot, ``[robots]`` each."""
    expected = life.units * ((life.end / scale) ** shape - (life.entry / scale) ** shape)
    robots = int(life.robot.max()) + 1
    of = np.bincount(life.robot, expected, robots)
    faults = np.bincount(life.robot, life.units * life.failed, robots)
    return of.astype(np.float64), faults.astype(np.float64)


def _gamma_shape(expected: Floats, faults: Floats) -> float:
    """Return a, the shape of the gamma distribution of the hazard between robots."""
    watched = expected > 0
    e = expected[watched]
    k = faults[watched]
    if k.sum() < _FEWEST:
        return float(_SPREADS[-1])
    a = _SPREADS[:, None]
    likelihood = gammaln(a + k) - gammaln(a) + a * np.log(a / (a + e)) + k * np.log(e / (a + e))
    return float(_SPREADS[likelihood.sum(axis=1).argmax()])


def _curve(life: Lifetimes, over: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Return ages, survival and its interval."""
    if not life.failed.any():
        return tuple(np.zeros(0) for _ in range(4))  # type: ignore[return-value]
    from statsmodels.duration.survfunc import SurvfuncRight

    # SurvfuncRight leaves a unit out of the risk set at its entry and before; it is at risk just
    # after.
    found = SurvfuncRight(
        life.end,
        life.failed.astype(int),
        entry=life.entry if life.entry.any() else None,
        freq_weights=life.units,
    )
    survival = np.asarray(found.surv_prob)
    error = np.asarray(found.surv_prob_se) * np.sqrt(over)
    inside = (survival > 0) & (survival < 1)
    s = np.where(inside, survival, 0.5)
    margin = np.where(inside, _Z * error / (s * np.abs(np.log(s))), 0.0)
    low = s ** np.exp(margin)
    high = s ** np.exp(-margin)
    return (
        np.asarray(found.surv_times),
        survival,
        np.where(inside, low, survival),
        np.where(inside, high, survival),
    )
