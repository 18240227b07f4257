"""Inspection of a log: everything that is told of it, each finding with a severity; the worst decides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.robot.converter_range import within_range
from adaptfault.robot.sensor_state import UNTESTED
from diagnostics import Diagnosis, FaultKind, SelfDiagnosis, SensorLayout
from diagnostics.evidence.recalibration import Recalibration, find_recalibration
from diagnostics.evidence.rewiring import Rewiring
from diagnostics.evidence.sensor_change import find_change
from diagnostics.sensor.disturbance import (
    CommonMode,
    Disturbance,
    find_common_mode,
    find_disturbances,
    find_sentinel,
)

SCHEMA = "adaptfault.inspection/1"

Name = Literal[
    "fault",
    "wire",
    "rewired",
    "transposed",
    "replaced_pad",
    "gain",
    "offset",
    "ramp",
    "hum",
    "noise",
    "quantised",
    "saturated",
    "crosstalk",
    "normalised",
    "sentinel",
    "silent_array",
    "frozen",
    "static_load",
    "untested",
    "lost_frames",
]
NAMES: tuple[str, ...] = get_args(Name)
"""Names of findings; they never change, because programs ask for them."""

_SERIOUS = ("normalised", "silent_array")  # no reading means anything
_DEAD = (FaultKind.OPEN, FaultKind.SHORT, FaultKind.STUCK, FaultKind.ALIAS)  # no predictors of how a pad reads
_COST = 4.0  # faults that a disturbance must explain away, as one wire or one cell each


@dataclass(frozen=True)
class Finding:
    """One finding.

    Attributes:
        name: one of :data:`NAMES`.
        severity: 0 nothing to do, 1 watch, 2 a person is needed, 3 unknown.
        reason: one sentence.
    """

    name: Name
    severity: int
    reason: str


@dataclass(frozen=True, eq=False)
class Inspection:
    """What a log tells about a sensor.

    Attributes:
        diagnosis: of the log with the readings put back, and without what the cells share.
        findings: in the order in which they are told.
        rewiring: rows, columns or pads that answer in each other's place; None where there are none.
        recalibration: gain and offset of replaced pads; None where none was replaced.
        common_mode: what the cells share, which the diagnosis does without; None where there is nothing to take out.
    """

    diagnosis: Diagnosis
    findings: tuple[Finding, ...]
    rewiring: Rewiring | None = None
    recalibration: Recalibration | None = None
    common_mode: CommonMode | None = None

    @property
    def severity(self) -> int:
        """The worst severity of all findings; 0 without any."""
        return max((finding.severity for finding in self.findings), default=0)

    def __str__(self) -> str:
        lines = [f"{finding.name}: {finding.reason}" for finding in self.findings]
        return "\n".join([str(self.diagnosis), *lines])

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {
            "schema": SCHEMA,
            "severity": self.severity,
            "findings": [asdict(finding) for finding in self.findings],
            "rewiring": [] if self.rewiring is None else list(self.rewiring.steps),
            "replaced_pads": [] if self.recalibration is None else list(self.recalibration.pads),
            "diagnosis": self.diagnosis.to_dict(),
        }


def inspect(
    recordings: ArrayLike | Sequence[ArrayLike],
    diagnoser: SelfDiagnosis,
    *,
    reference: ArrayLike | Sequence[ArrayLike] | None = None,
) -> Inspection:
    """Return everything that a log tells about a sensor.

    What all cells share is explained first: it is taken out where it can be, and where that leaves fewer faults. Then
    the wiring and replaced pads are undone, and then cells are judged.

    Args:
        recordings: the log, ``[T, D]`` or a list of them, in the layout's unit, in time order.
        diagnoser: fitted on healthy recordings of the same array; one that is not fitted is a cold start.
        reference: these recordings. None: nothing is compared with them.

    Raises:
        ValueError: recordings that do not fit the layout, or hold no frame.
    """
    layout = diagnoser.layout
    given = _checked(recordings, layout)
    healthy = [] if reference is None else [within_range(r, layout)[0] for r in _checked(reference, layout)]
    sentinel = find_sentinel(given, layout)
    log = [within_range(frames, layout)[0] for frames in given]
    if not any(np.isfinite(frames[:, layout.present.ravel()]).any() for frames in log):
        return _unreadable(log, layout, sentinel)
    disturbances = [] if sentinel is None else [sentinel]
    if healthy:
        disturbances += find_disturbances(log, healthy, layout)
    if any(one.name == "silent_array" for one in disturbances):
        return Inspection(_untold(log, layout), tuple(_finding(one) for one in disturbances))
    rewiring = diagnoser.rewiring(log)
    if rewiring is not None:
        log = [rewiring.undo(frames) for frames in log]
    diagnosis, common, log = _judged(log, healthy, diagnoser)
    recalibration = None if rewiring is not None else _recalibration(log, healthy, diagnoser, diagnosis)
    if recalibration is not None:
        log = [recalibration.undo(frames, layout.full_scale) for frames in log]
        diagnosis = diagnoser.diagnose(log)
    if common is not None:
        disturbances.append(common.disturbance)
    findings = [
        *_of_wiring(rewiring, recalibration),
        *(_finding(one) for one in disturbances),
        *_of_change(log, healthy, diagnoser, diagnosis, disturbances),
        *_of_diagnosis(diagnosis),
    ]
    return Inspection(diagnosis, tuple(findings), rewiring, recalibration, common)


def _checked(recordings: ArrayLike | Sequence[ArrayLike], layout: SensorLayout) -> list[NDArray[np.float64]]:
    """Return recordings ``[T, D]`` with at least one frame each."""
    given = layout.recordings(recordings)
    checked = [layout.check_recording(one, f"recording {i}") for i, one in enumerate(given)]
    checked = [np.asarray(frames, dtype=np.float64) for frames in checked if len(frames)]
    if not checked:
        raise ValueError("no frames: expected recordings [T, D] with T >= 1")
    return checked


def _judged(
    log: list[NDArray[np.float64]], healthy: list[NDArray[np.float64]], diagnoser: SelfDiagnosis
) -> tuple[Diagnosis, CommonMode | None, list[NDArray[np.float64]]]:
    """Return the diagnosis, the common mode that it does without, and the log that it is of.

    A common mode is one explanation beside the faults that it explains away: it is taken out where it spares more than
    four faults, or blames none.
    """
    diagnosis = diagnoser.diagnose(log)
    common = find_common_mode(log, healthy, diagnoser.layout) if healthy else None
    if common is None:
        return diagnosis, None, log
    cleaned = common.undo(log, diagnoser.layout)
    without = diagnoser.diagnose(cleaned)
    spared = len(diagnosis.faults) - len(without.faults)
    if spared >= _COST or (len(without.fault_set) <= len(diagnosis.fault_set) and not _is_dead(diagnosis)):
        return without, common, cleaned
    return diagnosis, None, log


def _is_dead(diagnosis: Diagnosis) -> bool:
    """Return whether a whole converter or address line is among the faults: its cells share what they read."""
    return any(fault.line is not None and fault.line.kind == "converter" for fault in diagnosis.faults)


def _recalibration(
    log: list[NDArray[np.float64]],
    healthy: list[NDArray[np.float64]],
    diagnoser: SelfDiagnosis,
    diagnosis: Diagnosis,
) -> Recalibration | None:
    """Return how replaced pads read; None where none is replaced."""
    if not healthy or diagnoser.load_ is not None or diagnoser.reference_ is None:
        return None
    faulty = np.zeros(diagnoser.layout.n_cells, bool)
    faulty[[cell for fault in diagnosis.faults if fault.kind in _DEAD for cell in fault.cells]] = True
    held = diagnosis.statically_loaded.mask
    return find_recalibration(log, healthy, diagnoser.reference_, diagnoser.layout, faulty, held)


def _of_wiring(rewiring: Rewiring | None, recalibration: Recalibration | None) -> list[Finding]:
    findings = []
    if rewiring is not None:
        findings.append(Finding("rewired", 2, rewiring.reason))
    if recalibration is not None:
        findings.append(Finding("replaced_pad", 1, recalibration.reason))
    return findings


def _of_change(
    log: list[NDArray[np.float64]],
    healthy: list[NDArray[np.float64]],
    diagnoser: SelfDiagnosis,
    diagnosis: Diagnosis,
    disturbances: list[Disturbance],
) -> list[Finding]:
    """Return what changed of a pad or of the sensor, unless a disturbance explains it."""
    if not healthy or any(one.name in ("normalised", "ramp", "hum", "crosstalk") for one in disturbances):
        return []
    load = diagnoser.load_
    new, old = (log, healthy) if load is None else ([*map(load.loads, log)], [*map(load.loads, healthy)])
    change = find_change(new, old, diagnoser.layout, diagnosis.fault_set | diagnosis.disturbed)
    if change is None:
        return []
    return [Finding("gain" if change.gain != 1.0 else "offset", 1, change.reason)]


def _of_diagnosis(diagnosis: Diagnosis) -> list[Finding]:
    """Return the faults, wires, static loads, lost frames and what was not tested."""
    worst = diagnosis.exit_code
    findings = []
    for fault in diagnosis.faults:
        findings.append(Finding("fault" if fault.line is None else "wire", worst, fault.reason))
    findings += [Finding("static_load", 1, load.reason) for load in diagnosis.static_loads]
    for fault in diagnosis.transport:
        if fault.kind == "frozen":
            findings.append(Finding("frozen", 1, fault.reason))
        elif fault.kind == "lost":
            findings.append(Finding("lost_frames", 0, fault.reason))
    share = diagnosis.coverage.test_coverage
    if share < UNTESTED:
        reason = f"only {share:.0%} of the cells were tested, so faults may be hidden"
        findings.append(Finding("untested", 1, reason))
    return findings


def _finding(disturbance: Disturbance) -> Finding:
    return Finding(disturbance.name, 2 if disturbance.name in _SERIOUS else 1, disturbance.reason)


def _unreadable(log: list[NDArray[np.float64]], layout: SensorLayout, sentinel: Disturbance | None) -> Inspection:
    """Return the inspection of a log without any reading in the range."""
    silent = Finding("silent_array", 2, "no cell has a reading in the range of the converter")
    findings = [silent] if sentinel is None else [Finding("sentinel", 2, sentinel.reason), silent]
    return Inspection(_untold(log, layout), tuple(findings))


def _untold(log: list[NDArray[np.float64]], layout: SensorLayout) -> Diagnosis:
    """Return a diagnosis that judges no cell."""
    return Diagnosis(
        layout=layout,
        faults=(),
        probability=np.zeros(layout.n_cells),
        tested=np.zeros(layout.n_cells, bool),
        n_frames=sum(map(len, log)),
        n_recordings=len(log),
    )
