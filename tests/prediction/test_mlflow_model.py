"""A bundle is an MLflow model: MLflow's own loader opens it, and its predictions are the same."""

import sys
import warnings

import numpy as np
import pytest

from adaptfault import Predictor
from adaptfault.prediction import mlflow_model


@pytest.fixture
def windows(made_bundle, rng) -> np.ndarray:
    length = Predictor.load(made_bundle)._running.model.length
    return rng.uniform(0, 1, (8, length, 60)).astype(np.float32)


@pytest.fixture
def pyfunc(tmp_path, monkeypatch):
    """MLflow, with its files in a folder of the test."""
    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings(action="ignore"):  # of MLflow's own modules
        return pytest.importorskip("mlflow.pyfunc", reason="mlflow-skinny is not installed")


def test_what_mlflow_calls_predicts_as_the_bundle_does(made_bundle, windows):
    opened = mlflow_model._load_pyfunc(str(made_bundle))
    np.testing.assert_array_equal(
        opened.predict(windows), Predictor.load(made_bundle).predict(windows)
    )


def test_without_mlflow_the_remedy_is_told(made_bundle, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mlflow", None)
    monkeypatch.setitem(sys.modules, "mlflow.pyfunc", None)
    with pytest.raises(ValueError, match=r"pip install 'adaptfault\[mlflow\]'"):
        mlflow_model.save(made_bundle, tmp_path / "model")


@pytest.mark.filterwarnings("ignore::UserWarning:mlflow")
def test_mlflow_opens_a_saved_bundle_and_states_its_signature(
    pyfunc, made_bundle, windows, tmp_path
):
    mlflow_model.save(made_bundle, tmp_path / "model", metadata={"robot": "seven"})
    model = pyfunc.load_model(str(tmp_path / "model"))
    expected = Predictor.load(made_bundle).predict(windows)
    predicted = model.predict(windows)
    assert predicted.dtype == expected.dtype
    np.testing.assert_array_equal(predicted, expected)
    assert model.metadata.metadata == {"robot": "seven"}
    (given,) = model.metadata.signature.inputs.inputs
    assert given.shape == (-1, *windows.shape[1:])
    assert not list((tmp_path / "model").rglob("*.pkl"))
    with pytest.raises(Exception, match="does not match expected shape"):
        model.predict(windows[:, :, :5])
    mlflow_model.save(made_bundle, tmp_path / "any", signature=None)
    predicted = pyfunc.load_model(str(tmp_path / "any")).predict(windows.astype(np.float64))
    np.testing.assert_array_equal(predicted, expected)


@pytest.mark.filterwarnings("ignore::UserWarning:mlflow")
def test_mlflow_logs_a_bundle_in_a_run(pyfunc, made_bundle, windows, tmp_path):
    import mlflow

    mlflow.set_tracking_uri((tmp_path / "runs").as_uri())
    with mlflow.start_run():
        logged = mlflow_model.log(made_bundle)
    model = pyfunc.load_model(logged.model_uri)
    np.testing.assert_array_equal(
        model.predict(windows), Predictor.load(made_bundle).predict(windows)
    )
