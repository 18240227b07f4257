import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch

from adaptfault.adaptation.adapter import Adapter
from adaptfault.adaptation.result import Adaptation
from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.checksummed_json import Damaged
from adaptfault.bundle.lock import Busy
from adaptfault.bundle.pointer import Pointer
from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.data.windows import make_windows
from adaptfault.models.network import TactileTransformer
from adaptfault.prediction.predictor import Predictor
from adaptfault.robot.maintenance import maintain
from diagnostics import FaultSet, SelfDiagnosis


def deploy(bundle: Bundle, *cells: int) -> int:
    """Deploy a version that does without these cells."""
    adaptation = bundle.parts.adapter().adapt(FaultSet(cells, bundle.layout.n_cells), method="fill")
    number = bundle.write_version(adaptation, {"reason": "test"}).number
    bundle.deploy(number)
    return number


def test_a_bundle_holds_all_that_a_robot_needs(bundle, small_grasps, later_grasps):
    assert bundle.class_names == small_grasps.class_names
    version = bundle.active()
    assert (version.number, len(version.fault_set), version.length) == (1, 0, 10)
    x = make_windows(later_grasps, None, bundle.layout).x
    model = Adaptation.load(version.folder)
    np.testing.assert_array_equal(model.predict(x), model.model.network.predict(x))
    assert bundle.diagnoser().diagnose(later_grasps).fault_set == set()
    assert len(bundle.parts.check_windows()) > 0
    assert bundle.parts.calibration is None
    assert bundle.problems() == []


def test_all_versions_are_exported_from_one_graph_and_without_it_where_it_is_damaged(
    bundle, tmp_path, monkeypatch
):
    given = []
    monkeypatch.setattr("adaptfault.prediction.export.graph_of", lambda network, values: b"graph")
    monkeypatch.setattr(
        "adaptfault.prediction.export.add_onnx", lambda folder, graph: given.append(graph)
    )
    adapter = bundle.parts.adapter()
    check = bundle.parts.check_windows()
    made = Bundle.create(tmp_path / "made", adapter.model, adapter, bundle.diagnoser(), check=check)
    deploy(made, 3)
    (made.path / "parts" / "graph.onnx").write_bytes(b"other")
    opened = Bundle.open(made.path)
    deploy(opened, 4)
    assert given == [b"graph", b"graph", None]
    assert "graph.onnx" in " ".join(opened.problems())


def test_what_new_versions_are_judged_on_was_never_learned_from(bundle):
    adapter = bundle.parts.adapter()
    check = bundle.parts.check_windows()
    learned = set(adapter.train.recording) | set(adapter.validation.recording)
    assert not learned & set(check.recording)


@pytest.mark.slow
def test_without_windows_to_judge_on_the_adapter_gives_up_half_of_its_validation(
    small_grasps, tmp_path
):
    windows = make_windows(small_grasps.frames[::3], small_grasps.labels[::3], small_grasps.layout)
    validation = windows.select(windows.recording % 2 == 0)
    model = TactileTransformer(small_grasps.layout, 3)
    adapter = Adapter(model, windows.select(windows.recording % 2 == 1), validation)
    diagnoser = SelfDiagnosis(small_grasps.layout).fit(small_grasps.frames[:20])
    bundle = Bundle.create(tmp_path / "a", model, adapter, diagnoser)
    kept = bundle.parts.adapter().validation
    given = bundle.parts.check_windows()
    assert set(kept.recording) | set(given.recording) == set(validation.recording)
    assert not set(kept.recording) & set(given.recording)
    assert set(given.y) == set(kept.y) == {0, 1, 2}


def test_what_does_not_belong_together_is_refused_and_leaves_nothing(
    bundle, small_grasps, tmp_path
):
    adapter, model = bundle.parts.adapter(), bundle.parts.adapter().model
    with pytest.raises(FileExistsError, match="choose another name"):
        Bundle.create(bundle.path, model, adapter, bundle.diagnoser())
    with pytest.raises(ValueError, match="fit first"):
        Bundle.create(tmp_path / "a", model, adapter, SelfDiagnosis(bundle.layout))
    with pytest.raises(ValueError, match="class names"):
        Bundle.create(tmp_path / "a", model, adapter, bundle.diagnoser(), class_names=["one"])
    assert not (tmp_path / "a").exists()
    with pytest.raises(FileNotFoundError, match="make"):
        Bundle.open(tmp_path / "a")


def test_opening_and_monitoring_need_no_torch(made_bundle):
    code = (
        "import sys\n"
        "from adaptfault.bundle.bundle import Bundle\n"
        f"bundle = Bundle.open({str(made_bundle)!r})\n"
        "bundle.active(), bundle.diagnoser(), bundle.known_faults()\n"
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_version_never_confirmed_gives_way_after_two_starts(bundle):
    assert deploy(bundle, 3) == 2
    assert [bundle.begin(f"start {i}").number for i in range(4)] == [2, 2, 1, 1]
    assert bundle.journal.runs()[-1]["what"] == "rollback"


def test_a_process_that_serves_many_devices_starts_once(bundle):
    deploy(bundle, 3)
    assert [bundle.begin().number for _ in range(5)] == [2] * 5
    assert bundle.begin("the next process").number == 2
    assert bundle.begin("and the one after").number == 1


def test_a_confirmed_version_stays(bundle):
    deploy(bundle, 3)
    bundle.begin()
    bundle.confirm()
    assert [bundle.begin(f"start {i}").number for i in range(4)] == [2, 2, 2, 2]
    bundle.confirm()  # again: nothing to say
    assert [run["what"] for run in bundle.journal.runs()] == ["confirmed"]


def test_rolling_back_returns_to_the_last_confirmed_version(bundle):
    deploy(bundle, 3)
    bundle.confirm()
    deploy(bundle, 3, 4)  # never confirmed
    deploy(bundle, 3, 4, 5)
    assert bundle.rollback().number == 2
    assert bundle.rollback().number == 1
    with pytest.raises(ValueError, match="the first"):
        bundle.rollback()


def test_old_versions_are_removed_but_none_that_may_run(bundle):
    for cell in range(9):
        deploy(bundle, cell)
        if cell == 1:
            bundle.confirm()
    assert {1, 3, 10} <= set(bundle.versions.numbers)
    assert len(bundle.versions.numbers) <= 8
    assert bundle.rollback().number == 3


def test_a_flipped_bit_in_any_file_is_noticed_and_a_good_version_runs(bundle, tmp_path, rng):
    deploy(bundle, 3)
    bundle.confirm()
    files = [p for p in sorted(bundle.path.rglob("*")) if p.is_file() and p.suffix != ".lock"]
    assert len(files) > 12
    for path in files:
        whole = path.read_bytes()
        broken = bytearray(whole)
        broken[rng.integers(len(broken))] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(broken))
        again = Bundle.open(bundle.path)
        assert again.problems(repair=False), path
        assert again.active().number == (1 if path.parent.name == "0002" else 2), path
        path.write_bytes(whole)
    assert Bundle.open(bundle.path).problems(repair=False) == []


def test_a_missing_or_truncated_file_is_noticed(bundle):
    deploy(bundle, 3)
    (bundle.versions.path(2) / "manifest.json").unlink()
    assert bundle.active().number == 1
    assert "missing" in bundle.problems()[0]
    part = next((bundle.path / "parts" / "adapter").glob("*.safetensors"))
    part.write_bytes(part.read_bytes()[:1000])
    with pytest.raises(Damaged):
        Bundle.open(bundle.path).parts.adapter()


def test_with_no_good_version_left_the_error_says_so(bundle):
    shutil.rmtree(bundle.versions.path(1))
    with pytest.raises(Damaged, match="no version that can be read"):
        bundle.active()


def test_one_maintenance_at_a_time_even_between_processes(bundle):
    code = (
        "import sys\n"
        "from adaptfault.bundle.bundle import Bundle\n"
        "from adaptfault.bundle.lock import Busy\n"
        "try:\n"
        f"    with Bundle.open({str(bundle.path)!r}).maintenance(): sys.exit(1)\n"
        "except Busy: sys.exit(0)"
    )
    with bundle.maintenance():
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
        with pytest.raises(Busy), bundle.maintenance():
            pass
    # it is free again
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 1


def test_a_bundle_that_cannot_be_written_runs_all_the_same(bundle, monkeypatch):
    deploy(bundle, 3)

    def refuse(*args, **kwargs):
        raise PermissionError(13, "read-only")

    monkeypatch.setattr("adaptfault.bundle.running.locked", refuse)
    assert bundle.begin().number == 2


def test_history_report_dry_run_and_prediction_need_no_write_access(
    bundle, later_grasps, capsys, caplog
):
    maintain(bundle, later_grasps[:4])
    bundle.deploy(1)
    with tempfile.TemporaryDirectory() as place:
        path = Path(place, "robot.bundle")
        log = Path(place, "log.npz")
        page = Path(place, "out", "report.html")
        shutil.copytree(bundle.path, path)
        frames = tuple(r.astype(np.float32) for r in later_grasps[4:8])
        save_npz(log, Recordings(frames, bundle.layout))
        page.parent.mkdir()
        page.parent.chmod(0o777)

        def use() -> Predictor:
            assert main(["history", str(path)]) == 0
            assert main(["report", str(path), "--out", str(page)]) == 0
            assert main(["maintain", str(path), str(log), "--dry-run", "--quiet"]) == 0
            predictor = Predictor.load(path)
            assert [predictor.stream(np.zeros(60)).label is None for _ in range(10)] == [
                True
            ] * 9 + [False]
            return predictor

        use()  # imports all that is needed
        page.unlink()
        for one in [*path.rglob("*"), path, Path(place)]:
            one.chmod(0o555 if one.is_dir() else 0o444)
        user = os.geteuid()
        if user == 0:  # root may write everything
            os.seteuid(65534)
        try:
            with pytest.raises(OSError, match=r"denied|ead-only"):
                (path / "x").touch()
            assert not use().confirm()
            assert page.stat().st_size > 0
        finally:
            os.seteuid(user)
            for one in [Path(place), path, *path.rglob("*")]:
                one.chmod(0o755)
    assert "stays on probation" in caplog.text


def test_a_version_on_probation_starts_on_a_full_disk(bundle):
    resource = pytest.importorskip("resource")
    bundle.deploy(1)
    before = Pointer.read(bundle.path)
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, usual[1]))  # every write to a file fails
    try:
        predictor = Predictor.load(bundle.path)
        confirmed = predictor.confirm()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    assert (predictor.version, confirmed) == (1, False)
    assert before.probation
    assert Pointer.read(bundle.path) == before


@pytest.mark.parametrize(("head", "fitted"), [("auto", True), ("linear", False)])
def test_version_1_has_the_head_that_is_asked_for(bundle, tmp_path, head, fitted):
    adapter = bundle.parts.adapter()
    check = bundle.parts.check_windows()
    with torch.no_grad():  # a head in closed form is better than one that was never trained
        adapter.model.head.weight.copy_(
            torch.randn(3, 128, generator=torch.Generator().manual_seed(0))
        )
    parts = (adapter.model, adapter, bundle.diagnoser())
    made = Bundle.create(tmp_path / "made", *parts, check=check, head=head)
    first = Adaptation.load(made.versions[1].folder)
    assert (first.model.head is not None) == fitted
    same = np.array_equal(first.predict_proba(check.x), adapter.model.predict_proba(check.x))
    assert same != fitted
    assert first.contact is not None
    with pytest.raises(ValueError, match="unknown head 'paper'"):
        Bundle.create(tmp_path / "other", *parts, check=check, head="paper")
