"""Draws the README's picture from a run of the demo: python examples/picture.py [--out FILE]
[--full]

Left what the broken skin reads, in the middle what the diagnosis says of it, right the accuracy
before and after. --full runs what `adaptfault demo` runs, as for the committed picture; without it
a few grasps of a small array must do.
"""

import argparse
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

import adaptfault as af
from adaptfault.cli.demo import QUICK, SIMULATED_PER_CLASS
from adaptfault.evaluation.demo import DemoResult, run_demo
from diagnostics import Diagnosis, FaultKind, SensorLayout
from diagnostics.decision.plot import draw_forces

VERDICTS = {"untested": "#d5d8dc", "alive": "#a9d3a5", "faulty": "#c0392b"}
LETTERS = {FaultKind.OPEN: "O", FaultKind.SHORT: "S", FaultKind.STUCK: "K"}
INK = "#2c3e50"


def draw_readings(axes: list[Axes], result: DemoResult) -> None:
    """Draw the mean force of each cell over the test recordings."""
    layout = result.recordings.layout
    for pad, ax in enumerate(axes):
        values = layout.grid(result.maps["broken"])[pad]
        image = draw_forces(ax, values, layout, cmap="magma", vmin=0, vmax=layout.full_scale / 5)
    bar = ax.figure.colorbar(
        image, ax=axes, location="bottom", shrink=0.7, aspect=30, pad=0.04, extend="max"
    )
    bar.set_label(f"mean reading [{layout.unit}]", color=INK, size=9)
    bar.ax.tick_params(labelsize=8)


def draw_verdicts(axes: list[Axes], diagnosis: Diagnosis) -> None:
    """Draw each cell's verdict, and the letter of its fault."""
    layout = diagnosis.layout
    codes = [list(VERDICTS).index(verdict.name.lower()) for verdict in diagnosis.verdicts]
    for pad, ax in enumerate(axes):
        ax.pcolormesh(
            layout.grid(codes)[pad],
            cmap=ListedColormap(list(VERDICTS.values())),
            vmin=0,
            vmax=2,
            ec="w",
            lw=1.5,
        )
        ax.set(aspect="equal", ylim=(layout.rows, 0))
    for fault in diagnosis.faults:
        for cell in fault.cells:
            pad, row, column = layout.position(cell)
            letter = LETTERS.get(fault.kind, "!")
            axes[pad].text(
                column + 0.5,
                row + 0.53,
                letter,
                ha="center",
                va="center",
                color="w",
                size=9,
                weight="bold",
            )
    letters = ", ".join(f"{letter} {kind.value}" for kind, letter in LETTERS.items())
    names = {**dict.fromkeys(VERDICTS, ""), "faulty": f" ({letters})"}
    patches = [
        Patch(color=color, label=name + names[name]) for name, color in reversed(VERDICTS.items())
    ]
    axes[0].figure.legend(
        handles=patches,
        loc="outside lower center",
        ncols=3,
        frameon=False,
        fontsize=8.5,
        handlelength=1,
        columnspacing=1,
    )


def draw_accuracy(ax: Axes, result: DemoResult) -> None:
    """Draw the accuracy and its 95 % interval of the healthy, the broken and the repaired
    classifier."""
    scores = [result.fault_free.accuracy, result.broken.accuracy, result.repaired.accuracy]
    ends = [(s - low, high - s) for s, (low, high) in zip(scores, result.intervals, strict=True)]
    bars = ax.bar(range(3), scores, 0.68, color=["#7f8c8d", "#c0392b", "#2e8b57"])
    ax.errorbar(
        range(3),
        scores,
        [[e[0] for e in ends], [e[1] for e in ends]],
        fmt="none",
        ecolor=INK,
        capsize=4,
    )
    ax.bar_label(
        bars, [f"{s:.0%}" for s in scores], label_type="center", color="w", size=14, weight="bold"
    )
    chance = 1 / len(result.recordings.class_names)
    ax.axhline(chance, color=INK, lw=1, ls=":", label="chance")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 1.0), frameon=False, fontsize=9)
    ax.set_xticks(range(3), ["healthy", "broken", "repaired"], size=11)
    ax.set(ylim=(0, 1), yticks=[])
    ax.spines[["top", "right", "left"]].set_visible(False)


def draw(result: DemoResult) -> Figure:
    """Return the picture."""
    layout = result.recordings.layout
    n_broken = len(result.injected_set)
    figure = Figure(figsize=(11.5, 3.5), layout="constrained")
    parts = figure.subfigures(1, 3, width_ratios=(1, 1, 0.75), wspace=0.04)
    readings, verdicts = (
        list(part.subplots(1, layout.pads, squeeze=False)[0]) for part in parts[:2]
    )
    draw_readings(readings, result)
    draw_verdicts(verdicts, result.diagnosis)
    draw_accuracy(parts[2].subplots(), result)
    for ax, pad in zip(readings + verdicts, 2 * list(range(layout.pads)), strict=True):
        ax.set_title(f"pad {pad}", size=10, color=INK)
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    titles = (
        f"{n_broken} of {layout.present.sum()} cells died",
        f"found {len(result.found)} of {n_broken}, {len(result.false_alarms)} false alarms",
        "accuracy of the classifier",
    )
    for part, title in zip(parts, titles, strict=True):
        part.suptitle(title, size=13, weight="bold", color=INK)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("picture.png"))
    parser.add_argument("--full", action="store_true")
    args = parser.parse_args()
    small = SensorLayout(2, 8, 6)
    grasps = (
        af.simulate(SIMULATED_PER_CLASS, seed=0)
        if args.full
        else af.simulate(16, small, n_frames=60, seed=0)
    )
    result = run_demo(grasps, **QUICK, seed=0, progress=False, say=print)
    draw(result).savefig(args.out, dpi=100, pil_kwargs={"optimize": True})
    print(f"picture      {args.out}")


if __name__ == "__main__":
    main()
