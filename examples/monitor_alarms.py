"""What the monitor for the microcontroller tells of recordings that it has not learned from: of
healthy ones, with dead cells, and with cut rows.

    python examples/monitor_alarms.py [RECORDINGS] [--logs 8] [--small]

Every second recording is the reference, the others are the log, and then the other way round. 4 %
of the cells are dead from the first frame on: open, shorted, or stuck at 10 to 90 % of full scale.
Without recordings it takes simulated grasps.
"""

import argparse

import numpy as np

from adaptfault import load, simulate
from adaptfault.firmware import CountingMonitor, Limits, learn_limits
from diagnostics import Fault, SelfDiagnosis, SensorLayout, inject

DEAD = 0.04
ROWS = 12  # at most


def told(limits: Limits, frames: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the cells that are told at any time, bool ``[D]``, and in how many frames the stream
    is told as frozen."""
    monitor = CountingMonitor(limits)
    found = np.zeros(frames.shape[1], bool)
    frozen = 0
    for frame in limits.counts(frames):
        monitor.update(frame)
        found |= monitor.states > 0
        frozen += monitor.frozen
    return found, frozen


def dead_cells(layout: SensorLayout, rng: np.random.Generator) -> list[Fault]:
    cells = np.flatnonzero(layout.present.ravel())
    chosen = rng.choice(cells, max(1, int(DEAD * len(cells))), replace=False)
    faults = []
    for cell, kind in zip(chosen, rng.choice(["open", "short", "stuck"], len(chosen)), strict=True):
        value = rng.uniform(0.1, 0.9) * layout.full_scale if kind == "stuck" else None
        faults.append(Fault(str(kind), [cell], value=value))
    return faults


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", nargs="?", help="default: simulated grasps")
    parser.add_argument("--logs", type=int, default=8, help="with dead cells, of each half")
    parser.add_argument("--small", action="store_true", help="one log of one half")
    args = parser.parse_args()
    if args.recordings is None:
        recordings = simulate(2 if args.small else 8, seed=0)
    else:
        recordings = load(args.recordings).recordings
    layout = recordings.layout
    for half in range(1 if args.small else 2):
        reference = recordings.frames[half::2]
        log = np.concatenate(recordings.frames[1 - half :: 2]).astype(float)
        limits = learn_limits(SelfDiagnosis(layout).fit(reference), reference)
        judged = limits.stuck_after > 0
        healthy, frozen = told(limits, log)
        print(
            f"half {half}: {len(log)} healthy frames: {healthy.sum()} cells told, {frozen} frames"
            f" frozen; {judged.sum()} of {layout.present.sum()} cells can be told stuck"
        )
        count = np.zeros(3, int)
        rng = np.random.default_rng(half)
        for seed in range(1 if args.small else args.logs):
            faults = dead_cells(layout, rng)
            dead = np.isin(np.arange(layout.n_cells), [c for one in faults for c in one.cells])
            found, _ = told(limits, inject(log, faults, layout, seed=seed))
            count += [dead.sum(), (found & dead).sum(), (found & ~dead).sum()]
        print(f"    dead cells: {count[1]} of {count[0]} found, {count[2]} others told")
        rows = [line for line in layout.lines if line.kind == "row"]
        count[:] = 0
        for line in rows[: 1 if args.small else ROWS]:
            cells = layout.cells_on(line)
            cut = np.isin(np.arange(layout.n_cells), cells) & judged
            found, _ = told(limits, inject(log, [Fault("open", cells, line=line)], layout))
            count += [cut.sum(), (found & cut).sum(), (found & ~cut).sum()]
        print(f"    cut rows: {count[1]} of {count[0]} cells found, {count[2]} others told")


if __name__ == "__main__":
    main()
