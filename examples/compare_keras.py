"""The paper's network here and in Keras: python examples/compare_keras.py [GRASPS.npz] [--epochs
10] [--seeds 0]

The same layers in Keras 3, on TensorFlow (the paper's stack) and on torch, with the same initial
weights; that both are one network is checked: as many parameters, the same logits. Then all train
for as many epochs on the same windows: Adam at 1e-4, batches of 32, the best of the epochs by
validation accuracy, no averaging of weights. Each stack has a process and one thread of its own.
They take turns, an epoch each, and later a few predictions each, so that whatever else the machine
does falls on all. "CPU" is what a process really used; on a busy machine only that compares.

An epoch is with its validation; the first (graphs are built) is apart. A prediction goes from
windows in numpy to classes in numpy, in each way that the stack offers. Without recordings: a few
simulated grasps and one epoch.

    pip install 'adaptfault[compare-keras]'    # Keras and TensorFlow; what is missing is skipped
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from importlib.util import find_spec
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
from compare.stacks import OURS, STACKS, Failure, Setup, serve

import adaptfault as af
from adaptfault.data.windows import evenly
from diagnostics import SensorLayout

BATCHES = (1, 256)


@dataclass
class Result:
    """What a stack reached."""

    parameters: int = 0
    difference: float = 0.0  # of the untrained logits from ours, the largest
    accuracy: list[float] = field(default_factory=list)  # a seed each
    # wall and CPU seconds of the first epoch
    first: list[tuple[float, float]] = field(default_factory=list)
    epochs: list[tuple[float, float]] = field(default_factory=list)  # of the later ones
    milliseconds: dict[tuple[str, int], list[tuple[float, float]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    megabytes: float = 0.0

    def epoch(self) -> tuple[float, float]:
        """Median wall and CPU seconds of an epoch; where there was one only, of that."""
        wall, cpu = np.median(self.epochs or self.first, axis=0)
        return float(wall), float(cpu)

    def latency(self, batch: int) -> dict[str, tuple[float, float]]:
        """Median wall and CPU milliseconds of each way to predict so many windows."""
        return {
            way: tuple(np.median(ms, axis=0))
            for (way, n), ms in self.milliseconds.items()
            if n == batch
        }


@dataclass(frozen=True)
class Worker:
    """A stack's process, the line to it, and how many seconds it may take for an answer."""

    name: str
    process: BaseProcess
    line: Connection
    limit: float

    @classmethod
    def start(cls, name: str, setup: Setup, limit: float) -> Worker:
        """Start a process that serves one stack."""
        context = get_context("spawn")
        line, far = context.Pipe()
        process = context.Process(target=serve, args=(far, name, setup), daemon=True)
        process.start()
        far.close()
        return cls(name, process, line, limit)

    def ask(self, question: object = "on"):
        """Send a question, if any, and wait for the answer.

        Raises:
            RuntimeError: the stack failed, or gave no answer in time and was killed.
        """
        try:
            if question != "":
                self.line.send(question)
            if self.line.poll(self.limit):
                answer = self.line.recv()
            else:
                self.process.kill()
                answer = Failure(f"no answer in {self.limit:g} s")
        except (EOFError, OSError):
            answer = Failure("its process ended")
        if isinstance(answer, Failure):
            raise RuntimeError(f"{self.name} failed: {answer.text}")
        return answer

    def end(self) -> None:
        """Wait until it has ended, or kill it."""
        self.process.join(self.limit)
        self.process.kill()


class Race:
    """All stacks on one setup, in turns; one that fails is out, the others go on."""

    def __init__(
        self, names: list[str], setup: Setup, results: dict[str, Result], limit: float
    ) -> None:
        self.setup = setup
        self.results = results
        self.workers = {name: Worker.start(name, setup, limit) for name in names}

    def each(self, question: object, keep: Callable[[Result, object], None]) -> None:
        """Put one question to all, one after another."""
        for name in list(self.workers):
            try:
                keep(self.results[name], self.workers[name].ask(question))
            except RuntimeError as error:
                print(error)
                del self.workers[name]

    def run(self, rounds: int, runs: int) -> None:
        """Compare the untrained logits, train in turns, predict in turns."""
        expected: list[np.ndarray] = []

        def about(result: Result, answer) -> None:
            result.parameters = answer[0]
            expected.append(answer[1])
            result.difference = max(result.difference, float(np.abs(answer[1] - expected[0]).max()))

        self.each("", about)
        for epoch in range(self.setup.epochs):
            self.each(
                "on",
                lambda r, took, first=epoch == 0: (r.first if first else r.epochs).append(took),
            )
        self.each("on", lambda result, accuracy: result.accuracy.append(accuracy))
        for _ in range(rounds):
            for batch in BATCHES:

                def keep(result: Result, answer, batch: int = batch) -> None:
                    for way, took in answer.items():
                        result.milliseconds[way, batch].append(took)

                self.each((batch, max(2, runs // batch)), keep)
        self.each(
            None,
            lambda result, megabytes: setattr(
                result, "megabytes", max(result.megabytes, megabytes)
            ),
        )
        for worker in self.workers.values():
            worker.end()


def race(
    parts: tuple,
    layout: SensorLayout,
    names: list[str],
    options: argparse.Namespace,
    seed: int,
    results,
) -> None:
    """One seed: the same weights and windows to all."""
    setup = Setup(layout, *parts, seed, options.epochs, options.small)
    model = af.TactileTransformer(layout, setup.n_classes, length=parts[0].x.shape[1], seed=seed)
    setup.weights.update({name: value.numpy() for name, value in model.state_dict().items()})
    Race(names, setup, results, options.limit).run(*((1, 2) if options.small else (5, 10)))


def show(results: dict[str, Result]) -> None:
    print(
        f"\n{'':20s}{'parameters':>12s}{'logits differ':>15s}{'accuracy':>22s}"
        f"{'first epoch s (CPU)':>23s}",
        end="",
    )
    print(f"{'epoch s (CPU)':>18s}{'memory MB':>11s}")
    for name, r in results.items():
        accuracy = f"{np.mean(r.accuracy):.3f} ± {np.std(r.accuracy):.3f} ({len(r.accuracy)})"
        first = np.median(r.first, axis=0)
        later = r.epoch()
        print(f"{name:20s}{r.parameters:12,d}{r.difference:15.1e}{accuracy:>22s}", end="")
        print(f"{first[0]:14.2f} ({first[1]:.2f})".rjust(23), end="")
        print(f"{later[0]:.2f} ({later[1]:.2f})".rjust(18) + f"{r.megabytes:11.0f}")
    print(f"\n{'ms a prediction (CPU)':40s}" + "".join(f"{f'batch of {n}':>22s}" for n in BATCHES))
    for name, r in results.items():
        for way in r.latency(1):
            cells = (r.latency(n)[way] for n in BATCHES)
            print(
                f"{name + ', ' + way:40s}"
                + "".join(f"{wall:.2f} ({cpu:.2f})".rjust(22) for wall, cpu in cells)
            )


def verdict(results: dict[str, Result]) -> list[str]:
    """Say where each is better than ours, from the numbers; times are CPU, each stack's fastest way
    to predict."""
    ours = results[OURS]
    lines = []
    for name, r in results.items():
        if name == OURS:
            continue
        won = []
        pairs = list(zip(r.accuracy, ours.accuracy, strict=False))
        if np.mean(r.accuracy) > np.mean(ours.accuracy):
            better = sum(theirs > mine for theirs, mine in pairs)
            won.append(
                f"accuracy: +{np.mean(r.accuracy) - np.mean(ours.accuracy):.3f} (in {better} of"
                f" {len(pairs)} seeds)"
            )
        if r.epoch()[1] < ours.epoch()[1]:
            won.append(f"an epoch: {r.epoch()[1]:.2f} s against {ours.epoch()[1]:.2f}")
        for batch in BATCHES:
            (way, theirs), (mine, least) = (
                min(
                    ((w, cpu) for w, (_, cpu) in x.latency(batch).items()), key=lambda pair: pair[1]
                )
                for x in (r, ours)
            )
            if theirs < least:
                won.append(
                    f"{batch} window{'s' * (batch > 1)}: {theirs:.2f} ms ({way}) against"
                    f" {least:.2f} ({mine})"
                )
        won += (
            [f"memory: {r.megabytes:.0f} MB against {ours.megabytes:.0f}"]
            if r.megabytes < ours.megabytes
            else []
        )
        lines.append(f"  {name}: {'; '.join(won) or 'in nothing'}")
    return lines


def plot(results: dict[str, Result], path: Path) -> None:
    """Draw accuracy, an epoch, and every way to predict."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.6), layout="constrained")
    accuracy, epoch, *latencies = figure.subplots(1, 2 + len(BATCHES))
    names = list(results)
    colors = {name: f"C{i}" for i, name in enumerate(names)}
    bars = [colors[name] for name in names]
    accuracy.barh(names, [np.mean(results[n].accuracy) for n in names], color=bars)
    accuracy.set(title="test accuracy", xlim=(0, 1))
    epoch.barh(names, [results[n].epoch()[1] for n in names], color=bars)
    epoch.set(title="an epoch, s of CPU", yticks=[])
    for axis, batch in zip(latencies, BATCHES, strict=True):
        ways = [
            (name, way, cpu)
            for name in names
            for way, (_, cpu) in results[name].latency(batch).items()
        ]
        axis.barh(
            [f"{name}\n{way}" for name, way, _ in ways],
            [cpu for *_, cpu in ways],
            color=[colors[n] for n, *_ in ways],
        )
        axis.set(title=f"{batch} window{'s' * (batch > 1)}, ms of CPU")
        axis.tick_params(axis="y", labelsize=7)
    for axis in figure.axes:
        axis.invert_yaxis()
    figure.savefig(path, dpi=110)


def write(results: dict[str, Result], path: Path) -> None:
    """Write a line for each stack and way to predict."""
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        times = [f"ms_{kind}_{n}" for n in BATCHES for kind in ("wall", "cpu")]
        out.writerow(
            [
                "stack",
                "parameters",
                "logits_differ",
                "accuracy",
                "seeds",
                "epoch_wall",
                "epoch_cpu",
                "way",
                *times,
            ]
        )
        for name, r in results.items():
            for way in r.latency(1):
                ms = [round(t, 3) for n in BATCHES for t in r.latency(n)[way]]
                accuracy = round(float(np.mean(r.accuracy)), 4)
                epoch = [round(t, 3) for t in r.epoch()]
                out.writerow(
                    [
                        name,
                        r.parameters,
                        f"{r.difference:.1e}",
                        accuracy,
                        len(r.accuracy),
                        *epoch,
                        way,
                        *ms,
                    ]
                )


def installed() -> list[str]:
    """Print versions and return the stacks that can run."""
    names = [OURS]
    print(f"{OURS}: torch {version('torch')}, numpy {version('numpy')}")
    for name, package in list(STACKS.items())[1:]:
        missing = [p for p in ("keras", package) if find_spec(p) is None]
        if missing:
            print(
                f"{name}: skipped, {' and '.join(missing)} missing: pip install"
                " 'adaptfault[compare-keras]'"
            )
            continue
        distribution = (
            "tensorflow_cpu" if package == "tensorflow" and find_spec("tensorflow") else package
        )
        print(f"{name}: keras {version('keras')}, {package} {version(distribution)}")
        names.append(name)
    return names


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="?", help="labelled recordings of a healthy array")
    parser.add_argument("--epochs", type=int, default=10, help="default 10")
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0], help="of split and weights (default 0)"
    )
    parser.add_argument(
        "--windows", type=int, default=10**9, help="train on at most so many (default: all)"
    )
    parser.add_argument(
        "--limit",
        type=float,
        default=1800,
        help="seconds a stack may take for a step (default 1800)",
    )
    parser.add_argument("--small", action="store_true", help="a few simulated grasps, one epoch")
    parser.add_argument(
        "--out", type=Path, default=Path("comparison"), help="folder for keras.csv and keras.png"
    )
    options = parser.parse_args()
    options.small = options.small or options.recordings is None
    if options.small:
        options.epochs = 1
    recordings = (
        af.simulate(4, seed=3) if options.small else af.load([options.recordings]).recordings
    )
    windows = af.make_windows(recordings.frames, recordings.labels, recordings.layout)
    windows = af.Windows(
        windows.x * recordings.layout.present.ravel(), windows.y, windows.recording
    )
    names = installed()
    few = f"at most {options.windows} to train on; " if options.windows < len(windows) else ""
    print(f"{windows}; {few}epochs {options.epochs}, seeds {options.seeds}, one thread a stack")
    results = {name: Result() for name in names}
    for seed in options.seeds:
        train, *rest = af.split(windows, seed=seed)
        race(
            (train.select(evenly(len(train), options.windows)), *rest),
            recordings.layout,
            names,
            options,
            seed,
            results,
        )
    results = {name: result for name, result in results.items() if result.megabytes}
    if OURS not in results:
        raise SystemExit(f"{OURS} failed: there is nothing to compare with")
    show(results)
    options.out.mkdir(parents=True, exist_ok=True)
    write(results, options.out / "keras.csv")
    plot(results, options.out / "keras.png")
    if len(results) > 1:
        print(f"\nBetter than {OURS}:", *verdict(results), sep="\n")


if __name__ == "__main__":
    main()
