"""Keeps the fit of a diagnosis beside the recordings that it was fitted to.

A fit is found again by a hash of the readings, the array, and the source of ``diagnostics``: other
readings or another version are fitted anew. A damaged file, or a folder that cannot be written, is
as none.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import diagnostics
from diagnostics import SelfDiagnosis, SensorLayout

FOLDER = ".adaptfault"
"""Hidden folder in that of the recordings; readers pass over it."""

_KEPT = 4  # latest fits that stay


class FitCache:
    """The fits beside some recordings.

    Args:
        beside: the first path of the recordings, a file or a folder.
        recordings: their readings, ``[T, D]`` each.
        layout: the array.
    """

    def __init__(
        self, beside: Path, recordings: Iterable[NDArray[Any]], layout: SensorLayout
    ) -> None:
        self.folder = (beside if beside.is_dir() else beside.parent) / FOLDER
        self.path = self.folder / f"fit-{_key(recordings, layout)}.npz"

    def load(self) -> SelfDiagnosis | None:
        """Return the fit; None where there is none."""
        with suppress(OSError, ValueError):
            return SelfDiagnosis.load(self.path)
        return None

    def save(self, fitted: SelfDiagnosis) -> None:
        """Keep a fit; where the folder cannot be written, nothing happens."""
        with suppress(OSError):
            self.folder.mkdir(exist_ok=True)
            fitted.save(self.path)
            for old in sorted(self.folder.glob("fit-*.npz"), key=_age)[:-_KEPT]:
                old.unlink(missing_ok=True)


def _age(path: Path) -> float:
    return path.stat().st_mtime


def _key(recordings: Iterable[NDArray[Any]], layout: SensorLayout) -> str:
    found = hashlib.sha256(_source())
    found.update(json.dumps(layout.to_dict(), sort_keys=True).encode())
    for frames in recordings:
        found.update(str(frames.shape).encode())
        found.update(np.ascontiguousarray(frames).tobytes())
    return found.hexdigest()[:32]


@cache
def _source() -> bytes:
    """Return a hash of the source of ``diagnostics``."""
    found = hashlib.sha256()
    for path in sorted(Path(diagnostics.__file__).parent.rglob("*.py")):
        found.update(path.read_bytes())
    return found.digest()
