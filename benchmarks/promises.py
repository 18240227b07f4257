"""How often the stated promises hold: sets of classes, and the certificate of a diagnosis.

Sets: on each split, a network is trained, and for each of many fault sets F its repair gives sets
of classes for the test windows, with F dead. Told is the share of sets that hold the true class,
which was stated as 1 - alpha, beside the mean number of classes in a set and the accuracy.

Certificate: from a random half of the healthy recordings a diagnosis is fitted and certified; the
share of false alarms is measured on logs of the other half.

    python benchmarks/promises.py sets hand --splits 0 1 --faults 10
    python benchmarks/promises.py certificate hand --repetitions 10
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import adaptfault as af
from diagnostics import SelfDiagnosis

DATA = Path(__file__).parents[2] / "shared" / "data"
FILES = {
    "hand": ("sdh2x13x6_grasps36.npz", None),
    "fingertips": ("icub5x1x12_grasps11.npz", None),
    "fabric": ("fabric4x4_slides7.npz", "4x4"),
    "soles": ("insole2x33x15.npz", None),
}
ALPHA = 0.1
LOG = 4  # recordings, as the certificate states


def recordings_of(array: str) -> af.Recordings:
    """Return the recordings of an array; "simulated" needs no file."""
    if array == "simulated":
        return af.simulate(40, seed=11)
    name, layout = FILES[array]
    return af.load(DATA / name, layout=layout).recordings


def sets(array: str, splits: list[int], faults: int, epochs: int) -> None:
    """Print how often sets hold the true class."""
    recordings = recordings_of(array)
    layout = recordings.layout
    present = np.flatnonzero(layout.present.ravel())
    windows = af.make_windows(recordings.frames, recordings.labels, layout)
    for split in splits:
        training, validation, test = af.split(windows, seed=split)
        model = af.TactileTransformer(layout, len(recordings.class_names), seed=split)
        af.train(model, training, validation, epochs=epochs, seed=split, progress=False)
        adapter = af.Adapter(model, training, validation)
        rng = np.random.default_rng(split)
        held = []
        sizes = []
        right = []
        for share in np.resize([0.02, 0.08, 0.3], faults):
            dead = rng.choice(present, max(1, round(share * len(present))), replace=False)
            repaired = adapter.adapt(dead, method="head", progress=False)
            found = repaired.prediction_sets(test.x, ALPHA)
            held.append(found[np.arange(len(test)), test.y].mean())
            sizes.append(found.sum(axis=1).mean())
            right.append((repaired.predict(test.x) == test.y).mean())
        print(
            f"{array}, split {split}, {faults} fault sets, {len(set(validation.recording))}"
            f" validation recordings: held {np.mean(held):.3f} (stated {1 - ALPHA:.2f}; lowest"
            f" {np.min(held):.3f}, highest {np.max(held):.3f}), classes a set"
            f" {np.mean(sizes):.2f}, accuracy {np.mean(right):.3f}",
            flush=True,
        )


def certificate(array: str, repetitions: int) -> None:
    """Print how often the certified bound holds."""
    recordings = recordings_of(array)
    held = 0
    for repetition in range(repetitions):
        order = np.random.default_rng(repetition).permutation(len(recordings))
        half = len(order) // 2
        fitted = SelfDiagnosis(recordings.layout).fit([recordings.frames[i] for i in order[:half]])
        certified = fitted.certificate_
        assert certified is not None
        others = order[half:]
        logs = [others[i : i + LOG] for i in range(0, len(others) - LOG + 1, LOG)]
        alarms = [
            bool(fitted.diagnose([recordings.frames[i] for i in log]).fault_set) for log in logs
        ]
        held += bool(np.mean(alarms) <= certified.false_alarms)
        print(
            f"{array}, repetition {repetition}: stated at most {certified.false_alarms:.3f}"
            f" ({certified.n_alarms} of {certified.n_logs}), measured {np.mean(alarms):.3f}"
            f" of {len(logs)} logs",
            flush=True,
        )
    print(f"{array}: the bound held in {held} of {repetitions} repetitions")


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["sets", "certificate"])
    parser.add_argument("array", choices=[*FILES, "simulated"])
    parser.add_argument("--splits", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--faults", type=int, default=12)
    parser.add_argument("--epochs", type=int, default=6)
    parser.add_argument("--repetitions", type=int, default=10)
    args = parser.parse_args()
    if args.what == "sets":
        sets(args.array, args.splits, args.faults, args.epochs)
    else:
        certificate(args.array, args.repetitions)


if __name__ == "__main__":
    main()
