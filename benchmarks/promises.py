"""How often the stated promises hold: sets of classes, the certificate of a diagnosis, and what a
self-test finds.

Sets: on each split, a network is trained, and for each of many fault sets F its repair gives sets
of classes for the test windows, with F dead. Told is the share of sets that hold the true class,
which was stated as 1 - alpha, beside the mean number of classes in a set and the accuracy.

Certificate: from a random half of the healthy recordings a diagnosis is fitted and certified; the
share of false alarms is measured on logs of the other half. "small" is a simulated sensor of 36
cells, another one in each repetition; a quarter of its recordings is fitted. With --reuse a third
of the recordings is fitted once, and each repetition divides logs of the others at random: one half
gives the bound, the other the measured share. That tells of the logs that are drawn, and not of the
fits.

Self-test: from a third of the recordings, repertoires are drawn and routines chosen. Cells are
weighted alike. 8 % of those that the repertoire loads are dead (open); told is the share of them
that a diagnosis finds in a log of repetitions of the chosen recordings, and of as many at random,
and the share by the number of repetitions that load the cell. A repetition is a recording of the
same class that is in neither the repertoire nor the fit; with --replay it is the
same recording, moved by up to one cell and with another force.

    python benchmarks/promises.py sets hand --splits 0 1 --faults 10
    python benchmarks/promises.py certificate hand --repetitions 10
    python benchmarks/promises.py certificate small --repetitions 100
    python benchmarks/promises.py certificate hand --repetitions 200 --reuse
    python benchmarks/promises.py selftest hand --repetitions 12 [--replay]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import adaptfault as af
from adaptfault.robot.routine import Repertoire
from adaptfault.robot.selftest import greedy, loads
from diagnostics import Fault, SelfDiagnosis, SensorLayout, inject
from diagnostics.decision.certificate import Certificate

DATA = Path(__file__).parents[2] / "shared" / "data"
FILES = {
    "hand": ("sdh2x13x6_grasps36.npz", None),
    "fingertips": ("icub5x1x12_grasps11.npz", None),
    "fabric": ("fabric4x4_slides7.npz", "4x4"),
    "soles": ("insole2x33x15.npz", None),
}
ALPHA = 0.1
LOG = 4  # recordings, as the certificate states
GROUPINGS = 4  # of recordings into logs, under one fit
SIZES = (2, 4, 8, 10)  # recordings of a self-test
REPERTOIRE = 150  # recordings, at most
DRAWS = 4  # of repetitions and faults for each routine
FORCE = 0.1  # standard deviation of the logarithm, between replays


def recordings_of(array: str, seed: int = 11) -> af.Recordings:
    """Return the recordings of an array; "simulated" and "small" need no file, and each seed of
    "small" is a sensor and recordings of its own."""
    if array == "simulated":
        return af.simulate(40, seed=11)
    if array == "small":
        return af.simulate(48, SensorLayout(1, 6, 6), n_frames=40, seed=seed, sensor_seed=seed)
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
    held = 0
    stated: list[float] = []
    measured: list[float] = []
    for repetition in range(repetitions):
        recordings = recordings_of(array, repetition)
        order = np.random.default_rng(repetition).permutation(len(recordings))
        # the more logs are left, the better the true share is known
        used = len(order) // (4 if array == "small" else 2)
        fitted = SelfDiagnosis(recordings.layout).fit([recordings.frames[i] for i in order[:used]])
        certified = fitted.certificate_
        assert certified is not None
        others = order[used:]
        logs = [others[i : i + LOG] for i in range(0, len(others) - LOG + 1, LOG)]
        alarms = [
            bool(fitted.diagnose([recordings.frames[i] for i in log]).fault_set) for log in logs
        ]
        stated.append(certified.false_alarms)
        measured.append(float(np.mean(alarms)))
        held += measured[-1] <= stated[-1]
        print(
            f"{array}, repetition {repetition}: stated at most {certified.false_alarms:.3f}"
            f" ({certified.n_alarms} of {certified.n_logs}), measured {np.mean(alarms):.3f}"
            f" of {len(logs)} logs",
            flush=True,
        )
    print(
        f"{array}: the bound held in {held} of {repetitions} repetitions; stated at most"
        f" {np.mean(stated):.3f}, measured {np.mean(measured):.3f} on average"
    )


def reused(array: str, repetitions: int) -> None:
    """Print how often the bound from some logs holds on others, under one fit."""
    recordings = recordings_of(array)
    order = np.random.default_rng(0).permutation(len(recordings))
    third = len(order) // 3
    fitted = SelfDiagnosis(recordings.layout).fit([recordings.frames[i] for i in order[:third]])
    stated: list[float] = []
    measured: list[float] = []
    for grouping in range(GROUPINGS):
        rng = np.random.default_rng(grouping)
        others = rng.permutation(order[third:])
        logs = [others[i : i + LOG] for i in range(0, len(others) - LOG + 1, LOG)]
        alarms = np.array(
            [bool(fitted.diagnose([recordings.frames[i] for i in log]).fault_set) for log in logs]
        )
        half = len(logs) // 2
        for _ in range(repetitions // GROUPINGS):
            drawn = rng.permutation(alarms)
            stated.append(Certificate.of(int(drawn[:half].sum()), half).false_alarms)
            measured.append(float(drawn[half:].mean()))
    held = np.mean(np.array(measured) <= np.array(stated))
    print(
        f"{array}, one fit to {third} recordings, {len(stated)} repetitions of {half} logs: stated"
        f" at most {np.mean(stated):.3f}, measured {np.mean(measured):.3f}, the bound held in"
        f" {held:.3f}",
        flush=True,
    )


def selftest(array: str, routines: int, replay: bool) -> None:
    """Print the share of dead cells that a self-test finds."""
    recordings = recordings_of(array)
    layout = recordings.layout
    labels = recordings.labels
    frames = [np.asarray(one, float) for one in recordings.frames]
    order = np.random.default_rng(0).permutation(len(frames))
    third = len(order) // 3
    repeated = order[third : 2 * third]
    fitted = SelfDiagnosis(layout).fit([frames[i] for i in order[2 * third :]])
    loaded = loads(frames, layout)
    of_routine: dict[tuple[int, str], list[float]] = {}
    by_loads: dict[int, list[bool]] = {}
    for seed in range(routines):
        rng = np.random.default_rng(seed)
        own = rng.choice(order[:third], min(REPERTOIRE, 2 * third // 3), replace=False)
        weights = loaded[own].any(axis=0) / loaded[own].any(axis=0).sum()
        known = Repertoire.from_loads(loaded[own], labels[own], ("",) * len(own), weights)
        none = np.zeros(layout.n_cells, bool)
        best, _ = greedy(known.likely, weights, np.ones(len(own)), none, None, max(SIZES))
        for size in SIZES:
            drawn = rng.permutation(len(own))[:size].tolist()
            for name, which in (("chosen", best[:size]), ("random", drawn)):
                found: list[bool] = []
                for _ in range(DRAWS):
                    again = [
                        rng.choice(repeated[labels[repeated] == labels[own[i]]]) for i in which
                    ]
                    log = [frames[i] for i in again]
                    if replay:
                        log = [moved(frames[own[i]], layout, rng) for i in which]
                    cells = np.flatnonzero(weights)
                    dead = rng.choice(cells, max(1, round(0.08 * len(cells))), replace=False)
                    broken = inject(np.concatenate(log), [Fault("open", tuple(dead))], layout)
                    blamed = fitted.diagnose(broken).fault_set.mask[dead]
                    found += blamed.tolist()
                    counts = loaded[again].sum(axis=0)[dead]
                    for count, one in zip(counts.tolist(), blamed.tolist(), strict=True):
                        by_loads.setdefault(count, []).append(one)
                of_routine.setdefault((size, name), []).append(float(np.mean(found)))
    kind = f"{array}{', replayed' if replay else ''}"
    for (size, name), shares in of_routine.items():
        error = np.std(shares) / np.sqrt(routines)
        print(f"{kind}, {size} {name}: found {np.mean(shares):.3f} (+- {error:.3f})")
    if not replay:
        told = [f"{count}: {np.mean(by_loads[count]):.2f}" for count in sorted(by_loads)[:7]]
        print(f"{kind}, found by number of loads: {', '.join(told)}", flush=True)


def moved(frames: np.ndarray, layout: SensorLayout, rng: np.random.Generator) -> np.ndarray:
    """Return a recording ``[T, D]`` as replayed: up to one cell away, with another force."""
    pads = frames.reshape(len(frames), *layout.shape)
    across = np.pad(pads, ((0, 0), (0, 0), (1, 1), (1, 1)))
    row, col = rng.integers(0, 3, 2)
    apart = across[:, :, row : row + layout.rows, col : col + layout.cols]
    force = np.exp(rng.normal(0, FORCE))
    there = np.where(layout.present, apart * force, 0.0)
    return np.minimum(there, layout.full_scale).reshape(frames.shape)


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["sets", "certificate", "selftest"])
    parser.add_argument("array", choices=[*FILES, "simulated", "small"])
    parser.add_argument("--splits", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--faults", type=int, default=12)
    parser.add_argument("--epochs", type=int, default=6)
    parser.add_argument("--repetitions", type=int, default=10)
    parser.add_argument("--replay", action="store_true")
    parser.add_argument("--reuse", action="store_true")
    args = parser.parse_args()
    if args.what == "sets":
        sets(args.array, args.splits, args.faults, args.epochs)
    elif args.what == "selftest":
        selftest(args.array, args.repetitions, args.replay)
    elif args.reuse:
        reused(args.array, args.repetitions)
    else:
        certificate(args.array, args.repetitions)


if __name__ == "__main__":
    main()
