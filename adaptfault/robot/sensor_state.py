"""The state of a robot's sensor as its bundle knows it: which known faults the running version
handles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.known_faults import KnownFaults
from adaptfault.bundle.versions import Version
from adaptfault.inspection.severity import of_accuracy, of_known
from diagnostics import Fault, FaultSet

# by so much more accuracy than the healthy model's, a repaired one shows that the healthy one is
# weak
_WEAK = 0.02


def unhandled_cells(bundle: Bundle, faulty: FaultSet, version: Version) -> FaultSet:
    """Return the faulty cells that a version still uses, without having been measured to be as good
    with them."""
    judged = bundle.journal.judged(faulty, version.number)
    tolerated = judged is not None and judged["exit_code"] < 2
    return FaultSet((), faulty.n_cells) if tolerated else faulty - version.fault_set


def weak_base(accuracy: float | None, fault_free: float | None) -> bool:
    """Return whether a repaired model exceeds the healthy one, which then has not learned what the
    data offer."""
    return accuracy is not None and fault_free is not None and accuracy > fault_free + _WEAK


@dataclass(frozen=True)
class SensorState:
    """The state after the last maintenance run or rollback.

    Attributes:
        exit_code: 0, 1 or 2, as of the commands.
        known: the known faults.
        version: the running version.
        unhandled: known faults, with the cells that the running version uses.
        accuracy, fault_free_accuracy: of the running version, under the known faults and without;
        None if not measured.
        reason: of the last maintenance run, while the same version runs; otherwise empty.
        measure: what the accuracies are, "accuracy" or "R2".
    """

    exit_code: int
    known: KnownFaults
    version: Version
    unhandled: tuple[Fault, ...] = ()
    accuracy: float | None = None
    fault_free_accuracy: float | None = None
    reason: str = ""
    measure: str = "accuracy"

    @classmethod
    def of(cls, bundle: Bundle) -> SensorState:
        """Return the state of the sensor of a bundle; raises Damaged."""
        known = bundle.known_faults()
        version = bundle.active()
        runs = bundle.journal.runs()
        faulty = known.fault_set
        cells = unhandled_cells(bundle, faulty, version)
        unhandled = tuple(fault for fault in known.faults if cells & set(fault.cells))
        accuracy, free = _measured(runs, faulty, version.number)
        code = max(of_known(faulty, cells), of_accuracy(accuracy, free))
        last = next((run for run in reversed(runs) if run["what"] != "confirmed"), None)
        reason = ""
        if last is not None and last.get("version") == version.number and "exit_code" in last:
            code = max(code, last["exit_code"])
            reason = last["reason"]
        measures = [run["measure"] for run in runs if "measure" in run]
        measure = "R2" if "R2" in measures else "accuracy"
        return cls(code, known, version, unhandled, accuracy, free, reason, measure)

    def shown(self, accuracy: float) -> str:
        """Return an accuracy in percent, or R2."""
        return f"{accuracy:.3f}" if self.measure == "R2" else f"{100 * accuracy:.1f}%"

    @property
    def weak_base(self) -> bool:
        """Whether the repaired model exceeds the healthy one; see :func:`weak_base`."""
        return weak_base(self.accuracy, self.fault_free_accuracy)


def _measured(
    runs: list[dict[str, Any]], faulty: FaultSet, version: int
) -> tuple[float | None, float | None]:
    """Return accuracy and fault-free accuracy of a version in the last run that measured it.

    After a rollback this is the run that deployed the version that was left: it was compared with
    this one.
    """
    before: dict[str, Any] = {}
    for run in reversed(runs):
        if run.get("accuracy") is not None and run["version"] == version:
            return run["accuracy"], run["fault_free_accuracy"]
        left = (
            run["what"] == "deployed"
            and before.get("what") == "rollback"
            and before.get("from") == run["version"]
        )
        if (
            left
            and before["to"] == version
            and run["fault_set"] == list(faulty)
            and run.get("judgement")
        ):
            return run["judgement"]["running"], run["fault_free_accuracy"]
        if run["what"] != "confirmed":
            before = run
    return None, None
