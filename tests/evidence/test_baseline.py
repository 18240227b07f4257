from functools import cache

import numpy as np
import pytest
from contact_recordings import CELLS, LAYOUT, events

from diagnostics import Fault, FaultKind, SelfDiagnosis, Verdict, inject
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


def test_an_array_that_thresholds_rests_at_one_value():
    most = baseline(events(0), PRESENT, TOLERANCE, 1.0)
    np.testing.assert_array_equal(most, np.zeros(CELLS))


def test_noise_at_rest_is_no_load():
    most = baseline(noisy(events(0), 0.01, 0.1), PRESENT, TOLERANCE, 1.0)
    idle = noisy([np.zeros((2000, CELLS))], 0.01, 0.1, seed=3)[0]
    assert (idle > most + 2 * TOLERANCE).mean() < 1e-3
    assert most.max() < 0.25


def test_offsets_that_wander_between_recordings_are_no_load():
    rng = np.random.default_rng(2)
    offsets = rng.uniform(0, 0.02, 24)
    most = baseline(
        [r + offset for r, offset in zip(events(0), offsets, strict=True)], PRESENT, TOLERANCE, 1.0
    )
    assert (offsets <= most.min() + 2 * TOLERANCE).all()
    assert most.max() < 0.03


def test_offsets_that_each_cell_changes_for_itself_from_one_recording_to_the_next_are_no_load():
    rng = np.random.default_rng(2)
    recordings = events(0, 60)
    offsets = 0.1 + 0.006 * rng.standard_normal((60, CELLS))  # now and then far from the usual
    most = baseline(
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
    most = baseline(recordings, PRESENT, TOLERANCE, 1.0)
    later = 0.006 * np.random.default_rng(3).standard_normal((1000, CELLS))
    assert (later > most + 2 * TOLERANCE).mean() < loaded
    assert most.max() < 0.04


def test_light_loads_that_are_released_once_do_not_look_like_offsets_of_a_rest_at_0():
    held = events(0, 60)
    for i, recording in enumerate(held):
        recording[1:, i % 3 :: 3] += 0.02
    most = baseline(held, PRESENT, TOLERANCE, 1.0)
    np.testing.assert_array_equal(most, np.zeros(CELLS))


def test_cells_that_are_always_loaded_do_not_make_others_rest_higher():
    held = events(0)
    for recording in held:
        recording[:, 40:] = 0.03 + 0.2 * np.random.default_rng(0).random(CELLS - 40)
    most = baseline(held, PRESENT, TOLERANCE, 1.0)
    np.testing.assert_array_equal(most[:40], np.zeros(40))


def test_a_cell_that_was_never_heard_rests_at_0():
    log = np.full((30, 3), 0.4)
    log[:, 1] = np.nan
    log[::2, 2] = np.nan
    most = baseline([log], np.ones(3, bool), TOLERANCE, 1.0)
    assert most.tolist() == pytest.approx([0.4, 0, 0.4])


def test_two_frames_give_no_noise_estimate():
    most = baseline([np.full((2, 3), 0.4)], np.ones(3, bool), TOLERANCE, 1.0)
    assert most.tolist() == [0.4] * 3


@cache
def fitted_to(sigma: float, rest: float) -> SelfDiagnosis:
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
