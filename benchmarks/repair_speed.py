"""What does a repair cost, and what does it reach? This checkout beside another one, in turn.

For 16 cells (fabric), 156 (hand) and 220 (simulated), and for few and many windows, both checkouts
repair the same network on the same split with ``method="auto"``, each in processes of its own with
one thread. Printed are the CPU time of an adapter, of its first repair and of a later one, the peak
of the process, the memory that the first repair adds, and the accuracy on test windows: medians,
and the means of accuracies.

    git worktree add ../then COMMIT
    python benchmarks/repair_speed.py ../then --splits 0 1 2
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

ARRAYS = ("fabric", "hand", "simulated")
FEW = 2_000  # windows of training and validation
MOST = 11_000
TESTED = 2_500
EPOCHS = 8  # of the network, on the few windows
WARM = 60  # windows of a repair that is not measured
FIELDS = ("x", "y", "recording")
BYTES = 1024**2


def prepared(name: str, split: int, folder: Path) -> Path:
    """Return a file of windows, a trained network and fault sets; it is made where missing."""
    path = folder / f"{name}-{split}.npz"
    if path.exists():
        return path
    from repair import HAND, by_recording, fabric, fault_sets, stored

    import adaptfault as af

    if name == "fabric":
        task = fabric(split, most=MOST)
    elif name == "hand":
        task = by_recording(stored(HAND), split, stride=2)
    else:
        task = by_recording(af.simulate(200, seed=1000 + split), split)
    share = MOST / (len(task.train) + len(task.validation))
    arrays = {}
    for part, windows in (("train", task.train), ("validation", task.validation)):
        arrays |= stored_windows(part, thinned(windows, share))
    arrays |= stored_windows("test", thinned(task.test, TESTED / len(task.test)))
    few = FEW / (len(task.train) + len(task.validation))
    model = af.TactileTransformer(task.layout, task.n_classes, seed=split)
    known = thinned(task.train, few)
    af.train(model, known, thinned(task.validation, few), epochs=EPOCHS, seed=split, progress=False)
    arrays |= {f"weight/{key}": value.numpy() for key, value in model.state_dict().items()}
    sets = fault_sets(task.layout, split)
    for which in ("10 %", "a line", "50 %"):
        arrays[f"faults/{which}"] = np.array(list(sets[which]))
    arrays["config"] = np.array(json.dumps(model.config))
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(path, **arrays)
    return path


def stored_windows(part: str, windows) -> dict[str, np.ndarray]:
    """Return the arrays of windows by name."""
    return {f"{part}/{field}": getattr(windows, field) for field in FIELDS}


def thinned(windows, share: float):
    """Return an even share of windows."""
    count = min(len(windows), round(share * len(windows)))
    return windows.select(np.linspace(0, len(windows) - 1, count).round().astype(int))


def resident() -> float:
    """Return what the process holds in memory, in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / BYTES


def measure(path: Path, size: int) -> dict[str, float]:
    """Repair with the checkout in the working directory."""
    sys.path.insert(0, os.getcwd())
    import torch

    import adaptfault as af

    kept = np.load(path)
    parts = {
        part: af.Windows(*(kept[f"{part}/{field}"] for field in FIELDS))
        for part in ("train", "validation", "test")
    }
    known = len(parts["train"]) + len(parts["validation"])
    train = thinned(parts["train"], size / known)
    validation = thinned(parts["validation"], size / known)
    model = af.TactileTransformer.from_config(json.loads(str(kept["config"])))
    prefix = "weight/"
    weights = {key: kept[key] for key in kept.files if key.startswith(prefix)}
    model.load_state_dict(
        {key.removeprefix(prefix): torch.from_numpy(value) for key, value in weights.items()}
    )
    model.eval()
    test = parts["test"]
    sets = [key for key in kept.files if key.startswith("faults/")]
    warm = [thinned(windows, WARM / len(windows)) for windows in (train, validation)]
    af.Adapter(model, *warm).adapt(kept[sets[0]].tolist(), progress=False)  # imports
    before = resident()
    found: dict[str, float] = {}
    began = time.process_time()
    adapter = af.Adapter(model, train, validation)
    found["adapter, CPU s"] = time.process_time() - began
    for key in sets:
        began = time.process_time()
        repaired = adapter.adapt(kept[key].tolist(), method="auto", progress=False)
        which = "auto" if key == sets[0] else "auto again"
        found[f"{which}, CPU s"] = time.process_time() - began
        if key == sets[0]:
            found["peak, MB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            found["added, MB"] = found["peak, MB"] - before
        began = time.process_time()
        found[f"accuracy, {key.removeprefix('faults/')}"] = float(
            (repaired.predict(test.x) == test.y).mean()
        )
        found["predict, CPU s"] = time.process_time() - began
    found["accuracy"] = float(
        np.mean([value for key, value in found.items() if key.startswith("accuracy")])
    )
    return found


def run(place: Path, path: Path, size: int) -> dict[str, float]:
    """Measure a checkout in a process of its own."""
    environment = dict(os.environ, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    command = [sys.executable, str(Path(__file__).resolve()), "--measure", str(path.resolve())]
    command += ["--sizes", str(size)]
    said = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True)
    if said.returncode:
        sys.exit(f"{place}: {said.stderr.strip()[-1000:]}")
    found: dict[str, float] = json.loads(said.stdout.splitlines()[-1])
    return found


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("other", nargs="?", type=Path)
    parser.add_argument("--arrays", nargs="+", default=ARRAYS, choices=ARRAYS)
    parser.add_argument("--sizes", nargs="+", type=int, default=(FEW, MOST))
    parser.add_argument("--splits", nargs="+", type=int, default=[0])
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path("build/repair-speed"))
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.measure is not None:
        print(json.dumps(measure(args.measure, args.sizes[0])))
        return
    here = Path(__file__).resolve().parents[1]
    places = [here] if args.other is None else [here, args.other]
    for name in args.arrays:
        for size in args.sizes:
            found = defaultdict(lambda: defaultdict(list))
            for split in args.splits:
                path = prepared(name, split, args.folder)
                for place in places * args.rounds:
                    for key, value in run(place, path, size).items():
                        found[key][place].append(value)
            for key, of in found.items():
                own = float(np.median(of[here]))
                line = f"{name:10s} {size:6d} {key:22s} here {own:9.3f}"
                if key.startswith("accuracy"):
                    line = f"{name:10s} {size:6d} {key:22s} here {np.mean(of[here]):9.4f}"
                if args.other is not None:
                    theirs = of[args.other]
                    if key.startswith("accuracy"):
                        gained = np.subtract(of[here], theirs)
                        line += f"   other {np.mean(theirs):9.4f}   gained {np.round(gained, 4)}"
                    else:
                        other = float(np.median(theirs))
                        line += f"   other {other:9.3f}   ratio {own / other:.2f}"
                print(line, flush=True)


if __name__ == "__main__":
    main()
