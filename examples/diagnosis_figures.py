"""How well faults are found, on simulated grasps or your own: python examples/diagnosis_figures.py [RECORDINGS [LOGS]]

Half of the recordings teach what healthy looks like. Logs of six recordings from the other half get random dead cells
(open, short, or stuck at any value, a third each). A dead cell is testable if what it hides differs from what it reads
by over 5 % of full scale in at least 10 frames of the log.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator

import numpy as np

from adaptfault.grasps import simulate
from adaptfault.recordings import Recordings, load
from diagnostics import Fault, FaultKind, SelfDiagnosis, SensorLayout, inject

CASES = {
    "16 % of the cells dead": {"share": 0.16},
    "the same, from 60 % of the log on": {"share": 0.16, "onset": 0.6},
    "2 % dead": {"share": 0.02},
    "40 % dead": {"share": 0.4},
    "stuck in mid-range, dither 0.4 %": {"share": 0.16, "kinds": ("stuck",), "dither": 0.004},
    "healthy": {"share": 0.0},
}


def draw_faults(layout: SensorLayout, share: float, kinds: tuple[str, ...], rng: np.random.Generator) -> list[Fault]:
    present = np.flatnonzero(layout.present)
    cells = rng.choice(present, round(share * len(present)), replace=False)
    return [
        Fault(kind, (int(cell),), value=rng.uniform(0.1, 0.9) * layout.full_scale if kind == "stuck" else None)
        for cell, kind in zip(cells, rng.choice([FaultKind(k) for k in kinds], len(cells)), strict=True)
    ]


def broken(log: list[np.ndarray], faults: list[Fault], layout: SensorLayout, onset: float, dither: float, seed: int):
    """Yield the recordings of a log that breaks when a share ``onset`` of its frames is over."""
    start = round(onset * sum(map(len, log)))
    for i, frames in enumerate(log):
        here = [Fault(f.kind, f.cells, value=f.value, onset=max(0, start)) for f in faults]
        yield inject(frames, here, layout, seed=1000 * seed + i, dither=dither)
        start -= len(frames)


def logs(
    recordings: Recordings, which: np.ndarray, count: int
) -> Iterator[tuple[list[np.ndarray], np.random.Generator]]:
    for seed in range(count):
        rng = np.random.default_rng(seed)
        yield [recordings.frames[i] for i in rng.choice(which, min(6, len(which)), replace=False)], rng


def main(path: str | None = None, count: int = 4) -> None:
    recordings = load(path).recordings if path else simulate(20, seed=3)
    layout = recordings.layout
    order = np.random.default_rng(0).permutation(len(recordings))
    reference, rest = order[: len(order) // 2], order[len(order) // 2 :]
    began = time.perf_counter()
    fitted = SelfDiagnosis(layout).fit([recordings.frames[i] for i in reference])
    print(
        f"{len(recordings)} recordings of {layout}; fitted in {time.perf_counter() - began:.1f} s; {count} logs a case"
    )
    for name, case in CASES.items():
        true = false = testable = hit = right_kind = cell_frames = 0
        seconds = 0.0
        for seed, (log, rng) in enumerate(logs(recordings, rest, count)):
            faults = draw_faults(layout, case["share"], case.get("kinds", ("open", "short", "stuck")), rng)
            seen = list(broken(log, faults, layout, case.get("onset", 0.0), case.get("dither", 0.0), seed))
            began = time.perf_counter()
            diagnosis = fitted.diagnose(seen)
            seconds += time.perf_counter() - began
            cell_frames += sum(frames.size for frames in seen)
            hidden = np.abs(np.concatenate(seen) - np.concatenate(log)) > 0.05 * layout.full_scale
            can = set(np.flatnonzero(hidden.sum(axis=0) >= 10).tolist())
            kinds = {cell: fault.kind for fault in faults for cell in fault.cells}
            found = diagnosis.fault_set
            true, false = true + len(found & kinds.keys()), false + len(found - kinds.keys())
            testable, hit = testable + len(can), hit + len(found & can)
            right_kind += sum(kinds.get(cell) == fault.kind for fault in diagnosis.faults for cell in fault.cells)
        figures = f"{false} false of {true + false} found"
        if true:
            figures += f", precision {true / (true + false):.3f}, recall of testable {hit / testable:.3f}"
            figures += f", kind right {right_kind / true:.3f}"
        print(f"{name:34s} {figures}; {cell_frames / seconds / 1e6:.2f} million cell-frames/s")


if __name__ == "__main__":
    main(*sys.argv[1:2], *map(int, sys.argv[2:3]))
