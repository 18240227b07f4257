"""Inspection of a log: everything that is told of it, each finding with a severity; the worst decides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.robot.changed_readings import ChangedReadings, find_changed_readings, find_sensor_change
from adaptfault.robot.converter_range import within_range
from adaptfault.robot.sensor_state import untested
from diagnostics import Diagnosis, SelfDiagnosis, SensorLayout
from diagnostics.diagnosis import checked_recordings
from diagnostics.evidence.recalibration import Recalibration
from diagnostics.evidence.rewiring import Rewiring
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
    given = list(checked_recordings(recordings, layout))
    healthy = [] if reference is None else [within_range(r, layout)[0] for r in checked_recordings(reference, layout)]
    sentinel = find_sentinel(given, layout)
    log = [within_range(frames, layout)[0] for frames in given]
    if not any(np.isfinite(frames[:, layout.present.ravel()]).any() for frames in log):
        return _unreadable(log, layout, sentinel)
    disturbances = [] if sentinel is None else [sentinel]
    disturbances += find_disturbances(log, healthy, layout)
    if any(one.name == "silent_array" for one in disturbances):
        return Inspection(_untold(log, layout), tuple(_finding(one) for one in disturbances))
    changed, common = _judged(log, healthy, diagnoser)
    if common is not None:
        disturbances.append(common.disturbance)
    findings = [
        *_of_readings(changed),
        *(_finding(one) for one in disturbances),
        *_of_change(changed, healthy, diagnoser, disturbances),
        *_of_diagnosis(changed.diagnosis),
    ]
    return Inspection(changed.diagnosis, tuple(findings), changed.rewiring, changed.recalibration, common)


def _judged(
    log: list[NDArray[np.float64]], healthy: list[NDArray[np.float64]], diagnoser: SelfDiagnosis
) -> tuple[ChangedReadings, CommonMode | None]:
    """Return the diagnosis of a log, and the common mode that it does without; None: the log as it is.

    A common mode is one explanation beside the faults that it explains away.
    """
    as_it_is = find_changed_readings(diagnoser, log, lambda: healthy)
    common = find_common_mode(log, healthy, diagnoser.layout) if healthy else None
    if common is None:
        return as_it_is, None
    without = find_changed_readings(diagnoser, common.undo(log, diagnoser.layout), lambda: healthy)
    explanations = len(without.diagnosis.faults) + 1
    if explanations > len(as_it_is.diagnosis.faults) and _is_converter(as_it_is.diagnosis):
        return as_it_is, None
    if len(without.diagnosis.fault_set) > len(as_it_is.diagnosis.fault_set):
        return as_it_is, None
    return without, common


def _is_converter(diagnosis: Diagnosis) -> bool:
    """Return whether a converter is among the faults: its cells share what they read, as those of a common mode."""
    return any(fault.line is not None and fault.line.kind == "converter" for fault in diagnosis.faults)


def _of_readings(changed: ChangedReadings) -> list[Finding]:
    """Return exchanged wires, or replaced pads."""
    if changed.rewiring is not None:
        return [Finding("rewired", 2, changed.reason)]
    return [Finding("replaced_pad", 1, changed.reason)] if changed.recalibration is not None else []


def _of_change(
    changed: ChangedReadings,
    healthy: list[NDArray[np.float64]],
    diagnoser: SelfDiagnosis,
    disturbances: list[Disturbance],
) -> list[Finding]:
    """Return what changed of a pad or of the sensor, unless a disturbance explains it."""
    if not healthy or any(one.name in ("normalised", "ramp", "hum", "crosstalk") for one in disturbances):
        return []
    change = find_sensor_change(diagnoser, changed.diagnosis, changed.frames, healthy)
    if change is None:
        return []
    return [Finding("gain" if change.gain != 1.0 else "offset", 1, change.reason)]


def _of_diagnosis(diagnosis: Diagnosis) -> list[Finding]:
    """Return the faults, wires, static loads, lost frames and what was not tested."""
    worst = diagnosis.exit_code
    findings = [Finding("fault" if f.line is None else "wire", worst, f.reason) for f in diagnosis.faults]
    findings += [Finding("static_load", 1, load.reason) for load in diagnosis.static_loads]
    findings += [Finding("frozen", 1, frozen.reason) for frozen in diagnosis.frozen]
    findings += [Finding("lost_frames", 0, link.reason) for link in diagnosis.transport if link.kind == "lost"]
    reason = untested(diagnosis)
    if reason is not None:
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
