"""Do the simulated grasps look like a real array? Usage: python examples/simulated_vs_real.py
[RECORDINGS.npz]

The file holds ``frames`` [n, T, pads, rows, cols] (or [n, T, D]) and, where it has them,
``lengths`` [n] of zero-padded recordings, ``factory_mask`` or ``present`` (False: no cell there)
and ``full_scale`` (default: the converter's 4095).
"""

from __future__ import annotations

import sys
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from adaptfault.data.simulated_grasps import simulate


def statistics(
    recordings: Iterable[NDArray], present: NDArray[np.bool_], full_scale: float
) -> dict[str, float]:
    """Return what decides how well dead cells can be found and filled, of recordings ``[T, D]``.

    A cell counts as active where it is touched in at least 1 % of the frames of either half. Its R2
    is that of a ridge regression on all other cells, fitted on every second recording and scored on
    the rest.
    """
    recordings = [np.asarray(r, np.float32)[:, present.ravel()] / full_scale for r in recordings]
    train = np.concatenate(recordings[::2])
    test = np.concatenate(recordings[1::2])
    active = np.minimum((train > 0).mean(0), (test > 0).mean(0)) >= 0.01
    train = train[:, active]
    test = test[:, active]
    mean = train.mean(0)
    covariance = np.cov(train.T, dtype=np.float64)
    ridge = 1e-4 * covariance.diagonal().mean() * np.eye(len(covariance))
    precision = cho_solve(cho_factor(covariance + ridge), np.eye(len(covariance)))
    # the error of regressing a cell on all others is its row of the precision, over the diagonal
    errors = (test - mean) @ precision / precision.diagonal()
    r2 = 1 - (errors**2).mean(0) / test.var(0)
    everything = np.cov(np.concatenate([train, test]).T, dtype=np.float64)
    explained = np.cumsum(np.linalg.eigvalsh(everything)[::-1])
    explained /= explained[-1]
    loaded = np.concatenate([r.ravel() for r in recordings])
    return {
        "active cells": int(active.sum()),
        "readings exactly 0": float((loaded == 0).mean()),
        "readings over 40 % of full scale": float((loaded > 0.4).mean()),
        "cells still through a recording": float(
            np.mean([(np.ptp(r, axis=0) == 0).mean() for r in recordings])
        ),
        "R2 from the other cells, median": float(np.median(r2)),
        "R2 from the other cells, worst tenth": float(np.quantile(r2, 0.1)),
        **{
            f"components for {s:.1%} of the variance": int((explained < s).sum()) + 1
            for s in (0.9, 0.99, 0.999)
        },
    }


def load(path: str) -> tuple[list[NDArray], NDArray[np.bool_], float]:
    """Return recordings ``[T, D]``, which positions are cells, and the full scale of a file."""
    with np.load(path) as file:
        data = {name: file[name] for name in file.files}
    frames = data["frames"].reshape(*data["frames"].shape[:2], -1)
    present = data.get("present", data.get("factory_mask", np.ones(frames.shape[2], bool)))
    lengths = data.get("lengths", np.full(len(frames), frames.shape[1]))
    recordings = [f[:length] for f, length in zip(frames, lengths, strict=True)]
    return recordings, np.asarray(present, bool), float(data.get("full_scale", 4095))


def main(arguments: list[str]) -> None:
    grasps = simulate(60)
    columns = {"simulated": statistics(grasps, grasps.layout.present, grasps.layout.full_scale)}
    for path in arguments[:1]:
        columns["real"] = statistics(*load(path))
    print(f"{'':40}" + "".join(f"{name:>12}" for name in columns))
    for row in columns["simulated"]:
        print(f"{row:40}" + "".join(f"{column[row]:12.4g}" for column in columns.values()))


if __name__ == "__main__":
    main(sys.argv[1:])
