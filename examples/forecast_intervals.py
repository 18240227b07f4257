"""How often the intervals of a forecast hold the accuracy of other recordings, and whether it ranks fault sets.

    python examples/forecast_intervals.py [GRASPS.npz] [--sets 60] [--splits 0 1] [--small]

For each split one network is trained and kept in ``--out``. For each random fault set (cells, lines, blocks, a pad) a
head is fitted, and the recordings that the network is not trained on are predicted by heads fitted without them. These
recordings are then divided into two parts, many times, at random or stratified by class as ``af.split`` does. One part
plays validation: it gives the forecast. The other plays test. All fault sets share the luck of a division, so a single
division says little about coverage.

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
from adaptfault.data.windows import evenly
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


def known_right(adapter: af.Adapter, faults: FaultSet) -> list[bool]:
    """Return for each validation window whether a head fitted without it, for F, is right."""
    run = Run(adapter, faults, None, 0, False)
    run.execute("head")
    return (run.held_out().argmax(1).numpy() == adapter.validation.y).tolist()


def measure(args: argparse.Namespace) -> None:
    recordings = af.simulate(args.grasps, seed=3) if args.recordings is None else af.load([args.recordings]).recordings
    layout = recordings.layout
    windows = af.make_windows(recordings.frames, recordings.labels, layout)
    args.out.mkdir(parents=True, exist_ok=True)
    for split in args.splits:
        training, validation, _ = af.split(windows, seed=split)
        model = trained(args.out / f"split{split}", layout, training, validation, args.epochs, split)
        rest = windows.select(~np.isin(windows.recording, training.recording))
        adapter = af.Adapter(model, training.select(evenly(len(training), args.windows)), rest)
        path = args.out / f"right{split}.jsonl"
        right = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
        rng = np.random.default_rng(1000 + split)
        for number, faults in enumerate(fault_set(layout, rng) for _ in range(args.sets)):
            if number < len(right):
                continue
            right.append(known_right(adapter, faults))
            with path.open("a") as file:
                file.write(json.dumps(right[-1]) + "\n")
            print(f"split {split}, {len(faults)} cells dead: accuracy {np.mean(right[-1]):.3f}", flush=True)
        show(split, np.array(right[: args.sets], bool), adapter.validation, args.divisions)


def show(split: int, right: np.ndarray, windows: af.Windows, divisions: int) -> None:
    """Print coverage, width, error and rank correlation over divisions of the windows; right is ``[sets, N]``."""
    recordings, bare = np.unique(windows.recording), np.zeros((len(windows), 1, 1), np.float32)
    low, high = right.mean(axis=1).min(), right.mean(axis=1).max()
    print(f"split {split}: {len(recordings)} recordings, {len(right)} fault sets, accuracies {low:.2f} to {high:.2f}")
    for stratified in (False, True):
        classes = windows.y if stratified else np.zeros_like(windows.y)
        drawn = af.Windows(bare, classes, windows.recording)
        within, widths, errors, ranks = [], [], [], []
        for seed in range(divisions):
            known, _, test = af.split(drawn, test=0.55, validation=0, seed=seed)
            of, new = np.isin(windows.recording, known.recording), len(np.unique(test.recording))
            forecasts = [Expected.of(one[of], windows.recording[of], new) for one in right]
            expected, low, high = np.transpose([[f.accuracy, f.low, f.high] for f in forecasts])
            reached = right[:, ~of].mean(axis=1)
            within.append(((low <= reached) & (reached <= high)).mean())
            widths.append(((high - low) / 2).mean())
            errors.append((expected - reached).mean())
            if np.ptp(expected) and np.ptp(reached):
                ranks.append(spearmanr(expected, reached).statistic)
        print(
            f"  {divisions} divisions {'stratified by class' if stratified else 'at random'}: coverage"
            f" {np.mean(within):.3f} +- {np.std(within) / np.sqrt(divisions):.3f} (standard error), half width"
            f" {np.mean(widths):.3f}, error {np.mean(errors):+.3f} +- {np.std(errors):.3f},"
            f" Spearman {np.mean(ranks or [np.nan]):.2f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="?", help="labelled recordings of a healthy array")
    parser.add_argument("--splits", type=int, nargs="+", default=[0, 1], help="seeds of split and weights")
    parser.add_argument("--sets", type=int, default=60, help="random fault sets of each split")
    parser.add_argument("--divisions", type=int, default=200, help="of the recordings")
    parser.add_argument("--windows", type=int, default=5000, help="training windows of a head, at most")
    parser.add_argument("--grasps", type=int, default=40, help="simulated grasps of each class")
    parser.add_argument("--epochs", type=int, default=4, help="of each network")
    parser.add_argument("--small", action="store_true", help="the smallest setting, to see that everything runs")
    parser.add_argument("--out", type=Path, default=Path("forecast_intervals"), help="where networks and results go")
    args = parser.parse_args()
    if args.small:
        args.splits, args.sets, args.divisions, args.grasps, args.epochs = [0], 3, 5, 6, 1
    measure(args)


if __name__ == "__main__":
    main()
