"""The paper's figures from a run's results, and the tables behind them."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.paper.ledger import Ledger, Mean, mean
from adaptfault.paper.settings import WIRING, Task, is_aware
from diagnostics import SensorLayout
from diagnostics.decision.plot import draw_row, pads_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TITLES = {
    2: "Figure 2: fault-free, open (OF) and short (SF) cells",
    3: "Figure 3: mean force: normal, 10 cells open, 10 short",
    4: "Figure 4: fault-aware training",
    5: "Figure 5: the faulty cells removed and the model adapted",
    6: "Figure 6: short cells corrected",
    7: "Beyond the paper: strategies against other kinds of fault",
}
_NAMES = {"open": "open (OF)", "short": "short (SF)", "mixed": "open or short", "none": "none"}

Row = tuple[Task, Mean]


def rows(ledger: Ledger, figure: int) -> list[Row]:
    """Return each condition of a figure, by the task of its first seed, with its mean over the
    seeds."""
    conditions: dict[tuple[str, int, str], list[Any]] = {}
    for result in ledger.of(figure):
        task = result.task
        conditions.setdefault((task.strategy, task.k, task.faults), []).append(result)
    return [(results[0].task, mean(results)) for results in conditions.values()]


def table(found: Sequence[Row]) -> str:
    """Return rows as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    numbers = ("accuracy", "low", "high", "precision", "recall", "f1", "spread")
    writer.writerow(["strategy", "faults", "k", *numbers, "seeds"])
    for task, m in found:
        writer.writerow(
            [
                task.strategy,
                task.faults,
                task.k,
                *(f"{getattr(m, name):.4f}" for name in numbers),
                m.seeds,
            ]
        )
    return text.getvalue()


def draw(ledger: Ledger, figure: int) -> Figure:
    """Draw Figure 2, 4, 5, 6 or 7."""
    from matplotlib.figure import Figure

    if figure == 4:
        return _samples(rows(ledger, 4))
    picture = Figure(figsize=(7.5, 4.2), layout="constrained")
    ax = picture.subplots()
    found = rows(ledger, figure)
    match figure:
        case 2:
            for kind in ("open", "short"):
                _line(ax, [(t.k, m) for t, m in found if t.faults == kind], _NAMES[kind])
        case 5:
            for strategy in ("adapted", "trained anew"):
                _line(ax, [(t.k, m) for t, m in found if t.strategy == strategy], strategy)
        case 6:
            for kind, dashes in (("open", ":"), ("short", "-.")):
                others = [(t.k, m) for t, m in rows(ledger, 2) if t.faults == kind]
                _line(ax, others, f"{_NAMES[kind]}, not corrected", linestyle=dashes, color="0.4")
            for strategy in dict.fromkeys(t.strategy for t, _ in found):
                _line(ax, [(t.k, m) for t, m in found if t.strategy == strategy and t.k], strategy)
        case _:
            _bars(ax, found)
    free = ledger.mean(2, "none", 0, "nothing")
    if free is not None:
        ax.axhline(free.accuracy, color="0.6", lw=1, ls="--", zorder=0, label="fault-free")
    ax.set(ylabel="test accuracy", ylim=(0, 1), title=TITLES[figure])
    if figure in (2, 5, 6):
        ax.set_xlabel("faulty cells")
        ax.set_xticks(sorted({t.k for t, _ in found}))
    picture.legend(
        *ax.get_legend_handles_labels(),
        loc="outside lower center",
        ncols=3,
        frameon=False,
        fontsize=8,
    )
    return picture


def _samples(found: Sequence[Row]) -> Figure:
    """Draw Figure 4: a panel for each test, accuracy over the number of samples that were added in
    training."""
    from matplotlib.figure import Figure

    tests = list(dict.fromkeys((t.faults, t.k) for t, _ in found))
    columns = min(len(tests), 3)
    picture = Figure(figsize=(7.5, 5.2), layout="constrained")
    axes = picture.subplots(-(-len(tests) // columns), columns, sharey=True, squeeze=False).ravel()
    known = [(is_aware(t.strategy) or (0, "cells"), (t.faults, t.k), m) for t, m in found]
    numbers = sorted({n for (n, _), _, _ in known})
    for ax, test in zip(axes, tests, strict=False):
        for kind in dict.fromkeys(kind for (_, kind), _, _ in known):
            of = [
                (numbers.index(n), m)
                for (n, own), at, m in known
                if at == test and (own == kind or n == 0)
            ]
            style = {"linestyle": "--", "color": "0.4"} if kind == "none" else {}
            label = "without faults (control)" if kind == "none" else f"with faulty {kind}"
            _line(ax, of, label, **style)
        ax.set_title(
            "no fault" if not test[1] else f"{test[1]} {_NAMES.get(test[0], test[0])}", fontsize=9
        )
        ax.set(ylim=(0, 1), xticks=range(len(numbers)))
        ax.set_xticklabels([f"{n // 1000}k" if n >= 1000 else str(n) for n in numbers])
    for ax in axes[len(tests) :]:
        ax.remove()
    picture.suptitle(TITLES[4])
    picture.supylabel("test accuracy")
    for ax in axes[: len(tests)][-columns:]:
        ax.set_xlabel("training windows added", fontsize=9)
    picture.legend(
        *axes[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=4,
        frameon=False,
        fontsize=8,
    )
    return picture


def _line(ax: Axes, points: Sequence[tuple[int, Mean]], label: str, **style: Any) -> None:
    points = sorted(points, key=lambda point: point[0])
    if points:
        reached = np.array([m.accuracy for _, m in points])
        around = [reached - [m.low for _, m in points], [m.high for _, m in points] - reached]
        ax.errorbar(
            [k for k, _ in points],
            reached,
            np.maximum(around, 0),
            marker="o",
            capsize=3,
            label=label,
            **style,
        )


def _bars(ax: Axes, found: Sequence[Row]) -> None:
    """Draw a group of bars for each kind of fault, one for each strategy."""
    groups = list(dict.fromkeys((t.faults, t.k) for t, _ in found))
    strategies = list(dict.fromkeys(t.strategy for t, _ in found))
    width = 0.8 / max(len(strategies), 1)
    for i, strategy in enumerate(strategies):
        of = {(t.faults, t.k): m for t, m in found if t.strategy == strategy}
        at = [
            j + (i - (len(strategies) - 1) / 2) * width
            for j, group in enumerate(groups)
            if group in of
        ]
        shown = [of[group] for group in groups if group in of]
        reached = np.array([m.accuracy for m in shown])
        around = [reached - [m.low for m in shown], [m.high for m in shown] - reached]
        ax.bar(
            at,
            reached,
            width,
            yerr=np.maximum(around, 0),
            label=strategy,
            error_kw={"elinewidth": 1},
        )
    names = [f"{k} {kind}" if kind in WIRING else kind for kind, k in groups]
    ax.set_xticks(range(len(groups)), names, fontsize=9)


def force_maps(
    frames: NDArray[np.floating[Any]], layout: SensorLayout, seed: int, k: int = 10
) -> tuple[Figure, dict[str, NDArray[np.float64]]]:
    """Draw Figure 3 from fault-free ``frames [n, D]`` in the layout's unit; return the maps ``[D]``
    as well."""
    present = np.flatnonzero(layout.present)
    cells = np.random.default_rng(seed).permutation(present)[: min(k, len(present))]
    normal = np.asarray(np.nanmean(frames, axis=0, dtype=np.float64))
    maps: dict[str, NDArray[np.float64]] = {"normal": normal}
    for name, value in (("open", 0.0), ("short", layout.full_scale)):
        maps[f"{len(cells)} {name}"] = normal.copy()
        maps[f"{len(cells)} {name}"][cells] = value
    figure, axes = pads_figure(layout, n_rows=len(maps))
    # One scale from the healthy map; shorts exceed it.
    top = float(normal[present].max()) or layout.full_scale
    for i, (name, values) in enumerate(maps.items()):
        dead = cells.tolist() if i else []
        title = f"{name}, "
        draw_row(axes[i], values, layout, title, dead, top=top, label=layout.unit, extend="max")
    return figure, maps
