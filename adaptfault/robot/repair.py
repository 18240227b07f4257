"""Repair: the models that could run instead of the running one, the best guess first."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from adaptfault.bundle.checksummed_json import Damaged
from adaptfault.bundle.versions import Version
from adaptfault.robot.maintenance_run import MaintenanceRun
from diagnostics import FaultSet

if TYPE_CHECKING:
    from adaptfault.adaptation.result import Adaptation


@dataclass(frozen=True)
class Candidate:
    """A model that could run.

    Attributes:
        model: which does without the faulty cells.
        stored: version that holds it already; None: it is new.
    """

    model: Adaptation
    stored: Version | None = None

    @property
    def stages(self) -> tuple[str, ...]:
        """Cost and result of each adaptation stage, as text."""
        return () if self.stored is not None else tuple(str(stage) for stage in self.model.stages)


def repair(run: MaintenanceRun, faulty: FaultSet) -> Iterator[Candidate]:
    """Yield models for a fault set; the caller takes the first in which no class collapses.

    Where cells recovered that the running version does without, that is the latest version which
    uses them again. Otherwise the model is adapted: by method "auto", then by imputation alone.
    """
    earlier = _version_for(run, faulty)
    if earlier is not None:
        yield Candidate(run.robot.model(earlier), earlier)
        return
    verb = "is" if len(faulty) == 1 else "are"
    run.say(f"{len(faulty)} of {len(run.robot.present)} cells {verb} faulty; adapting")
    for method in ("auto", "fill"):
        yield Candidate(
            run.robot.adapter.adapt(faulty, method=method, budget=run.budget, progress=False)
        )


def _version_for(run: MaintenanceRun, faulty: FaultSet) -> Version | None:
    """Return the latest version for exactly this F, where the running one also excludes recovered
    cells."""
    if not set(faulty) < set(run.version.fault_set):
        return None
    versions = run.robot.bundle.versions
    for number in reversed(versions.numbers):
        with suppress(Damaged, FileNotFoundError):
            version = versions[number]
            if version.fault_set == faulty and version.readings == run.version.readings:
                return version
    return None
