"""What maintaining a fleet costs, and what two workers gain: fleet_scaling.py [--robots N]

Makes N simulated robots (copies of one small bundle; a share of them has a short row since yesterday), maintains copies
of them with one worker process and with two, in one run, and prints the speed-up. Then, on paper, from the costs of
one robot measured here: cores, memory and network for 100,000 such robots a night.
"""

from __future__ import annotations

import argparse
import math
import resource
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed, parallel_config

import adaptfault as af
from diagnostics import Line, SelfDiagnosis, SensorLayout, inject, line_fault

LAYOUT = SensorLayout(2, 6, 5)
CLASSES = ("nothing", "softer", "harder")
ROBOTS, NIGHT, SHARE = 100_000, 8, 0.01  # robots, hours, and the share of robots with a new fault


def make_bundle(folder: Path) -> Path:
    grasps = af.simulate(16, LAYOUT, n_frames=60, seed=1, classes=CLASSES)
    training, validation, test = af.split(af.make_windows(grasps.frames, grasps.labels, LAYOUT))
    model = af.TactileTransformer(LAYOUT, len(CLASSES))
    af.train(model, training, validation, epochs=4, progress=False)
    diagnoser = SelfDiagnosis(LAYOUT).fit(grasps.frames)
    adapter = af.Adapter(model, training, validation)
    return af.Bundle.create(folder / "robot.bundle", model, adapter, diagnoser, check=test, class_names=CLASSES).path


def make_fleet(folder: Path, bundle: Path, robots: int, broken: float) -> af.Fleet:
    """Copy the bundle for each robot; every one has recorded twelve grasps, the broken ones with a short row."""
    grasps = af.simulate(6, LAYOUT, n_frames=60, seed=99, classes=CLASSES[1:])
    rng = np.random.default_rng(0)
    for number in range(robots):
        home = folder / f"r{number:05d}"
        shutil.copytree(bundle, home / "robot.bundle")
        frames = list(grasps.frames)
        if int((number + 1) * broken) > int(number * broken):
            row = Line(int(rng.integers(2)), "row", int(rng.integers(LAYOUT.rows)))
            frames = [inject(r, [line_fault(LAYOUT, row, "short")], LAYOUT).astype("f4") for r in frames]
        (home / "recordings").mkdir()
        af.save_npz(home / "recordings" / "log.npz", af.Recordings(tuple(frames), LAYOUT))
    (folder / "fleet.toml").write_text('bundles = "*/robot.bundle"\nrecordings = "{bundle_dir}/recordings"\n')
    return af.Fleet.read(folder / "fleet.toml")


def ready() -> float:
    """Load what a worker loads before its first robot; returns its peak memory in MB."""
    import adaptfault.robot.incoming
    import adaptfault.robot.maintenance
    import adaptfault.training  # noqa: F401

    time.sleep(0.2)  # so that no worker takes the task of another
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def on_each(workers: int) -> float:
    """Return the peak memory of the most greedy worker, in MB; starts the workers that maintain_fleet goes on with."""
    with parallel_config(backend="loky", n_jobs=workers, inner_max_num_threads=1):
        return max(Parallel(batch_size=1)(delayed(ready)() for _ in range(3 * workers)))


def size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def median(seconds: list[float]) -> float:
    return float(np.median(seconds)) if seconds else float("nan")


def on_paper(
    idle: float, adapting: float, efficiency: float, memory: float, read: float, back: float, price: float
) -> str:
    """Calculate a night: seconds of a robot without and with an adaptation, MB of a worker, bytes in and out of one."""
    hours = ROBOTS * ((1 - SHARE) * idle + SHARE * adapting) / efficiency / 3600
    cores = math.ceil(hours / NIGHT)
    network = 8 * ROBOTS * read / (3600 * NIGHT) / 1e6
    return (
        f"{ROBOTS:,} robots in a night of {NIGHT} h, {100 * SHARE:g} % of them with a new fault:"
        f" {hours:.0f} core hours,"
        f" {cores} cores, {cores * memory / 1024:.1f} GB of memory;\n"
        f"read {ROBOTS * read / 1e9:.0f} GB ({network:.0f} Mbit/s"
        f" throughout), sent back {ROBOTS * back / 1e6:.0f} MB; {price * hours:.2f} at {price:g} a core hour"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument(
        "--broken", type=float, default=0.25, help="share of the robots with a new fault (default 0.25)"
    )
    parser.add_argument("--price", type=float, default=0.04, help="of a core hour, an assumption (default 0.04)")
    args = parser.parse_args()
    took, starts, reports = {}, {}, {}
    with tempfile.TemporaryDirectory() as home:
        bundle = make_bundle(Path(home))
        for workers in (1, 2):
            folder = Path(home) / f"with{workers}"
            fleet = make_fleet(folder, bundle, args.robots, args.broken)
            began = time.perf_counter()
            if workers > 1:
                on_each(workers)
            starts[workers] = time.perf_counter() - began
            began = time.perf_counter()
            reports[workers] = af.maintain_fleet(fleet, folder / "run", jobs=workers, progress=False)
            took[workers] = time.perf_counter() - began
        memory = on_each(2)
        robot = folder / "r00000"
        read, back = size(robot), size(folder / "run") / args.robots
    speedup = took[1] / took[2]
    assert reports[1].counts == reports[2].counts, (reports[1].counts, reports[2].counts)
    of = {
        deployed: [o.seconds for o in reports[1].outcomes if (o.decision == "deployed") == deployed]
        for deployed in (0, 1)
    }
    idle, adapting = median(of[False]), median(of[True])
    print(reports[2])
    print(
        f"\n{args.robots} robots: {took[1]:.1f} s with one worker, {took[2]:.1f} s with two:"
        f" {speedup:.2f} times as fast"
    )
    print(f"({took[1] / (took[2] + starts[2]):.2f} with the {starts[2]:.1f} s that the two processes took to start)")
    print(
        f"one robot: {idle:.2f} s where nothing is new, {adapting:.2f} s with an adaptation and its export; reads"
        f" {read / 1e6:.2f} MB, sends {back:.0f} bytes; a worker holds {memory:.0f} MB"
    )
    print(on_paper(idle, adapting, speedup / 2, memory, read, back, args.price))


if __name__ == "__main__":
    main()
