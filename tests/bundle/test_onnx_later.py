"""A version that was deployed without its ONNX file for want of memory gets it at a later run."""

import json
import shutil

import power_cut
import pytest

from adaptfault.bundle.bundle import WITHOUT_ONNX, Bundle
from adaptfault.models.store import attach
from adaptfault.robot.maintenance import maintain

pytest.importorskip("torch")
from adaptfault.prediction.export import ExportError


@pytest.fixture
def bundle(linear_bundle, tmp_path):
    shutil.copytree(linear_bundle, tmp_path / "robot.bundle")
    return Bundle.open(tmp_path / "robot.bundle")


def manifest(bundle: Bundle) -> dict:
    return json.loads((bundle.active().folder / "manifest.json").read_text())


def exporting(monkeypatch, error: Exception | None) -> None:
    def add_onnx(folder, graph):
        if error is not None:
            raise error
        attach(folder, "onnx", "model.onnx", b"of the model")

    monkeypatch.setattr("adaptfault.prediction.export.add_onnx", add_onnx)


def wrapped(text: str) -> ExportError:
    error = ExportError("the model could not be exported")
    error.__cause__ = RuntimeError(text)
    return error


@pytest.mark.parametrize(
    "error", [MemoryError(), wrapped("DefaultCPUAllocator: can't allocate memory")]
)
@pytest.mark.parametrize("new", [True, False])
def test_too_little_memory_for_the_export_deploys_and_a_later_run_adds_it(
    bundle, monkeypatch, error, new
):
    exporting(monkeypatch, error)
    log = power_cut.broken_log()
    assert maintain(bundle, log).decision == "deployed"
    assert bundle.active().number == 2
    assert "onnx" not in manifest(bundle)
    again = power_cut.broken_log(10) if new else log
    assert maintain(bundle, again[:2]).version == 2  # still too little
    exporting(monkeypatch, None)
    kept = bundle.active()
    assert maintain(bundle, again, dry_run=True).version == 2
    report = maintain(bundle, again)
    assert (report.decision, report.version) == ("deployed", 3)
    assert "version 3 is version 2 with its ONNX file" in str(report)
    whole = bundle.active()
    assert manifest(bundle)["onnx"]["file"] == "model.onnx"
    assert WITHOUT_ONNX not in whole.about
    assert (whole.fault_set, whole.length) == (kept.fault_set, kept.length)
    assert [run["what"] for run in bundle.journal.runs()][-1] == "deployed"
    assert bundle.problems() == []
    assert maintain(bundle, again).version == 3


def test_missing_packages_and_models_that_cannot_be_exported_are_not_tried_again(
    bundle, monkeypatch
):
    for error in (ImportError("no onnxscript"), ExportError("no such operation")):
        exporting(monkeypatch, error)
        adaptation = bundle.parts.adapter().adapt(
            power_cut.FaultSet((3,), power_cut.LAYOUT.n_cells), method="fill"
        )
        version = bundle.write_version(adaptation, {})
        assert WITHOUT_ONNX not in version.about
        assert bundle.with_onnx(version) is None
    exporting(monkeypatch, KeyError("x"))
    with pytest.raises(KeyError):
        bundle.write_version(adaptation, {})
