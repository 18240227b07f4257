"""What large skins cost: python examples/scale_curves.py [--sizes 100 1000 10000] [--pads one many]
[--out scale]

Without --sizes only an array of 100 cells is measured; the whole curve (--sizes 100 300 1000 3000
10000 30000 100000) takes about half an hour on an idle core.

For arrays of 100 to 100,000 cells, as one big pad and as many pads of 16 x 16: CPU seconds and peak
memory of fitting, diagnosing a log, one update of the monitor, building a fill and applying it; the
slope of each in a log-log plot from 1000 cells on (1: linear); and beside them how many of the
injected faults were found, so that speed is not bought with blindness. Writes OUT.csv and OUT.png;
prints the table. A size that takes longer than ``--limit`` seconds is stopped, and the table says
so.

The skin is simulated: touches of a few cells' width come, wander a little and go, about one for
every 150 cells in each recording of 100 frames; what they do not reach reads 0; 12 bits. Broken are
2 % of the cells (open, short, stuck at any value), a row for every 20,000 cells and at least one,
and from 1000 cells on an address bit and a bridge of two columns. A broken cell is testable if what
it hides differs from what it reads by over 5 % of full scale in ten frames.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from diagnostics import Fault, FaultKind, Line, SensorLayout, inject
from diagnostics.simulation.injection import bridge, line_fault

STAGES = ("fit", "diagnose", "monitor update", "monitor mean", "fill build", "fill apply")
FULL_SCALE = 5.0
STEPS = 4095
# frames of a recording; recordings
FRAMES = 100
REFERENCE = 16
LOG = 6
PER_TOUCH = 150  # cells for which there is one touch in a recording
DEAD_SHARE = 0.02
PER_ROW = 20_000
# of full scale; frames
SHOWN = 0.05
ENOUGH = 10
FILLED_FROM = 12  # recordings
SMALLEST = 1000  # cells from which on the slope is taken


def shape(cells: int, pads: str) -> SensorLayout:
    """Return one pad, nearly square, or pads of 16 x 16 (of a smaller size, where that would be
    one)."""
    if pads == "one" or cells < 512:
        of_one = cells if pads == "one" else cells / 2
        rows = round(of_one**0.5)
        return SensorLayout(
            1 if pads == "one" else 2, rows, round(of_one / rows), full_scale=FULL_SCALE, rate=20.0
        )
    return SensorLayout(round(cells / 256), 16, 16, full_scale=FULL_SCALE, rate=20.0)


def recording(layout: SensorLayout, rng: np.random.Generator) -> np.ndarray:
    """Return float32 ``[T, D]``: touches that come, wander and go, over cells of unequal gain."""
    frames = np.zeros((FRAMES, *layout.shape), np.float32)
    for _ in range(max(2, round(layout.n_cells / PER_TOUCH))):
        lasts = int(rng.integers(25, 60))
        first = int(rng.integers(-10, FRAMES - 15))
        phase = np.linspace(0, np.pi, lasts)
        force = rng.uniform(0.8, 4) * np.minimum(1, 1.5 * np.sin(phase))
        size = rng.uniform(1.5, 4.5, 2)
        place = rng.uniform(0, 1, 2) * (layout.rows - 1, layout.cols - 1)
        path = place + np.outer(phase / np.pi - 0.5, rng.normal(0, 2, 2))
        kept = (first + np.arange(lasts) >= 0) & (first + np.arange(lasts) < FRAMES)
        low = np.maximum(np.floor(path.min(axis=0) - size), 0).astype(int)
        high = np.ceil(path.max(axis=0) + size).astype(int) + 1
        box = (int(rng.integers(layout.pads)), slice(low[0], high[0]), slice(low[1], high[1]))
        rows, cols = (
            np.arange(s.start, min(s.stop, n))
            for s, n in zip(box[1:], layout.shape[1:], strict=True)
        )
        away = ((rows - path[:, :1]) / size[0])[:, :, None] ** 2 + ((cols - path[:, 1:]) / size[1])[
            :, None, :
        ] ** 2
        pressed = (force[:, None, None] * np.maximum(1 - away, 0))[kept]
        frames[(slice(max(first, 0), first + lasts), *box)] += pressed
    # the same cells in all recordings
    gain = np.random.default_rng(1).uniform(0.8, 1.2, layout.shape)
    frames *= (gain * (1 + 0.01 * rng.standard_normal(layout.shape))).astype(np.float32)
    step = np.float32(FULL_SCALE / STEPS)
    np.round(frames / step, out=frames)
    return (np.clip(np.where(frames < 20, 0, frames), 0, STEPS) * step).reshape(FRAMES, -1)


def faults_of(layout: SensorLayout, rng: np.random.Generator) -> list[Fault]:
    """Return single dead cells, dead rows, a stuck address bit and a bridge; the wires on other
    pads where possible."""
    cells = rng.choice(layout.n_cells, round(DEAD_SHARE * layout.n_cells), replace=False)
    kinds = rng.choice([FaultKind.OPEN, FaultKind.SHORT, FaultKind.STUCK], len(cells))
    values = rng.uniform(0.1, 0.9, len(cells)) * FULL_SCALE
    faults = [
        Fault(
            FaultKind(kind), (int(cell),), value=float(value) if kind == FaultKind.STUCK else None
        )
        for cell, kind, value in zip(cells, kinds, values, strict=True)
    ]
    rows = 1 + layout.n_cells // PER_ROW
    pads = rng.permutation(layout.pads)
    for i in range(rows):
        row = Line(
            int(pads[i % layout.pads]),
            "row",
            int((i // layout.pads * 7 + layout.rows // 2) % layout.rows),
        )
        faults.append(line_fault(layout, row, FaultKind.OPEN))
    if layout.n_cells >= SMALLEST and layout.pads > rows + 1:
        faults.append(
            line_fault(layout, Line(int(pads[-1]), "row_address", 1), FaultKind.ALIAS, value=1)
        )
        faults.append(bridge(layout, Line(int(pads[-2]), "column", layout.cols // 3)))
    elif layout.n_cells >= SMALLEST:
        faults.append(bridge(layout, Line(0, "column", layout.cols // 3)))
    return faults


def peak() -> float:
    """Return the peak memory since the last call, in MB (Linux)."""
    status = Path("/proc/self/status").read_text()
    most = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts anew
    return most / 1024


def measure(layout: SensorLayout, frames: int) -> None:
    """Measure all stages in this process; memory is what comes on top of an empty process."""
    import sklearn.covariance  # noqa: F401

    from adaptfault.data.windows import make_windows
    from adaptfault.imputation.statistics import CellStatistics
    from adaptfault.imputation.tiled_statistics import LARGE, TiledStatistics
    from diagnostics import FaultSet, Monitor, SelfDiagnosis

    empty = peak()

    def measured(stage: str, seconds: float, **more: float) -> None:
        print(
            json.dumps({"stage": stage, "cpu": seconds, "peak_mb": peak() - empty, **more}),
            flush=True,
        )

    rng = np.random.default_rng(0)
    reference = [recording(layout, rng) for _ in range(REFERENCE)]
    log = [recording(layout, rng) for _ in range(LOG)]
    faults = faults_of(layout, rng)
    seen = [inject(r, faults, layout, seed=i).astype(np.float32) for i, r in enumerate(log)]
    measured("data", time.process_time())
    began = time.process_time()
    diagnoser = SelfDiagnosis(layout).fit(reference)
    measured("fit", time.process_time() - began)
    began = time.process_time()
    diagnosis = diagnoser.diagnose(seen)
    measured("diagnose", time.process_time() - began, **found(log, seen, faults, diagnosis, layout))
    monitor = Monitor(diagnoser, wait=True)
    times = []
    stream = np.concatenate(seen)
    began = time.process_time()  # of all threads
    for i in range(frames):
        frame_began = time.thread_time()
        monitor.update(stream[i % len(stream)])
        times.append(time.thread_time() - frame_began)
    measured("monitor mean", (time.process_time() - began) / frames)
    measured("monitor update", float(np.median(times)), worst=max(times))
    windows = make_windows(reference[:FILLED_FROM], None, layout)
    fault_set = FaultSet(tuple({cell for fault in faults for cell in fault.cells}), layout.n_cells)
    measured("windows", 0.0)
    began = time.process_time()
    large = layout.n_cells > LARGE
    fill = (TiledStatistics.fit(windows, layout) if large else CellStatistics.fit(windows)).nearest(
        fault_set
    )
    measured("fill build", time.process_time() - began)
    held_out = make_windows(log[:1], None, layout).x
    began = time.process_time()
    filled = apply(fill, held_out[..., fault_set.healthy])
    spent = (time.process_time() - began) / (held_out.shape[0] * held_out.shape[1])
    truth, guess = (x.reshape(-1, layout.n_cells)[:, fault_set.mask] for x in (held_out, filled))
    r2 = 1 - float(((truth - guess) ** 2).sum() / ((truth - truth.mean(axis=0)) ** 2).sum())
    measured("fill apply", spent, r2=r2)


def apply(fill, healthy: np.ndarray) -> np.ndarray:
    import torch

    torch.set_num_threads(1)
    with torch.no_grad():
        return fill(torch.from_numpy(np.ascontiguousarray(healthy))).numpy()


def found(log, seen, faults, diagnosis, layout: SensorLayout) -> dict[str, float]:
    """Return precision, recall of the testable cells, and how many of the wires were named."""
    differing = sum(
        (np.abs(a - b) > SHOWN * FULL_SCALE).sum(axis=0) for a, b in zip(log, seen, strict=True)
    )
    testable = set(np.flatnonzero(differing >= ENOUGH).tolist())
    broken = {cell for fault in faults for cell in fault.cells}
    for fault in faults:
        if fault.line and fault.line.kind == "row_address":
            # Which rows read which others cannot be told on a skin that is alike everywhere: either
            # level counts.
            broken |= set(layout.misaddressed(fault.line, 1 - int(fault.value))[0].tolist())
    called = set(diagnosis.fault_set)
    wires = {fault.line for fault in faults if fault.line}
    named = {fault.line for fault in diagnosis.faults if fault.line}
    called |= {
        cell
        for fault in faults
        if fault.line in named and fault.line.kind == "row_address"
        for cell in fault.cells
    }
    return {
        "precision": len(called & broken) / max(len(called), 1),
        "recall": len(called & testable) / max(len(testable), 1),
        "wires": len(wires),
        "named": len(wires & named),
        "invented": len(named - wires),
    }


def results(cells: int, pads: str, limit: float, frames: int) -> Iterator[dict]:
    """Measure one array in a process of its own, and yield what it said before the time was up."""
    command = [
        sys.executable,
        __file__,
        "--measure",
        str(cells),
        "--pads",
        pads,
        "--frames",
        str(frames),
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        out, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        process.kill()
        out, _ = process.communicate()
        print(f"{cells} cells, {pads}: stopped after {limit:.0f} s", file=sys.stderr, flush=True)
    for line in out.splitlines():
        yield {"pads": pads, "cells": shape(cells, pads).n_cells, **json.loads(line)}


def slopes(rows: list[dict], what: str) -> dict[tuple[str, str], float]:
    """Return the log-log slope from 1000 cells on of each kind of array and stage; NaN for fewer
    than two sizes."""
    found = {}
    for pads in sorted({row["pads"] for row in rows}):
        for stage in STAGES:
            points = [
                (r["cells"], r[what]) for r in rows if (r["pads"], r["stage"]) == (pads, stage)
            ]
            large = np.array(
                [p for p in points if p[0] >= 0.97 * SMALLEST and p[1] > 0], float
            ).reshape(-1, 2)
            enough = len(large) >= 2
            found[pads, stage] = (
                float(np.polyfit(*np.log(large).T, 1)[0]) if enough else float("nan")
            )
    return found


def table(rows: list[dict]) -> str:
    """Return all of it as text."""
    lines = [
        f"{'pads':5}{'cells':>8}"
        + "".join(f"{s:>22}" for s in STAGES)
        + "   precision recall wires  fill R2"
    ]
    for pads, cells in dict.fromkeys((r["pads"], r["cells"]) for r in rows):
        of = {r["stage"]: r for r in rows if (r["pads"], r["cells"]) == (pads, cells)}
        text = f"{pads:5}{cells:8d}"
        for stage in STAGES:
            text += (
                f"{of[stage]['cpu']:12.4f} s{of[stage]['peak_mb']:5.0f} MB"
                if stage in of
                else f"{'-':>22}"
            )
        if "diagnose" in of:
            d = of["diagnose"]
            text += (
                f"   {d['precision']:9.3f} {d['recall']:6.3f}"
                f" {d['named']}/{d['wires']}+{d['invented']}"
            )
        lines.append(text + (f"  {of['fill apply']['r2']:.3f}" if "fill apply" in of else ""))
    for what, name in (("cpu", "time"), ("peak_mb", "memory")):
        for (pads, stage), slope in slopes(rows, what).items():
            if np.isnan(slope):
                continue
            lines.append(
                f"slope of {name}, {pads} pad{'s' * (pads == 'many')}, {stage}: {slope:.2f}"
            )
    return "\n".join(lines)


def draw(rows: list[dict], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(13, 4.5), layout="constrained")
    for axis, what, name in zip(
        axes, ("cpu", "peak_mb"), ("CPU seconds", "peak memory, MB"), strict=True
    ):
        for (pads, stage), slope in slopes(rows, what).items():
            points = sorted(
                (r["cells"], r[what]) for r in rows if (r["pads"], r["stage"]) == (pads, stage)
            )
            if points:
                style = {
                    "color": f"C{STAGES.index(stage)}",
                    "linestyle": "-" if pads == "one" else ":",
                }
                axis.loglog(
                    *zip(*points, strict=True),
                    marker=".",
                    label=f"{stage}, {pads}: {slope:.2f}",
                    **style,
                )
        axis.set(xlabel="cells", ylabel=name, title=f"{name} (slope from {SMALLEST} cells on)")
        axis.legend(fontsize=6, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[100])
    parser.add_argument("--pads", nargs="+", choices=("one", "many"), default=["one"])
    parser.add_argument("--limit", type=float, default=1800.0, help="seconds for one array")
    parser.add_argument("--frames", type=int, default=2000, help="of the monitor")
    parser.add_argument("--out", type=Path, default=Path("scale"))
    parser.add_argument("--measure", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        measure(shape(options.measure, options.pads[0]), options.frames)
        return
    rows: list[dict] = []
    for cells in options.sizes:
        for pads in options.pads:
            rows += results(cells, pads, options.limit, options.frames)
            with options.out.with_suffix(".csv").open("w", newline="") as file:
                writer = csv.DictWriter(
                    file, list(dict.fromkeys(key for row in rows for key in row))
                )
                writer.writeheader()
                writer.writerows(rows)
    print(table(rows))
    draw(rows, options.out.with_suffix(".png"))


if __name__ == "__main__":
    main()
