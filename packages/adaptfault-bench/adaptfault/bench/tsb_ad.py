"""Writes the logs of a bench as files of TSB-AD, the benchmark of anomalies in time series."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adaptfault.bench.folder import Bench
from adaptfault.data.atomic import atomic_file, make_folder


def export(bench: Bench, truth_path: Path, folder: Path) -> list[Path]:
    """Write the logs with faults as files of TSB-AD-M, and return these.

    A file has the healthy reference first (``tr`` in its name counts its frames), then the log: a
    column a cell, and ``Label``, 1 in frames in which a faulty cell reads otherwise than it would
    by more than 5 % of full scale. ``1st`` is the first of them. Logs without one are left out.
    """
    truth = bench.truth(truth_path)
    make_folder(folder)
    written: list[Path] = []
    for name, told in truth["logs"].items():
        if "1" not in told["shows"]:
            continue
        about = bench.manifest["logs"][name]
        healthy = np.concatenate(bench.recordings(about["healthy"]).frames)
        log = np.concatenate(bench.recordings(about["file"]).frames)
        label = np.concatenate([np.zeros(len(healthy), int), np.array(list(told["shows"]), int)])
        number = len(written) + 1
        path = folder / (
            f"{number:03d}_Adaptfault_id_{number}_Sensor_tr_{len(healthy)}_1st_{label.argmax()}.csv"
        )
        columns = [*map(str, range(log.shape[1])), "Label"]
        whole = np.column_stack([np.concatenate([healthy, log]), label])
        with atomic_file(path) as file:
            np.savetxt(file, whole, "%d", ",", header=",".join(columns), comments="")
        written.append(path)
    return written
