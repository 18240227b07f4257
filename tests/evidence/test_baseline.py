from functools import cache

import numpy as np
import pytest
from conftest import without_calibration
from contact_recordings import CELLS, LAYOUT, events

from diagnostics import Fault, FaultKind, SelfDiagnosis, SensorLayout, Verdict, inject
from diagnostics.events.constant_runs import ConstantRuns
from diagnostics.evidence.lower_limit import LowerLimit
from diagnostics.evidence.term import ConstantCells
from diagnostics.preprocessing.baseline import baseline

PRESENT = np.ones(LAYOUT.n_cells, bool)
TOLERANCE = 0.005


def noisy(
    recordings: list[np.ndarray], sigma: float, rest: float, seed: int = 9
) -> list[np.ndarray]:
    """Return the same of an array with noise, whose cells rest at ``rest`` or somewhat more."""
    rng = np.random.default_rng(seed)
    offset = np.random.default_rng(1).uniform(rest, 1.5 * rest, CELLS)
    return [np.clip(r + offset + sigma * rng.standard_normal(r.shape), 0, 1) for r in recordings]


def highest_and_limit(recordings, present, tolerance, full_scale) -> tuple[np.ndarray, LowerLimit]:
    """Return the highest reading without contact of each cell, and the lower limit."""
    found = baseline(recordings, present, tolerance, full_scale)
    return found.highest, LowerLimit.fit(found, present, tolerance, full_scale)


def test_an_array_that_thresholds_rests_at_one_value():
    most, least = highest_and_limit(events(0), PRESENT, TOLERANCE, 1.0)
    np.testing.assert_array_equal(most, np.zeros(CELLS))
    # nothing is less than 0
    np.testing.assert_array_equal(least.reading, np.full(CELLS, -2 * TOLERANCE))


def test_noise_at_rest_is_no_load():
    most, least = highest_and_limit(noisy(events(0), 0.01, 0.1), PRESENT, TOLERANCE, 1.0)
    idle = noisy([np.zeros((2000, CELLS))], 0.01, 0.1, seed=3)[0]
    assert (idle > most + 2 * TOLERANCE).mean() < 1e-3
    assert most.max() < 0.25
    # no healthy cell is constant there
    np.testing.assert_array_equal(least.reading, np.ones(CELLS))


def test_offsets_that_wander_between_recordings_are_no_load():
    rng = np.random.default_rng(2)
    offsets = rng.uniform(0, 0.02, 24)
    most, _ = highest_and_limit(
        [r + offset for r, offset in zip(events(0), offsets, strict=True)], PRESENT, TOLERANCE, 1.0
    )
    assert (offsets <= most.min() + 2 * TOLERANCE).all()
    assert most.max() < 0.03


def test_offsets_that_each_cell_changes_for_itself_from_one_recording_to_the_next_are_no_load():
    rng = np.random.default_rng(2)
    recordings = events(0, 60)
    offsets = 0.1 + 0.006 * rng.standard_normal((60, CELLS))  # now and then far from the usual
    most, _ = highest_and_limit(
        [r + offset for r, offset in zip(recordings, offsets, strict=True)], PRESENT, TOLERANCE, 1.0
    )
    later = 0.1 + 0.006 * np.random.default_rng(3).standard_normal((1000, CELLS))
    assert (later > most + 2 * TOLERANCE).mean() < 2e-4
    assert most.max() < 0.14


# 0.047 of them without the estimate
@pytest.mark.parametrize(("noise", "loaded"), [(0.0, 1e-3), (0.002, 4e-3)])
def test_offsets_of_which_a_rest_at_0_hides_the_lower_half_are_no_load(noise: float, loaded: float):
    rng = np.random.default_rng(2)
    wander = 0.006 * rng.standard_normal((60, CELLS))
    recordings = [
        np.clip(r + w + noise * rng.standard_normal(r.shape), 0, 1)
        for r, w in zip(events(0, 60), wander, strict=True)
    ]
    most, _ = highest_and_limit(recordings, PRESENT, TOLERANCE, 1.0)
    later = 0.006 * np.random.default_rng(3).standard_normal((1000, CELLS))
    assert (later > most + 2 * TOLERANCE).mean() < loaded
    assert most.max() < 0.04


def test_light_loads_that_are_released_once_do_not_look_like_offsets_of_a_rest_at_0():
    held = events(0, 60)
    for i, recording in enumerate(held):
        recording[1:, i % 3 :: 3] += 0.02
    most, _ = highest_and_limit(held, PRESENT, TOLERANCE, 1.0)
    np.testing.assert_array_equal(most, np.zeros(CELLS))


def test_cells_that_are_always_loaded_do_not_make_others_rest_higher():
    held = events(0)
    for recording in held:
        recording[:, 40:] = 0.03 + 0.2 * np.random.default_rng(0).random(CELLS - 40)
    most, _ = highest_and_limit(held, PRESENT, TOLERANCE, 1.0)
    np.testing.assert_array_equal(most[:40], np.zeros(40))


def test_a_cell_that_was_never_heard_rests_at_0():
    log = np.full((30, 3), 0.4)
    log[:, 1] = np.nan
    log[::2, 2] = np.nan
    most, _ = highest_and_limit([log], np.ones(3, bool), TOLERANCE, 1.0)
    assert most.tolist() == pytest.approx([0.4, 0, 0.4])


def test_two_frames_give_no_noise_estimate_and_no_lower_limit():
    most, least = highest_and_limit([np.full((2, 3), 0.4)], np.ones(3, bool), TOLERANCE, 1.0)
    assert most.tolist() == [0.4] * 3
    assert (least.reading == -np.inf).all()


def evidence_of(readings: np.ndarray, least: LowerLimit) -> np.ndarray:
    """Return the evidence of 40 frames of these readings."""
    frames = np.tile(readings, (40, 1))
    every = np.ones(len(readings), bool)
    runs = ConstantRuns.begin(len(readings)).extend(frames, np.arange(40), TOLERANCE)
    layout = SensorLayout(1, 1, len(readings), full_scale=1.0)
    return least.evidence(
        ConstantCells(layout, 1.0, TOLERANCE, runs, every, least.lower(runs, every))
    )


def test_reading_less_than_ever_is_evidence_unless_half_of_the_cells_do():
    least = LowerLimit(np.full(10, 0.08), 0.02)
    assert (evidence_of(np.repeat([0.0, 0.1], [3, 7]), least) > 0).tolist() == [True] * 3 + [
        False
    ] * 7
    assert not evidence_of(np.repeat([0.0, 0.1], [6, 4]), least).any()


def test_a_usual_reading_above_the_rail_is_evidence_for_a_healthy_cell():
    least = LowerLimit(np.array([0.08, 0.08, 0.004, -0.01]), 0.02)
    assert (evidence_of(np.array([0.1, 0.09, 0.01, 0.0]), least) < 0).tolist() == [
        True,
        True,
        False,
        False,
    ]


def test_where_all_rest_lower_by_now_less_is_not_less_than_healthy():
    least = LowerLimit(np.full(10, 0.04), 0.01)
    warm = np.full(10, 0.05)
    warm[:2] = 0
    assert (evidence_of(warm, least) > 0).tolist() == [True] * 2 + [False] * 8
    assert (evidence_of(np.maximum(warm - 0.03, 0), least) > 0).tolist() == [True] * 2 + [False] * 8
    assert not (
        evidence_of(np.maximum(warm - 0.045, 0), least) > 0
    ).any()  # healthy ones read next to nothing, too


def test_cells_that_wander_as_ever_have_not_all_sunk():
    rng = np.random.default_rng(5)
    recordings = [r + rng.normal(0, 0.01, CELLS) for r in noisy(events(0), 0.001, 0.06)]
    most, least = highest_and_limit(recordings, PRESENT, TOLERANCE, 1.0)
    for frames in recordings:
        runs = ConstantRuns.begin(CELLS).extend(frames, np.arange(len(frames)), TOLERANCE)
        assert least.lower(runs, runs.value <= most) > -TOLERANCE / 2
    sunk = ConstantRuns.begin(CELLS).extend(
        recordings[0] - 0.03, np.arange(len(recordings[0])), TOLERANCE
    )
    assert least.lower(sunk, sunk.value <= most) < -2 * TOLERANCE


def test_each_cell_has_a_least_of_its_own():
    recordings = noisy(events(0), 0.001, 0.04)
    _, least = highest_and_limit(recordings, PRESENT, TOLERANCE, 1.0)
    fresh = noisy(events(1), 0.001, 0.04, seed=4)
    assert (
        np.min([r[a : a + 32].max(axis=0) for r in fresh for a in (0, 32)], axis=0) > least.reading
    ).all()
    untouched = np.median(np.concatenate(recordings), axis=0)[48:]
    assert (untouched - least.reading[48:] < 3 * TOLERANCE).all()
    assert (least.reading > 2 * TOLERANCE).all()


def test_a_cell_that_is_always_loaded_has_no_rest_to_fall_short_of():
    held = noisy(events(0), 0.001, 0.04)
    rng = np.random.default_rng(0)
    for recording in held:
        recording[:, 60] += rng.uniform(0.1, 0.4)
    _, least = highest_and_limit(held, PRESENT, TOLERANCE, 1.0)
    assert least.reading[60] < 0.04 < held[0][:, 60].min()


@cache
def fitted_to(sigma: float, rest: float) -> SelfDiagnosis:
    with without_calibration():
        return SelfDiagnosis(LAYOUT).fit(noisy(events(0), sigma, rest))


@pytest.mark.parametrize(("sigma", "rest"), [(0.0, 0.08), (0.01, 0.1)])
def test_an_open_cell_is_found_without_contact_where_cells_rest_above_0(sigma, rest):
    fitted = fitted_to(sigma, rest)
    log = noisy(events(1, 3), sigma, rest, seed=11)
    assert not fitted.diagnose(log).fault_set
    untouched = LAYOUT.cell(0, 7, 4)
    broken = [inject(r, [Fault(FaultKind.OPEN, (untouched,))], LAYOUT) for r in log]
    probability = fitted.diagnose(broken).probability
    assert probability[untouched] > 0.9
    assert np.delete(probability, untouched).max() < 0.05


def test_noise_alone_proves_no_cell_alive():
    fitted = fitted_to(0.01, 0.1)
    idle = noisy([np.zeros((200, CELLS))], 0.01, 0.1, seed=12)
    assert set(fitted.diagnose(idle).verdicts) == {Verdict.UNTESTED}


def test_cells_that_only_have_noise_are_not_put_down_to_a_broken_wire():
    fitted = fitted_to(0.01, 0.1)
    dead = list(range(20))
    idle = noisy([np.zeros((200, CELLS))], 0.01, 0.1, seed=12)[0]
    idle[:, dead] = 0
    assert fitted.diagnose(idle).fault_set == set(dead)
