"""Inference of a regression: values on both runtimes, and no probabilities."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import SMALL, small_windows

from adaptfault.adaptation.adapter import Adapter
from adaptfault.adaptation.result import Adaptation
from adaptfault.data.windows import Windows
from adaptfault.evaluation.scores import ValueScores, evaluate
from adaptfault.models.network import TactileTransformer
from adaptfault.models.value_units import ValueUnits
from adaptfault.prediction import export
from adaptfault.prediction.export import add_onnx, graph_of, to_onnx
from adaptfault.prediction.inference import Inference
from diagnostics import FaultSet

F = FaultSet((1, 9, 17), 18)
UNITS = np.array([4000.0, 0.001, 1.0])


def values(n: int, seed: int) -> Windows:
    x = small_windows(n, seed)
    every = x.mean((1, 2))
    last = x[:, -1, 9:].mean(1)
    first = x[:, 0, :9].mean(1)
    y = np.stack([every, last, first], axis=1) * UNITS + 3 * UNITS
    return Windows(x, y, np.arange(n) // 2)


@pytest.fixture(scope="module")
def adapter() -> Adapter:
    training = values(160, 0)
    network = TactileTransformer(SMALL, 3, length=5).eval()
    ValueUnits.of(training).fold(network)
    return Adapter(network, training, values(60, 1))


@pytest.fixture(scope="module")
def graph(made_once, adapter: Adapter) -> bytes:
    """The ONNX graph of the regression with any head in closed form."""

    def make(home: Path) -> None:
        (home / "graph.onnx").write_bytes(graph_of(adapter.model, values=True))

    return (made_once("graph_of_values", make) / "graph.onnx").read_bytes()


@pytest.fixture(scope="module")
def folders(made_once, adapter: Adapter, graph: bytes) -> dict[str, Path]:
    """An adaptation with a head in closed form, and one with the network's."""

    def make(home: Path) -> None:
        for method, known in (("head", graph), ("fill", None)):
            adapter.adapt(F, method=method).save(home / method)
            add_onnx(home / method, known)

    home = made_once("regressions", make)
    return {method: home / method for method in ("head", "fill")}


@pytest.mark.parametrize("name", ["head", "fill"])
def test_both_runtimes_return_the_values_of_the_adaptation(folders, name):
    here, there = (Inference.load(folders[name], runtime=runtime) for runtime in ("onnx", "torch"))
    assert here.task == there.task == "regression"
    assert "3 values from" in str(here)
    for n in (0, 1, 40):
        x = small_windows(n, seed=n + 5)
        x[..., list(F)] = np.nan
        one, other = here.predict(x), there.predict(x)
        assert one.dtype == other.dtype == np.float32
        assert one.shape == other.shape == (n, 3)
        np.testing.assert_allclose(one / UNITS, other / UNITS, atol=1e-5 * 5)
        np.testing.assert_allclose(other, Adaptation.load(folders[name]).predict(x), rtol=1e-5)


def test_a_regression_has_no_probabilities(folders):
    for runtime in ("onnx", "torch"):
        model = Inference.load(folders["head"], runtime=runtime)
        with pytest.raises(
            ValueError, match="a regression has no class probabilities: use predict"
        ):
            model.predict_proba(small_windows(2))
        with pytest.raises(ValueError, match=r"expected windows \[N, 5, 18\]"):
            model.predict(np.zeros((2, 4, 18)))


def test_the_graph_of_a_regression_saves_the_export_and_that_of_a_classifier_does_not(
    adapter, folders, graph, small_graph, monkeypatch
):
    """The classifier has as many classes as the regression has values: they differ in nothing
    else."""
    model = adapter.adapt(F, method="head").model
    file = (folders["head"] / "model.onnx").read_bytes()
    exported = []
    monkeypatch.setattr(export, "_translate", lambda *given: exported.append(1) or file)
    for count, known in enumerate((graph, small_graph)):
        assert b"probabilities" not in to_onnx(model, known, values=True)
        assert len(exported) == count


def test_a_damaged_task_is_refused(folders, tmp_path):
    for path in folders["fill"].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    manifest = tmp_path / "manifest.json"
    about = json.loads(manifest.read_text())
    manifest.write_text(json.dumps({**about, "task": "ranking"}))
    with pytest.raises(ValueError, match="is damaged: unknown task 'ranking'"):
        Inference.load(tmp_path)


def test_networks_adaptations_and_inference_are_scored_by_value_scores(adapter, folders):
    test = values(50, 2)
    for model in (
        adapter.model,
        adapter.adapt(F, method="head"),
        Inference.load(folders["head"], runtime="torch"),
    ):
        scores = evaluate(model, test)
        assert isinstance(scores, ValueScores)
        assert len(scores.mae) == 3
    assert scores.r2 > evaluate(adapter.model, test).r2
