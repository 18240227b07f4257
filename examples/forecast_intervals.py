"""How often the intervals of a forecast hold the accuracy of other recordings, and whether it ranks
fault sets.

    python examples/forecast_intervals.py [GRASPS.npz] [--sets 60] [--alike 20] [--splits 0 1]
    [--small]

For each split one network is trained and kept in ``--out``. For each random fault set (``--sets``
of mixed shapes and sizes: cells, lines, blocks, a pad; ``--alike`` of random cells, a fifth of
them) a head is fitted, and the recordings that the network is not trained on are predicted by heads
fitted without them. These recordings are then divided into two parts, many times, at random or
stratified by class as ``af.split`` does. One part plays validation: it gives the forecast. The
other plays test. All fault sets share the luck of a division, so a single division says little
about coverage. Fault sets are ranked by the accuracy of the known part, and by the mean probability
and the mean log probability of the true class there. How well the mean probability in the test part
ranks them shows the noise of the accuracy reached.

Killed and started again, it goes on where it was. Without GRASPS.npz the grasps are simulated.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

import adaptfault as af
from adaptfault.adaptation.forecast import Expected
from adaptfault.adaptation.stages import Run
from adaptfault.data.windows import evenly
from adaptfault.imputation.dropout import random_fault_set
from diagnostics import FaultSet, SensorLayout


def trained(
    folder: Path,
    layout: SensorLayout,
    training: af.Windows,
    validation: af.Windows,
    epochs: int,
    seed: int,
):
    """Return the network of a split, trained unless it was before; of the small kind, which trains
    in a minute."""
    if (folder / "manifest.json").exists():
        return af.load_model(folder)
    n_classes = int(training.y.max()) + 1
    model = af.TactileTransformer(layout, n_classes, padding="valid", init="glorot", seed=seed)
    af.train(
        model, training, validation, epochs=epochs, learning_rate=2e-4, seed=seed, progress=False
    )
    af.save_model(folder, model)
    return model


def fault_set(layout: SensorLayout, rng: np.random.Generator) -> FaultSet:
    faults = random_fault_set(layout, rng)
    return faults if len(faults) else fault_set(layout, rng)


def alike(layout: SensorLayout, rng: np.random.Generator) -> FaultSet:
    present = np.flatnonzero(layout.present)
    return FaultSet(
        tuple(int(c) for c in rng.choice(present, len(present) // 5, replace=False)), layout.n_cells
    )


def held_out(adapter: af.Adapter, faults: FaultSet) -> dict[str, list]:
    """Return for each validation window whether a head fitted without it, for F, is right, and
    P(true class)."""
    run = Run(adapter, faults, None, 0, False)
    run.execute("head")
    likely = run.held_out().double().softmax(1).numpy()
    y = adapter.validation.y
    return {
        "dead": len(faults),
        "right": (likely.argmax(1) == y).tolist(),
        "likely": np.round(likely[np.arange(len(y)), y], 5).tolist(),
    }


def measure(args: argparse.Namespace) -> None:
    recordings = (
        af.simulate(args.grasps, seed=3)
        if args.recordings is None
        else af.load([args.recordings]).recordings
    )
    layout = recordings.layout
    windows = af.make_windows(recordings.frames, recordings.labels, layout)
    args.out.mkdir(parents=True, exist_ok=True)
    for split in args.splits:
        training, validation, _ = af.split(windows, seed=split)
        model = trained(
            args.out / f"split{split}", layout, training, validation, args.epochs, split
        )
        rest = windows.select(~np.isin(windows.recording, training.recording))
        adapter = af.Adapter(model, training.select(evenly(len(training), args.windows)), rest)
        path = args.out / f"right{split}.jsonl"
        rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
        rng = np.random.default_rng(1000 + split)
        sets = [fault_set(layout, rng) for _ in range(args.sets)] + [
            alike(layout, rng) for _ in range(args.alike)
        ]
        for faults in sets[len(rows) :]:
            rows.append(held_out(adapter, faults))
            with path.open("a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
            print(
                f"split {split}, {len(faults)} cells dead: accuracy"
                f" {np.mean(rows[-1]['right']):.3f}",
                flush=True,
            )
        right, likely = (np.array([row[key] for row in rows]) for key in ("right", "likely"))
        for name, of in {
            "mixed": slice(0, args.sets),
            "alike": slice(args.sets, len(sets)),
        }.items():
            if len(right[of]):
                show(
                    f"split {split}, {name}",
                    right[of],
                    likely[of],
                    adapter.validation,
                    args.divisions,
                )


def show(
    name: str, right: np.ndarray, likely: np.ndarray, windows: af.Windows, divisions: int
) -> None:
    """Print coverage, width, error and rank correlations over divisions of the N windows; arrays
    are ``[sets, N]``."""
    recordings = np.unique(windows.recording)
    bare = np.zeros((len(windows), 1, 1), np.float32)
    low = right.mean(axis=1).min()
    high = right.mean(axis=1).max()
    print(
        f"{name}: {len(recordings)} recordings, {len(right)} fault sets, accuracies {low:.2f} to"
        f" {high:.2f}"
    )
    for stratified in (False, True):
        classes = windows.y if stratified else np.zeros_like(windows.y)
        drawn = af.Windows(bare, classes, windows.recording)
        within = []
        widths = []
        errors = []
        ranks = defaultdict(list)
        for seed in range(divisions):
            known, _, test = af.split(drawn, test=0.55, validation=0, seed=seed)
            of = np.isin(windows.recording, known.recording)
            new = len(np.unique(test.recording))
            forecasts = [Expected.of(one[of], windows.recording[of], new) for one in right]
            expected, low, high = np.transpose([[f.accuracy, f.low, f.high] for f in forecasts])
            reached = right[:, ~of].mean(axis=1)
            within.append(((low <= reached) & (reached <= high)).mean())
            widths.append(((high - low) / 2).mean())
            errors.append((expected - reached).mean())
            scores = {
                "accuracy": expected,
                "probability": likely[:, of].mean(axis=1),
                "log probability": np.log(np.maximum(likely[:, of], 1e-5)).mean(axis=1),
                "probability in the test part itself": likely[:, ~of].mean(axis=1),
            }
            for score, values in scores.items():
                if np.ptp(values) and np.ptp(reached):
                    ranks[score].append(spearmanr(values, reached).statistic)
        print(
            f"  {divisions} divisions {'stratified by class' if stratified else 'at random'}:"
            f" coverage {np.mean(within):.3f} +- {np.std(within) / np.sqrt(divisions):.3f}"
            f" (standard error), half width {np.mean(widths):.3f}, error {np.mean(errors):+.3f} +-"
            f" {np.std(errors):.3f}, Spearman by"
            f" {', '.join(f'{score} {np.mean(values):.2f}' for score, values in ranks.items())}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="?", help="labelled recordings of a healthy array")
    parser.add_argument(
        "--splits", type=int, nargs="+", default=[0, 1], help="seeds of split and weights"
    )
    parser.add_argument(
        "--sets", type=int, default=60, help="random fault sets of each split, of mixed shapes"
    )
    parser.add_argument(
        "--alike",
        type=int,
        default=20,
        help="random fault sets of each split, a fifth of the cells",
    )
    parser.add_argument("--divisions", type=int, default=200, help="of the recordings")
    parser.add_argument(
        "--windows", type=int, default=5000, help="training windows of a head, at most"
    )
    parser.add_argument("--grasps", type=int, default=40, help="simulated grasps of each class")
    parser.add_argument("--epochs", type=int, default=4, help="of each network")
    parser.add_argument(
        "--small", action="store_true", help="the smallest setting, to see that everything runs"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("forecast_intervals"), help="where networks and results go"
    )
    args = parser.parse_args()
    if args.small:
        args.splits = [0]
        args.sets = 3
        args.alike = 2
        args.divisions = 5
        args.grasps = 6
        args.epochs = 1
    measure(args)


if __name__ == "__main__":
    main()
