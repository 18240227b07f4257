"""Does the repair lead on every sensor? Accuracy beside what a user would try instead.

For each array and split a network is trained once. Then cells die: none, 10 %, 50 %, a line, a
pad. ``auto`` repairs the network; trees, boosting and an SVC are trained anew on summaries of the
healthy cells (mean, maximum and standard deviation over a window), and with ``--anew`` a network.
All learn from the same training and validation windows.

    python benchmarks/repair.py hand fabric --splits 0 1
    python examples/mujoco_gripper.py --grasps 40 --out build/physics.npz
    python benchmarks/repair.py --splits 40 41 42 --physics build/physics.npz

Results go to ``--out`` as they come, a line of JSON each; killed and started again, it goes on
where it was. At the end a table: mean accuracy over the splits.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from arrays import DATA, FABRIC, FINGERTIPS, HAND, SOLES
from sklearn.ensemble import ExtraTreesClassifier, HistGradientBoostingClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

import adaptfault as af
from adaptfault.bench.changes import counted, fault_sets, remade
from adaptfault.data.windows import evenly
from diagnostics import SensorLayout

MOST = 2_500  # windows of training and validation


@dataclass(frozen=True)
class Task:
    """One array on one split."""

    layout: SensorLayout
    train: af.Windows
    validation: af.Windows
    test: af.Windows

    @property
    def n_classes(self) -> int:
        """Number of classes."""
        parts = (self.train, self.validation, self.test)
        return 1 + max(int(part.y.max()) for part in parts)

    def known(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the windows to learn from, and their classes."""
        x = np.concatenate([self.train.x, self.validation.x])
        return x, np.concatenate([self.train.y, self.validation.y])


def by_recording(
    recordings: af.Recordings, split: int, length: int = 10, stride: int | None = None
) -> Task:
    """Split by recording, at random."""
    windows = af.make_windows(
        recordings.frames, recordings.labels, recordings.layout, length=length, stride=stride
    )
    return Task(recordings.layout, *af.split(windows, seed=split))


def stored(file: str) -> af.Recordings:
    return af.load(DATA / file).recordings


def hand(split: int) -> Task:
    return by_recording(stored(HAND), split)


def fingertips(split: int) -> Task:
    return by_recording(stored(FINGERTIPS), split, length=4)


def soles(split: int) -> Task:
    return by_recording(stored(SOLES), split)


def fabric(
    split: int, change: Callable[[np.ndarray], np.ndarray] = lambda x: x, most: int = MOST
) -> Task:
    """One repetition of each slide to learn from, the other one as test; ``split`` chooses which,
    and what is validated on."""
    with np.load(DATA / FABRIC) as kept:
        frames = np.split(kept["frames"].astype(np.float32), np.cumsum(kept["lengths"])[:-1])
        labels = kept["labels"].astype(np.int64)
        trial = kept["trial"]
    layout = SensorLayout(1, 4, 4, full_scale=1023, unit="count", rate=35.7, wiring="bus")
    windows = af.make_windows([change(of) for of in frames], labels, layout)
    first = split % 2
    learnt = windows.select(np.flatnonzero(trial[windows.recording] == first))
    test = windows.select(np.flatnonzero(trial[windows.recording] != first))
    learnt = learnt.select(evenly(len(learnt), most))
    train, validation, _ = af.split(learnt, test=0.0, validation=0.25, seed=split)
    return Task(layout, train, validation, test.select(evenly(len(test), MOST)))


def loads_only(frames: np.ndarray) -> np.ndarray:
    """Take the rest off, and divide by the spread of each cell."""
    rest = np.median(frames[:5], axis=0)
    return np.clip((frames - rest) * 2, 0, 1023)


def simulated(split: int) -> Task:
    return by_recording(af.simulate(30, seed=1000 + split), split)


def counts(split: int) -> Task:
    """The simulated grasps in counts of 10 bits, with rests and gains of their own."""
    recordings = af.simulate(30, seed=2000 + split)
    return by_recording(remade(recordings, counted(0.3)), split)


def physics(split: int, path: Path, raw: bool = False) -> Task:
    """Grasps of a physics simulator, in newton; ``raw``: in counts, as :func:`counts`."""
    recordings = af.load(path).recordings
    if raw:
        recordings = remade(recordings, counted(1.0))
    return by_recording(recordings, split)


ARRAYS: dict[str, Callable[[int], Task]] = {
    "hand": hand,
    "fingertips": fingertips,
    "soles": soles,
    "fabric": fabric,
    "fabric, loads": lambda split: fabric(split, loads_only),
    "simulated": simulated,
    "counts": counts,
}


def summary(x: np.ndarray) -> np.ndarray:
    """Map ``[N, T, cells]`` to mean, maximum and standard deviation of each cell."""
    return np.concatenate([x.mean(1), x.max(1), x.std(1)], axis=1)


PEERS: dict[str, Callable[[], object]] = {
    "trees": lambda: ExtraTreesClassifier(300, random_state=0, n_jobs=2),
    "boosting": lambda: HistGradientBoostingClassifier(max_iter=50, random_state=0),
    "SVC": lambda: make_pipeline(StandardScaler(), SVC(C=10)),
}


ADAPTED = {"network": "fill", "auto": "auto", "anew": "scratch"}


def network(name: str, task: Task, split: int, epochs: int, folder: Path) -> af.TactileTransformer:
    """Return the trained network, from ``folder`` if it is there."""
    path = folder / f"{name}-{split}-{epochs}".replace(" ", "-")
    if path.exists():
        return af.load_model(path)
    model = af.TactileTransformer(
        task.layout, task.n_classes, length=task.train.x.shape[1], seed=split
    )
    af.train(model, task.train, task.validation, epochs=epochs, seed=split, progress=False)
    af.save_model(path, model)
    return model


def rows(
    task: Task,
    model: af.TactileTransformer,
    split: int,
    methods: list[str],
    done: set[tuple[str, str]],
) -> Iterator[tuple[str, str, float, float]]:
    """Yield fault set, method, accuracy and seconds of what is not done yet."""
    adapter = af.Adapter(model, task.train, task.validation)
    x, y = task.known()
    for faults, dead in fault_sets(task.layout, split).items():
        for method in methods:
            if (faults, method) in done:
                continue
            began = time.perf_counter()
            if method in ADAPTED:
                repaired = adapter.adapt(dead, method=ADAPTED[method], progress=False)
                seconds = time.perf_counter() - began
                predicted = repaired.predict(task.test.x)
            else:
                classifier = PEERS[method]().fit(summary(x[..., dead.healthy]), y)
                seconds = time.perf_counter() - began
                predicted = classifier.predict(summary(task.test.x[..., dead.healthy]))
            yield faults, method, float((predicted == task.test.y).mean()), seconds


def table(kept: list[dict]) -> str:
    """Return mean accuracies over the splits, a line for each array and fault set."""
    found = defaultdict(lambda: defaultdict(list))
    for row in kept:
        found[row["array"], row["faults"]][row["method"]].append(row["accuracy"])
    lines = []
    for (array, faults), of in found.items():
        means = ", ".join(f"{method} {np.mean(each):.3f}" for method, each in of.items())
        spread = float(np.std(of["auto"])) if "auto" in of else 0.0
        lines.append(f"{array}, {faults}: {means} (auto varies by {spread:.3f})")
    return "\n".join(lines)


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("arrays", nargs="*")
    parser.add_argument("--splits", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("--only", nargs="+", choices=[*ADAPTED, *PEERS])
    parser.add_argument("--anew", action="store_true", help="a network trained anew, too")
    parser.add_argument("--physics", type=Path, help="grasps of examples/mujoco_gripper.py")
    parser.add_argument("--out", type=Path, default=Path("build/repair/rows.jsonl"))
    args = parser.parse_args()
    arrays = dict(ARRAYS)
    if args.physics is not None:
        arrays["physics"] = partial(physics, path=args.physics)
        arrays["physics, counts"] = partial(physics, path=args.physics, raw=True)
    methods = args.only or [name for name in (*ADAPTED, *PEERS) if name != "anew" or args.anew]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    lines = args.out.read_text().splitlines() if args.out.exists() else []
    kept = [json.loads(line) for line in lines]
    with args.out.open("a") as stream:
        for name in args.arrays or arrays:
            for split in args.splits:
                done = {
                    (row["faults"], row["method"])
                    for row in kept
                    if (row["array"], row["split"]) == (name, split)
                }
                task = arrays[name](split)
                if done >= {
                    (faults, of) for faults in fault_sets(task.layout, split) for of in methods
                }:
                    continue
                model = network(name, task, split, args.epochs, args.out.parent)
                for faults, method, accuracy, seconds in rows(task, model, split, methods, done):
                    row = {"array": name, "split": split, "faults": faults, "method": method}
                    row |= {"accuracy": accuracy, "seconds": round(seconds, 2)}
                    kept.append(row)
                    stream.write(json.dumps(row) + "\n")
                    stream.flush()
    print(table(kept))


if __name__ == "__main__":
    main()
