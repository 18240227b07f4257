"""Self-diagnosis of tactile arrays: which cells are faulty, why, and which could not be tested.

Needs numpy, scipy, statsmodels and scikit-learn; never torch, so that a robot can run the monitor
without it.
"""

from pkgutil import extend_path

__path__ = extend_path(__path__, __name__)  # adaptfault-bench adds the circuit

from diagnostics.decision.certificate import Certificate
from diagnostics.decision.coverage import Coverage
from diagnostics.decision.result import Diagnosis, Verdict
from diagnostics.decision.static_load import StaticLoad
from diagnostics.diagnosis import SelfDiagnosis
from diagnostics.faults import Fault, FaultKind, FaultSet
from diagnostics.layout import SensorLayout
from diagnostics.monitor import Monitor
from diagnostics.preprocessing.transport import TransportFault
from diagnostics.simulation.injection import bridge, freeze_stream, inject, line_fault, lose_frames
from diagnostics.wiring import Line

__all__ = [
    "Certificate",
    "Coverage",
    "Diagnosis",
    "Fault",
    "FaultKind",
    "FaultSet",
    "Line",
    "Monitor",
    "SelfDiagnosis",
    "SensorLayout",
    "StaticLoad",
    "TransportFault",
    "Verdict",
    "bridge",
    "freeze_stream",
    "inject",
    "line_fault",
    "lose_frames",
]
