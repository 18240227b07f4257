"""How fast and how honest ``Restorer`` is.

    python examples/restore_speed.py [--grasps 6] [--repeats 500]

On simulated grasps, for arrays of 220 and of 2,048 cells with 10 % and 50 % of the cells dead, one
thread:
    first      milliseconds of the first frame with a new F, a linear solve
    further    milliseconds of each further frame, median
    R2         of the restored cells, least of any pad, over new recordings
    worse      share of the recordings, of each pad, in which the squared error exceeds
               that of the mean of each cell
    within     share of the errors below two deviations, 0.95 if they were Gaussian
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from threadpoolctl import threadpool_limits

import adaptfault as af
from diagnostics import FaultSet, SensorLayout

LAYOUTS = (SensorLayout(2, 11, 10), SensorLayout(8, 16, 16))


def measure(layout: SensorLayout, share: float, grasps: int, repeats: int) -> list[float]:
    healthy, new = (af.simulate(grasps, layout, seed=seed).frames for seed in (0, 1))
    restorer = af.Restorer(layout).fit(healthy)
    faults = np.random.default_rng(0).permutation(layout.n_cells)[: round(share * layout.n_cells)]
    fault_set = FaultSet(tuple(faults.tolist()), layout.n_cells)
    seconds = []
    for i in range(repeats + 1):
        frame = new[0][i % len(new[0])]
        began = time.perf_counter()
        restorer.update(frame, fault_set)
        seconds.append(time.perf_counter() - began)

    pads = np.arange(layout.n_cells) // (layout.rows * layout.cols)
    errors = []
    spreads = []
    within = []
    for frames in new:
        restored, deviation = restorer.transform(frames, fault_set, return_std=True)
        error = (restored - frames) ** 2
        spread = (frames - restorer.mean_) ** 2
        of_pads = [fault_set.mask & (pads == pad) for pad in range(layout.pads)]
        errors.append([error[:, of].sum() for of in of_pads])
        spreads.append([spread[:, of].sum() for of in of_pads])
        within.append((error <= (2 * deviation) ** 2)[:, fault_set.mask].mean())
    error = np.array(errors)
    spread = np.array(spreads)
    r2 = 1 - error.sum(0) / spread.sum(0)
    return [
        1e3 * seconds[0],
        1e3 * float(np.median(seconds[1:])),
        r2.min(),
        (error > spread).mean(),
        np.mean(within),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grasps", type=int, default=2, help="recordings of each of 7 classes")
    parser.add_argument("--repeats", type=int, default=100, help="frames that are timed")
    args = parser.parse_args()
    print(
        f"{'cells, dead':16s}{'first, ms':>12s}{'further, ms':>12s}"
        f"{'R2':>8s}{'worse':>8s}{'within':>8s}"
    )
    with threadpool_limits(1):
        for layout in LAYOUTS:
            for share in (0.1, 0.5):
                row = measure(layout, share, args.grasps, args.repeats)
                name = f"{layout.n_cells:,}, {round(share * layout.n_cells):,}"
                print(
                    f"{name:16s}{row[0]:12.1f}{row[1]:12.3f}"
                    + "".join(f"{value:8.3f}" for value in row[2:])
                )


if __name__ == "__main__":
    main()
