"""Keeps a tactile classifier working when cells of the skin die.

Names are loaded when first used, so that ``import adaptfault`` is quick and torch comes only with a model.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from adaptfault.acquisition import Receiver, Recorder, Station
    from adaptfault.adaptation import Adaptation
    from adaptfault.adapter import Adapter
    from adaptfault.baselines.correction import CausalCorrection, correct
    from adaptfault.baselines.fault_aware import train_fault_aware
    from adaptfault.calibration import Calibration
    from adaptfault.evaluation import Scores, evaluate
    from adaptfault.export import add_onnx
    from adaptfault.fleet.listing import Fleet
    from adaptfault.fleet.report import FleetReport
    from adaptfault.fleet.run import maintain_fleet
    from adaptfault.forecast import Forecast
    from adaptfault.grasps import simulate
    from adaptfault.history import History
    from adaptfault.inference import Inference
    from adaptfault.network import TactileTransformer
    from adaptfault.recordings import Recordings, load, save_npz
    from adaptfault.reduction import ReducedModel
    from adaptfault.replay import load_adapter, save_adapter
    from adaptfault.robot.bundle import Bundle
    from adaptfault.robot.maintenance import MaintenanceReport, maintain
    from adaptfault.robot.predictor import Predictor, Reading
    from adaptfault.ros import diagnostic_array, write_diagnostics
    from adaptfault.single_faults import Sensitivity, analyse, sensitivity
    from adaptfault.store import load_model, save_model
    from adaptfault.training import train
    from adaptfault.windows import Windows, make_windows, split

__version__ = "0.1.0"

__all__ = [
    "Adaptation",
    "Adapter",
    "Bundle",
    "Calibration",
    "CausalCorrection",
    "Fleet",
    "FleetReport",
    "Forecast",
    "History",
    "Inference",
    "MaintenanceReport",
    "Predictor",
    "Reading",
    "Receiver",
    "Recorder",
    "Recordings",
    "ReducedModel",
    "Scores",
    "Sensitivity",
    "Station",
    "TactileTransformer",
    "Windows",
    "add_onnx",
    "analyse",
    "correct",
    "diagnostic_array",
    "evaluate",
    "load",
    "load_adapter",
    "load_model",
    "maintain",
    "maintain_fleet",
    "make_windows",
    "save_adapter",
    "save_model",
    "save_npz",
    "sensitivity",
    "simulate",
    "split",
    "train",
    "train_fault_aware",
    "write_diagnostics",
]

_HOMES = {
    "Adaptation": "adaptation",
    "Adapter": "adapter",
    "Bundle": "robot.bundle",
    "Calibration": "calibration",
    "CausalCorrection": "baselines.correction",
    "Fleet": "fleet.listing",
    "FleetReport": "fleet.report",
    "Forecast": "forecast",
    "History": "history",
    "Inference": "inference",
    "MaintenanceReport": "robot.maintenance",
    "Predictor": "robot.predictor",
    "Reading": "robot.predictor",
    "Receiver": "acquisition",
    "Recorder": "acquisition",
    "Recordings": "recordings",
    "ReducedModel": "reduction",
    "Station": "acquisition",
    "Scores": "evaluation",
    "Sensitivity": "single_faults",
    "TactileTransformer": "network",
    "Windows": "windows",
    "add_onnx": "export",
    "analyse": "single_faults",
    "correct": "baselines.correction",
    "diagnostic_array": "ros",
    "evaluate": "evaluation",
    "load": "recordings",
    "load_adapter": "replay",
    "load_model": "store",
    "maintain": "robot.maintenance",
    "maintain_fleet": "fleet.run",
    "make_windows": "windows",
    "save_adapter": "replay",
    "save_model": "store",
    "save_npz": "recordings",
    "sensitivity": "single_faults",
    "simulate": "grasps",
    "split": "windows",
    "train": "training",
    "train_fault_aware": "baselines.fault_aware",
    "write_diagnostics": "ros",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'adaptfault' has no attribute {name!r}")
    return getattr(import_module(f"adaptfault.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
