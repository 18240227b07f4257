"""The logs of a bench: simulated grasps on three sensors; healthy, disturbed, with dead cells, dead
cells that move, and broken wires. All readings are whole counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from adaptfault.bench import changes as of
from adaptfault.data.recordings import Recordings
from adaptfault.data.simulated_grasps import simulate
from diagnostics import Fault, FaultKind, SensorLayout, inject, line_fault

SENSORS: dict[str, tuple[SensorLayout, of.Change]] = {
    "pads, rest 0": (SensorLayout(2, 11, 10, full_scale=4095, unit="count"), of.read_with()),
    "skin, noise and gains": (
        SensorLayout(1, 10, 10, full_scale=1023, unit="count"),
        of.counted(1.0),
    ),
    "finger, rest wanders": (
        SensorLayout(1, 4, 4, full_scale=4095, unit="count", wiring="bus"),
        lambda x, rng: of.read_with(0.002, 0.05)(of.wandering(x, rng), rng),
    ),
}
KINDS = ("healthy", "disturbed", "dead", "dead later", "wires", "moving")
MOVING = (FaultKind.FLOATING, FaultKind.LATE, FaultKind.COPY, FaultKind.CLAMPED)
DISTURBANCES: tuple[of.Change, ...] = (
    of.hum,
    of.held,
    lambda x, rng: np.minimum(x + 0.007, 1),
    lambda x, rng: 0.9 * x,
)
LENGTHS = {"moving": 40}  # recordings of a log; 6 where not named
LEAST_OF_WIRE = 3  # testable cells of a wire that can be named


def record(sensor: str, per_class: int, n_frames: int, seed: int) -> Recordings:
    """Return simulated grasps as a sensor reads them, in counts."""
    layout, change = SENSORS[sensor]
    grasps = simulate(per_class, layout, n_frames=n_frames, seed=seed, sensor_seed=seed)
    shares = of.remade(grasps, change)
    whole = counts([f * layout.full_scale for f in shares.frames], layout)
    return replace(whole, labels=grasps.labels, class_names=grasps.class_names)


def counts(frames: of.Log, layout: SensorLayout) -> Recordings:
    """Return recordings in whole counts."""
    return Recordings(tuple(np.rint(f) for f in frames), layout)


def made_log(
    kind: str, number: int, layout: SensorLayout, pool: of.Log, rng: np.random.Generator
) -> tuple[of.Log, dict[str, Any]]:
    """Return the recordings of a log, and the truth about it; ``number`` chooses a variant."""
    length = min(LENGTHS.get(kind, 6), len(pool))
    log = [pool[i] for i in rng.choice(len(pool), length, replace=False)]
    faults: list[Fault] = []
    if kind == "disturbed":
        change = DISTURBANCES[number % len(DISTURBANCES)]
        full = layout.full_scale
        log = [full * change(frames / full, rng) for frames in log]
    elif kind == "wires":
        wires = broken_wires(layout, 1 + number % 2, rng)
        on_wires = {cell for fault in wires for cell in fault.cells}
        single = of.faults_of(of.draw_cells(layout, 0.04, rng), of.STUCK_KINDS, layout, rng)
        faults = [*wires, *(fault for fault in single if on_wires.isdisjoint(fault.cells))]
    elif kind == "moving":
        cells = of.draw_cells(layout, 0.08, rng).tolist()
        faults = [Fault(MOVING[number % len(MOVING)], (cell,)) for cell in cells]
    elif kind != "healthy":
        faults = of.faults_of(of.draw_cells(layout, 0.16, rng), of.STUCK_KINDS, layout, rng)
    whole = np.concatenate(log)
    onset = round(0.6 * len(whole)) if kind == "dead later" else 0
    seed = int(rng.integers(1 << 30))
    read = inject(whole, [replace(fault, onset=onset) for fault in faults], layout, seed=seed)
    return of.parted(read, log), truth_of(kind, whole, read, faults, layout)


def truth_of(
    kind: str, healthy: of.Frames, read: of.Frames, faults: Sequence[Fault], layout: SensorLayout
) -> dict[str, Any]:
    """Return the truth of a log, as :class:`~adaptfault.bench.score.Score` takes it.

    Args:
        kind: of the log, a name.
        healthy: frames ``[T, D]`` without the faults.
        read: the same with them.
        faults: what is broken; those of a line are wires.
        layout: the array.
    """
    wrong = of.differs(healthy, read, layout)
    testable = wrong.sum(axis=0) >= of.TESTABLE
    wires = [(fault.line, list(fault.cells)) for fault in faults if fault.line is not None]
    return {
        "kind": kind,
        "dead": sorted(cell for fault in faults for cell in fault.cells),
        "testable": np.flatnonzero(testable).tolist(),
        "wires": [(line.pad, line.kind, line.index) for line, _ in wires],
        "nameable": all(testable[cells].sum() >= LEAST_OF_WIRE for _, cells in wires),
        "shows": "".join(map(str, wrong.any(axis=1).astype(int))),
    }


def broken_wires(layout: SensorLayout, number: int, rng: np.random.Generator) -> list[Fault]:
    """Return open or shorted rows and columns that do not cross."""
    lines = [line for line in layout.lines if line.kind in ("row", "column")]
    first = lines[rng.integers(len(lines))]
    apart = [x for x in lines if x != first and (x.pad != first.pad or x.kind == first.kind)]
    second = apart[rng.integers(len(apart))]
    return [
        line_fault(layout, line, FaultKind(rng.choice(["open", "short"])))
        for line in (first, second)[:number]
    ]
