"""Fingers of one bus each, which are loaded independently: some fail as a whole, some are worn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptfault.inspection.inspection import inspect
from diagnostics import Diagnosis, FaultKind, Line, SelfDiagnosis, SensorLayout, Verdict

FINGERS = 4
CELLS = 6
FRAMES = 60
FAILS = 22  # first frame of a recording in which a finger fails
LAYOUT = SensorLayout(FINGERS, 2, 3, full_scale=255, unit="count", rate=50.0, wiring="bus")
N_RECORDINGS = 30
LONG = 32  # frames of a failure that even one recording shows
WAYS = ("blinks", "low", "high", "middle", "floats", "freezes")
PLACES = np.array([(row, column) for row in range(2) for column in range(3)], float)


def recording(rng: np.random.Generator) -> np.ndarray:
    """Two bumps that come and go on most fingers, with noise, in whole counts, ``[T, D]``."""
    load = np.zeros((FRAMES, FINGERS, CELLS))
    for finger in np.flatnonzero(rng.random(FINGERS) < 0.8):
        for begin in rng.integers(0, FRAMES - 12, 2):
            length = int(rng.integers(12, 36))
            center = rng.uniform((-0.3, -0.3), (1.3, 2.3))
            bump = np.exp(-((PLACES - center) ** 2).sum(axis=1) / 2)
            rise = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 0.5
            part = load[begin : begin + length, finger]
            part[:] = np.maximum(part, rng.uniform(60, 230) * np.outer(rise, bump)[: len(part)])
    noisy = load.reshape(FRAMES, -1) + rng.normal(0, 1, (FRAMES, FINGERS * CELLS))
    return np.clip(np.rint(noisy), 0, 255)


def recordings(n: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [recording(rng) for _ in range(n)]


@pytest.fixture(scope="module")
def fitted() -> SelfDiagnosis:
    return SelfDiagnosis(LAYOUT).fit(recordings(60, 1))


def failing(way: str, readings: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return what a finger reads that fails in some way, ``[t, cells]``, instead of its
    ``readings``."""
    n = len(readings)
    one: dict[str, np.ndarray] = {
        "blinks": 255.0 * rng.integers(0, 2, n),
        "low": np.zeros(n),
        "high": np.full(n, 255.0),
        "middle": np.full(n, 77.0),
        "floats": np.clip(np.rint(128 + np.cumsum(rng.normal(0, 5, n))), 0, 255),
    }
    if way == "freezes":
        return np.repeat(readings[:1], n, axis=0)
    return np.repeat(one[way][:, None], CELLS, axis=1)


def diagnosed(
    fitted: SelfDiagnosis,
    way: str,
    finger: int,
    which: list[int],
    frames: slice = slice(FAILS, None),
) -> Diagnosis:
    """Return the diagnosis of a log, in some recordings of which a finger fails for some frames."""
    rng = np.random.default_rng(3)
    log = recordings(N_RECORDINGS, 2)
    cells = slice(CELLS * finger, CELLS * (finger + 1))
    for i in which:
        log[i][frames, cells] = failing(way, log[i][frames, cells], rng)
    return fitted.diagnose(log)


def test_of_a_finger_that_goes_to_rest_in_every_second_recording_no_cell_is_called_alive(fitted):
    rng = np.random.default_rng(3)
    log = recordings(N_RECORDINGS, 2)
    for finger in range(2):
        seen = [frames.copy() for frames in log]
        cells = slice(CELLS * finger, CELLS * (finger + 1))
        for frames in seen[::2]:
            at_rest = rng.normal(0, 1, (FRAMES - FAILS, CELLS))
            frames[FAILS:, cells] = np.clip(np.rint(at_rest), 0, 255)
        found = fitted.diagnose(seen)
        assert not (found.verdicts[cells] == Verdict.ALIVE).any()
        assert (found.verdicts == Verdict.ALIVE).sum() == LAYOUT.n_cells - CELLS


def test_fingers_that_are_loaded_independently_are_tested_by_their_own_cells(fitted):
    found = fitted.diagnose(recordings(N_RECORDINGS, 2))
    assert found.faults == ()
    assert found.tested.mean() > 0.9


@pytest.mark.parametrize("way", WAYS)
def test_a_finger_that_fails_now_and_then_is_one_cause_with_its_first_frame(fitted, way: str):
    finger = 2
    (fault,) = diagnosed(fitted, way, finger, list(range(3, 30, 3))).faults
    assert fault.kind is FaultKind.INTERMITTENT
    assert fault.line == Line(finger, "bus", 0)
    assert len(fault.cells) == CELLS
    assert fault.onset == pytest.approx(3 * FRAMES + FAILS, abs=2)


@pytest.mark.parametrize("finger", range(FINGERS))
def test_any_finger_that_blinks_from_some_recording_on_is_one_cause(fitted, finger: int):
    (fault,) = diagnosed(fitted, "blinks", finger, list(range(18, 30))).faults
    assert (fault.kind, fault.line) == (FaultKind.INTERMITTENT, Line(finger, "bus", 0))
    # at rest, all cells may read the same by chance
    assert fault.onset == pytest.approx(18 * FRAMES + FAILS, abs=2)


@settings(max_examples=25, deadline=None)
@given(
    way=st.sampled_from(WAYS),
    finger=st.integers(0, FINGERS - 1),
    which=st.just([N_RECORDINGS - 1])
    | st.lists(st.integers(0, N_RECORDINGS - 1), min_size=1, unique=True),
    begin=st.integers(0, FRAMES - LONG),
    length=st.integers(LONG, FRAMES),
)
def test_a_finger_that_fails_anywhere_in_the_log_in_any_way_is_never_told_alive(
    fitted, way: str, finger: int, which: list[int], begin: int, length: int
):
    found = diagnosed(fitted, way, finger, which, slice(begin, begin + length))
    own = slice(CELLS * finger, CELLS * (finger + 1))
    assert not (found.verdicts[own] == Verdict.ALIVE).any()
    assert set(found.fault_set) <= set(range(own.start, own.stop))


@pytest.mark.parametrize("way", ["blinks", "high"])
def test_a_finger_that_fails_in_all_recordings_is_told_once_and_nothing_of_the_whole_sensor(
    fitted, way: str
):
    rng = np.random.default_rng(3)
    log = recordings(N_RECORDINGS, 2)
    for frames in log:
        frames[FAILS:45, 12:18] = failing(way, frames[FAILS:45, 12:18], rng)
    found = inspect(log, fitted, reference=recordings(60, 1))
    assert [one.name for one in found.findings] == ["wire"]
    assert set(found.diagnosis.fault_set) == set(range(12, 18))


def test_a_finger_that_a_flat_object_presses_beyond_the_range_is_healthy(fitted):
    log = recordings(N_RECORDINGS, 2)
    rise = np.minimum(1, np.arange(FRAMES) / 20) * np.minimum(1, np.arange(FRAMES)[::-1] / 20)
    edge = np.array([0.8, 1.0, 0.9, 1.2, 1.1, 0.85])
    for i in range(0, 30, 3):
        pressed = 500 * rise[:, None] * edge
        log[i][:, :CELLS] = np.clip(np.rint(np.maximum(log[i][:, :CELLS], pressed)), 0, 255)
    assert fitted.diagnose(log).faults == ()


@pytest.mark.parametrize("gain", [3, 5])
def test_the_noise_of_cells_with_a_higher_gain_is_no_load_of_their_finger(fitted, gain: float):
    log = recordings(N_RECORDINGS, 2)
    for frames in log:
        frames[:, [8, 15]] = np.clip(np.rint(gain * frames[:, [8, 15]]), 0, 255)
    faults = fitted.diagnose(log).faults
    assert [fault.cells for fault in faults] == [(8,), (15,)]


@pytest.mark.parametrize("gain", [0.05, 0.1, 0.2, 0.35])
def test_worn_cells_are_weak_with_their_gain_and_no_pad_is_replaced(fitted, gain: float):
    rng = np.random.default_rng(0)
    log = recordings(N_RECORDINGS, 2)
    worn = [8, 15]
    for frames in log:
        weaker = gain * frames[:, worn] + rng.normal(0, 1, (FRAMES, 2))
        frames[:, worn] = np.clip(np.rint(weaker), 0, 255)
    found = inspect(log, fitted, reference=recordings(60, 1))
    assert found.recalibration is None
    assert found.change is None
    faults = found.diagnosis.faults
    assert [(fault.kind, fault.cells) for fault in faults] == [
        (FaultKind.WEAK, (cell,)) for cell in worn
    ]
    assert all(gain / 2.1 < fault.value < 2.1 * gain for fault in faults)
