"""Self-diagnosis of tactile arrays: which cells are faulty, why, and what could not be tested.

Needs numpy, scipy, statsmodels and scikit-learn; never torch, so that a robot can monitor its skin without it.
"""

from diagnostics.coverage import Coverage
from diagnostics.diagnosis import SelfDiagnosis
from diagnostics.faults import Fault, FaultKind, FaultSet
from diagnostics.injection import inject, line_fault
from diagnostics.layout import Line, SensorLayout
from diagnostics.verdicts import Diagnosis, Verdict

__all__ = [
    "Coverage",
    "Diagnosis",
    "Fault",
    "FaultKind",
    "FaultSet",
    "Line",
    "SelfDiagnosis",
    "SensorLayout",
    "Verdict",
    "inject",
    "line_fault",
]
