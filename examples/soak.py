"""A robot's day in simulated time: 10 frames a second, faults that come and go, restarts: soak.py
[--hours 24]

Each hour the robot's frames are classified and monitored, and maintenance runs on its last grasps.
Prints the state after each hour and what it cost; ends with an error where F is wrong, or where
memory or the number of files grows. Predictions run on ONNX Runtime where it is installed, as on a
robot, else on torch, which takes twice as long.
"""

from __future__ import annotations

import argparse
import logging
import os
import tempfile
import time
from pathlib import Path
from unittest import mock

import numpy as np
import power_cut
import psutil

import adaptfault as af
from diagnostics import inject

LAYOUT = power_cut.LAYOUT
ROW = power_cut.ROW
HOUR = 36_000  # frames
LOGS_TO_RECOVER = 3  # logs that have to show a cell alive
PERIOD = 8  # hours: the row is broken in the first three of them, from the second on


def broken(hour: int) -> bool:
    return hour % PERIOD in (1, 2, 3)


def expected(hour: int) -> bool:
    """Return whether the row is in F after maintenance in that hour."""
    return any(broken(before) for before in range(max(0, hour - LOGS_TO_RECOVER + 1), hour + 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--hours", type=int, default=2, help="default 2; 24 takes a quarter of an hour of one core"
    )
    parser.add_argument(
        "--frames", type=int, default=HOUR, help="frames that an hour has (default 36000: 10 Hz)"
    )
    args = parser.parse_args()
    logging.getLogger("adaptfault").setLevel(logging.ERROR)
    af.allow_model("power_cut:linear")
    memory = []
    files = []
    spent = {"frames": 0.0, "maintenance": 0.0}
    with (
        tempfile.TemporaryDirectory() as home,
        mock.patch.object(os, "fsync", return_value=None),  # the disk is not what is measured
    ):
        bundle = power_cut.make(Path(home))
        predictor = af.Predictor.load(bundle.path)
        clock = 0.0
        for hour in range(args.hours):
            grasps = af.simulate(
                6, LAYOUT, n_frames=40, seed=1000 + hour, classes=power_cut.CLASSES[1:]
            )
            log = [inject(f, [ROW], LAYOUT) if broken(hour) else f for f in grasps.frames]
            frames = np.concatenate(log)
            began = time.process_time()
            for i in range(args.frames):
                reading = predictor.stream(frames[i % len(frames)], clock)
                assert reading.probabilities is None or np.isfinite(reading.probabilities).all()
                clock += 1 / LAYOUT.rate
            of_frames = time.process_time() - began
            began = time.process_time()
            report = af.maintain(af.Bundle.open(bundle.path), log)
            if hour % 6 == 5 or report.decision == "deployed":  # a restart
                predictor = af.Predictor.load(bundle.path)
            assert predictor.confirm()
            faulty = set(ROW.cells) if expected(hour) else set()
            assert report.fault_set == faulty, (
                f"hour {hour}: F is {report.fault_set}, expected {faulty}"
            )
            memory.append(psutil.Process().memory_info().rss / 1e6)
            files.append(sum(path.is_file() for path in bundle.path.rglob("*")))
            spent["frames"] += of_frames
            spent["maintenance"] += time.process_time() - began
            print(
                f"hour {hour + 1}: {report.decision}, version {predictor.version}, {len(faulty)}"
                f" cells in F, {memory[-1]:.0f} MB, {files[-1]} files, {of_frames:.0f} s of CPU for"
                " frames",
                flush=True,
            )
    settled = len(memory) // 3
    assert memory[-1] < 1.1 * memory[settled] + 20, "memory grows"
    assert max(files) < 60, "files pile up"
    cost = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in spent.items())
    print(
        f"{args.hours} hours, {args.hours * args.frames} frames: F right after each, memory and"
        " files flat"
    )
    print(f"CPU on {predictor.runtime}: {cost}")


if __name__ == "__main__":
    main()
