"""Classifiers side by side while cells die.

    python examples/compare_classification.py [GRASPS.npz] [--seeds 0 1 2]

All get the same windows, the same split by recording (training and validation windows to learn
from), the same dead cells F, and one thread. When they learn:

    ready    before the fault; F reaches them as NaN, and nothing is adapted. Boosting and GRU-D,
             which take NaN, have learned from each window twice, whole and without a random fault
             set (cells, lines, a block, a pad).
    adapted  before the fault, and once F is known in what seconds it takes: adaptfault.
    anew     once F is known, from scratch on the healthy cells.

"before" are the seconds until the fault, "repair" those after F is known, "predict" the
milliseconds a test window, "memory" the most megabytes that repair and prediction add. On a busy
machine only CPU times compare. Each peer gets its shortest correct call. Tables (SVC, boosting) see
mean and maximum of each cell over the window.

Results go to ``--out`` as they come, a line of CSV each; killed and started again, it goes on where
it was. Without recordings, or with --simulated: simulated grasps. --small, the default without
both: a few of them and of everything.

    pip install 'adaptfault[compare]'    # the public tools; those that are missing are skipped
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import gc
import io
import math
import os
import threading
import time
import warnings
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import torch
from adaptation_figures import cases
from compare.classifiers import FULL, OURS, PEERS, SMALL, Peer, Task, adaptfault
from threadpoolctl import threadpool_limits

import adaptfault as af
from diagnostics import FaultSet


@dataclass(frozen=True)
class Row:
    """One classifier on one fault set of one seed; times are of one thread, wall and CPU in
    seconds."""

    seed: int
    faults: str
    dead: int
    name: str
    protocol: str
    accuracy: float
    before: float
    before_cpu: float
    repair: float
    repair_cpu: float
    predict_ms: float
    memory_mb: float = math.nan


class PeakMemory:
    """Measures by how much a block raises the resident memory of the process, 50 times a second.
    Linux."""

    def __enter__(self) -> PeakMemory:
        self.megabytes = 0.0
        self._ended = threading.Event()
        start = resident()

        def watch() -> None:
            while not self._ended.wait(0.02):
                self.megabytes = max(self.megabytes, resident() - start)

        self._thread = threading.Thread(target=watch, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()


def resident() -> float:
    """Return the resident memory of this process in megabytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


class Stopwatch:
    """Measures wall and CPU seconds of a block."""

    def __enter__(self) -> Stopwatch:
        self._began = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.wall, self.cpu = (
            time.perf_counter() - self._began[0],
            time.process_time() - self._began[1],
        )


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep back what the peers print and warn about themselves; PyPOTS asks which encoding it
    prints in."""
    with (
        warnings.catch_warnings(),
        contextlib.redirect_stdout(io.TextIOWrapper(io.BytesIO(), encoding="utf-8")),
    ):
        warnings.simplefilter("ignore")
        yield


def measure(
    peer: Peer, task: Task, sets: dict[str, FaultSet], done: set[tuple[str, str]]
) -> Iterator[Row]:
    """Yield a row for each of the peer's classifiers and each fault set that is not done yet."""
    if all((name, faults) in done for name in peer.rows for faults in sets):
        return
    with quiet():
        peer.warm_up(task)
    with quiet(), Stopwatch() as before:
        prepared = peer.prepare(task)
    # what the network took elsewhere
    unknown = peer.prepare is adaptfault and task.networks is not None
    spent = (math.nan, math.nan) if unknown else (before.wall, before.cpu)
    repairs = prepared if isinstance(prepared, dict) else {peer.name: prepared}
    for label, faults in sets.items():
        for name, repair in repairs.items():
            if (name, label) in done:
                continue
            gc.collect()
            with PeakMemory() as peak:
                with quiet(), Stopwatch() as repairing:
                    predict = repair(faults)
                with quiet(), Stopwatch() as predicting:
                    classes = np.asarray(predict(task.test.x))
            yield Row(
                task.seed,
                label,
                len(faults),
                name,
                peer.protocol,
                float((classes == task.test.y).mean()),
                *spent,
                repairing.wall,
                repairing.cpu,
                1000 * predicting.cpu / len(classes),
                peak.megabytes,
            )


def read(path: Path) -> list[Row]:
    """Return the rows of an earlier run."""
    if not path.exists():
        return []
    kinds = {
        name: {"int": int, "float": float}.get(kind, str)
        for name, kind in Row.__annotations__.items()
    }
    with path.open(newline="") as file:
        return [
            Row(**{name: kinds[name](value) for name, value in row.items()})
            for row in csv.DictReader(file)
        ]


def compare(tasks: Iterator[Task], peers: list[Peer], few: bool, path: Path) -> list[Row]:
    """Measure what the file does not hold yet, and return all of it."""
    rows = read(path)
    for task in tasks:
        wanted = (
            ("random 10%", "one pad")
            if few
            else ("random 10%", "random 50%", "five rows, all pads", "one pad")
        )
        known = cases(task.layout, task.seed, simulated=False)
        sets = {"none": FaultSet((), task.layout.n_cells)} | {
            name: known[name] for name in wanted if name in known
        }
        for peer in peers:
            done = {(row.name, row.faults) for row in rows if row.seed == task.seed}
            anew = peer.protocol == "anew"  # without a fault there is nothing to learn anew
            try:
                for row in measure(
                    peer, task, {k: f for k, f in sets.items() if len(f) or not anew}, done
                ):
                    rows.append(row)
                    fresh = not path.exists()
                    with path.open("a", newline="") as file:
                        writer = csv.DictWriter(file, asdict(row))
                        if fresh:
                            writer.writeheader()
                        writer.writerow(
                            {
                                k: round(v, 4) if isinstance(v, float) else v
                                for k, v in asdict(row).items()
                            }
                        )
            except Exception as error:  # one peer's failure is not the end
                print(f"{peer.name}, seed {task.seed}: failed, {type(error).__name__}: {error}")
    return rows


@dataclass(frozen=True)
class Reached:
    """What one classifier reached over the seeds."""

    protocol: str
    accuracy: dict[str, dict[int, float]]  # fault set -> seed -> accuracy
    before_cpu: float
    repair: float
    repair_cpu: float
    predict_ms: float
    memory_mb: float


def summed(rows: list[Row]) -> dict[str, Reached]:
    """Return for each classifier its accuracies, medians of its times and its most memory, where
    cells are dead."""
    result = {}
    for name in dict.fromkeys(row.name for row in rows):
        mine = [row for row in rows if row.name == name]
        accuracy = defaultdict(dict)
        for row in mine:
            accuracy[row.faults][row.seed] = row.accuracy
        broken = [row for row in mine if row.dead]
        median = {
            key: float(
                np.median(
                    [v for row in broken if not math.isnan(v := getattr(row, key))] or [math.nan]
                )
            )
            for key in ("before_cpu", "repair", "repair_cpu", "predict_ms")
        }
        # memory that was freed before is used again
        most = max((row.memory_mb for row in broken), default=math.nan)
        result[name] = Reached(mine[0].protocol, dict(accuracy), **median, memory_mb=most)
    return result


def show(table: dict[str, Reached]) -> None:
    names = list(next(iter(table.values())).accuracy)
    print(
        f"\n{'accuracy ± spread (seeds)':34s}" + "".join(f"{name:>22s}" for name in names), end=""
    )
    print("   before s CPU   repair s (CPU)   predict ms   memory MB")
    for name, got in table.items():
        cells = [list(got.accuracy.get(case, {}).values()) for case in names]
        text = "".join(
            f"{np.mean(c):10.3f} ± {np.std(c):.3f}{f'({len(c)})':>4s}" if c else f"{'-':>22s}"
            for c in cells
        )
        print(f"{name:24s}{got.protocol:10s}{text}{got.before_cpu:15.1f}", end="")
        print(
            f"{got.repair:9.2f} ({got.repair_cpu:.2f})".ljust(20)
            + f"{got.predict_ms:8.2f}{got.memory_mb:12.0f}"
        )


def verdict(table: dict[str, Reached]) -> Iterator[str]:
    """Say where each classifier beats ours, from the numbers."""
    ours = table[OURS]
    for name, got in table.items():
        won = []
        for case, mine in got.accuracy.items():
            gaps = [
                mine[seed] - ours.accuracy[case][seed]
                for seed in mine
                if seed in ours.accuracy.get(case, {})
            ]
            if gaps and np.mean(gaps) > 0:
                case = "accuracy fault-free" if case == "none" else f"accuracy, {case}"
                won.append(
                    f"{case}: +{np.mean(gaps):.3f} (in {sum(g > 0 for g in gaps)} of {len(gaps)}"
                    " seeds)"
                )
        if got.before_cpu + got.repair_cpu < ours.before_cpu + ours.repair_cpu:
            won.append(f"all learning: {got.before_cpu + got.repair_cpu:.0f} s CPU")
        if got.repair_cpu < ours.repair_cpu:
            won.append(f"repair: {got.repair_cpu:.2f} s CPU")
        won += [f"prediction: {got.predict_ms:.2f} ms"] if got.predict_ms < ours.predict_ms else []
        if name != OURS:
            yield f"  {name}: {'; '.join(won) or 'in nothing'}"


def plot(table: dict[str, Reached], path: Path) -> None:
    """Draw accuracy against the CPU seconds after F is known, one panel a fault set."""
    from matplotlib.figure import Figure

    names = [name for name in next(iter(table.values())).accuracy if name != "none"]
    figure = Figure(figsize=(3.3 * len(names) + 0.6, 5), layout="constrained")
    markers = {"ready": "o", "adapted": "D", "anew": "s"}
    for axis, case in zip(
        np.atleast_1d(figure.subplots(1, len(names), sharey=True)), names, strict=True
    ):
        for i, (name, got) in enumerate(table.items()):
            accuracy = list(got.accuracy.get(case, {}).values())
            if accuracy:
                ours = name.startswith("adaptfault")
                axis.errorbar(
                    max(got.repair_cpu, 0.01),
                    np.mean(accuracy),
                    np.std(accuracy),
                    color=f"C{i % 10}",
                    capsize=2,
                    fmt="*" if ours else markers[got.protocol],
                    ms=13 if ours else 6,
                    mfc="none" if i >= 10 else None,
                    label=f"{name} ({got.protocol})" if got.protocol not in name else name,
                )
        axis.set(xscale="log", title=case, xlabel="CPU seconds after F is known (none: 0.01)")
        axis.grid(alpha=0.3)
    figure.axes[0].set_ylabel("test accuracy, mean and spread over seeds")
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=4,
        frameon=False,
    )
    figure.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="?", help="labelled recordings of a healthy array")
    parser.add_argument(
        "--simulated", action="store_true", help="simulated grasps, 40 of each class"
    )
    parser.add_argument(
        "--small", action="store_true", help="the smallest setting, to see that everything runs"
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0], help="of split, weights and faults (default 0)"
    )
    parser.add_argument(
        "--networks",
        type=Path,
        help="fault-free networks instead of training them: --out of adaptation_figures.py",
    )
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", help="peers, by the start of their names"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("comparison"),
        help="folder for classification.csv and .png",
    )
    options = parser.parse_args()
    simulated = options.simulated or options.recordings is None
    small = options.small or (options.recordings is None and not options.simulated)
    recordings = (
        af.simulate(6 if small else 40, seed=3)
        if simulated
        else af.load([options.recordings]).recordings
    )
    windows = af.make_windows(recordings.frames, recordings.labels, recordings.layout)
    peers = []
    for peer in PEERS:
        try:
            print(f"{peer.name}: {peer.package} {version(peer.package)}")
        except PackageNotFoundError:
            print(
                f"{peer.name}: skipped, {peer.package} is missing: pip install"
                " 'adaptfault[compare]'"
            )
            continue
        if options.only is None or peer.name.startswith(("adaptfault", *options.only)):
            peers.append(peer)
    print(
        f"torch {torch.__version__}, numpy {np.__version__}; {len(recordings)} recordings of"
        f" {recordings.layout}"
    )
    effort = SMALL if small else FULL
    print(f"{windows}; seeds {options.seeds}; {effort}, SVC C=10")
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    tasks = (
        Task(recordings.layout, *af.split(windows, seed=s), s, simulated, effort, options.networks)
        for s in options.seeds
    )
    with threadpool_limits(1):
        rows = compare(tasks, peers, small, options.out / "classification.csv")
    table = summed(rows)
    if OURS not in table:
        raise SystemExit(f"{OURS} failed: there is nothing to compare with")
    show(table)
    plot(table, options.out / "classification.png")
    ours = table[OURS]
    print(
        f"\nBetter than {OURS} (all learning {ours.before_cpu + ours.repair_cpu:.0f} s CPU, ",
        end="",
    )
    print(f"repair {ours.repair_cpu:.2f} s CPU, prediction {ours.predict_ms:.2f} ms a window):")
    print(*verdict(table), sep="\n")


if __name__ == "__main__":
    main()
