"""What a robot recorded, read as its bundle says: in the layout's unit, or raw through the bundle's calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import Problem
from adaptfault.data.recordings.load import load
from adaptfault.robot.bundle import Bundle


@dataclass(frozen=True, eq=False)
class Incoming:
    """Recordings for :func:`adaptfault.maintain`.

    Attributes:
        frames: ``[T, D]`` each, in the layout's unit.
        names: one a recording.
        problems: what was left out or is odd.
    """

    frames: tuple[NDArray[np.float32], ...]
    names: tuple[str, ...]
    problems: tuple[Problem, ...]


def load_incoming(bundle: Bundle, paths: Sequence[str | PathLike[str]]) -> Incoming:
    """Read files and folders of recordings for a bundle.

    What ``adaptfault listen`` recorded lies beside a ``layout.json`` and is in its unit already; all else is raw, and
    goes through the bundle's calibration where it has one.

    Raises:
        InputError: a path does not exist, or nothing could be read.
        Damaged: the calibration is not what was written.
    """
    given = [Path(path) for path in paths]
    ready = [p for p in given if ((p if p.is_dir() else p.parent) / "layout.json").exists()]
    raw = [p for p in given if p not in ready]
    parts = [
        load(p, layout=bundle.layout, calibration=t) for p, t in ((ready, None), (raw, bundle.parts.calibration)) if p
    ]
    return Incoming(
        tuple(frames for part in parts for frames in part.recordings.frames),
        tuple(name for part in parts for name in part.recordings.names),
        tuple(problem for part in parts for problem in part.problems),
    )
