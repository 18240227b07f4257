"""The whole routine on a gripper in MuJoCo: python examples/mujoco_bench.py [--small]

Grasps of ``mujoco_gripper.py`` are recorded, a network is trained, a bundle is written. Then each
fault breaks the sensor, ``maintain`` is given a log without labels, and other grasps under the same
fault are predicted by the healthy version and by the one that runs afterwards. Faults are physics,
not readings: they change the resistor network, or the forces before it.

A cell is faulty where a press of 2.5 N on it alone reads more than a fifth wrong, and healthy where
it reads less than a twentieth wrong. Those in between count as neither.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain
from pathlib import Path

import mujoco_gripper
import numpy as np
from mujoco_gripper import LAYOUT, OBJECTS, Floats

import adaptfault as af
from diagnostics import Line, SelfDiagnosis
from diagnostics.simulation.circuit import (
    BridgedLines,
    Circuit,
    CutLine,
    NetlistFault,
    StuckCell,
)

HEALTHY = Circuit(LAYOUT)
PRESS = 2.5  # newtons on one cell, to see whether it works
FAULTY = 0.2  # share of the press that is read wrong
FINE = 0.05
SEEN = 72  # recordings in a log, at most


@dataclass(frozen=True)
class Damage:
    """What happens to the sensor.

    Attributes:
        name: in the table.
        netlist: faults of the resistor network.
        leak: newtons that each cell reads more, ``[D]``: a resistor beside it.
        wear: at the end of its life a cell reads ``1 / (1 + wear)`` of its load, ``[D]``.
        opens_at: the netlist has its faults only while pad 1 carries more than these newtons.
    """

    name: str
    netlist: tuple[NetlistFault, ...] = ()
    leak: Floats | float = 0.0
    wear: Floats | float = 0.0
    opens_at: float = -1.0

    def read(self, forces: Floats, seed: int, age: float = 1.0) -> Floats:
        """Return the readings of forces ``[T, D]`` at an age from 0 to 1, with the noise of
        ``seed``."""
        pressed = forces / (1 + age * self.wear) + self.leak
        broken = mujoco_gripper.read(pressed, HEALTHY.with_faults(*self.netlist), seed)
        closed = forces[:, LAYOUT.n_cells // 2 :].sum(axis=1) <= self.opens_at
        broken[closed] = mujoco_gripper.read(pressed, HEALTHY, seed)[closed]
        return broken

    def errors(self) -> Floats:
        """Return the share of a press on each cell alone that is read wrong, ``[D]``."""
        at_worst = replace(self, opens_at=-1.0)
        wrong = at_worst.read(one_by_one(), 0) - right()
        pressed = one_by_one() > 0
        return np.abs(wrong.T[pressed.T]) / PRESS


def one_by_one() -> Floats:
    """Return presses on each cell alone, on all pads at once: ``[D / pads, D]``."""
    return np.tile(PRESS * np.eye(LAYOUT.rows * LAYOUT.cols), LAYOUT.pads)


@cache
def right() -> Floats:
    """Return what a healthy sensor reads of these presses."""
    return Damage("nothing").read(one_by_one(), 0)


def damages(life: Sequence[Floats]) -> list[Damage]:
    """Return the damages; the wear is that of the forces of all grasps in ``life``."""
    cell = LAYOUT.cell(0, 6, 4)
    knife = tuple(CutLine(Line(0, "row", row), 7 - row) for row in range(5))
    row, col = np.indices((LAYOUT.rows, LAYOUT.cols))
    away = np.hypot(row - 3, col - 6)  # in cells, from the middle of the drop
    drop = np.zeros(LAYOUT.shape)
    drop[1] = 1.5 * np.clip(2.2 - away, 0, 1)
    water = tuple(BridgedLines(Line(1, "row", row), 20e3) for row in (2, 3))
    water += tuple(BridgedLines(Line(1, "column", col), 20e3) for col in (5, 6))
    work = np.sum([forces.sum(axis=0) for forces in life], axis=0)
    return [
        Damage("nothing"),
        Damage("crossing shorts", (StuckCell(cell, 0),)),
        Damage("cut through a pad", knife),
        Damage("cable opens under load", (CutLine(Line(1, "row", 5), 0),), opens_at=20.0),
        Damage(f"wear of {len(life)} grasps", wear=3 * work / work.max()),
        Damage("drop of water", water, leak=drop.ravel()),
    ]


@dataclass(frozen=True)
class Bench:
    """A robot's bundle, and forces that it has not seen.

    Attributes:
        bundle: the folder as it is delivered.
        life: forces of the grasps that follow, in order.
        later: forces of the grasps after them, and their labels.
        labels: of ``later``.
    """

    bundle: Path
    life: Sequence[Floats]
    later: Sequence[Floats]
    labels: np.ndarray

    def row(self, damage: Damage) -> list[str]:
        """Return the row of the table for one damage."""
        errors = damage.errors()
        faulty = errors > FAULTY
        healthy = errors < FINE
        broken = [damage.read(forces, 5000 + i) for i, forces in enumerate(self.later)]
        windows = af.make_windows(broken, self.labels, LAYOUT)
        with tempfile.TemporaryDirectory() as folder:
            robot = Path(folder) / "robot.bundle"
            shutil.copytree(self.bundle, robot)
            before = self.accuracy(robot, windows)
            began = len(self.life) - SEEN if np.any(damage.wear) else 0
            log = [
                damage.read(forces, 9000 + i, i / len(self.life))
                for i, forces in enumerate(self.life[began : began + SEEN], max(began, 0))
            ]
            report = af.maintain(af.Bundle.open(robot), log)
            after = self.accuracy(robot, windows)
        removed = report.fault_set.mask
        return [
            damage.name,
            f"{faulty.sum()}",
            f"{(removed & faulty).sum()}",
            f"{(removed & healthy).sum()}",
            f"{report.decision} ({report.exit_code})",
            f"{before:.3f}",
            f"{after:.3f}",
            named(report),
        ]

    @staticmethod
    def accuracy(robot: Path, windows: af.Windows) -> float:
        """Return the share of windows that the running version names right."""
        return float(np.mean(af.Predictor.load(robot).predict(windows.x) == windows.y))


def named(report: af.MaintenanceReport) -> str:
    """Return how many root causes of each kind there are, and the largest one; without faults the
    reasons."""
    if not report.faults:
        return "; ".join(reason.text for reason in report.reasons)
    kinds = Counter(str(fault.kind) for fault in report.faults)
    largest = max(report.faults, key=lambda fault: len(fault.cells))
    counts = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    return f"{counts}: {largest.reason.split(';')[0]}"


def build(folder: Path, grasps: Sequence[int], epochs: int, objects: Sequence[str]) -> Bench:
    """Record, train, write the bundle; ``grasps`` of each object: to train, in a life, later."""
    forces = mujoco_gripper.record(sum(grasps), objects=objects)
    of_object = np.arange(len(forces)).reshape(len(objects), -1)
    parts = np.split(of_object, np.cumsum(grasps)[:-1], axis=1)
    first, life, later = (part.ravel() for part in parts)
    order = np.random.default_rng(0).permutation(life)
    frames = [mujoco_gripper.read(forces[i], HEALTHY, i) for i in first]
    recordings = mujoco_gripper.as_recordings(frames, objects)
    windows = af.make_windows(recordings.frames, recordings.labels, LAYOUT)
    training, validation, check = af.split(windows)
    model = af.TactileTransformer(LAYOUT, len(objects), padding="valid", init="glorot")
    af.train(model, training, validation, epochs=epochs, learning_rate=1e-3, progress=False)
    af.Bundle.create(
        folder / "robot.bundle",
        model,
        af.Adapter(model, training, validation),
        SelfDiagnosis(LAYOUT).fit(frames),
        check=check,
        class_names=objects,
    )
    return Bench(
        folder / "robot.bundle",
        [forces[i] for i in order],
        [forces[i] for i in later],
        np.repeat(np.arange(len(objects)), grasps[2]),
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--small", action="store_true", help="three objects, little training, one damage"
    )
    args = parser.parse_args()
    began = time.perf_counter()
    objects = list(OBJECTS)[: 3 if args.small else None]
    with tempfile.TemporaryDirectory() as folder:
        grasps = (8, 6, 2) if args.small else (14, 17, 4)
        bench = build(Path(folder), grasps, 1 if args.small else 6, objects)
        print(
            f"recorded, trained and bundled after {time.perf_counter() - began:.0f} s", flush=True
        )
        heads = ["fault", "faulty", "found", "blamed", "decision", "broken", "repaired", "named"]
        widths = (24, 7, 6, 7, 15, 7, 9, 0)
        for row in chain([heads], map(bench.row, damages(bench.life)[: 2 if args.small else None])):
            print(
                "".join(f"{value:{width}}" for value, width in zip(row, widths, strict=True)),
                flush=True,
            )
    print(f"{time.perf_counter() - began:.0f} s in all")


if __name__ == "__main__":
    main()
