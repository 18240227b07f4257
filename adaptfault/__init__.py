"""Keeps a tactile classifier working when cells of the skin die.

Names are loaded when first used, so that ``import adaptfault`` is quick and torch comes only with a
model.
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import extend_path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from adaptfault.acquisition import NotAuthentic as NotAuthentic
    from adaptfault.acquisition import Receiver as Receiver
    from adaptfault.acquisition import Recorder as Recorder
    from adaptfault.acquisition import Station as Station
    from adaptfault.acquisition import read_key as read_key
    from adaptfault.adaptation.adapter import Adapter
    from adaptfault.adaptation.adapter_files import load_adapter, save_adapter
    from adaptfault.adaptation.baselines.correction import CausalCorrection, correct
    from adaptfault.adaptation.baselines.fault_aware import train_fault_aware
    from adaptfault.adaptation.forecast import Forecast
    from adaptfault.adaptation.reduced_model import ReducedModel
    from adaptfault.adaptation.result import Adaptation
    from adaptfault.adaptation.worst import WorstFaults, worst_faults
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.bundle.signing import sign_bundle
    from adaptfault.bundle.versions import Untrusted
    from adaptfault.data.calibration import Calibration
    from adaptfault.data.recordings import Recordings, load, save, save_npz
    from adaptfault.data.simulated_grasps import simulate
    from adaptfault.data.summary import Summary, summarise
    from adaptfault.data.windows import Windows, make_windows, split
    from adaptfault.evaluation.scores import Scores, ValueScores, evaluate
    from adaptfault.evaluation.sensitivity import Sensitivity, analyse, sensitivity
    from adaptfault.fleet.listing import Fleet as Fleet
    from adaptfault.fleet.run import maintain_fleet as maintain_fleet
    from adaptfault.fleet.summary import FleetReport as FleetReport
    from adaptfault.imputation.restorer import Restorer
    from adaptfault.imputation.scikit_learn import (
        CellImputer,
        FaultTolerantClassifier,
        FaultTolerantRegressor,
    )
    from adaptfault.inspection.findings import Findings
    from adaptfault.inspection.guard import GuardError, guard
    from adaptfault.inspection.inspection import inspect
    from adaptfault.inspection.result import Finding, Inspection
    from adaptfault.models.builders import allow_model, build_model
    from adaptfault.models.history import History
    from adaptfault.models.network import TactileTransformer
    from adaptfault.models.store import load_model, save_model
    from adaptfault.models.training import train
    from adaptfault.models.valid_touch import ValidTouch
    from adaptfault.models.value_units import ValueUnits
    from adaptfault.prediction.export import add_onnx
    from adaptfault.prediction.inference import Inference
    from adaptfault.prediction.predictor import Predictor
    from adaptfault.prediction.reading import Reading
    from adaptfault.robot.maintenance import maintain
    from adaptfault.robot.maintenance_report import MaintenanceReport
    from adaptfault.robot.routine import Routine
    from adaptfault.robot.selftest import plan_selftest
    from adaptfault.viewers.ros_diagnostics import diagnostic_array as diagnostic_array
    from adaptfault.viewers.ros_diagnostics import write_diagnostics as write_diagnostics

__path__ = extend_path(__path__, __name__)  # the packages of the repository add rooms
__version__ = "0.1.0"

__all__ = [
    "Adaptation",
    "Adapter",
    "Bundle",
    "Calibration",
    "CausalCorrection",
    "CellImputer",
    "FaultTolerantClassifier",
    "FaultTolerantRegressor",
    "Finding",
    "Findings",
    "Forecast",
    "GuardError",
    "History",
    "Inference",
    "Inspection",
    "MaintenanceReport",
    "Predictor",
    "Reading",
    "Recordings",
    "ReducedModel",
    "Restorer",
    "Routine",
    "Scores",
    "Sensitivity",
    "Summary",
    "TactileTransformer",
    "Untrusted",
    "ValidTouch",
    "ValueScores",
    "ValueUnits",
    "Windows",
    "WorstFaults",
    "add_onnx",
    "allow_model",
    "analyse",
    "build_model",
    "correct",
    "evaluate",
    "guard",
    "inspect",
    "load",
    "load_adapter",
    "load_healthy",
    "load_model",
    "maintain",
    "make_windows",
    "plan_selftest",
    "save",
    "save_adapter",
    "save_model",
    "save_npz",
    "sensitivity",
    "sign_bundle",
    "simulate",
    "split",
    "summarise",
    "train",
    "train_fault_aware",
    "worst_faults",
]

_HOMES = {
    "Adaptation": "adaptation.result",
    "Adapter": "adaptation.adapter",
    "Bundle": "bundle.bundle",
    "Calibration": "data.calibration",
    "CausalCorrection": "adaptation.baselines.correction",
    "CellImputer": "imputation.scikit_learn",
    "FaultTolerantClassifier": "imputation.scikit_learn",
    "FaultTolerantRegressor": "imputation.scikit_learn",
    "Finding": "inspection.result",
    "Findings": "inspection.findings",
    "Fleet": "fleet.listing",
    "FleetReport": "fleet.summary",
    "Forecast": "adaptation.forecast",
    "GuardError": "inspection.guard",
    "History": "models.history",
    "Inference": "prediction.inference",
    "Inspection": "inspection.result",
    "MaintenanceReport": "robot.maintenance_report",
    "NotAuthentic": "acquisition",
    "Predictor": "prediction.predictor",
    "Reading": "prediction.reading",
    "Receiver": "acquisition",
    "Recorder": "acquisition",
    "Recordings": "data.recordings",
    "ReducedModel": "adaptation.reduced_model",
    "Restorer": "imputation.restorer",
    "Station": "acquisition",
    "Routine": "robot.routine",
    "Scores": "evaluation.scores",
    "Summary": "data.summary",
    "Sensitivity": "evaluation.sensitivity",
    "TactileTransformer": "models.network",
    "Untrusted": "bundle.versions",
    "ValueScores": "evaluation.scores",
    "ValidTouch": "models.valid_touch",
    "ValueUnits": "models.value_units",
    "Windows": "data.windows",
    "WorstFaults": "adaptation.worst",
    "add_onnx": "prediction.export",
    "allow_model": "models.builders",
    "analyse": "evaluation.sensitivity",
    "build_model": "models.builders",
    "correct": "adaptation.baselines.correction",
    "diagnostic_array": "viewers.ros_diagnostics",
    "evaluate": "evaluation.scores",
    "guard": "inspection.guard",
    "inspect": "inspection.inspection",
    "load": "data.recordings",
    "load_adapter": "adaptation.adapter_files",
    "load_healthy": "adaptation.result",
    "load_model": "models.store",
    "maintain": "robot.maintenance",
    "maintain_fleet": "fleet.run",
    "make_windows": "data.windows",
    "plan_selftest": "robot.selftest",
    "read_key": "acquisition",
    "save": "data.recordings",
    "save_adapter": "adaptation.adapter_files",
    "save_model": "models.store",
    "save_npz": "data.recordings",
    "sensitivity": "evaluation.sensitivity",
    "sign_bundle": "bundle.signing",
    "simulate": "data.simulated_grasps",
    "split": "data.windows",
    "summarise": "data.summary",
    "train": "models.training",
    "train_fault_aware": "adaptation.baselines.fault_aware",
    "worst_faults": "adaptation.worst",
    "write_diagnostics": "viewers.ros_diagnostics",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'adaptfault' has no attribute {name!r}")
    try:
        return getattr(import_module(f"adaptfault.{_HOMES[name]}"), name)
    except ModuleNotFoundError as error:
        from adaptfault.data.plugins import what_to_install

        what = what_to_install(error)
        if what is None:
            raise
        raise ImportError(f"adaptfault.{name}: {what}") from None


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
