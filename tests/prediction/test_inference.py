import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import DROPPED, SMALL, small_windows

from adaptfault.adaptation.result import Adaptation
from adaptfault.prediction.inference import Inference, open_session

WITHOUT_TORCH = """
import sys
import numpy as np
import adaptfault
import adaptfault.models.store, adaptfault.data.windows
from adaptfault.prediction.inference import Inference
model = Inference.load(sys.argv[1])
assert model.runtime == "onnx"
assert model.predict(np.load(sys.argv[2])).tolist() == np.load(sys.argv[3]).tolist()
assert "torch" not in sys.modules
"""


@pytest.fixture
def copied(versions: dict[str, Path], tmp_path: Path) -> Path:
    return Path(shutil.copytree(versions["whole"], tmp_path / "version"))


@pytest.mark.parametrize("name", DROPPED)
def test_both_runtimes_say_the_same(versions, name):
    here, there = (Inference.load(versions[name], runtime=runtime) for runtime in ("onnx", "torch"))
    assert here.fault_set == there.fault_set
    assert (tuple(here.fault_set), here.layout, here.length, here.n_classes) == (
        DROPPED[name],
        SMALL,
        5,
        3,
    )
    for n in (0, 1, 300):
        x = small_windows(n, seed=n)
        x[..., list(DROPPED[name])] = np.nan
        one = here.predict_proba(x)
        other = there.predict_proba(x)
        assert one.shape == other.shape == (n, 3)
        assert one.dtype == other.dtype == np.float32
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-5)
        assert here.predict(x).tolist() == one.argmax(axis=1).tolist()
        assert here.predict(x).dtype == np.int64


@pytest.mark.parametrize("runtime", ["onnx", "torch"])
def test_sets_of_classes_are_those_of_the_adaptation(versions, runtime):
    if runtime == "onnx":
        pytest.importorskip("onnxruntime")
    x = small_windows(9)
    adaptation = Adaptation.load(versions["head"])
    inference = Inference.load(versions["head"], runtime=runtime)
    sets = inference.prediction_sets(x, alpha=0.2)
    threshold = adaptation.conformal.threshold(0.2)
    likely = inference.predict_proba(x)
    np.testing.assert_array_equal(sets, 1 - likely.astype(float) <= threshold)
    by_class = inference.prediction_sets(x, alpha=0.2, by_class=True)
    thresholds = [one.threshold(0.2) for one in adaptation.conformal.by_class]
    np.testing.assert_array_equal(by_class, 1 - likely.astype(float) <= thresholds)
    inference.sets = None
    with pytest.raises(ValueError, match="need validation windows"):
        inference.prediction_sets(x)


def test_onnx_runtime_does_without_torch(versions, tmp_path):
    x = small_windows(20)
    np.save(tmp_path / "x.npy", x)
    np.save(tmp_path / "y.npy", Inference.load(versions["head"], runtime="torch").predict(x))
    arguments = [versions["head"], tmp_path / "x.npy", tmp_path / "y.npy"]
    done = subprocess.run([sys.executable, "-c", WITHOUT_TORCH, *map(str, arguments)], check=False)
    assert done.returncode == 0


def test_torch_does_without_onnx_runtime(versions, monkeypatch):
    x = small_windows(20)
    expected = Inference.load(versions["head"], runtime="onnx").predict(x)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    alone = Inference.load(versions["head"])
    assert alone.runtime == "torch"
    np.testing.assert_array_equal(alone.predict(x), expected)


def test_a_long_log_is_predicted_a_few_windows_at_a_time(versions, monkeypatch):
    model = Inference.load(versions["head"], runtime="onnx")
    sizes = []
    once = model.run
    monkeypatch.setattr(model, "run", lambda x: sizes.append(len(x)) or once(x))
    x = small_windows(50)
    np.testing.assert_allclose(
        model.predict_proba(x)[-3:], model.predict_proba(x[-3:]), rtol=0, atol=1e-6
    )
    assert max(sizes) <= 16  # the memory of the absolute distances grows with them


def test_without_an_onnx_file_it_runs_on_torch(copied):
    manifest = json.loads((copied / "manifest.json").read_text())
    del manifest["onnx"]
    (copied / "manifest.json").write_text(json.dumps(manifest))
    assert Inference.load(copied).runtime == "torch"
    with pytest.raises(ValueError, match="add one with add_onnx"):
        Inference.load(copied, runtime="onnx")


def test_one_thread_runs_it_and_sleeps_in_between(versions):
    options = open_session((versions["whole"] / "model.onnx").read_bytes()).get_session_options()
    assert options.intra_op_num_threads == options.inter_op_num_threads == 1
    assert options.get_session_config_entry("session.intra_op.allow_spinning") == "0"


def test_a_flipped_bit_in_the_file_is_noticed(copied):
    data = bytearray((copied / "model.onnx").read_bytes())
    data[len(data) // 2] ^= 1
    (copied / "model.onnx").write_bytes(data)
    with pytest.raises(ValueError, match=r"model\.onnx is damaged"):
        Inference.load(copied)


def test_a_missing_file_is_named(copied):
    (copied / "model.onnx").unlink()
    with pytest.raises(FileNotFoundError, match=r"missing: model\.onnx"):
        Inference.load(copied)


def test_a_file_that_onnx_runtime_cannot_run_is_refused_in_one_line(copied):
    (copied / "model.onnx").write_bytes(b"no model")
    manifest = json.loads((copied / "manifest.json").read_text())
    manifest["onnx"]["sha256"] = hashlib.sha256(b"no model").hexdigest()
    (copied / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(ValueError, match="cannot run this file") as error:
        Inference.load(copied)
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"network": None},
        {"network": {"layout": {}}},
        {"fault_set": [99]},
        {"fault_set": None},
        {"onnx": 3},
    ],
)
def test_a_damaged_manifest_is_refused(copied, wrong):
    manifest = json.loads((copied / "manifest.json").read_text())
    (copied / "manifest.json").write_text(json.dumps({**manifest, **wrong}))
    with pytest.raises(ValueError, match="damaged"):
        Inference.load(copied)


@pytest.mark.parametrize("runtime", ["onnx", "torch"])
def test_windows_of_another_shape_are_refused(versions, runtime):
    model = Inference.load(versions["whole"], runtime=runtime)
    for x in (small_windows(1)[0], small_windows(1)[:, :4], small_windows(1)[..., :17]):
        with pytest.raises(ValueError, match=r"expected windows \[N, 5, 18\]"):
            model.predict_proba(x)


def test_an_unknown_runtime_is_refused_and_it_prints_what_it_is(versions):
    with pytest.raises(ValueError, match="unknown runtime 'tpu': use one of onnx, torch"):
        Inference.load(versions["whole"], runtime="tpu")
    text = str(Inference.load(versions["head"]))
    assert text == f"3 classes from 5 frames of {SMALL}, 3 cells dropped, on ONNX Runtime"
