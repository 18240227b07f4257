"""How many lines may fail? Accuracy after repair against the number of dead lines, for two layouts
of one size.

    python examples/design_study.py [--small]

Both arrays have as many cells: two small pads (many short lines) and one large pad (few long
lines). For each a network is trained on simulated grasps. Random lines die, the network is repaired
without a gradient step, and the repair is scored on test recordings. Prints a table and draws
design_study.png. To study your own design, change ``LAYOUTS`` and read recordings instead of
simulating them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import adaptfault as af
from diagnostics import FaultSet, SensorLayout

LAYOUTS = {"2 pads of 8 x 6": SensorLayout(2, 8, 6), "1 pad of 12 x 8": SensorLayout(1, 12, 8)}
Curve = dict[int, list[float]]  # number of dead lines -> accuracy of each draw


def after_repair(
    layout: SensorLayout, counts: list[int], draws: int, grasps: int, epochs: int
) -> Curve:
    recordings = af.simulate(grasps, layout, seed=1)
    training, validation, test = af.split(
        af.make_windows(recordings.frames, recordings.labels, layout)
    )
    model = af.TactileTransformer(
        layout, len(recordings.class_names), padding="valid", init="glorot"
    )
    af.train(model, training, validation, epochs=epochs, learning_rate=1e-3, progress=False)
    adapter = af.Adapter(model, training, validation)
    lines = [line for line in layout.lines if line.kind in ("row", "column")]
    # In each draw the lines die in one order, so that a curve shows what one more line costs.
    rng = np.random.default_rng(0)
    orders = [rng.permutation(len(lines)) for _ in range(draws)]
    curve = Curve()
    for count in counts:
        curve[count] = []
        for order in orders[: draws if count else 1]:
            dead = [layout.cells_on(lines[i]) for i in order[:count]]
            faults = FaultSet(
                tuple(np.unique(np.concatenate(dead)).tolist()) if dead else (), layout.n_cells
            )
            repaired = adapter.adapt(faults, method="head") if count else adapter.healthy
            curve[count].append(af.evaluate(repaired, test).accuracy)
    return curve


def show(curves: dict[str, Curve], path: Path) -> None:
    """Print the mean and the worst draw, and draw them."""
    from matplotlib.figure import Figure

    axes = Figure(figsize=(5.6, 3.6), layout="constrained").subplots()
    counts = list(next(iter(curves.values())))
    print(f"{'dead lines':18s}" + "".join(f"{count:>14d}" for count in counts))
    for number, (name, curve) in enumerate(curves.items()):
        mean, worst = ([f(curve[count]) for count in counts] for f in (np.mean, min))
        print(
            f"{name:18s}" + "".join(f"{m:8.3f} ({w:.2f})" for m, w in zip(mean, worst, strict=True))
        )
        axes.plot(counts, mean, "o-", color=f"C{number}", label=name)
        axes.plot(counts, worst, ":", color=f"C{number}")
    axes.set(xlabel="dead lines", ylabel="accuracy after repair (dotted: worst draw)", ylim=(0, 1))
    axes.legend(frameon=False)
    axes.figure.savefig(path, dpi=120)
    print(f"mean of the draws (worst draw); picture in {path}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=5, help="of the lines, for each number")
    parser.add_argument("--out", type=Path, default=Path("design_study.png"))
    parser.add_argument("--small", action="store_true", help="the smallest setting, in seconds")
    args = parser.parse_args()
    counts, draws, grasps, epochs = (
        ([0, 2, 6], 1, 6, 1) if args.small else ([0, 1, 2, 4, 6, 8, 10], args.draws, 40, 5)
    )
    show(
        {name: after_repair(of, counts, draws, grasps, epochs) for name, of in LAYOUTS.items()},
        args.out,
    )


if __name__ == "__main__":
    main()
