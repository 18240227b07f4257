"""Keeps a tactile classifier working when cells of the skin die.

Names are loaded when first used, so that ``import adaptfault`` is quick and torch comes only with a model.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from adaptfault.adaptation import Adaptation
    from adaptfault.adapter import Adapter
    from adaptfault.baselines.correction import CausalCorrection, correct
    from adaptfault.baselines.fault_aware import train_fault_aware
    from adaptfault.calibration import Calibration
    from adaptfault.evaluation import Scores, evaluate
    from adaptfault.forecast import Forecast
    from adaptfault.grasps import simulate
    from adaptfault.history import History
    from adaptfault.network import TactileTransformer
    from adaptfault.recordings import Recordings, load, save_npz
    from adaptfault.reduction import ReducedModel
    from adaptfault.replay import load_adapter, save_adapter
    from adaptfault.single_faults import Sensitivity, analyse, sensitivity
    from adaptfault.store import load_model, save_model
    from adaptfault.training import train
    from adaptfault.windows import Windows, make_windows, split

__version__ = "0.1.0"

__all__ = [
    "Adaptation",
    "Adapter",
    "Calibration",
    "CausalCorrection",
    "Forecast",
    "History",
    "Recordings",
    "ReducedModel",
    "Scores",
    "Sensitivity",
    "TactileTransformer",
    "Windows",
    "analyse",
    "correct",
    "evaluate",
    "load",
    "load_adapter",
    "load_model",
    "make_windows",
    "save_adapter",
    "save_model",
    "save_npz",
    "sensitivity",
    "simulate",
    "split",
    "train",
    "train_fault_aware",
]

_HOMES = {
    "Adaptation": "adaptation",
    "Adapter": "adapter",
    "Calibration": "calibration",
    "CausalCorrection": "baselines.correction",
    "Forecast": "forecast",
    "History": "history",
    "Recordings": "recordings",
    "ReducedModel": "reduction",
    "Scores": "evaluation",
    "Sensitivity": "single_faults",
    "TactileTransformer": "network",
    "Windows": "windows",
    "analyse": "single_faults",
    "correct": "baselines.correction",
    "evaluate": "evaluation",
    "load": "recordings",
    "load_adapter": "replay",
    "load_model": "store",
    "make_windows": "windows",
    "save_adapter": "replay",
    "save_model": "store",
    "save_npz": "recordings",
    "sensitivity": "single_faults",
    "simulate": "grasps",
    "split": "windows",
    "train": "training",
    "train_fault_aware": "baselines.fault_aware",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'adaptfault' has no attribute {name!r}")
    return getattr(import_module(f"adaptfault.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
