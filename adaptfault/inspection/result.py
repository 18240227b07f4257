"""Result of an inspection: its findings, each with a severity; the worst decides."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from adaptfault.inspection.changed_readings import ChangedReadings
from adaptfault.inspection.code import Code
from adaptfault.inspection.codes import BY_NAME
from adaptfault.inspection.severity import Name, of_faults, of_finding, untested, worst
from diagnostics import Diagnosis, Fault
from diagnostics.shown import shown

if TYPE_CHECKING:
    from diagnostics.sensor.recalibration import Recalibration
    from diagnostics.sensor.rewiring import Rewiring
    from diagnostics.sensor.sensor_change import SensorChange

SCHEMA = "adaptfault.inspection/1"

OF_FRAMES: Mapping[str, Name] = {
    "frozen": "frozen",
    "lost": "lost_frames",
    "one_signal": "one_signal",
    "corrupt_frame": "corrupt_frame",
    "common_spike": "common_spike",
    "repeated_frames": "repeated_frames",
    "crosstalk": "crosstalk",
}
"""Names of the findings of each kind of transport fault."""

OF_CELLS = ("fault", "wire", "static_load", *OF_FRAMES.values(), "held_value", "untested")
"""Names of the findings that a diagnosis gives."""


@dataclass(frozen=True)
class Finding:
    """One finding.

    Attributes:
        name: one of :data:`adaptfault.inspection.severity.NAMES`.
        severity: 0 nothing to do, 1 watch, 2 a person is needed, 3 unknown.
        reason: one sentence.
        fault: of which it tells; None: of none.
    """

    name: Name
    severity: int
    reason: str
    fault: Fault | None = field(default=None, repr=False)

    @property
    def code(self) -> Code:
        """What is to say of each finding of this kind."""
        return BY_NAME[self.name if self.fault is None else str(self.fault.kind)]

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {
            "code": str(self.code),
            "name": self.name,
            "severity": self.severity,
            "reason": self.reason,
        }


@shown
@dataclass(frozen=True, eq=False)
class Inspection:
    """What a log tells about a sensor.

    Attributes:
        readings: of the log with wires and pads put back; their diagnosis.
        findings: in the order in which they are told.
        change: of a pad, or of the whole sensor, against the reference; None where there is none.
    """

    readings: ChangedReadings
    findings: tuple[Finding, ...]
    change: SensorChange | None = None

    @property
    def diagnosis(self) -> Diagnosis:
        """Of the readings."""
        return self.readings.diagnosis

    @property
    def rewiring(self) -> Rewiring | None:
        """Rows, columns or pads that answer in each other's place; None where there are none."""
        return self.readings.rewiring

    @property
    def recalibration(self) -> Recalibration | None:
        """Gain and offset of replaced pads; None where none was replaced."""
        return self.readings.recalibration

    @property
    def severity(self) -> int:
        """The worst severity of all findings; 0 without any."""
        return worst(self.findings)

    def __str__(self) -> str:
        lines = [f"{finding.name}: {finding.reason}" for finding in self.findings]
        return "\n".join([str(self.diagnosis), *lines])

    @property
    def told(self) -> dict[str, Any]:
        """What changed between cells and readings, JSON-safe."""
        return {
            "rewiring": list(self.readings.told["rewiring"]),
            "replaced_pads": list(self.readings.told["replaced_pads"]),
            "change": None if self.change is None else asdict(self.change),
        }

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return {
            "schema": SCHEMA,
            "severity": self.severity,
            "findings": [finding.to_dict() for finding in self.findings],
            **self.told,
            "diagnosis": self.diagnosis.to_dict(),
        }


def of_diagnosis(diagnosis: Diagnosis) -> list[Finding]:
    """Return the faults, wires, static loads, lost frames, held values and what was not tested."""
    findings = faults_and_frames(diagnosis)
    reason = untested(diagnosis)
    if reason is not None:
        findings.append(finding_of("untested", reason))
    return findings


def faults_and_frames(diagnosis: Diagnosis) -> list[Finding]:
    """Return the faults, wires, static loads, lost frames and held values."""
    severity = of_faults(diagnosis)
    of_frames = [
        finding_of(OF_FRAMES[one.kind], one.reason)
        for one in diagnosis.transport
        if one.kind in OF_FRAMES
    ]
    told = {one.reason for one in of_frames}
    findings = [
        Finding("fault" if f.line is None else "wire", severity, f.reason, f)
        for f in diagnosis.faults
        if f.reason not in told
    ]
    findings += [finding_of("static_load", load.reason) for load in diagnosis.static_loads]
    findings += of_frames
    findings += [
        finding_of("held_value", one.reason) for one in diagnosis.possible if one.recordings
    ]
    return findings


def finding_of(name: Name, reason: str) -> Finding:
    """Return a finding that is no fault."""
    return Finding(name, of_finding(name), reason)
