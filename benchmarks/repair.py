"""Does the repair lead on every sensor? Accuracy beside what a user would try instead.

For each array and split a network is trained once. Then cells die: none, 10 %, 50 %, a line, a
pad. ``auto`` repairs the network; trees, boosting and an SVC are trained anew on summaries of the
healthy cells (mean, maximum and standard deviation over a window), the network anew on request.
All learn from the same training and validation windows.

    python benchmarks/repair.py hand fabric --splits 0 1
    python benchmarks/repair.py --splits 40 41 42 --anew          # all arrays, the table

Results go to ``--out`` as they come, a line of JSON each; killed and started again, it goes on
where it was.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from other_sensors import of_each, read_with, remade
from sklearn.ensemble import ExtraTreesClassifier, HistGradientBoostingClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

import adaptfault as af
from adaptfault.data.windows import evenly
from diagnostics import FaultSet, SensorLayout

DATA = Path(__file__).parents[2] / "shared" / "data"
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


def by_recording(recordings: af.Recordings, split: int, length: int = 10) -> Task:
    """Split by recording, at random."""
    windows = af.make_windows(
        recordings.frames, recordings.labels, recordings.layout, length=length
    )
    return Task(recordings.layout, *af.split(windows, seed=split))


def stored(file: str, layout: str | None = None) -> af.Recordings:
    return af.load(DATA / file, layout=layout).recordings


def hand(split: int) -> Task:
    return by_recording(stored("sdh2x13x6_grasps36.npz"), split)


def fingertips(split: int) -> Task:
    return by_recording(stored("icub5x1x12_grasps11.npz"), split, length=4)


def soles(split: int) -> Task:
    return by_recording(stored("insole2x33x15.npz"), split)


def fabric(split: int, change: Callable[[np.ndarray], np.ndarray] = lambda x: x) -> Task:
    """One repetition of each slide to learn from, the other one as test; ``split`` chooses which,
    and what is validated on."""
    with np.load(DATA / "fabric4x4_slides7.npz") as arrays:
        frames = np.split(arrays["frames"].astype(np.float32), np.cumsum(arrays["lengths"])[:-1])
        labels = arrays["labels"].astype(np.int64)
        trial = arrays["trial"]
    layout = SensorLayout(1, 4, 4, full_scale=1023, unit="count", rate=35.7, wiring="bus")
    windows = af.make_windows([change(of) for of in frames], labels, layout)
    first = split % 2
    learnt = windows.select(np.flatnonzero(trial[windows.recording] == first))
    test = windows.select(np.flatnonzero(trial[windows.recording] != first))
    learnt = learnt.select(evenly(len(learnt), MOST))
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

    def change(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        gained = np.minimum(x * (0.5 + of_each(1.0, x)), 1)
        return read_with(0.002, 0.1, 1023)(0.3 * gained, rng)

    return by_recording(remade(recordings, change), split)


def physics(split: int, raw: bool = False) -> Task:
    """Grasps of a physics simulator, in newton."""
    with np.load("/tmp/physics.npz") as arrays:
        frames = arrays["frames"].astype(np.float32)
        labels = arrays["labels"].astype(np.int64)
    top = float(np.quantile(frames[frames > 0], 0.999))
    layout = SensorLayout(*frames.shape[2:], full_scale=top, unit="N")
    recordings = af.Recordings(tuple(of.reshape(len(of), -1) for of in frames), layout, labels)
    if raw:

        def change(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
            gained = np.minimum(x * (0.5 + of_each(1.0, x)), 1)
            return read_with(0.002, 0.1, 1023)(gained, rng)

        recordings = remade(recordings, change)
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
if Path("/tmp/physics.npz").exists():
    ARRAYS["physics"] = physics
    ARRAYS["physics, counts"] = lambda split: physics(split, raw=True)


def cases(layout: SensorLayout, seed: int) -> dict[str, FaultSet]:
    """Return the fault sets."""
    rng = np.random.default_rng(100 + seed)
    present = np.flatnonzero(layout.present)
    index = np.arange(layout.n_cells).reshape(layout.shape)
    sets = {
        "none": np.array([], int),
        "10 %": rng.choice(present, max(1, round(0.1 * len(present))), replace=False),
        "50 %": rng.choice(present, len(present) // 2, replace=False),
    }
    if layout.pads > 1:
        sets["a pad"] = index[seed % layout.pads].ravel()
    if layout.rows > 1:
        sets["a line"] = index[seed % layout.pads, layout.rows // 2].ravel()
    return {
        name: FaultSet(tuple(int(c) for c in cells if layout.present.flat[c]), layout.n_cells)
        for name, cells in sets.items()
    }


def summary(x: np.ndarray) -> np.ndarray:
    """Map ``[N, T, cells]`` to mean, maximum and standard deviation of each cell."""
    return np.concatenate([x.mean(1), x.max(1), x.std(1)], axis=1)


PEERS: dict[str, Callable[[], object]] = {
    "trees": lambda: ExtraTreesClassifier(300, random_state=0, n_jobs=2),
    "boosting": lambda: HistGradientBoostingClassifier(max_iter=50, random_state=0),
    "SVC": lambda: make_pipeline(StandardScaler(), SVC(C=10)),
}


def network(name: str, task: Task, split: int, epochs: int, folder: Path) -> af.TactileTransformer:
    """Return the trained network, from ``folder`` if it is there."""
    path = folder / f"{name}-{split}-{epochs}".replace(" ", "-")
    if (path / "model.json").exists() or path.exists():
        return af.load_model(path)
    model = af.TactileTransformer(
        task.layout, task.n_classes, length=task.train.x.shape[1], seed=split
    )
    af.train(model, task.train, task.validation, epochs=epochs, seed=split, progress=False)
    af.save_model(path, model)
    return model


def rows(
    name: str, split: int, epochs: int, folder: Path, done: set[tuple], only: list[str] | None
) -> Iterator[dict[str, object]]:
    """Yield a row for each fault set and method that is not done yet."""
    task = ARRAYS[name](split)
    model = network(name, task, split, epochs, folder)
    adapter = af.Adapter(model, task.train, task.validation)
    x, y = task.known()

    def row(faults: str, method: str, right: np.ndarray, began: float) -> dict[str, object]:
        return {
            "array": name,
            "split": split,
            "faults": faults,
            "method": method,
            "accuracy": float(right.mean()),
            "seconds": round(time.perf_counter() - began, 2),
        }

    for faults, dead in cases(task.layout, split).items():
        for method in ("network", "auto", *PEERS):
            if (name, split, faults, method) in done or (only and method not in only):
                continue
            began = time.perf_counter()
            if method == "network":
                filled = adapter.adapt(dead, method="fill", progress=False)
                predicted = filled.predict(task.test.x)
            elif method == "auto":
                repaired = adapter.adapt(dead, progress=False)
                took = time.perf_counter() - began
                predicted = repaired.predict(task.test.x)
                began = time.perf_counter() - took
            else:
                classifier = PEERS[method]().fit(summary(x[..., dead.healthy]), y)
                predicted = classifier.predict(summary(task.test.x[..., dead.healthy]))
            yield row(faults, method, predicted == task.test.y, began)


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("arrays", nargs="*", default=list(ARRAYS))
    parser.add_argument("--splits", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("--only", nargs="+")
    parser.add_argument("--out", type=Path, default=Path("build/repair/rows.jsonl"))
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    lines = args.out.read_text().splitlines() if args.out.exists() else []
    kept = [json.loads(line) for line in lines]
    done = {(of["array"], of["split"], of["faults"], of["method"]) for of in kept}
    with args.out.open("a") as stream:
        for name in args.arrays or ARRAYS:
            for split in args.splits:
                for of in rows(name, split, args.epochs, args.out.parent, done, args.only):
                    stream.write(json.dumps(of) + "\n")
                    stream.flush()
                    print(of, flush=True)


if __name__ == "__main__":
    main()
