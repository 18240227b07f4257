import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from adaptfault.data.recordings import Recordings
from diagnostics import Fault, Line, Monitor, SelfDiagnosis, SensorLayout, inject, line_fault


def stored(diagnoser: SelfDiagnosis) -> SelfDiagnosis:
    """Through a file, as on a disk."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "diagnosis.npz"
        diagnoser.save(path)
        return SelfDiagnosis.load(path)


@pytest.fixture(scope="module")
def fitted(grasps: Recordings) -> SelfDiagnosis:
    """Fitted here: that of all tests may have come from a file, and what that lost would go
    unseen."""
    return SelfDiagnosis(grasps.layout).fit(grasps.frames[::20])


@pytest.fixture(scope="module")
def log(grasps: Recordings) -> np.ndarray:
    """Eight grasps that the reference does not hold, with a broken row, a stuck and a loose
    cell."""
    frames = np.concatenate([grasps.frames[i] for i in range(21, 140, 15)]).astype(float)
    row = line_fault(grasps.layout, Line(0, "row", 5), "short", onset=250)
    faults = [row, Fault("stuck", (160,), value=1.7), Fault("intermittent", (38,), onset=100)]
    return inject(frames, faults, grasps.layout, seed=0, dither=0.004)


def small_fit(layout: SensorLayout, recordings: int = 3) -> SelfDiagnosis:
    rng = np.random.default_rng(1)
    force = np.maximum(0, np.sin(np.arange(120) / 9))[:, None]
    return SelfDiagnosis(layout).fit(
        [force * rng.uniform(0, 3, layout.n_cells) for _ in range(recordings)]
    )


@pytest.fixture(scope="module")
def small() -> SelfDiagnosis:
    """A fit of nine cells; not to be changed."""
    return small_fit(SensorLayout(1, 3, 3))


def test_a_restored_diagnosis_gives_the_same_result_to_the_last_bit(fitted, log):
    assert fitted.diagnose(log).faults
    assert stored(fitted).diagnose(log).to_dict() == fitted.diagnose(log).to_dict()


def test_one_without_a_reference_does_too(grasps, log):
    cold = SelfDiagnosis(grasps.layout, false_discovery_rate=0.02)
    restored = stored(cold)
    assert restored.reference_ is None
    assert restored.false_discovery_rate == 0.02
    assert restored.diagnose(log).to_dict() == cold.diagnose(log).to_dict()


@pytest.mark.usefixtures("seldom_evaluated")
def test_frame_by_frame_it_gives_the_same_result(fitted, log):
    was = Monitor(fitted, wait=True)
    restored = Monitor(stored(fitted), wait=True)
    news = [(was.update(frame), restored.update(frame)) for frame in log[:700]]
    assert any(one for one, _ in news)
    assert all(one == other for one, other in news)
    assert restored.diagnosis().to_dict() == was.diagnosis().to_dict()


def test_masked_positions_and_arrays_in_tiles_come_back():
    present = np.ones((2, 16, 16), bool)
    present[:, :2, :2] = False
    diagnoser = small_fit(
        SensorLayout(2, 16, 16, full_scale=4095, unit="counts", rate=31.25, present=present)
    )
    assert len(diagnoser.reference_.model.predictor.mean.parts) == 8
    frames = np.full((80, 512), np.nan)
    frames[:, :500] = np.random.default_rng(2).uniform(0, 4000, (80, 500))
    frames[20:, 100] = 4095
    restored = stored(diagnoser)
    assert restored.layout == diagnoser.layout
    assert restored.diagnose(frames).to_dict() == diagnoser.diagnose(frames).to_dict()


def test_the_state_is_a_copy(fitted):
    about, arrays = fitted.state()
    restored = SelfDiagnosis.from_state(about, arrays)
    before = restored.reference_.model.predictor.usual.copy()
    arrays["reference.model.predictor.usual"][:] = 7
    assert (restored.reference_.model.predictor.usual == before).all()
    assert (fitted.reference_.model.predictor.usual == before).all()


def refused(about: dict, arrays: dict[str, np.ndarray], message: str) -> bool:
    """Return whether a state is refused with such a message."""
    try:
        SelfDiagnosis.from_state(about, arrays)
    except ValueError as error:
        return message in str(error)
    return False


def test_each_array_that_is_missing_misshapen_or_not_finite_is_refused_by_name(small):
    about, arrays = small.state()
    names = [name for name, values in arrays.items() if values.size]
    assert len(names) > 20
    for name in names:
        values = arrays[name]
        without = {other: kept for other, kept in arrays.items() if other != name}
        assert refused(about, without, name), name
        misshapen = {**arrays, name: values[:-1, ...][:, None]}
        assert refused(about, misshapen, name), name
        if values.dtype.kind == "f" and np.isfinite(values).all():
            assert refused(about, {**arrays, name: np.full_like(values, np.nan)}, name), name


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"schema": "adaptfault.diagnoser/2"}, "schema"),
        ({"layout": {"rows": 3}}, "pads"),
        ({"layout": None}, "damaged"),
        ({"false_discovery_rate": None}, "damaged"),
        ({"reference": {}}, "missing"),
        ({"reference": 3}, "damaged"),
    ],
)
def test_a_field_that_is_missing_or_wrong_is_refused(small, wrong, message):
    about, arrays = small.state()
    with pytest.raises(ValueError, match=message):
        SelfDiagnosis.from_state({**about, **wrong}, arrays)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("tolerance", -1.0),
        ("tolerance", "wide"),
        ("patience", 0),
        ("patience", None),
        ("usual", {}),
        ("model", 3),
    ],
)
def test_a_reference_whose_numbers_cannot_be_is_refused(small, field, value):
    about, arrays = small.state()
    about["reference"][field] = value
    with pytest.raises(ValueError, match="damaged"):
        SelfDiagnosis.from_state(about, arrays)


def test_restoring_needs_no_torch(small, tmp_path):
    path = tmp_path / "diagnosis.npz"
    small.save(path)
    code = """
import sys
from diagnostics import SelfDiagnosis
print(SelfDiagnosis.load(sys.argv[1]).layout.n_cells, "torch" in sys.modules)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, path], check=True, capture_output=True, text=True
    )
    assert done.stdout.split() == ["9", "False"]


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", b"{}", b"\x93NUMPY"])
def test_a_file_that_is_no_fitted_diagnosis_is_refused_by_its_name(tmp_path, content):
    path = tmp_path / "diagnosis.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"diagnosis\.npz is damaged, or holds no fitted"):
        SelfDiagnosis.load(path)


def test_each_byte_that_turns_in_a_file_is_noticed_or_changes_nothing(tmp_path):
    path = tmp_path / "diagnosis.npz"
    whole = small_fit(SensorLayout(1, 2, 3))
    whole.save(path)
    data = path.read_bytes()
    about, arrays = whole.state()
    rng = np.random.default_rng(0)
    for place in rng.choice(len(data), 60, replace=False):
        turned = bytearray(data)
        turned[place] ^= 0x10
        path.write_bytes(turned)
        try:
            other, found = SelfDiagnosis.load(path).state()
        except ValueError:
            continue
        assert other == about
        assert all(np.array_equal(found[name], arrays[name], equal_nan=True) for name in arrays)


def test_a_save_that_fails_leaves_the_earlier_file(small, tmp_path, monkeypatch):
    path = tmp_path / "diagnosis.npz"
    earlier = small_fit(SensorLayout(1, 2, 3))
    earlier.save(path)

    def full(*args: object, **named: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numpy.savez", full)
    with pytest.raises(OSError, match="No space left"):
        small.save(path)
    assert [file.name for file in tmp_path.iterdir()] == ["diagnosis.npz"]
    assert SelfDiagnosis.load(path).layout == earlier.layout
