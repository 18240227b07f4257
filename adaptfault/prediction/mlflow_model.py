"""A bundle as an MLflow model: ``mlflow.pyfunc.load_model(path).predict(x)`` is what its predictor
says.

The model holds a copy of the bundle and the name of this module, which opens it: no pickle. Needs
the extra "mlflow", and adaptfault where the model is loaded. Windows are float32 ``[N, T, D]``, as
``make_windows`` gives them: MLflow refuses others, as the model states its signature.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from adaptfault import __version__
from adaptfault.bundle.bundle import Bundle
from adaptfault.prediction.inference import Inference
from adaptfault.prediction.predictor import Predictor


def save(bundle: str | os.PathLike[str], path: str | os.PathLike[str], **options: Any) -> None:
    """Save a bundle as an MLflow model.

    Args:
        bundle: folder of the bundle.
        path: folder of the model; it must not exist.
        options: of ``mlflow.pyfunc.save_model``, as ``metadata`` or ``pip_requirements``; with
            ``signature=None`` nothing is refused before the predictor sees it.

    Raises:
        ValueError: MLflow is not installed.
        FileNotFoundError, Damaged: the bundle cannot be read.
        mlflow.exceptions.MlflowException: the folder exists.
    """
    _pyfunc().save_model(os.fspath(path), **{**_described(bundle), **options})


def log(bundle: str | os.PathLike[str], name: str = "model", **options: Any) -> Any:
    """Log a bundle as a model of the current MLflow run.

    Args:
        bundle: folder of the bundle.
        name: of the model.
        options: of ``mlflow.pyfunc.log_model``, as ``registered_model_name``.

    Returns:
        ``mlflow.models.model.ModelInfo``; its ``model_uri`` is what ``load_model`` takes.

    Raises:
        ValueError: MLflow is not installed.
        FileNotFoundError, Damaged: the bundle cannot be read.
    """
    return _pyfunc().log_model(name=name, **{**_described(bundle), **options})


def _load_pyfunc(path: str) -> Predictor:
    """Return the predictor of a bundle; MLflow calls this function by its name."""
    return Predictor.load(path)


def _pyfunc() -> Any:
    try:
        import mlflow.pyfunc
    except ImportError:
        raise ValueError(
            "MLflow models are written with mlflow; install it: pip install 'adaptfault[mlflow]'"
        ) from None
    return mlflow.pyfunc


def _described(bundle: str | os.PathLike[str]) -> dict[str, Any]:
    """Return what MLflow stores of a bundle: who opens it, and what goes in and comes out."""
    from mlflow.models import ModelSignature
    from mlflow.types import Schema, TensorSpec

    model = Inference.load(Bundle.open(Path(bundle)).active().files)
    window = np.zeros((1, model.length, model.layout.n_cells), np.float32)
    result = model.predict(window)
    given = TensorSpec(window.dtype, (-1, *window.shape[1:]))
    told = TensorSpec(result.dtype, (-1, *result.shape[1:]))
    return {
        "loader_module": __name__,
        "data_path": os.fspath(bundle),
        "signature": ModelSignature(inputs=Schema([given]), outputs=Schema([told])),
        "pip_requirements": [f"adaptfault=={__version__}"],
    }
