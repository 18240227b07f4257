"""How often the intervals of a forecast hold the accuracy reached, and whether it ranks fault sets.

    python examples/forecast_intervals.py [GRASPS.npz] [--sets 200] [--splits 0 1 2] [--small]

For each split one network is trained and kept in ``--out``. The recordings that it is not trained on are divided at
random into validation and test, anew for every ``--sets-each`` fault sets: all fault sets of one division share the
luck of the division, so a single one says little about the coverage. Each fault set (cells, lines, blocks, a pad) is
forecast from validation, and the same repair is scored on test. A forecast that is exact for the many but not for the
division is out by the same amount for all fault sets, so the ranks are compared within each division.

Killed and started again, it goes on where it was. Without GRASPS.npz the grasps are simulated.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

import adaptfault as af
from adaptfault.adaptation.forecast import Expected
from adaptfault.adaptation.stages import Run
from adaptfault.imputation.dropout import random_fault_set
from diagnostics import FaultSet, SensorLayout


def trained(folder: Path, layout: SensorLayout, training: af.Windows, validation: af.Windows, epochs: int, seed: int):
    """Return the network of a split, trained unless it was before; of the small kind, which trains in a minute."""
    if (folder / "manifest.json").exists():
        return af.load_model(folder)
    n_classes = int(training.y.max()) + 1
    model = af.TactileTransformer(layout, n_classes, padding="valid", init="glorot", seed=seed)
    af.train(model, training, validation, epochs=epochs, learning_rate=2e-4, seed=seed, progress=False)
    af.save_model(folder, model)
    return model


def fault_set(layout: SensorLayout, rng: np.random.Generator) -> FaultSet:
    faults = random_fault_set(layout, rng)
    return faults if len(faults) else fault_set(layout, rng)


def stages_of(adapter: af.Adapter, faults: FaultSet, test: af.Windows) -> dict[str, dict[str, float]]:
    """Return for fill and head what ``adapter.forecast`` expects of the test recordings, and what they then give."""
    run, new, result = Run(adapter, faults, None, 0, False), len(np.unique(test.recording)), {}
    for stage in ("fill", "head"):
        if stage == "head":
            run.execute("head")
        right = run.held_out().argmax(1).numpy() == adapter.validation.y
        expected = Expected.of(right, adapter.validation.recording, new)
        result[stage] = {**vars(expected), "reached": af.evaluate(run.done(), test).accuracy}
    return result


def measure(args: argparse.Namespace) -> list[dict]:
    if args.recordings is None:
        recordings = af.simulate(args.grasps, seed=3)
    else:
        recordings = af.load([args.recordings]).recordings
    layout = recordings.layout
    windows = af.make_windows(recordings.frames, recordings.labels, layout)
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / "forecasts.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {(row["split"], row["number"]) for row in rows}
    for split in args.splits:
        training, validation, test = af.split(windows, seed=split)
        model = trained(args.out / f"split{split}", layout, training, validation, args.epochs, split)
        rest = windows.select(~np.isin(windows.recording, training.recording))
        rng, adapter = np.random.default_rng(1000 + split), None
        for number in range(args.sets):
            if number % args.sets_each == 0:
                validation, _, test = af.split(rest, test=0.55, validation=0, seed=1000 * split + number)
                adapter = None
            faults = fault_set(layout, rng)
            if (split, number) in done:
                continue
            adapter = af.Adapter(model, training, validation) if adapter is None else adapter
            row = {"split": split, "number": number, "division": number // args.sets_each, "k": len(faults)}
            rows.append({**row, "stages": stages_of(adapter, faults, test)})
            with path.open("a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
            head = rows[-1]["stages"]["head"]
            print(
                f"split {split}, {len(faults)} cells dead: head {head['accuracy']:.3f}"
                f" ({head['low']:.3f} to {head['high']:.3f}), reached {head['reached']:.3f}",
                flush=True,
            )
    return rows


def show(rows: list[dict]) -> None:
    """Print coverage, width, error and rank correlation of each stage."""
    for stage in ("fill", "head"):
        for split in dict.fromkeys(row["split"] for row in rows):
            mine = [row for row in rows if row["split"] == split]
            expected, low, high, reached = np.transpose([list(row["stages"][stage].values()) for row in mine])
            within = (low <= reached) & (reached <= high)
            division = np.array([row["division"] for row in mine])
            divisions, ranks = np.unique(division), []
            for i in divisions:
                which = division == i
                if which.sum() > 2 and np.ptp(reached[which]) > 0 and np.ptp(expected[which]) > 0:
                    ranks.append(spearmanr(expected[which], reached[which]).statistic)
            print(
                f"{stage}, split {split}: {within.sum()} of {len(mine)} intervals ({within.mean():.3f}) hold the test"
                f" accuracy, over {len(divisions)} divisions; half width {(high - low).mean() / 2:.3f}, error"
                f" {np.mean(reached - expected):+.3f} +- {np.std(reached - expected):.3f}"
                + (f"; Spearman {np.mean(ranks):.2f}" if ranks else "")
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="?", help="labelled recordings of a healthy array")
    parser.add_argument("--splits", type=int, nargs="+", default=[0, 1, 2], help="seeds of split and weights")
    parser.add_argument("--sets", type=int, default=200, help="random fault sets of each split")
    parser.add_argument("--sets-each", type=int, default=10, help="fault sets of one division")
    parser.add_argument("--grasps", type=int, default=40, help="simulated grasps of each class")
    parser.add_argument("--epochs", type=int, default=4, help="of each network")
    parser.add_argument("--small", action="store_true", help="the smallest setting, to see that everything runs")
    parser.add_argument("--out", type=Path, default=Path("forecast_intervals"), help="where networks and results go")
    args = parser.parse_args()
    if args.small:
        args.splits, args.sets, args.sets_each, args.grasps, args.epochs = [0], 3, 3, 6, 1
    show(measure(args))


if __name__ == "__main__":
    main()
