"""Fits the calibration of a cold start: python benchmarks/cold_calibration.py [--logs N] [--arrays
NAME ...]

Logs of simulated grasps and postures are diagnosed without a reference, healthy ones and ones with
4 to 16 % of the cells dead. For the cells that never moved and rest, and of which an event tells
anything, a logistic regression with balanced classes is fitted,

    log odds = a + surprisal + temporal

a near ``diagnostics.decision.calibration.OFFSET[0, 0]`` means that a cold start is calibrated. Each
kind of array counts alike.
"""

from __future__ import annotations

import argparse

import numpy as np
from arrays import ARRAYS
from rows import Bench, draw_faults, kind_of_cells
from scipy.optimize import minimize

from adaptfault.bench.changes import STUCK_KINDS, broken
from diagnostics import SelfDiagnosis

SIMULATED = ("grasps, 1 x 12 x 12", "grasps, 2 x 11 x 10", "posture, seat", "posture, rests at 5 %")
SHARES = (0.04, 0.08, 0.16, 0.16)
CLIP = 5.0  # temporal log ratios beyond do not steer the fit


def cells_at_rest(bench: Bench) -> np.ndarray:
    """Return surprisal, temporal log ratio, and whether it is dead, of each such cell,
    ``[n, 3]``."""
    diagnoser = SelfDiagnosis(bench.layout)
    found = []
    for seed, log, rng in bench.logs():
        faults = draw_faults(bench.layout, SHARES[seed % len(SHARES)], STUCK_KINDS, rng)
        for given, dead in (
            (list(broken(log, faults, bench.layout, 0.0, 0.0, seed)), faults),
            (log, []),
        ):
            stream = diagnoser.stream()
            for frames in given:
                stream.extend(frames)
            stream = stream.complete()
            spatial = stream.cold.spatial(stream)
            still = stream.present & stream.rests() & spatial.scored & ~stream.runs.moved
            cells = np.flatnonzero(still & (spatial.surprisal > 0))
            found.append(
                np.stack(
                    [
                        spatial.surprisal[cells],
                        stream.cold.temporal(stream)[cells],
                        np.isin(cells, list(kind_of_cells(dead))),
                    ],
                    1,
                )
            )
    return np.concatenate(found)


def fit(cells: list[np.ndarray]) -> float:
    """Return a; each array, and in it the dead and the healthy cells, count alike."""
    weight = np.concatenate(
        [np.where(c[:, 2] > 0, 1 / c[:, 2].sum(), 1 / (1 - c[:, 2]).sum()) for c in cells]
    )
    surprisal, temporal, dead = np.concatenate(cells).T

    def loss(weights: np.ndarray) -> float:
        odds = weights[0] + surprisal + np.clip(temporal, -CLIP, CLIP)
        return float(weight @ (np.logaddexp(0, odds) - dead * odds))

    return float(minimize(loss, [0.0]).x[0])


def show(name: str, cells: list[np.ndarray]) -> None:
    print(f"{name:28}{sum(map(len, cells)):7} cells: a = {fit(cells):.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Fits the calibration of a cold start")
    parser.add_argument("--logs", type=int, default=24, help="of each array and split (default 24)")
    parser.add_argument(
        "--arrays", nargs="+", default=SIMULATED, metavar="NAME", help="default: simulated ones"
    )
    options = parser.parse_args()
    every = []
    for array in ARRAYS:
        if array.name in options.arrays:
            cells = np.concatenate(
                [cells_at_rest(array.bench(split, 0, options.logs)) for split in (0, 1)]
            )
            every.append(cells)
            show(array.name, [cells])
    show("all", every)


if __name__ == "__main__":
    main()
