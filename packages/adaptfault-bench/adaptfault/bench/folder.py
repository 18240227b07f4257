"""The folder of a bench: recordings without the truth, and a manifest with the hash of every file.

The truth is one file elsewhere, named by its SHA-256, which the manifest states. The same seed
gives the same files on one machine; on another kind of CPU one reading in 100,000 may be another
count, as sums of floating point differ: hand over the folder, not the seed.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from adaptfault.bench.changes import STUCK_KINDS, fault_sets, faults_of
from adaptfault.bench.logs import KINDS, SENSORS, counts, made_log, record
from adaptfault.data.atomic import atomic_write, make_folder
from adaptfault.data.recordings import Recordings, load, save_npz
from diagnostics import inject

SCHEMA = "adaptfault.bench/1"
MANIFEST = "manifest.json"
WINDOW = 10  # frames of a grasp to classify
Json = dict[str, Any]


@dataclass(frozen=True)
class Size:
    """How large a bench is: logs of a kind, recordings of a class for logs, for training and for
    tests."""

    sensors: tuple[str, ...] = tuple(SENSORS)
    logs: int = 4
    grasps: int = 24
    training: int = 40
    test: int = 20


SMALL = Size(("finger, rest wanders", "skin, noise and gains"), 1, 8, 4, 2)


def make(folder: Path, truth_folder: Path, seed: int = 0, size: Size = Size()) -> Path:
    """Write a bench; return the file of its truth, which is named by its SHA-256.

    Raises:
        ValueError: the folder holds files.
    """
    if folder.exists() and any(folder.iterdir()):
        raise ValueError(f"{folder} holds files; choose a new folder")
    make_folder(folder)
    make_folder(truth_folder)
    rng = np.random.default_rng(seed)
    manifest: Json = {"schema": SCHEMA, "logs": {}, "repairs": {}}
    truth: Json = {"logs": {}, "repairs": {}}
    for number, sensor in enumerate(size.sensors):
        names = {"sensor": sensor, "healthy": f"reference-{number}.npz"}
        add_logs(folder, names, size, seed, rng, manifest["logs"], truth["logs"])
        names = {"sensor": sensor, "healthy": f"train-{number}.npz"}
        add_repairs(folder, names, size, seed, rng, manifest["repairs"], truth["repairs"])
    data = json.dumps(truth).encode()
    manifest["files"] = {file.name: digest(file) for file in sorted(folder.iterdir())}
    manifest["truth"] = sha256(data).hexdigest()
    path = truth_folder / f"{manifest['truth']}.json"
    atomic_write(path, data)
    atomic_write(folder / MANIFEST, json.dumps(manifest, indent=1).encode())
    return path


def add_logs(
    folder: Path,
    names: dict[str, str],
    size: Size,
    seed: int,
    rng: np.random.Generator,
    logs: Json,
    truth: Json,
) -> None:
    """Write the reference and the logs of a sensor, in an order that tells nothing."""
    recorded = record(names["sensor"], size.grasps, 60, seed)
    layout = recorded.layout
    order = rng.permutation(len(recorded))
    save_npz(folder / names["healthy"], recorded.select(order[::2]))
    pool = [recorded.frames[i].astype(np.float64) for i in order[1::2]]
    variants = list(product(KINDS, range(size.logs)))
    for i in rng.permutation(len(variants)).tolist():
        kind, variant = variants[i]
        if kind == "wires" and layout.wiring == "bus":
            continue
        name = f"log-{len(logs):03d}"
        read, truth[name] = made_log(kind, variant, layout, pool, rng)
        save_npz(folder / f"{name}.npz", counts(read, layout))
        logs[name] = names | {"file": f"{name}.npz", "cells": int(layout.present.sum())}


def add_repairs(
    folder: Path,
    names: dict[str, str],
    size: Size,
    seed: int,
    rng: np.random.Generator,
    repairs: Json,
    truth: Json,
) -> None:
    """Write windows to learn from, and windows with dead cells, in an order that tells nothing."""
    of_class = size.training + size.test
    grasps = record(names["sensor"], of_class, WINDOW, seed + 1)
    layout = grasps.layout
    in_test = np.arange(len(grasps)) % of_class >= size.training
    save_npz(folder / names["healthy"], grasps.select(np.flatnonzero(~in_test)))
    test = grasps.select(rng.permutation(np.flatnonzero(in_test)))
    labels = np.array(test.labels).tolist()
    for case, dead in fault_sets(layout, seed).items():
        name = f"repair-{len(repairs):02d}"
        faults = faults_of(np.array(list(dead), int), STUCK_KINDS, layout, rng)
        read = [inject(frames, faults, layout) for frames in test.frames]
        save_npz(folder / f"{name}.npz", counts(read, layout))
        repairs[name] = names | {"file": f"{name}.npz", "case": case, "faults": list(dead)}
        truth[name] = {"case": case, "y": labels}


def digest(file: Path) -> str:
    """Return the SHA-256 of a file."""
    return sha256(file.read_bytes()).hexdigest()


@dataclass(frozen=True)
class Bench:
    """A folder that :func:`make` wrote."""

    folder: Path

    @cached_property
    def identity(self) -> str:
        """The SHA-256 of the manifest, which names the bench."""
        return digest(self.folder / MANIFEST)

    @cached_property
    def manifest(self) -> Json:
        """Logs, tasks of repair, and the hash of each file and of the truth."""
        return read_json(self.folder / MANIFEST, SCHEMA, "make the bench again")

    def check(self) -> None:
        """Compare each file with the manifest.

        Raises:
            ValueError: a file is missing or was changed.
        """
        for name, expected in self.manifest["files"].items():
            path = self.folder / name
            if not path.exists():
                raise ValueError(f"{path} is missing; get the whole folder again")
            if (found := digest(path)) != expected:
                raise ValueError(
                    f"{path} was changed: its SHA-256 is {found[:12]}..., the manifest says"
                    f" {expected[:12]}...; get the folder again"
                )

    def truth(self, path: Path) -> Json:
        """Return the truth.

        Raises:
            ValueError: it is not that of this bench.
        """
        data = path.read_bytes()
        if (found := sha256(data).hexdigest()) != self.manifest["truth"]:
            raise ValueError(
                f"{path}: its SHA-256 is {found[:12]}..., the truth of {self.folder} has"
                f" {self.manifest['truth'][:12]}...; give the file of that name"
            )
        truth: Json = json.loads(data)
        return truth

    def recordings(self, name: str) -> Recordings:
        """Return the recordings of a file."""
        return load(self.folder / name).recordings


def read_json(path: Path, schema: str, mend: str) -> Json:
    """Return a JSON object of a schema.

    Raises:
        ValueError: it is none; ``mend``: what to do then.
    """
    try:
        found = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        what = f"expected JSON, but it is cut off or damaged ({error})"
        raise ValueError(f"{path}: {what}; {mend}") from None
    if not isinstance(found, dict) or found.get("schema") != schema:
        came = found.get("schema") if isinstance(found, dict) else type(found).__name__
        raise ValueError(f"{path}: expected schema {schema}, got {came}; {mend}")
    return found
