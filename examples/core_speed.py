"""How fast the core is, as a share of what this machine's matrix product and memory reach in the
same run.

    python examples/core_speed.py                    a small array, a quick look
    python examples/core_speed.py --shape 2 11 10 --grasps 44 --healthy 14 --copy 128 \\
        --out examples/speed

Each job runs between two products of 1024 x 1024 in single precision and two copies of an array,
again and again; the shares are medians over these rounds, so that a busy machine slows both. What
counts as useful, and is divided by the time that all of a job takes:
    GFLOP   multiplications and additions of its matrix products and convolutions, counted by torch,
            or for what runs on numpy by formula (a job's remark says which); exponentials, sums and
            comparisons count as nothing
    MB      what has to be read and written once if nothing stays in a cache: weights, or the
            sensor's readings
A job without matrix products has no share of one.
"""

from __future__ import annotations

import argparse
import csv
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from threadpoolctl import threadpool_limits
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

import adaptfault as af
from adaptfault.adaptation.reduced_model import ReducedModel, phi
from adaptfault.models import training_run
from adaptfault.models.compact import CompactNetwork
from adaptfault.models.store import load_model, save_model
from diagnostics import FaultSet, Monitor, SelfDiagnosis, SensorLayout

N = 1024  # of the square matrices
SECONDS = 0.1  # that quick jobs are repeated for in a round


@dataclass(frozen=True)
class Job:
    """Something to time: ``work`` does ``flop`` operations and has to move ``moved`` bytes."""

    name: str
    work: Callable[[], object]
    flop: float
    moved: float = 0.0
    remark: str = ""


@dataclass(frozen=True)
class Row:
    """A line of the table; medians over the rounds."""

    name: str
    threads: int
    seconds: float
    gflop: float
    gflops: float
    share_of_product: float
    megabytes: float
    share_of_copy: float
    remark: str


def seconds_of(work: Callable[[], object]) -> float:
    """Return the median of some runs; one run where it takes long."""
    taken = []
    end = time.perf_counter() + SECONDS
    while not taken or time.perf_counter() < end:
        began = time.perf_counter()
        work()
        taken.append(time.perf_counter() - began)
    return statistics.median(taken)


class Machine:
    """What the machine reaches: operations a second of a matrix product, bytes a second of a
    copy."""

    def __init__(self, large: int) -> None:
        self.a, self.b, self.c = (torch.rand(N, N) for _ in range(3))
        self.source = torch.rand(large)
        self.target = torch.empty_like(self.source)

    def now(self) -> tuple[float, float]:
        """Return what it reaches at this moment."""
        product = seconds_of(lambda: torch.mm(self.a, self.b, out=self.c))
        copy = seconds_of(lambda: self.target.copy_(self.source))
        return 2 * N**3 / product, 2 * self.source.nbytes / copy


def count(work: Callable[[], object]) -> float:
    """Return torch's count of operations."""
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()


def size_of(module: nn.Module) -> int:
    return sum(p.nbytes for p in module.parameters())


def step_of(model: nn.Module, x: Tensor, y: Tensor) -> Callable[[], object]:
    """Return one step of adaptfault's training loop."""
    run = training_run.Optimisation(model.train(), 1e-4, 0.995)

    def step() -> float:
        loss = F.cross_entropy(model(x), y)
        run.step(loss)
        return loss.item()

    return step


def training_jobs(
    model: af.TactileTransformer, adapter: af.Adapter, faults: FaultSet
) -> Iterator[Job]:
    x = torch.from_numpy(adapter.train.x[:32])
    y = torch.from_numpy(adapter.train.y[:32])
    fresh = af.TactileTransformer(model.layout, model.n_classes)
    step = step_of(fresh, x, y)
    # Adam reads weights, gradients and two moments, writes three; the average 3 more
    moved = 10 * size_of(fresh)
    yield Job("training step, 32 windows", step, count(step), moved, "torch's count")
    reduced = ReducedModel(
        af.TactileTransformer(model.layout, model.n_classes),
        faults,
        adapter.statistics.linear(faults),
    )
    step = step_of(reduced, x[..., faults.healthy], y)
    yield Job(
        "fine-tuning step, 32 windows", step, count(step), moved, f"{len(faults)} cells dropped"
    )


def fill_jobs(adapter: af.Adapter, faults: FaultSet) -> Iterator[Job]:
    known = adapter.statistics
    d = faults.n_cells
    k = len(faults)
    m = len(known.frames)
    r = d - k
    solved = r**3 / 3 + 2 * r**2 * k + 2 * r * k  # Cholesky, triangular solves, bias
    near = 2 * m * r * k + 2 * 100 * m * r  # residuals of the linear fill, distances of the probes
    kept = 4 * m * d
    yield Job(
        "fill: built",
        lambda: known.nearest(faults),
        solved + near,
        kept,
        "formula; the solve is double",
    )
    front = known.nearest(faults)
    x = torch.from_numpy(phi(adapter.validation.x[:256], faults))

    def fill() -> Tensor:
        with torch.no_grad():
            return front(x)

    yield Job(f"fill: applied to {len(x)} windows", fill, count(fill), kept, "torch's count")


def head_jobs(adapter: af.Adapter, faults: FaultSet) -> Iterator[Job]:
    """Most of a head is the network's features and Cholesky decompositions, which torch does not
    count."""
    _ = adapter.compact  # made once, a set-up cost of its own
    yield Job("adapt, method head", lambda: adapter.adapt(faults, method="head", progress=False), 0)


def diagnosis_jobs(grasps: af.Recordings, faults: FaultSet, most: int) -> Iterator[Job]:
    healthy = list(grasps.frames[:: max(1, len(grasps) // most)])
    fitted = SelfDiagnosis(grasps.layout)
    fitted.fit(healthy)
    yield Job(f"diagnosis: fit on {len(healthy)} grasps", lambda: fitted.fit(healthy), 0)
    # of every class: some press nothing
    log = [frames.copy() for frames in grasps.frames[:: -(-len(grasps) // 20)]]
    for frames in log:
        frames[:, list(faults)] = 0.0
    n = sum(len(frames) for frames in log)
    moved = sum(frames.nbytes for frames in log)
    yield Job(
        f"diagnosis: a log of {n} frames",
        lambda: fitted.diagnose(log),
        0,
        moved,
        "readings, read once",
    )
    monitor = Monitor(fitted)
    at = 0
    frames = np.concatenate(log)

    def update() -> object:
        nonlocal at
        at = (at + 1) % len(frames)
        return monitor.update(frames[at])

    def batch() -> None:
        for _ in range(64):
            update()

    yield Job("Monitor.update, 64 frames", batch, 0, 64 * frames[0].nbytes, "readings, read once")


def prediction_jobs(
    model: af.TactileTransformer, adapter: af.Adapter, folder: Path
) -> Iterator[Job]:
    from adaptfault.prediction.export import add_onnx

    x = adapter.validation.x[:256].copy()
    for n in (1, len(x)):
        name = f"prediction on torch, {n} window" + "s" * (n > 1)
        flop = count(lambda n=n: model.predict_proba(x[:n]))
        yield Job(
            name, lambda n=n: model.predict_proba(x[:n]), flop, size_of(model), "torch's count"
        )
    adapter.adapt(FaultSet((), model.layout.n_cells)).save(folder)
    try:
        add_onnx(folder)
    except ImportError:
        return
    onnx = af.Inference.load(folder, runtime="onnx")
    small = CompactNetwork(model)
    with torch.no_grad():
        flop = count(lambda: small(torch.from_numpy(x[:1])))
    yield Job(
        "prediction on ONNX Runtime, 1 window",
        lambda: onnx.predict_proba(x[:1]),
        flop,
        size_of(small),
        "on one thread",
    )


def set_up_jobs(model: af.TactileTransformer, adapter: af.Adapter, folder: Path) -> Iterator[Job]:
    """What is paid once."""
    save_model(folder, model)
    yield Job(
        "set-up: load a model",
        lambda: load_model(folder),
        0,
        2 * size_of(model),
        "read, and copied",
    )
    m = min(adapter.train.x.shape[0] * 10, 20_000)
    d = adapter.train.x.shape[2]
    kept = type(adapter.statistics)
    yield Job(
        "set-up: statistics of the fills",
        lambda: kept.fit(adapter.train),
        4 * m * d**2,
        8 * m * d,
        "formula",
    )
    k = [model.layout.n_cells + 1]
    for added in (256, 128) * 2:
        k.append(k[-1] + added + 1)
    # of each basis: its Gram matrix, Cholesky, a triangular solve; then the folds
    width = model.dense.in_features
    flop = sum(3 * width * n**2 + n**3 / 3 for n in k[1:]) + sum(
        2 * width * n * 768 for n in (k[0], k[2])
    )
    yield Job(
        "set-up: the network on fewer numbers",
        lambda: CompactNetwork(model),
        flop,
        0,
        "formula; double",
    )


def measure(
    jobs: list[Job], rounds: int, threads: int, machine: Machine
) -> tuple[list[Row], tuple[float, float]]:
    """Run all jobs in each round; return the rows and what the machine reached."""
    torch.set_num_threads(threads)
    taken: dict[str, list[tuple[float, float, float]]] = {job.name: [] for job in jobs}
    reached = []
    with threadpool_limits(threads):
        for job in jobs * rounds:
            before = machine.now()
            seconds = seconds_of(job.work)
            product, copy = np.mean([before, machine.now()], axis=0)
            reached.append((product, copy))
            taken[job.name].append(
                (seconds, job.flop / seconds / product, job.moved / seconds / copy)
            )
    rows = []
    for job in jobs:
        seconds, of_product, of_copy = np.median(taken[job.name], axis=0)
        rate = job.flop / seconds / 1e9
        rows.append(
            Row(
                job.name,
                threads,
                seconds,
                job.flop / 1e9,
                rate,
                of_product,
                job.moved / 1e6,
                of_copy,
                job.remark,
            )
        )
    return rows, tuple(np.median(reached, axis=0))


def show(rows: list[Row], reached: tuple[float, float]) -> None:
    product, copy = reached
    print(
        f"\n{rows[0].threads} thread(s): matrix product {product / 1e9:.0f} GFLOP/s, copy"
        f" {copy / 1e9:.1f} GB/s"
    )
    print(f"{'':42} {'ms':>9} {'GFLOP':>9} {'GFLOP/s':>8} {'of product':>10} {'of copy':>8}")
    for row in rows:
        work = (
            f"{row.gflop:9.3f} {row.gflops:8.1f} {row.share_of_product:10.1%}"
            if row.gflop
            else 29 * " "
        )
        moved = f"{row.share_of_copy:8.1%}" if row.megabytes else ""
        print(f"{row.name:42} {1000 * row.seconds:9.2f} {work} {moved}".rstrip())


def write(folder: Path, rows: list[Row]) -> None:
    """Write the table and its picture."""
    from matplotlib.figure import Figure

    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "core_speed.csv").open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(vars(rows[0]))
        table.writerows(
            [f"{v:.4g}" if isinstance(v, float) else v for v in vars(row).values()] for row in rows
        )
    shown = [row for row in rows if row.gflop]
    names = list(dict.fromkeys(row.name for row in shown))
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    ax = figure.subplots()
    counts = sorted({row.threads for row in shown})
    for i, threads in enumerate(counts):
        share = {row.name: row.share_of_product for row in shown if row.threads == threads}
        where = np.arange(len(names)) + (i - (len(counts) - 1) / 2) * 0.8 / len(counts)
        ax.barh(
            where, [share[name] for name in names], 0.8 / len(counts), label=f"{threads} thread(s)"
        )
    ax.set_yticks(range(len(names)), names)
    ax.invert_yaxis()
    ax.set(xlabel="share of the matrix product", xlim=(0, 1))
    ax.legend()
    figure.savefig(folder / "core_speed.png", dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shape", type=int, nargs=3, default=(2, 5, 5), help="pads, rows, columns")
    parser.add_argument("--grasps", type=int, default=4, help="simulated, of each of 7 classes")
    parser.add_argument(
        "--healthy", type=int, default=7, help="of them, that the diagnosis is fitted on"
    )
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--threads", type=int, nargs="+", default=[1])
    parser.add_argument(
        "--copy", type=int, default=32, metavar="MB", help="size of the array that is copied"
    )
    parser.add_argument("--out", type=Path, help="folder for core_speed.csv and core_speed.png")
    arguments = parser.parse_args()
    grasps = af.simulate(arguments.grasps, SensorLayout(*arguments.shape), seed=0)
    windows = af.make_windows(grasps.frames, grasps.labels, grasps.layout)
    learnt, validation, _ = af.split(windows)
    model = af.TactileTransformer(grasps.layout, 7).eval()  # untrained: the same work
    adapter = af.Adapter(model, learnt, validation)
    d = grasps.layout.n_cells
    faults = FaultSet(tuple(range(0, d, 11)), d)
    machine = Machine(arguments.copy * 250_000)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        jobs = [
            *training_jobs(model, adapter, faults),
            *fill_jobs(adapter, faults),
            *head_jobs(adapter, faults),
            *diagnosis_jobs(grasps, faults, arguments.healthy),
            *prediction_jobs(model, adapter, Path(folder) / "adapted"),
            *set_up_jobs(model, adapter, Path(folder) / "model"),
        ]
        print(f"{grasps.layout}; {windows}; {len(faults)} cells dropped")
        for threads in arguments.threads:
            found, reached = measure(jobs, arguments.rounds, threads, machine)
            show(found, reached)
            rows += found
    if arguments.out:
        write(arguments.out, rows)


if __name__ == "__main__":
    main()
