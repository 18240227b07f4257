"""Self-diagnosis of tactile arrays: which cells are faulty, why, and what could not be tested.

Needs numpy, scipy, statsmodels and scikit-learn; never torch, so that a robot can monitor its skin without it.
"""

from diagnostics.coverage import Coverage
from diagnostics.diagnosis import SelfDiagnosis
from diagnostics.faults import Fault, FaultKind, FaultSet
from diagnostics.injection import bridge, freeze_stream, inject, line_fault, lose_frames
from diagnostics.layout import Line, SensorLayout
from diagnostics.monitor import Monitor
from diagnostics.transport import TransportFault
from diagnostics.verdicts import Diagnosis, Verdict

__all__ = [
    "Coverage",
    "Diagnosis",
    "Fault",
    "FaultKind",
    "FaultSet",
    "Line",
    "Monitor",
    "SelfDiagnosis",
    "SensorLayout",
    "TransportFault",
    "Verdict",
    "bridge",
    "freeze_stream",
    "inject",
    "line_fault",
    "lose_frames",
]
