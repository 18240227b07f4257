"""The arrays that the benchmark measures: real ones where their recordings are at hand, remade
ones, simulated ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import gestures
import numpy as np
import static_holds
from other_sensors import DRIFTS, SENSORS
from random_sensors import draw
from rows import Bench

from adaptfault.bench.changes import remade
from adaptfault.data.recordings import Recordings, load
from adaptfault.data.simulated_grasps import simulate
from diagnostics import SensorLayout

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
HAND = "sdh2x13x6_grasps36.npz"
FINGERTIPS = "icub5x1x12_grasps11.npz"
SOLES = "insole2x33x15.npz"
FABRIC = "fabric4x4_slides7.npz"
MAIN = ("cells", "onset", "healthy")
LIFE = ("moving", "proven", "failing", "crossing", "worn", "own_reference")
DISTURBED = ("disturbed", "untested", "offsets", "short", "monitored")
SKIN = (*MAIN, "lines", "cold", "static")
EVERY = (
    "cells",
    "onset",
    "dither",
    "missing",
    "many",
    "cold",
    "reference_faults",
    "lines",
    "cut",
    "address",
    "healthy",
    "holds",
    "untouched",
    "kind",
    "calibration",
    "changing",
    "gain",
    "rewired",
    "replaced",
    "specimen",
    "static",
    "transport",
)


@dataclass(frozen=True)
class Array:
    """One array.

    Attributes:
        name: as the table prints it; rows: of it, by name.
        bench: builds it from split, repeat and number of logs; None where its recordings are
            absent.
        logs, repeats: of a full run; quick: logs of a quick one, 0: left out.
        quick_rows: of a quick run.
    """

    name: str
    rows: tuple[str, ...]
    bench: Callable[[int, int, int], Bench]
    logs: int
    repeats: int = 1
    quick: int = 0
    quick_rows: tuple[str, ...] = MAIN
    file: str | None = None

    @property
    def available(self) -> bool:
        """Whether its recordings are at hand."""
        return self.file is None or (DATA / self.file).exists()


def real(file: str) -> Callable[[int, int, int], Bench]:
    return lambda split, repeat, logs: Bench(load(DATA / file).recordings, split, logs, repeat)


def slides(split: int, repeat: int, logs: int) -> Bench:
    """Return the finger that slides over fabrics: 16 cells on one bus."""
    with np.load(DATA / FABRIC) as stored:
        frames = np.split(stored["frames"].astype(np.float32), np.cumsum(stored["lengths"])[:-1])
        labels = stored["labels"].astype(np.int64)
    layout = SensorLayout(1, 4, 4, full_scale=4095, unit="count", rate=35.7, wiring="bus")
    return Bench(Recordings(tuple(frames), layout, labels), split, logs, repeat)


def sensor(name: str) -> Callable[[int, int, int], Bench]:
    def bench(split: int, repeat: int, logs: int) -> Bench:
        plain = load(DATA / HAND).recordings
        trained = remade(plain, SENSORS["as it is"]) if name in DRIFTS else None
        return Bench(remade(plain, (SENSORS | DRIFTS)[name]), split, logs, repeat, trained)

    return bench


def simulated(
    record: Callable[[int, int], Recordings], count: int = 120
) -> Callable[[int, int, int], Bench]:
    """Return a builder of benches, with recordings of their own for each split and repeat."""
    return lambda split, repeat, logs: Bench(
        record(count, 1000 * split + repeat), split, logs, repeat
    )


def grasps(layout: SensorLayout) -> Callable[[int, int], Recordings]:
    return lambda count, seed: simulate(-(-count // 7), layout, n_frames=60, seed=seed)


def triangles(rows: int, cols: int) -> SensorLayout:
    """Return a skin of triangles of 10 cells, 4 of them behind a connector, as of ``rows`` x
    ``cols`` blocks."""
    wide = 5 * cols
    groups = {}
    for r in range(rows):
        for c in range(cols):
            cells = [(2 * r + i) * wide + 5 * c + j for i in range(2) for j in range(5)]
            groups[f"triangle {cols * r + c}"] = cells
    names = list(groups)
    groups |= {f"connector J{i}": names[4 * i : 4 * i + 4] for i in range(len(names) // 4)}
    return SensorLayout(1, 2 * rows, wide, groups=groups)


def on_buses(split: int, repeat: int, logs: int) -> Bench:
    """Return the fingertips with their true wiring."""
    recordings = load(DATA / FINGERTIPS).recordings
    return Bench(
        replace(recordings, layout=replace(recordings.layout, wiring="bus")), split, logs, repeat
    )


def random_sensor(split: int, repeat: int, logs: int) -> Bench:
    """Return a sensor of its own for each split and repeat."""
    real = [lambda file=file: load(DATA / file).recordings for file in (HAND, FINGERTIPS, SOLES)]
    return Bench(draw(1000 * split + repeat, real), split, logs, repeat)


def wired(layout: SensorLayout) -> Callable[[int, int], Recordings]:
    """Return simulated grasps of an array with declared wiring."""
    plain = grasps(replace(layout, groups=None))
    return lambda count, seed: replace(plain(count, seed), layout=layout)


ARRAYS = [
    Array("hand", EVERY, real(HAND), 50, 2, 40, (*MAIN, "lines", "calibration", "cold"), HAND),
    Array(
        "fingertips",
        (
            *MAIN,
            "many",
            "cold",
            "reference_faults",
            "holds",
            "untouched",
            "calibration",
            "rewired",
            "replaced",
            "specimen",
            "static",
            "transport",
        ),
        real(FINGERTIPS),
        60,
        2,
        40,
        (*MAIN, "cold"),
        FINGERTIPS,
    ),
    Array("sliding finger", MAIN, slides, 30, 1, 12, MAIN, FABRIC),
    *(
        Array(f"{name}, long logs", LIFE, bench, logs, 1, quick, LIFE, file)
        for name, bench, logs, quick, file in (
            ("hand", real(HAND), 10, 3, HAND),
            ("fingertips", real(FINGERTIPS), 20, 6, FINGERTIPS),
            ("soles", real(SOLES), 10, 2, SOLES),
            ("sliding finger", slides, 30, 9, FABRIC),  # one dead cell a log
        )
    ),
    *(
        Array(f"{name}, disturbed", DISTURBED, bench, logs, 1, logs // 5, DISTURBED, file)
        for name, bench, logs, file in (
            ("hand", real(HAND), 10, HAND),
            ("fingertips", real(FINGERTIPS), 10, FINGERTIPS),
            ("soles", real(SOLES), 5, SOLES),
            ("sliding finger", slides, 10, FABRIC),
        )
    ),
    Array(
        "fingertips, buses", (*MAIN, "groups"), on_buses, 60, 1, 40, (*MAIN, "groups"), FINGERTIPS
    ),
    Array(
        "soles",
        (
            *MAIN,
            "many",
            "cold",
            "reference_faults",
            "lines",
            "cut",
            "holds",
            "untouched",
            "calibration",
            "changing",
            "rewired",
        ),
        real(SOLES),
        30,
        2,
        12,
        (*MAIN, "cold"),
        SOLES,
    ),
    Array("random sensors", MAIN, random_sensor, 10, 20, file=HAND),
    *(
        Array(f"hand, {name}", MAIN, sensor(name), 30, file=HAND)
        for name in (*SENSORS, *DRIFTS)
        if name != "as it is"
    ),
    *(
        Array(f"fabric, {name}", SKIN, simulated(skin.recordings), 30, 1, 12 * (name == "10 x 10"))
        for name, skin in gestures.SKINS.items()
    ),
    *(
        Array(f"posture, {name}", SKIN, simulated(skin.recordings), 20, 1, 12 * (name == "seat"))
        for name, skin in static_holds.SKINS.items()
    ),
    Array("grasps, 2 x 11 x 10", SKIN, simulated(grasps(SensorLayout.paper())), 30),
    Array(
        "grasps, 1 x 10 x 10, long logs",
        ("own_reference",),
        simulated(grasps(SensorLayout(1, 10, 10))),
        10,
        1,
        4,
        ("own_reference",),
    ),
    Array(
        "grasps, 1 x 12 x 12",
        (*MAIN, "lines", "address", "rewired"),
        simulated(grasps(SensorLayout(1, 12, 12))),
        30,
    ),
]
SPEED = [
    Array("hand", ("speed",), real(HAND), 1, 3, 1, ("speed",), HAND),
    Array(
        "grasps, 2 x 11 x 10",
        ("speed",),
        simulated(grasps(SensorLayout.paper()), 42),
        1,
        3,
        1,
        ("speed",),
    ),
    Array("grasps, 1 x 64 x 32", ("speed",), simulated(grasps(SensorLayout(1, 64, 32)), 21), 1, 3),
]
