"""Draws the figures of the method pages from simulated grasps: python docs/figures.py [--out
FOLDER] [--only NAME ...]

All seeds are fixed. The whole takes about a minute and a half of one core; each figure can be drawn
alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import cache
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

import adaptfault as af
from adaptfault.adaptation.reduced_model import phi
from adaptfault.prognosis.trend import trends
from diagnostics import (
    Diagnosis,
    Fault,
    FaultKind,
    FaultSet,
    Line,
    SelfDiagnosis,
    SensorLayout,
    Verdict,
    inject,
    line_fault,
)
from diagnostics.events.constant_runs import segments
from diagnostics.events.contact_events import ContactEvent, EventLog

Floats = NDArray[np.float64]

LAYOUT = SensorLayout(1, 10, 8)
OPEN = LAYOUT.cell(0, 4, 3)
STUCK = LAYOUT.cell(0, 6, 5)
CUT = line_fault(LAYOUT, Line(0, "row", 4), "open", break_at=3)
ONSET = 130
FAULTS = (CUT, Fault(FaultKind.STUCK, (STUCK,), value=2.0, onset=ONSET))
RED = "#c0392b"
BLUE = "#2c6fa6"
GREEN = "#3f8f4f"
GREY = "#8a9199"
SETTINGS = {
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "image.interpolation": "nearest",
}


@cache
def reference() -> SelfDiagnosis:
    """Fit the diagnosis to 42 healthy grasps."""
    return SelfDiagnosis(LAYOUT).fit(healthy(seed=1, n_per_class=6))


def healthy(seed: int, n_per_class: int = 1) -> list[Floats]:
    """Return simulated grasps in random order, without those that touch nothing."""
    classes = ("normal", "foreign matter", "void", "deformation", "softer", "harder")
    frames = af.simulate(n_per_class, LAYOUT, n_frames=50, seed=seed, classes=classes).frames
    order = np.random.default_rng(seed).permutation(len(frames))
    return [np.asarray(frames[i], dtype=np.float64) for i in order]


@cache
def log() -> tuple[Floats, Floats, Diagnosis]:
    """Return one log as it would be without faults and as it reads, ``[T, D]`` each, and its
    diagnosis."""
    true = np.concatenate(healthy(seed=2))
    seen = inject(true, FAULTS, LAYOUT, seed=0)
    return true, seen, reference().diagnose(seen)


def root_load(frames: Floats) -> Floats:
    """Return the square root of the load, 0..1."""
    return np.sqrt(np.clip(frames / LAYOUT.full_scale, 0, 1))


def events_of(frames: Floats) -> tuple[ContactEvent, ...]:
    """Return the contact events of healthy frames ``[T, D]``."""
    scale = reference().reference_.scale
    found = EventLog()
    for part, numbers, runs in segments(frames, scale):
        found = found.extend(scale.root_load(part), numbers, scale.root_near, runs.start)
    return found.kept


def panels(*widths: float, height: float = 2.5) -> tuple[Figure, list[Axes]]:
    """Return a figure with axes side by side."""
    figure = Figure(figsize=(8.4, height), layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(1, len(widths), width_ratios=widths)))


def draw_map(axes: Axes, values: Floats, title: str, label: str, **style: object) -> None:
    """Draw one value a cell, with a colour bar."""
    image = axes.imshow(LAYOUT.grid(values)[0], **{"cmap": "viridis", **style})
    axes.set(title=title, xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    bar = axes.figure.colorbar(image, ax=axes, shrink=0.85)
    bar.set_label(label)


def outline(axes: Axes, cell: int, colour: str) -> None:
    """Mark one cell of a map."""
    _, row, column = LAYOUT.position(cell)
    axes.add_patch(
        Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, edgecolor=colour, linewidth=1.8)
    )


def draw_verdicts(axes: Axes, diagnosis: Diagnosis) -> None:
    """Draw the verdict of each cell and the letter of its fault."""
    codes = [list(Verdict).index(verdict) for verdict in diagnosis.verdicts]
    colours = {Verdict.ALIVE: "#a9d3a5", Verdict.FAULTY: RED, Verdict.UNTESTED: "#d5d8dc"}
    axes.imshow(
        LAYOUT.grid(np.array(codes))[0],
        cmap=ListedColormap([colours[v] for v in Verdict]),
        vmin=0,
        vmax=2,
    )
    for fault in diagnosis.faults:
        for cell in fault.cells:
            _, row, column = LAYOUT.position(cell)
            letter = "K" if fault.kind == FaultKind.STUCK else fault.kind.value[0].upper()
            axes.text(column, row, letter, color="white", ha="center", va="center", weight="bold")
    for row, column in zip(
        *np.nonzero(LAYOUT.grid(diagnosis.verdicts == Verdict.UNTESTED)[0]), strict=True
    ):
        axes.text(column, row, "?", color=GREY, ha="center", va="center")
    axes.set(title="verdicts and root causes", xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def diagnosis() -> Figure:
    """Draw frames, evidence and verdicts of one log."""
    _, seen, found = log()
    figure, axes = panels(1.5, 1, 0.85)
    load = root_load(seen)
    image = axes[0].imshow(load.T, aspect="auto", cmap="magma", vmin=0, vmax=1)
    axes[0].axvline(ONSET, color="white", linestyle=":", linewidth=1)
    axes[0].set(title="frames: root load of each cell", xlabel="frame", ylabel="cell")
    axes[0].spines[:].set_visible(False)
    figure.colorbar(image, ax=axes[0], shrink=0.85)
    draw_map(
        axes[1], found.evidence["spatial"], "evidence", "log likelihood ratio", cmap="Reds", vmin=0
    )
    draw_verdicts(axes[2], found)
    return figure


def events() -> Figure:
    """Draw the total load with its contact events, and the features of one event."""
    pause = np.zeros((12, LAYOUT.n_cells))
    grasps = healthy(seed=3)[:4]
    frames = np.concatenate([part for grasp in grasps for part in (pause, grasp)][1:])
    found = events_of(frames)
    figure, axes = panels(1.9, 1, 1)
    total = root_load(frames).sum(axis=1)
    axes[0].plot(total, color="black", linewidth=0.9)
    for k, event in enumerate(found):
        axes[0].axvspan(event.first, event.end, color=(BLUE, GREEN)[k % 2], alpha=0.22, linewidth=0)
        axes[0].text(
            (event.first + event.end) / 2, total.max() * 1.05, str(k + 1), ha="center", va="center"
        )
    axes[0].set(
        title=f"{len(found)} contact events",
        xlabel="frame",
        ylabel="sum of root loads",
        xlim=(0, len(frames)),
        ylim=(0, 1.12 * total.max()),
    )
    peak, _, _, share = found[0].suffixes()[0].features()
    draw_map(axes[1], peak, "event 1: highest root load", "", vmin=0, vmax=1)
    draw_map(axes[2], share, "event 1: share of frames loaded", "", cmap="cividis", vmin=0, vmax=1)
    return figure


def root_causes() -> Figure:
    """Draw the evidence of single cells and the wire that explains them."""
    _, _, found = log()
    figure, axes = panels(1, 0.85, 1.1)
    draw_map(
        axes[0],
        found.evidence["spatial"],
        "evidence of single cells",
        "log ratio",
        cmap="Reds",
        vmin=0,
    )
    draw_verdicts(axes[1], found)
    for fault in found.faults:
        if fault.line is not None:
            positions = np.array([LAYOUT.position(cell)[1:] for cell in fault.cells])
            (top, left), (bottom, right) = positions.min(axis=0), positions.max(axis=0)
            corner = (left - 0.5, top - 0.5)
            size = (right - left + 1, bottom - top + 1)
            axes[1].add_patch(Rectangle(corner, *size, fill=False, edgecolor="black", linewidth=2))
    text = "\n\n".join(fault.reason for fault in found.faults)
    axes[2].text(0, 0.95, text, va="top", wrap=True, transform=axes[2].transAxes, fontsize=8)
    axes[2].set_axis_off()
    return figure


@cache
def adapter() -> tuple[af.Adapter, af.Windows]:
    """Train a small network on simulated grasps; return its adapter and the test windows."""
    grasps = af.simulate(30, LAYOUT, n_frames=50, seed=5)
    windows = af.make_windows(grasps.frames, grasps.labels, LAYOUT)
    training, validation, test = af.split(windows)
    model = af.TactileTransformer(LAYOUT, len(grasps.class_names))
    af.train(model, training, validation, epochs=6, progress=False)
    return af.Adapter(model, training, validation), test


def repair() -> Figure:
    """Draw a frame with dead cells, and what the fill makes of it."""
    network, test = adapter()
    scattered = np.random.default_rng(0).choice(LAYOUT.n_cells, 16, replace=False)
    fault_set = FaultSet(
        tuple(np.union1d(scattered, LAYOUT.cells_on(CUT.line)).tolist()), LAYOUT.n_cells
    )
    window = test.x[test.x.sum(axis=(1, 2)).argmax()][None]
    adapted = network.adapt(fault_set, method="fill", progress=False)
    with torch.no_grad():
        filled = adapted.model.complete(torch.from_numpy(phi(window, fault_set)))[0, -1].numpy()
    frame = window[0, -1]
    figure, axes = panels(1, 1, 1)
    style = {"vmin": 0.0, "vmax": float(frame.max())}
    draw_map(axes[0], frame, "healthy sensor", "", **style)
    dead = np.where(fault_set.mask, np.nan, frame)
    draw_map(axes[1], dead, f"{len(fault_set)} of {LAYOUT.n_cells} cells dead", "", **style)
    draw_map(axes[2], filled, "dead cells filled", "", **style)
    for cell in fault_set:
        outline(axes[2], cell, "white")
    return figure


def forecast() -> Figure:
    """Draw the forecast accuracy of some fault sets beside the accuracy that the adapted model
    reaches."""
    network, test = adapter()
    rng = np.random.default_rng(1)
    sets = {f"{n} cells": rng.choice(LAYOUT.n_cells, n, replace=False) for n in (8, 40, 68)}
    sets["rows 3 to 6"] = np.concatenate(
        [LAYOUT.cells_on(Line(0, "row", row)) for row in (3, 4, 5, 6)]
    )
    figure, axes = panels(1)
    for k, cells in enumerate(sets.values()):
        fault_set = FaultSet(tuple(cells.tolist()), LAYOUT.n_cells)
        expected = network.forecast(fault_set).stages
        for method, colour, side in (("fill", BLUE, -0.15), ("head", GREEN, 0.15)):
            of = expected[method]
            label = method if k == 0 else None
            error = [[of.accuracy - of.low], [of.high - of.accuracy]]
            axes[0].errorbar(
                k + side, of.accuracy, error, fmt="_", capsize=3, color=colour, label=label
            )
            reached = af.evaluate(
                network.adapt(fault_set, method=method, progress=False), test
            ).accuracy
            axes[0].plot(
                k + side,
                reached,
                "x",
                color="black",
                label="reached on test" if k == 0 and side > 0 else None,
            )
    axes[0].set_xticks(range(len(sets)), sets)
    axes[0].set(
        ylabel="accuracy",
        title="forecast with its 95 % interval, and the accuracy reached on test recordings",
    )
    axes[0].legend(loc="lower left")
    return figure


def ageing() -> Figure:
    """Draw the gains of a weakening and of a stable cell over weekly runs, with what is reported of
    them."""
    rng = np.random.default_rng(0)
    when = 7.0 * np.arange(14)
    gains = rng.normal(0, 0.05, (14, 40))
    gains[:, 0] += np.log(0.97) * when / 7
    found = {
        t.series: t
        for t in trends(when, gains, np.full(40, np.log(0.5)), np.full(40, np.log(2))).found
    }
    figure, axes = panels(1, 1)
    for cell, place in enumerate(axes):
        place.plot(when, np.exp(gains[:, cell]), ".", color=BLUE)
        place.axhline(0.5, color=GREY, linestyle=":")
        place.set(
            xlabel="days",
            ylabel="gain",
            ylim=(0.3, 1.3),
            xlim=(-3, 200),
            title="no drift beyond chance",
        )
        if (trend := found.get(cell)) is not None and trend.crossing is not None:
            days = np.linspace(when[0], when[-1] + trend.crossing)
            place.plot(days, np.exp(trend.now + trend.rate * (days - when[-1])), color=RED)
            place.set_title(f"crosses its limit in {trend.crossing:.0f} days")
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    "diagnosis": diagnosis,
    "events": events,
    "ageing": ageing,
    "root-causes": root_causes,
    "repair": repair,
    "forecast": forecast,
}


def main() -> None:
    """Draw them."""
    parser = argparse.ArgumentParser(description="Draws the figures of the method pages")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(__file__).parent / "figures",
        help="folder of the PNG files",
    )
    parser.add_argument(
        "--only", nargs="+", choices=FIGURES, metavar="NAME", help=f"some of {', '.join(FIGURES)}"
    )
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    matplotlib.rcParams.update(SETTINGS)
    for name in options.only or FIGURES:
        FIGURES[name]().savefig(options.out / f"{name}.png", dpi=110)
        print(options.out / f"{name}.png")


if __name__ == "__main__":
    main()
