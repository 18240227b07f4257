"""What the steps of one maintenance run work with: read where it is first needed, and changed by
none of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.checksummed_json import Damaged
from adaptfault.bundle.known_faults import KnownFaults
from adaptfault.bundle.versions import Version
from adaptfault.data.windows import recordings_of
from adaptfault.evaluation.scores import chance
from adaptfault.robot.model_comparison import measure_of, score
from diagnostics import FaultSet, Scan, SelfDiagnosis, SensorLayout

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter
    from adaptfault.adaptation.result import Adaptation
    from adaptfault.data.windows import Windows


@dataclass(frozen=True)
class MaintenanceRun:
    """One maintenance run.

    Attributes:
        robot: what the bundle holds.
        version: that runs.
        known: the known faults before this run.
        dry_run: nothing is changed.
        budget: seconds that an adaptation may take; None: no limit.
        sign: PEM file of the key that signs what is deployed; None: it is not signed.
        say: receives one line of progress before each long step.
        warnings: damage found in the bundle.
        left_out: recordings, or readings of them, that are not used, with the reason.
        scan: of the read-out, in the time of the recordings; None: there is none.
    """

    robot: Robot
    version: Version
    known: KnownFaults
    dry_run: bool
    budget: float | None
    sign: str | PathLike[str] | None
    say: Callable[[str], None]
    warnings: tuple[str, ...]
    left_out: tuple[str, ...]
    scan: Scan | None = None


class Robot:
    """The bundle of a robot and its parts, each read once."""

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle

    @property
    def layout(self) -> SensorLayout:
        """The array."""
        return self.bundle.layout

    @cached_property
    def diagnoser(self) -> SelfDiagnosis:
        """The fitted diagnosis."""
        return self.bundle.diagnoser()

    @cached_property
    def adapter(self) -> Adapter:
        """The adapter, with the fault-free model and windows."""
        return self.bundle.parts.adapter()

    @cached_property
    def healthy(self) -> list[NDArray[np.float64]]:
        """The healthy recordings, ``[T, D]`` each."""
        return recordings_of(self.adapter.train, self.layout)

    @cached_property
    def windows(self) -> Windows:
        """Held-out fault-free windows, on which models are compared."""
        return self.bundle.parts.check_windows()

    @cached_property
    def chance(self) -> tuple[float, float]:
        """Accuracy of always naming the most frequent class, and what guessing may reach by chance;
        of values, R2 of always naming their mean."""
        return (0.0, 0.0) if self.windows.y.ndim == 2 else chance(self.windows.y)

    @property
    def measure(self) -> str:
        """What models are compared by: "accuracy" or "R2"."""
        return measure_of(self.windows)

    @cached_property
    def present(self) -> FaultSet:
        """Every cell that exists."""
        cells = np.flatnonzero(self.layout.present).tolist()
        return FaultSet(tuple(cells), self.layout.n_cells)

    @cached_property
    def fault_free_accuracy(self) -> float:
        """Accuracy or R2 of version 1, the model of the healthy sensor, on the windows without
        faults."""
        try:
            model = self.model(self.bundle.versions[1])
        except (Damaged, FileNotFoundError):
            model = None
        if model is None:  # the fault-free model with its own head
            none = FaultSet((), self.layout.n_cells)
            model = self.adapter.adapt(none, method="fill")
        return score(model.predict, self.windows)

    def model(self, version: Version) -> Adaptation:
        """Return the model of a version; raises Damaged."""
        from adaptfault.adaptation.result import Adaptation

        return Adaptation.load(version.files)

    def class_name(self, number: int) -> str:
        """Return the name of a class or a value, or its number."""
        names = self.bundle.class_names
        kind = "value" if self.windows.y.ndim == 2 else "class"
        return names[number] if names else f"{kind} {number}"
