"""What two workers gain on a fleet, and what a night of 100,000 robots costs: fleet_scaling.py
[--robots N]

Copies one small trained bundle for N simulated robots, which have recorded twelve grasps each, and
maintains them with one worker and with two: on loky, and on Dask clusters on loopback. One and two
take turns, batch by batch on fresh copies, so that a machine that is busy with something else slows
both alike; "on cores of their own" is the same less the time that workers stood in line for a core
(/proc/self/schedstat). A few robots have a new short row and are adapted. From what one robot took
(CPU, memory, bytes) follows, on paper, what 100,000 a night need. Linux only.
"""

from __future__ import annotations

import argparse
import logging
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import adaptfault as af
from adaptfault.fleet.engines import Engine, engine
from adaptfault.fleet.guard import Task
from adaptfault.fleet.listing import Robot
from diagnostics import Line, SelfDiagnosis, SensorLayout, inject, line_fault

LAYOUT = SensorLayout(2, 6, 5)
CLASSES = ("nothing", "softer", "harder")
# robots, and hours to do them in
ROBOTS = 100_000
NIGHT = 8


@dataclass
class Costs:
    """Of robots, in lists of equal length.

    CPU seconds, seconds in line for a core, peak MB of the process, bytes of its files, read (most
    files are read three times, for their checksums), written and sent back.
    """

    cpu: list[float] = field(default_factory=list)
    waited: list[float] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)
    files: list[float] = field(default_factory=list)
    read: list[float] = field(default_factory=list)
    written: list[float] = field(default_factory=list)
    sent: list[float] = field(default_factory=list)


def measured(robot: Robot) -> tuple[str, dict[str, float]]:
    """Maintain a robot in the worker's process; returns the decision and what it cost."""
    import json
    import time
    from pathlib import Path

    from adaptfault.fleet.work import maintain_robot

    def so_far() -> dict[str, int]:
        with open("/proc/self/io") as io, open("/proc/self/schedstat") as stat:
            lines = (line.split(": ") for line in io)
            return {
                "waited": int(stat.read().split()[1]),
                **{key: int(value) for key, value in lines},
            }

    files = sum(
        path.stat().st_size for path in Path(robot.bundle).parent.rglob("*") if path.is_file()
    )
    before = so_far()
    began = time.process_time()
    outcome = maintain_robot(robot)
    cpu = time.process_time() - began
    after = so_far()
    with open("/proc/self/status") as file:
        peak = next(int(line.split()[1]) for line in file if line.startswith("VmHWM"))  # kB
    return outcome.decision, {
        "cpu": cpu,
        "waited": (after["waited"] - before["waited"]) * 1e-9,
        "memory": peak / 1024,
        "files": files,
        "read": after["rchar"] - before["rchar"],
        "written": after["wchar"] - before["wchar"],
        "sent": len(json.dumps(outcome.to_dict())),
    }


def prepare() -> None:
    """Load what maintenance needs, in a session of its own: some kernels share cores among
    sessions, not processes."""
    import os

    from adaptfault.fleet.work import ready

    if os.getsid(0) != os.getpid():
        os.setsid()
    ready()


def make_bundle(folder: Path) -> Path:
    grasps = af.simulate(16, LAYOUT, n_frames=60, seed=1, classes=CLASSES)
    training, validation, test = af.split(af.make_windows(grasps.frames, grasps.labels, LAYOUT))
    model = af.TactileTransformer(LAYOUT, len(CLASSES))
    af.train(model, training, validation, epochs=4, progress=False)
    diagnoser = SelfDiagnosis(LAYOUT).fit(grasps.frames)
    adapter = af.Adapter(model, training, validation)
    return af.Bundle.create(
        folder / "robot.bundle", model, adapter, diagnoser, check=test, class_names=CLASSES
    ).path


@dataclass(frozen=True)
class Farm:
    """Gives robots: copies of a bundle that have recorded grasps, healthy ones or with a short
    row."""

    folder: Path
    bundle: Path

    @contextmanager
    def robots(self, number: int, *, broken: bool = False) -> Iterator[list[Robot]]:
        """Make them; they are removed afterwards."""
        frames = list(af.simulate(6, LAYOUT, n_frames=60, seed=99, classes=CLASSES[1:]).frames)
        if broken:
            row = line_fault(LAYOUT, Line(1, "row", 2), "short")
            frames = [inject(r, [row], LAYOUT).astype("f4") for r in frames]
        with tempfile.TemporaryDirectory(dir=self.folder) as made:
            homes = [Path(made) / f"r{i:05d}" for i in range(number)]
            for home in homes:
                shutil.copytree(self.bundle, home / "robot.bundle")
                af.save_npz(home / "log.npz", af.Recordings(tuple(frames), LAYOUT))
            yield [
                Robot(home.name, str(home / "robot.bundle"), (str(home / "log.npz"),))
                for home in homes
            ]


def timed(workers: Engine, farm: Farm, number: int, costs: Costs, *, broken: bool = False) -> float:
    """Return the seconds for a batch of fresh robots; adds what each took to the costs."""
    with farm.robots(number, broken=broken) as robots:
        began = time.perf_counter()
        ended = list(workers(robots))
        seconds = time.perf_counter() - began
    for decision, robot in ended:
        assert decision == ("deployed" if broken else "unchanged"), decision
        for name, value in robot.items():
            getattr(costs, name).append(value)
    return seconds


@dataclass(frozen=True)
class Turns:
    """Batches of one number of workers: seconds, the same on cores of their own, and costs."""

    workers: Engine
    seconds: list[float]
    alone: list[float]
    costs: Costs

    def take(self, farm: Farm, batch: int, number: int) -> None:
        """Do a batch; the workers are so many."""
        known = len(self.costs.waited)
        self.seconds.append(timed(self.workers, farm, batch, self.costs))
        self.alone.append(self.seconds[-1] - sum(self.costs.waited[known:]) / number)


def alternating(
    name: str, one: Engine, two: Engine, farm: Farm, batches: Sequence[int], all_costs: Costs
) -> float:
    """Let one worker and two take turns, every other time two first; prints, and returns the
    speed-up."""
    turns = {number: Turns(workers, [], [], Costs()) for number, workers in ((1, one), (2, two))}
    for i, batch in enumerate(batches):
        for number in (1, 2) if i % 2 else (2, 1):
            turns[number].take(farm, batch, number)
    seen, alone = (
        [a / b for a, b in zip(getattr(turns[1], kind), getattr(turns[2], kind), strict=True)]
        for kind in ("seconds", "alone")
    )
    for number, turn in turns.items():
        gains = [1.0] * 2 if number == 1 else [statistics.median(seen), statistics.median(alone)]
        rates = [sum(batches) / sum(turn.seconds), sum(batches) / sum(turn.alone)]
        print(
            f"{name:8}{number:7}{sum(batches):8}   {rates[0]:7.2f} {gains[0]:6.2f}"
            f" {gains[0] / number:5.0%}   {rates[1]:7.2f} {gains[1]:6.2f}"
            f" {gains[1] / number:5.0%}{statistics.mean(turn.costs.cpu):13.3f}",
            flush=True,
        )
        for key, values in vars(turn.costs).items():
            getattr(all_costs, key).extend(values)
    return statistics.median(alone)


@contextmanager
def loky() -> Iterator[tuple[Engine, Engine]]:
    task = Task(measured, prepare)
    with engine(task, jobs=1, dask=None) as one, engine(task, jobs=2, dask=None) as two:
        yield one, two


@contextmanager
def dask() -> Iterator[tuple[Engine, Engine]]:
    from distributed import LocalCluster

    start = partial(
        LocalCluster,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    )
    task = Task(measured, prepare)
    with (
        start(n_workers=1) as small,
        start(n_workers=2) as large,
        engine(task, jobs=None, dask=small.scheduler_address) as one,
        engine(task, jobs=None, dask=large.scheduler_address) as two,
    ):
        yield one, two


def on_paper(
    idle: Costs, adapting: Costs, efficiency: float, share: float, price: float
) -> list[tuple[str, str]]:
    """Return the rows of a night: what is needed, and from what."""

    def each(name: str) -> float:
        """The mean of a robot, as they come."""
        a = statistics.mean(getattr(idle, name))
        b = statistics.mean(getattr(adapting, name))
        return (1 - share) * a + share * b

    memory = max(*idle.memory, *adapting.memory)
    hours = ROBOTS * each("cpu") / efficiency / 3600
    cores = max(1, -int(-hours // NIGHT))

    def mbit(name: str) -> float:
        return 8 * ROBOTS * each(name) / (3600 * NIGHT) / 1e6

    return [
        (
            "core hours",
            f"{hours:.1f}   {each('cpu'):.3f} CPU s a robot, at an efficiency of {efficiency:.2f}",
        ),
        ("cores", f"{cores}   for {NIGHT} hours"),
        ("memory", f"{cores * memory / 1024:.1f} GB   {memory:.0f} MB a worker at its peak"),
        (
            "network in",
            (
                f"{mbit('files'):.0f} Mbit/s where workers cache files, {mbit('read'):.0f} where"
                " they do not"
            ),
        ),
        (
            "network out",
            f"{mbit('written'):.1f} Mbit/s written, {mbit('sent'):.3f} sent back as reports",
        ),
        ("money", f"{price * hours:.2f}   at {price:g} a core hour"),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--robots",
        type=int,
        default=200,
        help="for each engine and number of workers (default 200)",
    )
    parser.add_argument("--engines", nargs="+", choices=["loky", "dask"], default=["loky", "dask"])
    parser.add_argument("--batch", type=int, default=20, help="robots of a turn (default 20)")
    parser.add_argument(
        "--adapted", type=int, default=2, help="robots with a new fault (default 2)"
    )
    parser.add_argument(
        "--share",
        type=float,
        default=0.01,
        help="of robots with a new fault a night (default 0.01)",
    )
    parser.add_argument(
        "--price", type=float, default=0.04, help="of a core hour, an assumption (default 0.04)"
    )
    args = parser.parse_args()
    batch = max(1, min(args.batch, args.robots))
    batches = [batch] * (args.robots // batch)
    idle = Costs()
    adapting = Costs()
    warm = Costs()
    print("                            as it was: speed-up,    on cores of their own:")
    print(
        "engine  workers  robots  robots/s, efficiency        the same                CPU s/robot",
        flush=True,
    )
    with tempfile.TemporaryDirectory() as home:
        farm = Farm(Path(home), make_bundle(Path(home)))
        speedups = []
        for name in args.engines:
            with {"loky": loky, "dask": dask}[name]() as (one, two):
                for workers in (one, two):
                    timed(workers, farm, 4, warm)
                speedups.append(alternating(name, one, two, farm, batches, idle))
                if name == args.engines[0]:
                    timed(two, farm, args.adapted, adapting, broken=True)
    print("\na robot                nothing new   adapted")
    for label, key, scale in (
        ("CPU s", "cpu", 1),
        ("peak MB", "memory", 1),
        ("MB of files", "files", 1e-6),
        ("MB read", "read", 1e-6),
        ("MB written", "written", 1e-6),
        ("bytes sent back", "sent", 1),
    ):
        a, b = (statistics.mean(getattr(costs, key)) * scale for costs in (idle, adapting))
        print(f"  {label:18}{a:14.3f}{b:10.3f}")
    print(f"\n{ROBOTS:,} such robots a night, {args.share:.1%} of them with a new fault")
    for label, value in on_paper(idle, adapting, min(1.0, speedups[0] / 2), args.share, args.price):
        print(f"  {label:12}{value}")


if __name__ == "__main__":
    main()
