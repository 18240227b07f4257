"""Ageing of one robot's sensor: the table of the conditions of its cells, one row a run, and what
drifts in it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.bundle.checksummed_json import Damaged
from adaptfault.data.atomic import atomic_figure
from adaptfault.inspection.severity import TECHNICIAN_BELOW
from adaptfault.prognosis.trend import COVERAGE, FALSE, Trend, Trends, trends
from diagnostics.decision.result import Verdict
from diagnostics.layout import SensorLayout
from diagnostics.sensor.ageing import STATISTICS
from diagnostics.shown import shown
from diagnostics.wiring import Line

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from adaptfault.bundle.bundle import Bundle

SCHEMA = "adaptfault.trend/1"

LIMITS = {
    "gain": (0.5, 2.0),
    "offset": (-0.05, 0.05),
    "noise": (-np.inf, 0.05),
    "blinks": (-np.inf, 0.05),
}
"""Limits of a cell: the wrong gain, offset, noise and rate of blinks that the diagnosis takes for a
fault."""

_DAY = 86400.0  # seconds
_SHOWN = 10  # entries of a list, in the text
# share of the cells of a line, and of all cells, that must be known
_OF_LINE = 0.5
_OF_SENSOR = 0.1
_ROBUST = 3  # cells of a line that must be known: the median of fewer follows a single cell
_PLOTTED = 8  # series in the picture

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AgeingTable:
    """Condition of the cells by run, oldest first.

    Attributes:
        layout: the array.
        runs: numbers of the n runs in the journal.
        times: of the runs, UTC, ISO 8601.
        values: float ``[n, 4, D]``: gain, offset, noise and blinks, as
            :class:`diagnostics.sensor.ageing.CellCondition`; NaN:
            not known.
        verdicts: int ``[n, D]``, as :class:`diagnostics.Verdict`.
        accuracy: float ``[n]``, of the running version as a share of the fault-free one; NaN: not
            measured.
    """

    layout: SensorLayout
    runs: tuple[int, ...]
    times: tuple[str, ...]
    values: Floats
    verdicts: NDArray[np.int8]
    accuracy: Floats

    @classmethod
    def of(cls, bundle: Bundle) -> AgeingTable:
        """Read the table of a bundle. Raises Damaged."""
        d = bundle.layout.n_cells
        rows = bundle.journal.conditions()
        values = np.full((len(rows), 4, d), np.nan)
        verdicts = np.full((len(rows), d), Verdict.UNTESTED, np.int8)
        for i, (run, _, cells) in enumerate(rows):
            if len(cells) != 9 * d:
                raise Damaged(
                    f"{bundle.journal.path} is damaged: the condition of {d} cells in run {run} has"
                    " a wrong size"
                )
            values[i] = np.frombuffer(cells, "<f2", 4 * d).reshape(4, d)
            verdicts[i] = np.frombuffer(cells, np.int8, offset=8 * d)
        accuracy = {
            run["id"]: run["accuracy"] / run["fault_free_accuracy"]
            for run in bundle.journal.runs()
            if run.get("accuracy") is not None and run.get("fault_free_accuracy")
        }
        runs = tuple(run for run, _, _ in rows)
        kept = np.array([accuracy.get(run, np.nan) for run in runs])
        return cls(bundle.layout, runs, tuple(time for _, time, _ in rows), values, verdicts, kept)

    @property
    def last_alive(self) -> list[str | None]:
        """Time of the last proof of life of each cell, ``[D]``; None: no run in the table proves
        it."""
        alive = self.verdicts == Verdict.ALIVE
        last = (
            np.where(alive.any(axis=0), len(alive) - 1 - alive[::-1].argmax(axis=0), -1)
            if len(alive)
            else None
        )
        return (
            [None] * self.layout.n_cells
            if last is None
            else [self.times[i] if i >= 0 else None for i in last]
        )

    def report(self) -> AgeingReport:
        """Return what drifts."""
        when, unit = self._when()
        names, values, low, high = self._series()
        return AgeingReport(self, unit, when, tuple(names), values, trends(when, values, low, high))

    def _when(self) -> tuple[Floats, str]:
        """Return days since the first run; runs, where all are of one day."""
        seconds = np.array([datetime.fromisoformat(time).timestamp() for time in self.times])
        days = np.maximum.accumulate((seconds - seconds[0]) / _DAY) if len(seconds) else np.zeros(0)
        if len(days) and days[-1] >= 1:
            return days, "day"
        return np.arange(len(days), dtype=float), "run"

    def _series(self) -> tuple[list[Series], Floats, Floats, Floats]:
        """Return the series of the sensor, its lines and cells, with values ``[n, m]`` and limits
        ``[m]``."""
        present = self.layout.is_cell
        # A fault is an event and not a trend: the values of a faulty cell are left out.
        values = np.where(
            (self.verdicts == Verdict.FAULTY)[:, None] | ~present, np.nan, self.values
        )
        values[:, 0] = np.log(np.where(values[:, 0] > 0, values[:, 0], np.nan))
        names: list[Series] = []
        columns = []
        limits = []
        for k, statistic in enumerate(STATISTICS):
            low, high = np.log(LIMITS[statistic]) if k == 0 else LIMITS[statistic]
            sensor = _median(values[:, k, present], _OF_SENSOR)
            cells = values[:, k] - sensor[:, None]
            of = [(Series(statistic), sensor)]
            for line in self.layout.lines:
                on = self.layout.cells_on(line)
                if "address" not in line.kind and _ROBUST <= len(on) < present.sum():
                    of.append((Series(statistic, line=line), _median(cells[:, on], _OF_LINE)))
            of += [
                (Series(statistic, cell=int(cell)), cells[:, cell])
                for cell in np.flatnonzero(present)
            ]
            names += [name for name, _ in of]
            columns += [column for _, column in of]
            limits += [(low, high)] * len(of)
        names.append(Series("accuracy"))
        columns.append(self.accuracy)
        limits.append((TECHNICIAN_BELOW, np.inf))
        return names, np.stack(columns, axis=1), *np.array(limits).T


@dataclass(frozen=True)
class Series:
    """What one series describes: the whole sensor, a line, or a cell.

    Attributes:
        statistic: "gain", "offset", "noise", "blinks" or "accuracy".
        line: of a line; the median of its cells.
        cell: of a cell. Lines and cells are relative to the median of all cells, gains as
            logarithms.
    """

    statistic: str
    line: Line | None = None
    cell: int | None = None

    def place(self, layout: SensorLayout) -> str:
        """Return where it is, in words."""
        if self.line is not None:
            return str(self.line)
        return "all cells" if self.cell is None else layout.place(self.cell)

    def value(self, level: float) -> float:
        """Return the level in the unit of the statistic: a gain from its logarithm."""
        return float(np.exp(level)) if self.statistic == "gain" else level


@shown
@dataclass(frozen=True, eq=False)
class AgeingReport:
    """What drifts on one sensor.

    Attributes:
        table: the conditions by run.
        unit: of times: "day", or "run" where all runs are of one day.
        when: float ``[n]``, times of the runs since the first.
        series: what each series describes.
        values: float ``[n, m]``, their values.
        trends: of those that drift beyond chance.
    """

    table: AgeingTable
    unit: str
    when: Floats
    series: tuple[Series, ...]
    values: Floats
    trends: Trends

    @property
    def shown(self) -> list[Trend]:
        """Trends without those of cells on a line that drifts itself, sensor and lines first."""
        lines = [
            (self.series[t.series].statistic, self.series[t.series].line) for t in self.trends.found
        ]
        covered = {
            (statistic, int(cell))
            for statistic, line in lines
            if line is not None
            for cell in self.table.layout.cells_on(line)
        }
        left = [
            t for t in self.trends.found if (self._of(t).statistic, self._of(t).cell) not in covered
        ]
        return sorted(
            left, key=lambda t: (self._of(t).cell is not None, self._of(t).line is not None, t.p)
        )

    def _of(self, trend: Trend) -> Series:
        return self.series[trend.series]

    def __str__(self) -> str:
        n = len(self.table.runs)
        times = self.table.times
        if not n:
            return "no run has measured the condition of the cells yet: adaptfault maintain does"
        lines = [f"{n} runs from {times[0]} to {times[-1]}, {self.trends.tested} series tested"]
        shown = self.shown
        if shown:
            lines.append(f"drift beyond chance (of the intervals, {COVERAGE:.0%} hold the truth):")
            lines += [f"  {self._told(trend)}" for trend in shown[:_SHOWN]]
            lines += [f"  and {len(shown) - _SHOWN} more"] if len(shown) > _SHOWN else []
        else:
            lines.append("no drift beyond chance")
            fewest = self.trends.fewest_runs
            if self.trends.tested and n < fewest:
                lines.append(f"a steady drift of one cell alone needs {fewest} runs")
        lines += self._unproven()
        return "\n".join(lines)

    def _told(self, trend: Trend) -> str:
        series = self._of(trend)
        layout = self.table.layout
        span, every = (30, "30 days") if self.unit == "day" else (1, "run")
        rates = [span * rate for rate in (trend.rate, trend.rate_low, trend.rate_high)]
        if series.statistic == "gain":
            told = [f"{100 * np.expm1(r):+.2g}%" for r in rates]
        elif series.statistic in ("offset", "noise"):
            told = [f"{100 * r:+.2g}% of full scale" for r in rates]
        else:
            told = [f"{r:+.2g}" for r in rates]
        rate, low, high = told
        now = series.value(trend.now)
        text = (
            f"{series.place(layout)}: {series.statistic} {now:.3g}, {rate} per {every} ({low} to"
            f" {high})"
        )
        if trend.limit is None or trend.crossing is None:
            return text
        limit = f"{series.value(trend.limit):.2g}"
        if trend.crossing == 0:
            return f"{text}; beyond its limit {limit}"
        last = "no end" if trend.crossing_high is None else f"{trend.crossing_high:.0f}"
        return (
            f"{text}; crosses {limit} in {trend.crossing:.0f} {self.unit}s"
            f" ({trend.crossing_low:.0f} to {last})"
        )

    def _unproven(self) -> list[str]:
        """Return one line about the cells that the last run did not prove alive, the longest ago
        first."""
        last = self.table.last_alive
        times = self.table.times
        cells = [int(c) for c in np.flatnonzero(self.table.layout.present) if last[c] != times[-1]]
        if not cells:
            return []
        oldest = min(cells, key=lambda cell: last[cell] or "")
        since = last[oldest] or "never in these runs"
        place = self.table.layout.place(oldest)
        return [
            f"{len(cells)} cells without proof of life in the last run; the longest: {place}, last"
            f" {since}"
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {
            "schema": SCHEMA,
            "runs": list(self.table.runs),
            "times": list(self.table.times),
            "unit": self.unit,
            "tested": self.trends.tested,
            "fewest_runs": self.trends.fewest_runs,
            "correlation": self.trends.correlation,
            "false_discovery_rate": FALSE,
            "coverage": COVERAGE,
            "drifts": [
                {
                    "statistic": self._of(trend).statistic,
                    "place": self._of(trend).place(self.table.layout),
                    "cell": self._of(trend).cell,
                    **trend.to_dict(),
                }
                for trend in self.trends.found
            ],
            "last_alive": self.table.last_alive,
        }

    def plot(self) -> Figure:
        """Return a figure of the series that drift, with their lines and limits; of the sensor
        where none does."""
        from matplotlib.figure import Figure

        drifts = {trend.series: trend for trend in self.shown[:_PLOTTED]}
        chosen = (
            list(drifts)
            or [i for i, s in enumerate(self.series) if s.line is None and s.cell is None][:4]
        )
        figure = Figure(figsize=(8, 1.9 * ((len(chosen) + 1) // 2) + 0.4), layout="constrained")
        grid = figure.subplots((len(chosen) + 1) // 2, 2, squeeze=False).ravel()
        for axes, index in zip(grid, chosen, strict=False):
            series = self.series[index]
            y = self.values[:, index]
            axes.plot(
                self.when, np.exp(y) if series.statistic == "gain" else y, ".", color="#2c6fa6"
            )
            axes.set_title(f"{series.place(self.table.layout)}: {series.statistic}", fontsize=8)
            axes.set_xlabel(f"{self.unit}s", fontsize=8)
            axes.tick_params(labelsize=7)
            if (trend := drifts.get(index)) is None:
                continue
            ends = np.array([self.when[0], self.when[-1]])
            line = trend.now + trend.rate * (ends - self.when[-1])
            axes.plot(ends, np.exp(line) if series.statistic == "gain" else line, color="#c0392b")
            if trend.limit is not None:
                axes.axhline(series.value(trend.limit), color="#8a9199", linestyle=":")
        for axes in grid[len(chosen) :]:
            axes.set_axis_off()
        return figure

    def write_picture(self, path: str | Path) -> None:
        """Write the figure as PNG; raises OSError."""
        atomic_figure(path, self.plot(), dpi=150)


def _median(values: Floats, share: float) -> Floats:
    """Return the median over cells in runs where at least this share is known, ``[n]``; NaN
    elsewhere."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a run in which none is known
        median = np.nanmedian(values, axis=1)
    known = np.count_nonzero(~np.isnan(values), axis=1)
    return np.where(known >= max(_ROBUST, share * values.shape[1]), median, np.nan)
