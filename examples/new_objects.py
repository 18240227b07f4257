"""What objects that training did not have cost, and a forecast that knows it.

    python examples/new_objects.py [GRASPS.npz --kinds kinds.csv] [--draws 5] [--sets 4] [--small]

A class is a kind of objects, as balls. A quarter of the objects of each kind, at least one, is kept
out. The network learns the kinds from the others, random fault sets are forecast, and the repaired
model meets other recordings of known objects, and the new objects. Twice: validation has other
*recordings* of the objects of training, as ``af.split`` draws them; and other *objects*, as the
recordings of an object share one number in ``Windows.recording``, so that they are drawn together.

``kinds.csv`` has a line ``class,kind`` for each class of the recordings, which are the objects;
classes without a line are left out. Without recordings, grasps are simulated: the kinds are sound
and flawed blocks, the objects what is wrong with them.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

import adaptfault as af
from adaptfault.adaptation.forecast import Expected
from adaptfault.data.windows import evenly
from adaptfault.imputation.dropout import random_fault_set
from diagnostics import SensorLayout

SIMULATED = {
    "normal": "sound",
    "softer": "sound",
    "harder": "sound",
    "foreign matter": "flawed",
    "void": "flawed",
    "deformation": "flawed",
}


def of_kinds(recordings: af.Recordings, kinds: dict[str, str]) -> tuple[af.Windows, np.ndarray]:
    """Return windows whose classes are kinds, and the object of each recording, int ``[n]``."""
    names = recordings.class_names
    kept = np.flatnonzero([names[label] in kinds for label in recordings.labels])
    objects = recordings.labels[kept]
    numbers = sorted(set(kinds.values()))
    labels = [numbers.index(kinds[names[of]]) for of in objects]
    frames = [recordings.frames[i] for i in kept]
    return af.make_windows(frames, labels, recordings.layout), objects


def kept_out(objects: np.ndarray, kinds: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a quarter of the objects of each kind that has several."""
    chosen = []
    for kind in np.unique(kinds):
        of_kind = rng.permutation(np.unique(objects[kinds == kind]))
        if len(of_kind) > 1:
            chosen.append(of_kind[: max(1, len(of_kind) // 4)])
    return np.concatenate(chosen)


def measured(
    windows: af.Windows, objects: np.ndarray, layout: SensorLayout, seed: int, args
) -> list[tuple[str, Expected, float, float]]:
    """Return forecasts of a draw of objects, with the accuracy reached on known and new ones."""
    rng = np.random.default_rng(seed)
    of_window = objects[windows.recording]
    new = np.isin(of_window, kept_out(of_window, windows.y, rng))
    known = windows.select(~new)
    rest, _, test = af.split(known, test=0.25, validation=0, seed=seed)
    by_object = replace(rest, recording=objects[rest.recording].astype(np.int64))
    found = []
    for how, of in {"recordings": rest, "objects": by_object}.items():
        training, validation, _ = af.split(of, test=0, validation=0.3, seed=seed)
        classes = int(windows.y.max()) + 1
        model = af.TactileTransformer(layout, classes, padding="valid", init="glorot", seed=seed)
        af.train(
            model, training, validation, epochs=args.epochs, learning_rate=1e-3, progress=False
        )
        few = training.select(evenly(len(training), args.windows))
        adapter = af.Adapter(model, few, validation)
        draw = np.random.default_rng(seed)
        for _ in range(args.sets):
            faults = random_fault_set(layout, draw)
            met = len(np.unique(of_window[new] if how == "objects" else test.recording))
            expected = adapter.forecast(faults, recordings=met).stages
            model_now = adapter.adapt(faults, method="head", progress=False)
            reached = [af.evaluate(model_now, one).accuracy for one in (test, windows.select(new))]
            found.append((how, expected.get("head", expected["fault-free"]), *reached))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="?", help="labelled recordings; a class is an object")
    parser.add_argument("--kinds", type=Path, help="CSV table class,kind")
    parser.add_argument("--draws", type=int, default=5, help="of the objects that are kept out")
    parser.add_argument("--sets", type=int, default=4, help="random fault sets of each draw")
    parser.add_argument("--epochs", type=int, default=3, help="of each network")
    parser.add_argument("--windows", type=int, default=1000, help="of training, for a head")
    parser.add_argument("--small", action="store_true", help="to see that everything runs")
    args = parser.parse_args()
    if args.recordings is not None and args.kinds is None:
        parser.error("recordings need --kinds: a CSV table class,kind")
    grasps = 40
    if args.small:
        args.draws = args.sets = args.epochs = 1
        grasps = 6
    if args.recordings is None:
        layout = SensorLayout(2, 6, 5)
        recordings = af.simulate(grasps, layout, n_frames=40, classes=tuple(SIMULATED))
        kinds = SIMULATED
    else:
        recordings = af.load([args.recordings]).recordings
        with args.kinds.open() as file:
            kinds = {row["class"]: row["kind"] for row in csv.DictReader(file)}
    windows, objects = of_kinds(recordings, kinds)
    rows = [
        row
        for seed in range(args.draws)
        for row in measured(windows, objects, recordings.layout, seed, args)
    ]
    for how in ("recordings", "objects"):
        of = [row[1:] for row in rows if row[0] == how]
        expected, *reached = np.array([[one.accuracy, known, new] for one, known, new in of]).T
        low, high = np.array([[one.low, one.high] for one, *_ in of]).T
        print(f"validation of other {how}: expected {expected.mean():.3f}", end="")
        for name, accuracy in zip(("known", "new"), reached, strict=True):
            holds = ((low <= accuracy) & (accuracy <= high)).sum()
            print(f"; {name} objects {accuracy.mean():.3f}, holds {holds} of {len(of)}", end="")
        print()


if __name__ == "__main__":
    main()
