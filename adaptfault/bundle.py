"""The one folder that a robot carries: what the predictor needs of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from diagnostics import FaultSet, SelfDiagnosis, SensorLayout


@dataclass(frozen=True)
class Version:
    """One adaptation in a bundle."""

    number: int
    folder: Path
    fault_set: FaultSet
    length: int


class Bundle:
    """A bundle on disk."""

    layout: SensorLayout
    class_names: tuple[str, ...]
    pointer: Path

    @classmethod
    def open(cls, path: str | Path) -> Bundle:
        """Open a bundle."""
        raise NotImplementedError

    def active(self) -> Version:
        """Return the version that is deployed."""
        raise NotImplementedError

    def begin(self) -> Version:
        """Return the version to start with, and count the start while it is on probation."""
        raise NotImplementedError

    def confirm(self) -> None:
        """Confirm that the active version works."""
        raise NotImplementedError

    def diagnoser(self) -> SelfDiagnosis:
        """Return the fitted diagnosis."""
        raise NotImplementedError
