"""Without a reference, a log of enough recordings is its own: its first half."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import whole_fit
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptfault.data.simulated_grasps import simulate
from diagnostics import Fault, FaultKind, SelfDiagnosis, SensorLayout, Verdict, inject
from diagnostics.when import OWN_REFERENCE, reads_enough

LAYOUT = SensorLayout(1, 8, 8)
FAILS = 25  # recording from which on cells are dead


@pytest.fixture(scope="module")
def grasps() -> list[np.ndarray]:
    frames = simulate(6, LAYOUT, n_frames=50, seed=3).frames[:40]
    return [np.asarray(recording, dtype=np.float64) for recording in frames]


@pytest.fixture(scope="module")
def progress() -> list[float]:
    """What the fixture below was told of its progress."""
    return []


@pytest.fixture(scope="module")
def own(grasps: list[np.ndarray], progress: list[float]) -> SelfDiagnosis:
    """Fitted by the healthy log to its first half."""
    with whole_fit():
        return SelfDiagnosis(LAYOUT).for_log(grasps, progress=progress.append)


def failing(grasps: list[np.ndarray], cells: list[int], since: int) -> list[np.ndarray]:
    faults = [Fault(FaultKind.OPEN, (cell,)) for cell in cells]
    after = [
        inject(recording, faults, LAYOUT, seed=i) for i, recording in enumerate(grasps[since:])
    ]
    return [*grasps[:since], *after]


def test_cells_that_fail_in_the_second_half_are_found_without_a_reference(grasps):
    dead = [18, 27, 44]
    diagnosis = SelfDiagnosis(LAYOUT).diagnose(failing(grasps, dead, FAILS))
    assert sorted(diagnosis.fault_set) == dead
    start = sum(map(len, grasps[:FAILS]))
    assert all(abs(fault.onset - start) < 300 for fault in diagnosis.faults)


def test_cells_that_are_dead_from_the_start_are_found_too(grasps):
    dead = [9, 36]
    diagnosis = SelfDiagnosis(LAYOUT).diagnose(failing(grasps, dead, 0))
    assert sorted(diagnosis.fault_set) == dead


def test_of_a_healthy_log_no_cell_is_blamed_and_most_are_alive(grasps, own):
    diagnosis = own.diagnose(grasps)
    assert not diagnosis.faults
    alive = (diagnosis.verdicts == Verdict.ALIVE).reshape(8, 8)
    assert alive[1:-1, 1:-1].mean() > 0.9
    assert alive.mean() > 0.6  # contacts hardly touch the edges: these may be worn


def test_a_shorter_log_is_no_reference(grasps):
    cold = SelfDiagnosis(LAYOUT)
    assert cold.for_log(grasps[: OWN_REFERENCE - 1]) is cold


def test_of_a_log_that_lies_class_by_class_the_first_half_of_each_class_is_the_reference(
    grasps, monkeypatch
):
    taken = []

    def fitted(self, first, progress, suspected):
        taken.extend(first.given)
        return self

    monkeypatch.setattr(SelfDiagnosis, "_fit", fitted)
    log = grasps[:40]
    SelfDiagnosis(LAYOUT).for_log(log, classes=[0] * 30 + [1] * 10)
    wanted = [*log[:15], *log[30:35]]
    assert len(taken) == len(wanted)
    assert all(np.array_equal(a, b) for a, b in zip(taken, wanted, strict=True))


def test_a_fitted_diagnosis_stays_what_it_is(grasps, own):
    assert own.for_log(grasps) is own


def test_the_diagnosis_itself_is_not_fitted_by_a_log(grasps):
    cold = SelfDiagnosis(LAYOUT)
    cold.diagnose(grasps)
    assert cold.reference_ is None


@pytest.mark.parametrize("value", [0.0, 2.5, 5.0])
def test_an_array_that_never_moves_is_no_reference(value: float):
    cold = SelfDiagnosis(LAYOUT)
    assert cold.for_log([np.full((20, 64), value)] * 40) is cold


def test_noise_before_the_first_contact_is_no_reference(grasps):
    rng = np.random.default_rng(0)
    idle = [np.abs(rng.normal(0, 0.005, recording.shape)) for recording in grasps[:20]]
    cold = SelfDiagnosis(LAYOUT)
    assert cold.for_log([*idle, *grasps[20:]]) is cold


def test_a_log_with_missing_readings_is_its_own_reference(grasps):
    rng = np.random.default_rng(0)
    gappy = [np.where(rng.random(recording.shape) < 0.2, np.nan, recording) for recording in grasps]
    diagnosis = SelfDiagnosis(LAYOUT).diagnose(failing(gappy, [27], FAILS))
    assert sorted(diagnosis.fault_set) == [27]


def test_recordings_of_one_frame_do_not_crash_it(grasps):
    frames = [recording[25:26] for recording in grasps]
    SelfDiagnosis(LAYOUT).diagnose(frames)


def test_progress_is_told(own, progress):
    assert len(progress) > 30
    assert progress == sorted(progress)
    assert (progress[0] < 0.1, progress[-1]) == (True, 1.0)


def test_a_log_without_any_reading_is_refused():
    with pytest.raises(ValueError, match="no frame with a reading"):
        SelfDiagnosis(LAYOUT).diagnose([np.full((20, 64), np.nan)] * 40)


def test_a_cell_that_never_delivers_a_reading_is_faulty_and_does_not_disturb_the_fit(grasps):
    silent = [np.where(np.arange(64) == 30, np.nan, recording) for recording in grasps]
    assert SelfDiagnosis(LAYOUT).diagnose(silent).fault_set == {30}


def test_a_cell_at_full_scale_on_a_pad_that_nothing_touched_is_short_without_a_reference():
    layout = SensorLayout(2, 5, 5)
    rng = np.random.default_rng(0)
    log = [np.asarray(frames) for frames in simulate(4, layout, n_frames=50, seed=1).frames]
    for frames in log:
        frames[:, 25:] = np.abs(rng.normal(0.05, 0.002, (len(frames), 25)))
        frames[:, [31, 44]] = layout.full_scale
    diagnosis = SelfDiagnosis(layout).diagnose(log)
    assert sorted(diagnosis.fault_set) == [31, 44]
    assert {fault.kind for fault in diagnosis.faults} == {FaultKind.SHORT}


@pytest.mark.parametrize("recordings", [slice(None), slice(8)], ids=["own reference", "short"])
def test_a_cell_that_is_worn_from_the_start_is_not_told_alive_without_a_reference(
    grasps, recordings: slice
):
    diagnosis = SelfDiagnosis(LAYOUT).diagnose(worn(grasps[recordings], [27, 28], 0.2))
    assert not (diagnosis.verdicts[[27, 28]] == Verdict.ALIVE).any()
    assert set(diagnosis.fault_set) <= {27, 28}


@settings(max_examples=30)
@given(
    row=st.integers(2, 5),
    column=st.integers(2, 5),
    gain=st.floats(0.01, 0.15),
    n=st.integers(8, 40),
    noise=st.floats(0, 0.02),
)
def test_a_worn_cell_never_reads_enough(grasps, row: int, column: int, gain: float, n: int, noise):
    cell = LAYOUT.cell(0, row, column)
    rng = np.random.default_rng(n)
    log = [one + noise * rng.normal(size=one.shape) for one in worn(grasps[:n], [cell], gain)]
    enough = reads_enough(np.ptp(np.concatenate(log), axis=0), LAYOUT)
    assert not enough[cell]


def worn(grasps: list[np.ndarray], cells: list[int], gain: float) -> list[np.ndarray]:
    """Return recordings in which some cells read a part of their load."""
    log = [recording.copy() for recording in grasps]
    for recording in log:
        recording[:, cells] *= gain
    return log
