"""Reads new recordings for a bundle: in the layout's unit, or raw counts through the bundle's
calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptfault.bundle.bundle import Bundle
from adaptfault.data.recordings.errors import Problem
from adaptfault.data.recordings.load import load
from diagnostics import Scan


@dataclass(frozen=True, eq=False)
class NewRecordings:
    """Recordings for :func:`adaptfault.maintain`.

    Attributes:
        frames: ``[T, D]`` each, in the layout's unit.
        names: one a recording.
        problems: recordings that were left out, and warnings.
        scan: of the read-out, of all recordings together; None: there is none.
    """

    frames: tuple[NDArray[np.float32], ...]
    names: tuple[str, ...]
    problems: tuple[Problem, ...]
    scan: Scan | None = None


def load_new_recordings(bundle: Bundle, paths: Sequence[str | PathLike[str]]) -> NewRecordings:
    """Read files and folders of recordings for a bundle.

    Recordings of ``adaptfault listen`` lie beside a ``layout.json`` and are in its unit. All others
    are raw and are converted with the bundle's calibration where it has one. What
    ``adaptfault diagnose`` refuses for the bundle is refused: another shape, rate or scale.

    Raises:
        InputError: a path does not exist, or nothing could be read.
        Damaged: the calibration fails its checksum.
    """
    given = [Path(path) for path in paths]
    ready = [p for p in given if ((p if p.is_dir() else p.parent) / "layout.json").exists()]
    raw = [p for p in given if p not in ready]
    parts = [
        load(p, layout=bundle.layout, calibration=t, strict=True)
        for p, t in ((ready, None), (raw, bundle.parts.calibration))
        if p
    ]
    return NewRecordings(
        tuple(frames for part in parts for frames in part.recordings.frames),
        tuple(name for part in parts for name in part.recordings.names),
        tuple(problem for part in parts for problem in part.problems),
        _joined([part.recordings.scan for part in parts if part.recordings.scan is not None]),
    )


def _joined(scans: Sequence[Scan]) -> Scan | None:
    """Return the frames of several scans of one array as one; None: there is none."""
    if not scans:
        return None
    levels = np.concatenate([scan.levels for scan in scans])
    return replace(scans[0], levels=levels, readings=np.concatenate([s.readings for s in scans]))
