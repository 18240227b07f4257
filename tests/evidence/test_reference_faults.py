"""Cells that are dead in what was taken for a fault-free reference."""

import numpy as np
import pytest

from adaptfault.data.simulated_grasps import simulate
from diagnostics import Diagnosis, Fault, FaultKind, SelfDiagnosis, SensorLayout, Verdict, inject
from diagnostics.evidence.reference_faults import find_reference_faults
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.preprocessing.tolerance import tolerance_of

LAYOUT = SensorLayout(1, 8, 8)
GRASPS = simulate(6, LAYOUT, n_frames=40, seed=2).frames
OPEN = LAYOUT.cell(0, 3, 3)
SHORT = LAYOUT.cell(0, 4, 6)
STUCK = LAYOUT.cell(0, 2, 5)
FAULTS = [
    Fault(FaultKind.OPEN, (OPEN,)),
    Fault(FaultKind.SHORT, (SHORT,)),
    Fault(FaultKind.STUCK, (STUCK,), value=2.0),
]
DEAD = {OPEN, SHORT, STUCK}


def reference_faults(recordings: list[np.ndarray], layout: SensorLayout = LAYOUT) -> np.ndarray:
    readings = RecordingBlocks(recordings)
    return find_reference_faults(
        readings, layout, tolerance_of(readings, layout), SelfDiagnosis._diagnosed_cold
    )


@pytest.fixture(scope="module")
def worn() -> list[np.ndarray]:
    return [inject(frames, FAULTS, LAYOUT) for frames in GRASPS]


@pytest.fixture(scope="module")
def fitted(worn: list[np.ndarray]) -> SelfDiagnosis:
    return SelfDiagnosis(LAYOUT).fit(worn[::2])


def test_cells_that_are_dead_throughout_are_found_and_no_other(worn):
    assert set(np.flatnonzero(reference_faults(worn)).tolist()) == DEAD


def test_a_fault_free_reference_has_none_and_costs_no_diagnosis():
    def never(*_):
        raise AssertionError("all cells moved")

    moved = [frames + 0.1 * np.arange(len(frames))[:, None] for frames in GRASPS]
    assert not find_reference_faults(RecordingBlocks(moved), LAYOUT, 0.025, never).any()
    assert not reference_faults(GRASPS).any()


def test_a_reference_with_hardly_any_contact_has_no_faults():
    assert not reference_faults([np.zeros((50, 64))] * 10).any()


def test_a_cell_that_moved_once_was_not_dead(worn):
    moved = [worn[0].copy(), *worn[1:]]
    moved[0][5, SHORT] = 1.0
    assert SHORT not in np.flatnonzero(reference_faults(moved))


def test_a_cell_without_readings_is_not_a_constant_cell(worn):
    silent = [frames.copy() for frames in worn]
    for frames in silent:
        frames[:, SHORT] = np.nan
    assert set(np.flatnonzero(reference_faults(silent)).tolist()) == DEAD - {SHORT}


def test_they_are_faulty_in_every_log_with_the_kind_of_what_they_read(worn, fitted):
    for log in (worn[1:12:2], worn[1:2]):
        diagnosis = fitted.diagnose(log)
        assert diagnosis.fault_set == DEAD
        kinds = {fault.cells[0]: fault.kind for fault in diagnosis.faults}
        assert kinds == {OPEN: FaultKind.OPEN, SHORT: FaultKind.SHORT, STUCK: FaultKind.STUCK}
        assert all("in the reference already" in fault.reason for fault in diagnosis.faults)


def test_a_cell_that_was_repaired_is_no_longer_faulty(fitted):
    diagnosis = fitted.diagnose(GRASPS[1:12:2])
    assert not diagnosis.fault_set
    # how it depends on the others is not known
    assert diagnosis.verdicts[OPEN] is Verdict.UNTESTED


def test_new_faults_are_found_beside_them(worn, fitted):
    new = LAYOUT.cell(0, 4, 3)
    log = [inject(frames, [Fault(FaultKind.SHORT, (new,))], LAYOUT) for frames in worn[1::2]]
    assert fitted.diagnose(log).fault_set == DEAD | {new}


def test_a_stored_diagnosis_keeps_them(worn, fitted):
    about, arrays = fitted.state()
    again = SelfDiagnosis.from_state(about, arrays).diagnose(worn[1:12:2])
    np.testing.assert_array_equal(again.probability, fitted.diagnose(worn[1:12:2]).probability)


@pytest.mark.slow
def test_on_a_large_array_only_tiles_of_candidates_are_scored_with_the_same_result():
    skin = SensorLayout(1, 40, 40)
    rng = np.random.default_rng(0)
    places = np.argwhere(np.ones((40, 40)))

    def event() -> np.ndarray:
        load = np.clip(2 - ((places - rng.uniform(4, 20, 2)) ** 2).sum(axis=1) / 6, 0, None)
        return (np.sin(np.linspace(0, np.pi, 20))[:, None] * load).round(2)

    reference = [np.concatenate([event() for _ in range(6)]) for _ in range(20)]
    dead = [
        skin.cell(0, 9, 9),
        *(skin.cell(0, 14, col) for col in range(8, 18)),
        skin.cell(0, 16, 11),
    ]
    for recording in reference:
        recording[:, dead] = 0
    requested: list[np.ndarray] = []

    def all_of(log: RecordingBlocks, needed: np.ndarray, *_: object) -> Diagnosis:
        requested.append(needed)
        return SelfDiagnosis(skin).diagnose(list(log))

    def some_of(log: RecordingBlocks, needed: np.ndarray, *_: object) -> Diagnosis:
        cold = SelfDiagnosis(skin)
        stream = cold.stream(needed)
        for frames in log:
            stream.extend(frames)
        return cold.evaluate(stream)

    # nothing else moved there
    readings = RecordingBlocks([*reference, 0.1 * np.ones((10, 1600)) * (places[:, 0] > 30)])
    whole, part = (
        find_reference_faults(readings, skin, 0.01, diagnose) for diagnose in (all_of, some_of)
    )
    assert set(np.flatnonzero(whole)) == set(np.flatnonzero(part)) == set(dead)
    assert set(dead) <= set(np.flatnonzero(requested[0]))
