import logging
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from conftest import DROPPED, SMALL, small_windows

from adaptfault.bundle import reload
from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.versions import Version
from adaptfault.data.atomic import atomic_write
from adaptfault.data.windows import make_windows
from adaptfault.prediction import predictor as module
from adaptfault.prediction.inference import Inference
from adaptfault.prediction.predictor import Predictor, Reading
from diagnostics import Fault, FaultSet, Monitor, Scan, SelfDiagnosis, inject
from diagnostics.simulation.circuit import Circuit, StuckCell
from diagnostics.simulation.scan import scan_circuit

D = SMALL.n_cells


@dataclass
class Carried:
    """What the predictor needs of a bundle: a pointer to a version, and starts that are counted."""

    root: Path
    folders: dict[int, Path]
    fitted: SelfDiagnosis
    begun: list[int] = field(default_factory=list)
    confirmed: list[int] = field(default_factory=list)
    layout = SMALL
    class_names = ("a", "b", "c")

    @property
    def pointer(self) -> Path:
        return self.root / "active"

    def deploy(self, number: int) -> None:
        atomic_write(self.pointer, str(number).encode())

    def active(self) -> Version:
        number = int(self.pointer.read_text())
        return Version(number, self.folders[number], SMALL, (), 5, FaultSet((), D))

    def begin(self, starter: str = "") -> Version:
        number = self.active().number
        if (
            self.begun.count(number) == 2
            and number not in self.confirmed
            and number - 1 in self.folders
        ):
            self.deploy(number - 1)
        self.begun.append(self.active().number)
        return self.active()

    def confirm(self) -> None:
        self.confirmed.append(self.active().number)

    def diagnoser(self) -> SelfDiagnosis:
        return self.fitted


def presses(seed: int, frames: int = 400) -> np.ndarray:
    """Presses that come and go, in newtons, harder on some cells."""
    rng = np.random.default_rng(seed)
    force = np.maximum(0, np.sin(np.arange(frames) / rng.uniform(6, 12)))[:, None]
    load = force * rng.uniform(0.5, 3, D) + rng.normal(0, 0.005, (frames, D))
    return np.maximum(0, load) * SMALL.present.ravel()


@pytest.fixture(scope="module")
def fitted_small() -> SelfDiagnosis:
    return SelfDiagnosis(SMALL).fit([presses(seed, 100) for seed in range(12)])


@pytest.fixture
def carried(versions, tmp_path, fitted_small) -> Carried:
    folders = {1: versions["whole"], 2: versions["head"], 3: versions["whole"]}
    made = Carried(tmp_path, folders, fitted_small)
    made.deploy(1)
    return made


@pytest.fixture
def eager(monkeypatch) -> None:
    """Look for a new version at every frame."""
    monkeypatch.setattr(module, "_POLL", 0.0)
    monkeypatch.setattr(reload, "_RETRY", 0.0)


def running(carried: Carried, number: int = 1) -> Predictor:
    carried.deploy(number)
    return Predictor(lambda: carried, wait=True)


def spoil(carried: Carried, number: int) -> None:
    """Flip a bit of a version's ONNX file, in a copy."""
    folder = shutil.copytree(carried.folders[number], carried.root / f"spoilt{number}")
    data = bytearray((folder / "model.onnx").read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "model.onnx").write_bytes(data)
    carried.folders[number] = folder


def stream_until(
    predictor: Predictor, frames: np.ndarray, done: Callable[[], bool]
) -> list[Reading]:
    """Stream the frames over and over until it is done, and for one more window."""
    readings: list[Reading] = []
    end = time.monotonic() + 300
    while not done():
        assert time.monotonic() < end, "it was never done"
        readings.append(predictor.stream(frames[len(readings) % len(frames)]))
        time.sleep(0.002)
    return readings + [
        predictor.stream(frames[(len(readings) + i) % len(frames)]) for i in range(5)
    ]


# frames


def test_frame_by_frame_it_says_what_the_model_says_of_every_window(carried, rng):
    frames = presses(50, 60)
    frames[rng.random(frames.shape) < 0.05] = np.nan  # lost readings, held from the frame before
    frames[:3, 7] = np.nan
    predictor = running(carried, 2)
    readings = [predictor.stream(frame) for frame in frames]
    assert [reading.label for reading in readings[:4]] == [None] * 4
    assert [reading.probabilities for reading in readings[:4]] == [None] * 4
    x = make_windows([frames], None, SMALL, length=5, stride=1).x
    assert [reading.label for reading in readings[4:]] == predictor.predict(x).tolist()
    np.testing.assert_allclose(
        [reading.probabilities for reading in readings[4:]],
        predictor.predict_proba(x),
        rtol=0,
        atol=1e-6,
    )
    assert len(set(predictor.predict(x))) > 1
    assert all(tuple(reading.fault_set) == DROPPED["head"] for reading in readings)
    assert readings[3].name is None
    assert [reading.name for reading in readings[4:]] == [
        "abc"[label] for label in predictor.predict(x)
    ]


def test_what_a_dropped_cell_reads_changes_nothing_and_an_infinite_reading_of_another_is_held(
    carried,
):
    frames = presses(51, 12)
    held = frames.copy()
    held[6, 3] = held[5, 3]
    wild = frames.copy()
    wild[:, list(DROPPED["head"])] = np.array([np.nan, np.inf, -1e9])
    wild[6, 3] = np.inf
    one = running(carried, 2)
    other = running(carried, 2)
    for a, b in zip(held, wild, strict=True):
        usual = one.stream(a).probabilities
        given = other.stream(b).probabilities
        assert (usual is None and given is None) or np.array_equal(usual, given)
    assert given is not None


def test_its_events_are_the_monitors(carried, fitted_small):
    frames = inject(
        np.concatenate([presses(60), presses(61)]), [Fault("short", (8,), onset=200)], SMALL
    )
    predictor = running(carried)
    monitor = Monitor(fitted_small, wait=True)
    times = np.arange(len(frames)) / SMALL.rate
    readings = [predictor.stream(frame, t) for frame, t in zip(frames, times, strict=True)]
    said = [reading.events for reading in readings]
    assert said == [monitor.update(frame, t) for frame, t in zip(frames, times, strict=True)]
    assert any(8 in event.cells for events in said for event in events)
    assert readings[0].faults == ()
    assert readings[-1].faults == monitor.faults
    assert any(8 in fault.cells for fault in monitor.faults)


def test_a_frame_may_come_as_a_grid_and_one_of_another_shape_is_refused_and_not_counted(carried):
    frames = presses(52, 8)
    flat = running(carried)
    grid = running(carried)
    for i, frame in enumerate(frames):
        if i == 3:
            with pytest.raises(
                ValueError, match=r"expected a frame \[18\] or \[2, 3, 3\], got \[17\]"
            ):
                grid.stream(frame[:-1])
        assert str(flat.stream(frame)) == str(grid.stream(frame.reshape(SMALL.shape)))


def test_after_a_reset_a_window_must_fill_again(carried):
    predictor = running(carried)
    frames = presses(53, 10)
    first = [predictor.stream(frame).label for frame in frames[:7]]
    predictor.reset()
    assert [predictor.stream(frame).label for frame in frames[:7]] == first


# versions


def test_a_new_version_takes_over_between_two_frames_and_none_is_missed(carried, eager):
    predictor = running(carried)
    frames = presses(54, 50)
    readings = [predictor.stream(frame) for frame in frames]
    carried.deploy(2)
    predictor.reset()
    readings = stream_until(predictor, frames, lambda: predictor.version == 2)
    numbers = [reading.version for reading in readings]
    assert numbers == sorted(numbers)
    assert set(numbers) == {1, 2}
    models = {number: Inference.load(carried.folders[number]) for number in (1, 2)}
    x = make_windows([np.resize(frames, (len(readings), D))], None, SMALL, length=5, stride=1).x
    for reading, window in zip(readings[4:], x, strict=True):
        expected = models[reading.version].predict_proba(window[None])[0]
        np.testing.assert_allclose(reading.probabilities, expected, rtol=0, atol=1e-6)
        assert reading.fault_set == models[reading.version].fault_set


def test_it_follows_back_and_forth_and_starts_each_version_once(carried, eager):
    predictor = running(carried)
    for number in (3, 2, 1):
        carried.deploy(number)
        stream_until(predictor, presses(55, 50), lambda number=number: predictor.version == number)
    assert carried.begun == [1, 3, 2, 1]


def test_predicting_windows_keeps_up_too(carried, eager):
    predictor = running(carried)
    carried.deploy(2)
    end = time.monotonic() + 300
    while predictor.version == 1 and time.monotonic() < end:
        predictor.predict(small_windows(1))
    x = small_windows(9)
    x[..., list(DROPPED["head"])] = np.nan
    assert predictor.predict(x).tolist() == Inference.load(carried.folders[2]).predict(x).tolist()


def test_while_a_new_version_loads_the_old_one_answers(carried, eager, monkeypatch):
    predictor = running(carried)
    go_on = threading.Event()
    load = Inference.load
    monkeypatch.setattr(Inference, "load", lambda folder: go_on.wait(60) and load(folder))
    carried.deploy(2)
    frames = presses(56, 50)
    readings = [predictor.stream(frame) for frame in frames]
    assert {reading.version for reading in readings} == {1}
    assert "adaptfault-load" in {thread.name for thread in threading.enumerate()}
    go_on.set()
    assert stream_until(predictor, frames, lambda: predictor.version == 2)[-1].version == 2


def test_one_that_cannot_be_loaded_leaves_the_old_one_running_is_logged_once_and_the_next_is_taken(
    carried, eager, caplog
):
    spoil(carried, 2)
    predictor = running(carried)
    carried.deploy(2)
    frames = presses(57, 50)
    stream_until(predictor, frames, lambda: bool(caplog.records))
    carried.deploy(2)  # touched again: it has failed before
    readings = [predictor.stream(frame) for frame in frames]
    assert {reading.version for reading in readings} == {1}
    assert all(reading.label is not None for reading in readings)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "version 2 could not be loaded, version 1 goes on" in caplog.text
    assert carried.begun == [1, 2]
    carried.deploy(3)
    stream_until(predictor, frames, lambda: predictor.version == 3)


def test_a_bundle_that_cannot_be_read_for_a_while_is_tried_again(carried, eager, caplog):
    def busy_once():
        if len(calls) == 1:
            calls.append(1)
            raise OSError("somebody else has the lock")
        calls.append(1)
        return carried

    calls: list[int] = []
    predictor = Predictor(busy_once)
    carried.deploy(2)
    stream_until(predictor, presses(58, 50), lambda: predictor.version == 2)
    assert (
        "the bundle could not be read, version 1 goes on: somebody else has the lock" in caplog.text
    )


def test_a_start_with_a_version_that_cannot_be_loaded_falls_back(carried, caplog):
    spoil(carried, 2)
    predictor = running(carried, 2)
    assert predictor.version == 1
    assert carried.begun == [2, 2, 1]
    assert caplog.text.count("version 2 could not be loaded") == 2
    assert predictor.stream(presses(0, 1)[0]).version == 1


def test_a_start_without_any_whole_version_is_refused(carried):
    for number in (1, 2):
        spoil(carried, number)
    with pytest.raises(ValueError, match=r"model\.onnx is damaged"):
        running(carried, 2)


def test_a_version_for_another_array_is_not_taken(carried):
    carried.layout = type(SMALL)(3, 3, 2)
    with pytest.raises(ValueError, match="the bundle for 3 x 3 x 2 cells"):
        running(carried)


def test_readings_outside_the_range_never_make_the_probabilities_nan(carried):
    predictor = running(carried)
    log = presses(60, 30)
    clean = [predictor.stream(frame).probabilities for frame in log]
    predictor.reset()
    for i, value in enumerate((1e30, np.inf, -np.inf, 1e308, -1e30, np.nan)):
        log[10 + i, i % D] = value
    found = [predictor.stream(frame).probabilities for frame in log]
    assert all(p is None or np.isfinite(p).all() for p in found)
    np.testing.assert_array_equal(found[-1], clean[-1])
    assert predictor.outside == 5
    x = small_windows(3)
    x[0, 2, 1] = x[1, 0, 0] = np.float32(np.inf)
    x[2, 1, 3] = 1e30
    assert np.isfinite(predictor.predict_proba(x)).all()


def test_a_version_on_probation_runs_on_a_disk_that_cannot_be_written(carried, caplog):
    def full():
        raise OSError(28, "No space left on device")

    carried.confirm = full
    predictor = running(carried, 2)
    assert not predictor.confirm()
    assert "stays on probation" in caplog.text


def test_only_the_running_version_is_confirmed(carried):
    predictor = running(carried, 2)
    assert predictor.confirm()
    carried.deploy(3)
    assert not predictor.confirm()
    assert carried.confirmed == [2]


def test_between_two_looks_the_disk_is_left_alone(carried, monkeypatch):
    monkeypatch.setattr(module, "_POLL", 1000.0)
    predictor = running(carried)
    looked = []
    monkeypatch.setattr(module, "file_stamp", looked.append)
    readings = [predictor.stream(frame) for frame in presses(59, 30)]
    assert readings[-1].label is not None
    assert looked == []


def test_load_opens_the_bundle_at_a_path_and_prints_what_runs(carried, monkeypatch):
    monkeypatch.setattr(
        Bundle,
        "open",
        lambda path, **signed: carried if path == "robot.bundle" else pytest.fail(path),
    )
    predictor = Predictor.load("robot.bundle")
    assert (predictor.version, predictor.runtime, predictor.class_names) == (
        1,
        "onnx",
        ("a", "b", "c"),
    )
    assert str(predictor).startswith("version 1: 3 classes from 5 frames of 2 x 3 x 3 cells")


WITHOUT_TORCH = """
import sys
from pathlib import Path
from types import SimpleNamespace
import numpy as np
from adaptfault import Predictor
from adaptfault.models.store import ADAPTATION, read_manifest
from adaptfault.bundle.versions import Version
from diagnostics import FaultSet, SelfDiagnosis, SensorLayout
folder = Path(sys.argv[1])
layout = SensorLayout.from_dict(read_manifest(folder, ADAPTATION)["network"]["layout"])
version = Version(1, folder, layout, (), 10, FaultSet((), layout.n_cells))
predictor = Predictor(lambda: SimpleNamespace(
    layout=layout, class_names=(), pointer=folder, active=lambda: version,
    begin=lambda starter: version, diagnoser=lambda: SelfDiagnosis(layout),
))
for frame in np.random.default_rng(0).uniform(0, 4, (200, layout.n_cells)):
    reading = predictor.stream(frame)
assert reading.label is not None
assert predictor.runtime == "onnx"
assert "torch" not in sys.modules
"""


def test_a_robot_streams_without_torch(versions):
    command = [sys.executable, "-c", WITHOUT_TORCH, str(versions["head"])]
    assert subprocess.run(command, check=False).returncode == 0  # what it asserts


def test_a_predictor_tells_the_set_of_classes_of_each_window_where_it_is_asked_to(carried):
    frames = presses(3, 30)
    plain = running(carried)
    with_sets = Predictor(lambda: carried, sets=0.3)
    for frame in frames:
        alone = plain.stream(frame)
        reading = with_sets.stream(frame)
        assert alone.classes is None
        assert (reading.classes is None) == (reading.label is None)
        if reading.classes is not None:
            threshold = with_sets._running.model.sets.threshold(0.3)
            likely = reading.probabilities.astype(float)
            assert reading.classes == tuple(np.flatnonzero(1 - likely <= threshold))
    with pytest.raises(ValueError, match="alpha is the share of wrong sets"):
        Predictor(lambda: carried, sets=1.0)


def test_a_predictor_accumulates_over_a_contact_only_where_it_is_asked_to(carried):
    frames = presses(3, 60)
    plain = running(carried)
    accumulating = Predictor(lambda: carried, accumulate=True)
    alone = [plain.stream(f) for f in frames]
    together = [accumulating.stream(f) for f in frames]
    assert all(reading.contact is None for reading in alone)
    full = [reading for reading in together if reading.probabilities is not None]
    inside = [reading.contact is not None for reading in full]
    assert any(inside)
    assert not all(inside)
    first = full[inside.index(True)]
    np.testing.assert_allclose(first.contact, first.probabilities, atol=1e-6)
    for one, other in zip(alone, together, strict=True):
        assert one.label == other.label
    accumulating.reset()
    assert accumulating.stream(np.zeros(D)).contact is None


def scan_of(*faults: StuckCell) -> Scan:
    """Return a scan of the untouched array, with lines held."""
    scan = scan_circuit(Circuit(SMALL, faults=faults), np.full(D, 0.01))
    return Scan(scan.levels, scan.readings, holds_lines=True)


def test_a_scan_is_evidence_of_its_monitor_each_crossing_where_its_cell_answers(
    carried, monkeypatch
):
    scan = scan_of(StuckCell(8, np.inf))
    predictor = running(carried)
    (fault,) = predictor.scan(scan)
    assert fault.cells == (8,)
    assert predictor.faults == (fault,)
    assert predictor.stream(presses(50, 1)[0]).faults == (fault,)
    with pytest.raises(ValueError, match=f"a scan of 4 cells, but the array has {D}"):
        predictor.scan(Scan(np.array([0.0, 1.0]), np.zeros((2, 4))))
    assert predictor.faults == (fault,)
    exchanged = np.arange(D)
    exchanged[[7, 8]] = (8, 7)
    monkeypatch.setattr(Version, "source", exchanged)
    (fault,) = running(carried).scan(scan)
    assert fault.cells == (7,)
