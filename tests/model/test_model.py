"""The one model: dead cells, cells that move by themselves, and healthy ones, in one judgement."""

from __future__ import annotations

import numpy as np
import pytest
from pressed_recordings import LAYOUT, REST, presses

from diagnostics import (
    Fault,
    FaultKind,
    Monitor,
    SelfDiagnosis,
    Verdict,
    inject,
)
from diagnostics.model import Model, fit_model
from diagnostics.model.ways import WAYS

USED = (18, 27, 36, 45)  # cells in the middle, which presses reach often


@pytest.fixture(scope="module")
def fitted(pressed: SelfDiagnosis) -> SelfDiagnosis:
    return pressed


@pytest.fixture(scope="module")
def model(fitted) -> Model:
    assert fitted._model is not None
    return fitted._model


@pytest.fixture
def healthy() -> list[np.ndarray]:
    return presses(1, 8)


def blamed(fitted: SelfDiagnosis, log: list[np.ndarray]) -> list[int]:
    return list(fitted.diagnose(log).fault_set)


def test_nobody_is_blamed_for_a_healthy_log_and_most_cells_are_alive(fitted, healthy):
    diagnosis = fitted.diagnose(healthy)
    assert not diagnosis.faults
    alive = [verdict is Verdict.ALIVE for verdict in diagnosis.verdicts]
    assert np.mean(alive) > 0.8


@pytest.mark.parametrize("value", [REST, 1500.0, 4095.0])
def test_cells_that_hold_a_value_are_found_with_it(fitted, healthy, value):
    for frames in healthy:
        frames[:, USED] = value
    diagnosis = fitted.diagnose(healthy)
    assert set(diagnosis.fault_set) == set(USED)
    kinds = {REST: FaultKind.OPEN, 1500.0: FaultKind.STUCK, 4095.0: FaultKind.SHORT}
    assert {fault.kind for fault in diagnosis.faults} == {kinds[value]}


def test_a_cell_that_dies_in_the_log_is_told_with_about_its_frame(fitted, healthy):
    for frames in healthy[4:]:
        frames[:, 27] = 900.0
    (fault,) = fitted.diagnose(healthy).faults
    assert fault.cells == (27,)
    assert fault.onset == pytest.approx(240, abs=16)


def test_a_cell_that_moves_by_itself_floats(fitted, healthy):
    swing = 1000 + 600 * np.sin(np.arange(480) / 9)
    for i, frames in enumerate(healthy):
        frames[:, 27] = swing[60 * i :][:60].round()
    (fault,) = fitted.diagnose(healthy).faults
    assert fault.cells == (27,)
    assert fault.kind is FaultKind.FLOATING


def test_a_cell_that_reads_the_loads_of_another_time_floats_and_those_beside_it_are_alive(fitted):
    log = presses(2, 30)
    for frames, other in zip(log, presses(6, 30), strict=True):
        frames[:, 27] = other[:, 27]
    diagnosis = fitted.diagnose(log)
    assert set(diagnosis.fault_set) == {27}
    beside = [diagnosis.verdicts[cell] for cell in (19, 26, 28, 35)]
    assert set(beside) == {Verdict.ALIVE}


def test_a_cell_that_is_dead_in_every_second_recording_is_told_with_these(fitted):
    log = presses(2, 30)
    for frames in log[::2]:
        frames[:, 27] = REST
    (fault,) = fitted.diagnose(log).faults
    assert fault.cells == (27,)
    assert fault.recordings == tuple(range(0, 30, 2))


def test_a_cell_that_repeats_the_one_beside_it_is_a_copy_of_it(fitted):
    log = presses(2, 20)
    for frames in log:
        frames[:, 27] = frames[:, 35]
    (fault,) = fitted.diagnose(log).faults
    assert (fault.cells, fault.kind, fault.value) == ((27,), FaultKind.COPY, 35)


def test_nobody_is_blamed_beside_cells_that_move_by_themselves_however_long_the_log(fitted):
    log = presses(4, 40)
    rng = np.random.default_rng(5)
    dead = [1, 14, 27, 44, 51]
    swing = 1000 + 400 * np.cumsum(rng.normal(0, 0.1, (2400, len(dead))), axis=0)
    for i, frames in enumerate(log):
        frames[:, dead] = np.clip(swing[60 * i :][:60], 0, 4095).round()
    assert blamed(fitted, log) == dead


def test_a_dead_row_is_one_fault(fitted, healthy):
    for frames in healthy:
        frames[:, 16:24] = REST
    (fault,) = fitted.diagnose(healthy).faults
    assert fault.cells == tuple(range(16, 24))
    assert fault.line is not None


def test_a_silent_cell_is_faulty(fitted, healthy):
    for frames in healthy:
        frames[:, 27] = np.nan
    assert blamed(fitted, healthy) == [27]


def test_missing_readings_are_no_fault(fitted, healthy, rng):
    log = [np.where(rng.random(frames.shape) < 0.3, np.nan, frames) for frames in healthy]
    assert blamed(fitted, log) == []


def test_a_log_in_which_nothing_is_touched_blames_and_proves_nobody(fitted):
    rng = np.random.default_rng(3)
    log = [(REST + rng.normal(0, 2, (60, 64))).round() for _ in range(6)]
    diagnosis = fitted.diagnose(log)
    assert not diagnosis.faults
    assert set(diagnosis.verdicts) == {Verdict.UNTESTED}


def test_what_nothing_is_known_of_is_not_judged(model, healthy):
    judgement = model.judge_record(model.record_of(healthy))
    assert judgement.evidence.shape == (len(WAYS), 64)
    assert judgement.probability.max() < 0.5
    assert not judgement.disturbed.any()


def test_the_same_recordings_give_the_same_model(healthy):
    one, again = [fit_model(presses(0, 48), LAYOUT, np.zeros(64, bool)) for _ in range(2)]
    record = one.record_of(healthy)
    np.testing.assert_allclose(
        again.judge_record(record).probability, one.judge_record(record).probability, rtol=1e-4
    )


@pytest.mark.parametrize("reference", [[presses(0, 1)[0][:20]], [np.full((60, 64), REST)] * 12])
def test_a_reference_that_shows_too_little_gives_no_model(reference):
    assert fit_model(reference, LAYOUT, np.zeros(64, bool)) is None


def test_with_too_short_a_reference_a_log_is_judged_by_its_own_cells(healthy):
    reference = [frames[20:42] for frames in presses(0, 7)]
    for frames in healthy:
        frames[:, USED] = 1500.0
    fitted = SelfDiagnosis(LAYOUT).fit(reference)
    assert fitted._model is None
    assert set(blamed(fitted, healthy)) == set(USED)


def test_one_long_recording_is_a_reference_as_well(healthy):
    fitted = SelfDiagnosis(LAYOUT).fit(np.concatenate(presses(0, 80)))
    assert not blamed(fitted, healthy)
    for frames in healthy:
        frames[:, USED] = 1500.0
    assert set(blamed(fitted, healthy)) == set(USED)


def test_a_stored_diagnosis_judges_bit_for_bit_as_before(fitted, tmp_path, healthy):
    healthy[0][:, USED] = 1500.0
    path = tmp_path / "fitted.npz"
    fitted.save(path)
    again = SelfDiagnosis.load(path)
    assert again.diagnose(healthy).to_dict() == fitted.diagnose(healthy).to_dict()


def test_a_monitor_says_at_the_end_what_the_whole_log_says(fitted, healthy):
    for frames in healthy:
        frames[:, USED[0]] = 1500.0
    monitor = Monitor(fitted, wait=True)
    for frame in np.concatenate(healthy):
        monitor.update(frame)
    assert {fault.cells for fault in monitor.faults} == {(USED[0],)}
    whole = fitted.diagnose(np.concatenate(healthy))
    assert monitor.diagnosis().to_dict() == whole.to_dict()


@pytest.mark.parametrize("kind", [FaultKind.INTERMITTENT, FaultKind.NOISY])
def test_what_fails_for_single_frames_is_told_by_its_name(fitted, kind):
    log = presses(2, 12)
    whole = inject(np.concatenate(log), [Fault(kind, (27,))], LAYOUT, seed=1)
    (fault,) = fitted.diagnose(np.split(whole, 12)).faults
    assert (fault.cells, fault.kind) == ((27,), kind)
