"""A bundle of a regression: versions are compared by R2, and the predictor gives values."""

import json

import numpy as np
import pytest
from conftest import SIMULATED, VALUES, forces

from adaptfault.adaptation.adapter import Adapter
from adaptfault.adaptation.result import Adaptation
from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.parts import split_validation
from adaptfault.data.determination import r2
from adaptfault.data.windows import Windows, make_windows
from adaptfault.prediction.predictor import Predictor
from adaptfault.robot.maintenance import maintain
from adaptfault.robot.technician_report import write_report
from diagnostics import inject


def test_a_broken_row_is_repaired_and_deployed_by_r2(
    forces_bundle, later_grasps, broken_row, tmp_path
):
    log = [inject(r, [broken_row], SIMULATED) for r in later_grasps]
    report = maintain(forces_bundle, log)
    assert (report.decision, report.version, report.measure) == ("deployed", 2, "R2")
    assert report.fault_set == set(broken_row.cells)
    assert report.judgement.candidate > report.judgement.running + 0.1
    windows = forces_bundle.parts.check_windows()
    healthy = Adaptation.load(forces_bundle.versions[1].folder)
    assert report.fault_free_accuracy == pytest.approx(r2(windows.y, healthy.predict(windows.x)))
    said = str(report)
    assert "deployed: R2 " in said
    assert f"R2={report.accuracy:.4f}" in said
    assert "R2 under these faults" in said
    assert "validation R2" in said
    assert "accuracy" not in said
    assert json.loads(json.dumps(report.to_dict(), allow_nan=False))["measure"] == "R2"
    page = write_report(tmp_path / "report.html", forces_bundle).read_text()
    assert "R2 under these faults" in page
    assert "accuracy" not in page
    assert maintain(forces_bundle, log).decision == "unchanged"


def test_a_healthy_log_changes_nothing_and_no_accuracy_is_told(forces_bundle, later_grasps):
    report = maintain(forces_bundle, later_grasps)
    assert (report.decision, report.version, report.accuracy) == ("unchanged", 1, None)


def test_the_predictor_gives_the_values_of_each_window(forces_bundle, later_grasps):
    predictor = Predictor.load(forces_bundle.path)
    assert predictor.task == "regression"
    assert predictor.class_names == VALUES
    frames = later_grasps[0][:12]
    readings = [predictor.stream(frame) for frame in frames]
    assert readings[8].values is None
    assert "window not full yet" in str(readings[8])
    last = readings[11]
    assert (last.label, last.name, last.probabilities, last.contact) == (None,) * 4
    assert last.values.dtype == np.float32
    window = make_windows([frames[2:]], None, SIMULATED).x
    np.testing.assert_allclose(last.values, predictor.predict(window)[0], rtol=1e-5)
    assert str(last).startswith("values ")
    with pytest.raises(ValueError, match="a regression has no class probabilities: use predict"):
        predictor.predict_proba(window)
    with pytest.raises(ValueError, match=r"no class probabilities to accumulate: leave accumulate"):
        Predictor.load(forces_bundle.path, accumulate=True)


def test_a_bundle_holds_the_values_of_its_windows_and_their_names(forces_bundle):
    adapter = forces_bundle.parts.adapter()
    assert adapter.task == "regression"
    assert forces_bundle.class_names == VALUES
    frames = adapter.train.x[:, -1] * SIMULATED.full_scale
    np.testing.assert_allclose(
        adapter.train.y / [1000, 1, 1e-3], forces(frames) / [1000, 1, 1e-3], atol=0.02
    )


def test_the_validation_of_a_regression_is_split_by_recording_alone(forces_bundle):
    adapter = forces_bundle.parts.adapter()
    left, check = split_validation(adapter)
    assert left.task == "regression"
    recordings = np.unique(adapter.validation.recording)
    np.testing.assert_array_equal(np.unique(check.recording), recordings[1::2])
    np.testing.assert_array_equal(np.unique(left.validation.recording), recordings[::2])
    single = adapter.validation.select(adapter.validation.recording == recordings[0])
    with pytest.raises(ValueError, match="one validation recording cannot be split"):
        split_validation(Adapter(adapter.model, adapter.train, single))


def test_windows_of_classes_and_names_too_few_are_refused(forces_bundle, tmp_path):
    adapter = forces_bundle.parts.adapter()
    check = adapter.validation
    classes = Windows(check.x, np.zeros(len(check)), check.recording)
    given = (tmp_path / "new.bundle", adapter.model, adapter, forces_bundle.diagnoser())
    with pytest.raises(ValueError, match=r"check has targets \[N\], the adapter \[N, 3\]"):
        Bundle.create(*given, check=classes)
    with pytest.raises(ValueError, match="3 values need as many value names, got 1"):
        Bundle.create(*given, check=check, class_names=["force"])
    assert not (tmp_path / "new.bundle").exists()
