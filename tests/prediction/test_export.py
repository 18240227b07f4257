import hashlib
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import DROPPED, small_windows
from torch import nn

import adaptfault as af
from adaptfault.adaptation.adapter import Adapter
from adaptfault.adaptation.reduced_model import ReducedModel
from adaptfault.adaptation.result import Adaptation
from adaptfault.data.windows import Windows
from adaptfault.models.any_model import AnyModel
from adaptfault.models.heads import Head
from adaptfault.models.network import TactileTransformer
from adaptfault.prediction import export
from adaptfault.prediction.export import ExportError, add_onnx, to_onnx
from adaptfault.prediction.inference import open_session, run_session
from adaptfault.prediction.whole_windows import Masked, Selected
from diagnostics import FaultSet, SensorLayout


@pytest.mark.parametrize("name", DROPPED)
def test_the_file_says_what_the_model_says_for_any_number_of_windows(versions, name):
    adaptation = Adaptation.load(versions[name])
    session = open_session((versions[name] / "model.onnx").read_bytes())
    (given,) = session.get_inputs()
    assert isinstance(given.shape[0], str)  # a name, not a number
    assert given.shape[1:] == [5, 18]
    for n in (1, 3, 64):
        x = small_windows(n, seed=n)
        said = run_session(session, x)
        assert said.dtype == np.float32
        np.testing.assert_allclose(said, adaptation.predict_proba(x), rtol=0, atol=1e-5)
        np.testing.assert_allclose(said.sum(axis=1), 1, atol=1e-5)
        assert n == 1 or np.ptp(said, axis=0).max() > 1e-3


def test_what_a_dropped_cell_reads_changes_not_a_bit(versions):
    session = open_session((versions["head"] / "model.onnx").read_bytes())
    x = small_windows(6)
    usual = run_session(session, x)
    for anything in (np.nan, np.inf, -np.inf, 1e30, 0.0):
        x[..., list(DROPPED["head"])] = anything
        np.testing.assert_array_equal(run_session(session, x), usual)


def with_a_head(network: TactileTransformer, n: int, cells: tuple[int, ...]) -> Adaptation:
    """An adaptation to faults whose head knows n windows."""
    windows = Windows(small_windows(n, seed=3), np.arange(n) % 3, np.arange(n))
    adapter = Adapter(network, windows, windows.select(slice(0, 20)))
    return adapter.adapt(FaultSet(cells, 18), method="head")


def test_one_graph_serves_every_fault_set_and_number_of_known_windows(
    versions, small_graph, monkeypatch
):
    network = Adaptation.load(versions["whole"]).model.network
    monkeypatch.setattr(torch.onnx, "export", None)  # from here on the exporter is not there
    for n, cells in ((40, ()), (50, (3,)), (50, (0, 4, 9, 10, 11, 17))):
        head = with_a_head(network, n, cells)
        assert head.model.head is not None
        x = small_windows(5)
        x[..., list(cells)] = np.nan
        said = run_session(open_session(to_onnx(head.model, small_graph)), x)
        np.testing.assert_allclose(said, head.predict_proba(x), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", DROPPED)
def test_the_file_states_layout_fault_set_task_and_version(versions, name):
    onnx = pytest.importorskip("onnx")
    model = Adaptation.load(versions[name]).model
    graph = onnx.load(versions[name] / "model.onnx")
    stated = {entry.key: entry.value for entry in graph.metadata_props}
    layout = json.dumps(model.network.layout.to_dict(), sort_keys=True)
    assert stated["adaptfault.layout"] == hashlib.sha256(layout.encode()).hexdigest()
    assert json.loads(stated["adaptfault.fault_set"]) == sorted(DROPPED[name])
    assert stated["adaptfault.task"] == "classification"
    assert stated["adaptfault.version"] == af.__version__


def test_what_the_file_states_changes_no_prediction_and_the_file_comes_out_twice_the_same(
    versions, small_graph, monkeypatch
):
    onnx = pytest.importorskip("onnx")
    data = (versions["whole"] / "model.onnx").read_bytes()
    model = Adaptation.load(versions["whole"]).model
    plain = onnx.load_from_string(data)
    del plain.metadata_props[:]
    x = small_windows(7)
    np.testing.assert_array_equal(
        run_session(open_session(data), x),
        run_session(open_session(plain.SerializeToString()), x),
    )
    assert to_onnx(model) == data
    assert not onnx.load_from_string(small_graph).metadata_props  # it serves any F
    monkeypatch.setattr(torch.onnx, "export", None)  # from here on the exporter is not there
    repaired = with_a_head(model.network, 40, (3,)).model
    assert to_onnx(repaired, small_graph) == to_onnx(repaired, small_graph)


def test_a_large_array_is_exported_without_a_matrix_of_its_cells(monkeypatch):
    monkeypatch.setattr("adaptfault.prediction.whole_windows.LARGE", 17)
    none = FaultSet((), 18)
    model = ReducedModel(TactileTransformer(SensorLayout(2, 3, 3), 3, length=5), none, None).eval()
    with torch.no_grad():
        model.head = Head.blank(model.views(torch.from_numpy(small_windows(4))), 3, 18)
    assert isinstance(export._whole(model), Selected)
    monkeypatch.undo()
    assert isinstance(export._whole(model), Masked)


def test_a_graph_of_another_kind_of_model_has_no_effect(versions, monkeypatch):
    model = Adaptation.load(versions["head"]).model
    exported = (versions["head"] / "model.onnx").read_bytes()
    monkeypatch.setattr(export, "_translate", lambda *_: exported)
    assert to_onnx(model, (versions["whole"] / "model.onnx").read_bytes()) == exported


def test_a_file_that_is_fixed_at_one_size_of_batch_is_refused_and_the_model_is_left_as_it_was(
    versions, monkeypatch
):
    model = Adaptation.load(versions["whole"]).model.train()
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    whole = torch.onnx.export

    def fixed(*args, dynamic_shapes, **named):
        return whole(*args, **named)

    monkeypatch.setattr(torch.onnx, "export", fixed)
    with pytest.raises(ExportError, match="does not run on 1 windows"):
        to_onnx(model)
    assert all(module.training for module in model.modules())
    assert all(torch.equal(tensor, before[name]) for name, tensor in model.state_dict().items())


def test_a_file_whose_outputs_differ_from_the_model_is_refused(versions, monkeypatch):
    other = (versions["whole"] / "model.onnx").read_bytes()
    exported = SimpleNamespace(model_proto=SimpleNamespace(SerializeToString=lambda: other))
    monkeypatch.setattr(torch.onnx, "export", lambda *_, **__: exported)
    with pytest.raises(ExportError, match="differ from the model on 1 windows"):
        to_onnx(Adaptation.load(versions["head"]).model)


class DataDependent(nn.Module):
    """Branches on the values of its input, which torch.export cannot follow."""

    def __init__(self) -> None:
        super().__init__()
        self.last = nn.Linear(18, 3)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        loudest = x.amax(1)
        return self.last(loudest * 2 if loudest.sum().item() > 5 else loudest)


@pytest.mark.slow
def test_a_model_that_does_not_export_is_named_in_one_line(capfd):
    layout = SensorLayout(2, 3, 3)
    model = AnyModel.probe(DataDependent(), layout, torch.rand(3, 5, 18))
    with pytest.raises(
        ExportError, match=r"the model could not be exported: .*data-dependent"
    ) as error:
        to_onnx(ReducedModel(model, FaultSet((), 18), None).eval())
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_the_manifest_states_the_file_and_keeps_all_else(versions, tmp_path, monkeypatch):
    adaptation = Adaptation.load(versions["whole"])
    adaptation.save(tmp_path)
    before = json.loads((tmp_path / "manifest.json").read_text())
    monkeypatch.setattr(export, "to_onnx", lambda model, graph, values: b"a file")
    path = add_onnx(tmp_path)
    assert (path, path.read_bytes()) == (tmp_path / "model.onnx", b"a file")
    after = json.loads((tmp_path / "manifest.json").read_text())
    assert after.pop("onnx").keys() == {"file", "sha256"}
    assert after == before
    x = small_windows(4)
    np.testing.assert_array_equal(
        Adaptation.load(tmp_path).predict_proba(x), adaptation.predict_proba(x)
    )


def test_a_folder_without_an_adaptation_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"manifest\.json"):
        add_onnx(Path(tmp_path))


def test_it_says_what_to_install(versions, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(ImportError, match=r"pip install 'adaptfault\[deploy\]'"):
        to_onnx(Adaptation.load(versions["whole"]).model)
