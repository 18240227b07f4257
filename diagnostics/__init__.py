"""Self-diagnosis of tactile arrays: which cells are faulty, why, and which could not be tested.

Needs numpy, scipy, statsmodels and scikit-learn; never torch, so that a robot can run the monitor
without it. Names are loaded when first used: what reads an array's layout does without the rest.
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import extend_path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diagnostics.decision.certificate import Certificate
    from diagnostics.decision.coverage import Coverage
    from diagnostics.decision.result import Diagnosis, Verdict
    from diagnostics.decision.static_load import StaticLoad
    from diagnostics.diagnosis import SelfDiagnosis
    from diagnostics.evidence.read_out import ReadOut, Scan, judge_scan, with_scan
    from diagnostics.faults import Fault, FaultKind, FaultSet
    from diagnostics.layout import SensorLayout
    from diagnostics.monitor import Monitor
    from diagnostics.preprocessing.transport import TransportFault
    from diagnostics.simulation.injection import (
        bridge,
        freeze_stream,
        inject,
        line_fault,
        lose_frames,
    )
    from diagnostics.wiring import Line

__path__ = extend_path(__path__, __name__)  # adaptfault-bench adds the circuit

_HOMES = {
    "Certificate": "decision.certificate",
    "Coverage": "decision.coverage",
    "Diagnosis": "decision.result",
    "Fault": "faults",
    "FaultKind": "faults",
    "FaultSet": "faults",
    "Line": "wiring",
    "Monitor": "monitor",
    "ReadOut": "evidence.read_out",
    "Scan": "evidence.read_out",
    "SelfDiagnosis": "diagnosis",
    "SensorLayout": "layout",
    "StaticLoad": "decision.static_load",
    "TransportFault": "preprocessing.transport",
    "Verdict": "decision.result",
    "bridge": "simulation.injection",
    "freeze_stream": "simulation.injection",
    "inject": "simulation.injection",
    "judge_scan": "evidence.read_out",
    "line_fault": "simulation.injection",
    "lose_frames": "simulation.injection",
    "with_scan": "evidence.read_out",
}

__all__ = [
    "Certificate",
    "Coverage",
    "Diagnosis",
    "Fault",
    "FaultKind",
    "FaultSet",
    "Line",
    "Monitor",
    "ReadOut",
    "Scan",
    "SelfDiagnosis",
    "SensorLayout",
    "StaticLoad",
    "TransportFault",
    "Verdict",
    "bridge",
    "freeze_stream",
    "inject",
    "judge_scan",
    "line_fault",
    "lose_frames",
    "with_scan",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
