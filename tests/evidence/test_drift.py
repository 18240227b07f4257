from dataclasses import replace

import numpy as np
import pytest

from diagnostics import FaultKind, SelfDiagnosis, SensorLayout
from diagnostics.evidence.drift import drift_counts, drifting, gain_evidence, misleading
from diagnostics.healthy.prediction import Prediction

CELLS = 30
NEAR = 0.1
SPREAD = 0.05
FRAMES = 100  # of a recording


def events(n: int, gain: np.ndarray | float = 1.0, *, error: float = SPREAD / 2, own: bool = True):
    """Touches that load all cells, what is expected of them, and that all cells moved in each."""
    rng = np.random.default_rng(0)
    mean = rng.uniform(0.3, 0.8, (n, CELLS))
    root = np.sqrt(gain) * mean + error * rng.standard_normal((n, CELLS))
    ones = np.ones((n, CELLS))
    expected = Prediction(0.02 * ones, 0.5 * ones, mean, np.full(CELLS, SPREAD), own)
    return np.stack([root, root, ones, ones], axis=1), expected, ones > 0


def one_has(gain: float, cell: int = 4) -> np.ndarray:
    return np.where(np.arange(CELLS) == cell, gain, 1.0)


@pytest.mark.parametrize("gain", [0.15, 0.35, 0.5, 2.5])
def test_a_wrong_gain_is_found_from_events_and_no_other_cell_is_reported(gain: float):
    result = gain_evidence(*events(20, one_has(gain)), NEAR)
    assert drifting(np.zeros(CELLS), result.evidence).nonzero()[0].tolist() == [4]
    assert 0.6 < result.factor[4] / gain < 1.6
    assert (result.since[4], result.events[4]) == (0, 20)
    assert (np.delete(result.evidence, 4) < 0).all()


def test_the_change_point_is_the_first_event_with_another_gain():
    gain = np.ones((12, CELLS))
    gain[7:, 4] = 0.2
    result = gain_evidence(*events(12, gain), NEAR)
    assert drifting(np.zeros(CELLS), result.evidence)[4]
    assert result.since[4] == 7


@pytest.mark.parametrize("gain", [0.8, 1.25])
def test_a_gain_that_is_a_little_off_is_no_fault_however_many_events_there_are(gain: float):
    assert (gain_evidence(*events(60, one_has(gain)), NEAR).evidence < 0).all()


@pytest.mark.parametrize("n", [1, 2])
def test_one_or_two_events_prove_nothing(n: int):
    assert (gain_evidence(*events(n, one_has(0.1)), NEAR).evidence == 0).all()


def test_where_all_that_is_expected_errs_no_cell_is_accused():
    inflation = gain_evidence(*events(8, error=5 * SPREAD), NEAR)
    assert not drifting(np.zeros(CELLS), inflation.evidence).any()


def test_events_without_information_about_a_gain_do_not_count():
    whole, expected, moved = events(8, one_has(0.2))
    unloaded = whole.copy()
    unloaded[:, :, 4] = 0.0  # tested by the spatial evidence
    unmoved = moved.copy()
    unmoved[:, 4] = False
    unknown = replace(expected, spread=np.where(one_has(0.0) == 0, np.nan, SPREAD))
    faint = replace(expected, mean=np.minimum(expected.mean, 1.4 * NEAR))
    for result in (
        gain_evidence(unloaded, expected, moved, NEAR),
        gain_evidence(whole, expected, unmoved, NEAR),
        gain_evidence(whole, unknown, moved, NEAR),
        gain_evidence(whole, faint, moved, NEAR),
        gain_evidence(*events(8, one_has(0.2), own=False), NEAR),
    ):
        assert (result.evidence[4], result.factor[4], result.events[4]) == (0.0, 1.0, 0)


def test_cells_that_mislead_are_left_out_the_surest_gain_first_and_all_offsets_at_once():
    offset = np.zeros(CELLS)
    gain = np.zeros(CELLS)
    known = np.zeros(CELLS, bool)
    assert not misleading(offset, gain, known).any()
    offset[[1, 2]] = 20.0
    gain[[5, 6, 7]] = (20.0, 30.0, 6.0)
    order = []
    while (more := misleading(offset, gain, known)).any():
        order.append(np.flatnonzero(more).tolist())
        known |= more
    assert order == [[1, 2, 6], [5]]


def test_what_counts_for_less_proves_less_and_what_healthy_cells_reached_proves_nothing():
    whole, expected, moved = events(20, one_has(0.35))
    full, some, none = (
        gain_evidence(whole, expected, moved, NEAR, np.full((20, 1), counts)).evidence[4]
        for counts in (1.0, 0.5, 0.0)
    )
    assert full > some > none
    assert none < 0
    assert drift_counts(0.0, 0.0) == drift_counts(3.0, 3.0) == (1, 1)
    for reached in (10.0, 30.0):
        offset, gain = drift_counts(reached, reached)
        for evidence in ((reached * offset, 0.0), (0.0, reached * gain)):
            assert not drifting(*np.array([evidence]).T).any()
            assert drifting(*2 * np.array([evidence]).T).all()


def held_beside_contacts(count: int, share: float, seed: int) -> list[np.ndarray]:
    """Contacts on 4 x 6 cells; in a ``share`` of the recordings a hand holds a cell of the left
    column throughout."""
    rng = np.random.default_rng(seed)
    recordings = []
    for _ in range(count):
        load = np.zeros((FRAMES, 4, 6))
        for first in range(2, FRAMES, 20):
            row = rng.integers(0, 3)
            column = rng.integers(0, 5)
            load[first : first + 16, row : row + 2, column : column + 2] += (
                0.6 * np.hanning(16)[:, None, None]
            )
        if rng.random() < share:
            load[:, rng.integers(4), 0] += (
                rng.uniform(0.3, 0.5) + 0.005 * rng.standard_normal(FRAMES).cumsum()
            )
        readings = load.reshape(FRAMES, 24) + 0.002 * rng.standard_normal((FRAMES, 24))
        recordings.append(np.clip(np.round(readings * 255) / 255, 0, 1))
    return recordings


def test_loads_that_outlast_contacts_are_no_offsets_where_healthy_cells_hold_them_too():
    fitted = SelfDiagnosis(SensorLayout(1, 4, 6)).fit(held_beside_contacts(40, 0.15, 0))
    for log in held_beside_contacts(10, 1.0, 100):
        assert not fitted.diagnose(log).fault_set
    broken = held_beside_contacts(6, 0.0, 200)
    for recording in broken:
        recording[:, 9] += 0.1
    (found,) = fitted.diagnose(broken).faults
    assert (found.kind, found.cells) == (FaultKind.DRIFT, (9,))
