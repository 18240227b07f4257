"""How cells rest, and what a pad shares."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diagnostics import SensorLayout
from diagnostics.model.middles import shortest
from diagnostics.model.record import Record, record_of
from diagnostics.model.rest import Rest, _step, fit_rest
from diagnostics.preprocessing.tolerance import converter_step

PAD = np.repeat([0, 1], 12)


def touched(seed: int) -> list[np.ndarray]:
    """Recordings of two pads that rest at 100; a few cells of the first are pressed."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(12):
        frames = 100 + rng.normal(0, 1, (48, 24))
        pressed = rng.choice(12, 4, replace=False)
        frames[12:36, pressed] += 400
        found.append(frames.round())
    return found


def above_rest(rest: Rest, record: Record, living: np.ndarray) -> np.ndarray:
    """Readings above rest without what the pads share, ``[n, D]``."""
    return rest.above(record, rest.shared(record, living).offset)


def width_of_rest(rest: Rest, record: Record, living: np.ndarray) -> tuple[np.ndarray, float]:
    """How far a cell reads from rest without a load, ``[D]``, and the step of its converter."""
    shared = rest.shared(record, living)
    noise = rest.noise_of(record, rest.above(record, shared.offset), living)
    return rest.unsure(record, noise, shared, living)


@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=30))
def test_the_shortest_interval_is_no_wider_than_any_other(values):
    row = np.array([values], dtype=np.float32)
    middle, width = shortest(row, 0.5)
    ordered = np.sort(row[0])
    half = len(ordered) // 2
    others = ordered[half:] - ordered[: len(ordered) - half]
    assert width[0] == others.min()
    assert ordered[0] <= middle[0] <= ordered[-1]


def test_a_pad_that_sags_as_a_whole_is_told_by_how_much_and_the_other_is_not():
    healthy = touched(0)
    living = np.ones(24, bool)
    rest = fit_rest(record_of(healthy, 8), 1000.0, 1.0, PAD, living)
    log = touched(1)
    for frames in log:
        frames[:, 12:] -= 40
    offset = rest.shared(record_of(log, 8), living).offset
    np.testing.assert_allclose(offset[:, 12:], -40, atol=4)
    assert np.abs(offset[:, :12]).max() < 3
    np.testing.assert_allclose(rest.level, 100, atol=3)


def test_recordings_that_begin_and_end_in_a_contact_rest_where_some_do():
    healthy = touched(0)
    rng = np.random.default_rng(3)
    for frames in healthy[:8]:
        frames[:, :4] += rng.uniform(100, 400, 4)
    rest = fit_rest(record_of(healthy, 8), 1000.0, 1.0, PAD, np.ones(24, bool))
    np.testing.assert_allclose(rest.level, 100, atol=5)
    assert rest.near.max() < 50  # the lightest load is 100


def test_a_cell_that_shares_more_of_a_sag_than_others_reads_nothing_below_rest():
    living = np.ones(24, bool)
    rest = fit_rest(record_of(touched(0), 8), 1000.0, 1.0, PAD, living)
    log = touched(1)
    for frames in log:
        frames[:, 12:] -= np.linspace(30, 50, 12)
    above = above_rest(rest, record_of(log, 8), living)
    assert (above[:, 12:] >= -rest.near[12:]).all()


def test_cells_that_are_stuck_tell_nothing_of_where_the_others_of_their_pad_rest():
    living = np.ones(24, bool)
    rest = fit_rest(record_of(touched(0), 8), 1000.0, 1.0, PAD, living)
    log = touched(1)
    drift = np.linspace(-52, -28, 12)
    for frames in log:
        frames[:, 12:] += drift
        frames[:, 19:] = np.linspace(200, 900, 5)
    offset = rest.shared(record_of(log, 8), living).offset
    np.testing.assert_allclose(offset[:, 12:19], np.broadcast_to(drift[:7], (72, 7)), atol=6)
    np.testing.assert_allclose(offset[:, 19:], -40, atol=12)


def test_what_a_pad_swings_by_is_no_load_of_cells_that_show_more_of_it_than_others():
    living = np.ones(24, bool)
    rest = fit_rest(record_of(touched(0), 8), 1000.0, 1.0, PAD, living)
    swing = 40 * (1 + np.sin(np.arange(48) / 9))
    resting = []
    for seed in range(40):
        share = np.random.default_rng(seed).uniform(0.5, 1.5, 12)
        log = touched(1)
        for frames in log:
            frames[:, 12:] += (share * swing[:, None]).round()
        above = above_rest(rest, record_of(log, 8), living)
        resting.append((np.abs(above[:, 12:]) <= 2 * rest.near[12:]).mean())
    # one share for all cells: in 8 of 40 draws
    assert (np.array(resting) > 0.95).sum() >= 24


@given(reach=st.integers(7, 12), ends=st.integers(0, 7))
def test_loads_that_reach_the_top_saturate_though_some_cells_end_there(reach, ends):
    living = np.ones(12, bool)
    healthy, log = ([frames[:, :12] for frames in touched(seed)] for seed in (0, 1))
    rest = fit_rest(record_of(healthy, 8), 1000.0, 1.0, PAD[:12], living)
    record = record_of(log, 8)
    assert not rest.saturates(record, above_rest(rest, record, living), living)
    for frames in log:
        frames[:, :reach] = np.clip(100 + 5 * (frames[:, :reach] - 100), 0, 1000)
    log[-1][36:, :ends] = 1000.0
    record = record_of(log, 8)
    assert rest.saturates(record, above_rest(rest, record, living), living)


@given(st.sets(st.integers(12, 23), max_size=4))
def test_a_cell_that_does_not_drift_with_its_pad_is_learned_as_such(steady):
    rng = np.random.default_rng(7)
    cells = sorted(steady)
    drifts = np.array([cell not in steady for cell in range(12, 24)])
    recordings = touched(0) + touched(2)
    for frames in recordings:
        frames[:, 12:] += rng.choice([0, 30]) * drifts
    living = np.ones(24, bool)
    rest = fit_rest(record_of(recordings, 8), 1000.0, 1.0, PAD, living)
    assert (rest.share[cells] < 0.2).all()
    assert (rest.share[12:][drifts] > 0.8).all()
    log = touched(1)
    for frames in log:
        frames[:, 12:] += 30 * drifts
    above = above_rest(rest, record_of(log, 8), living)
    assert (np.abs(above[:, 12:]) <= rest.near[12:]).all()


def test_the_step_of_the_converter_is_the_smallest_usual_difference():
    readings = [(np.arange(200) % 13 * 4.0)[:, None]]
    assert converter_step(readings, SensorLayout(1, 1, 1, full_scale=100.0)) == 4.0


def rest_of_reference(living: np.ndarray) -> Rest:
    return fit_rest(record_of(touched(0), 8), 1000.0, 1.0, PAD, living)


@given(st.integers(0, 99), st.floats(0, 90))
def test_cells_that_drift_each_by_its_own_amount_rest_where_they_did(seed, most):
    rng = np.random.default_rng(seed)
    living = np.ones(24, bool)
    rest = rest_of_reference(living)
    drift = np.concatenate([rng.permutation(np.linspace(0, most, 12)) for _ in range(2)])
    log = [frames + drift for frames in touched(1)]
    above = above_rest(rest, record_of(log, 8), living)
    resting = np.abs(above) < 150
    assert resting.mean() > 0.8
    assert (above[resting] <= 3 * rest.near.max()).all()


def log_with_contacts(shared: np.ndarray) -> Record:
    """The record of contacts with most of a pad, beside what it ``shared`` in each recording and
    piece, ``[recordings, 6]``."""
    rng = np.random.default_rng(1)
    log = [100 + rng.normal(0, 1, (48, 24)) for _ in shared]
    for frames, of_pieces in zip(log, shared, strict=True):
        frames[12:36, :7] += np.linspace(200, 500, 7)
        frames += np.repeat(of_pieces, 8)[:, None]
    return record_of(log, 8)


@given(st.floats(10, 90))
def test_a_contact_with_most_of_a_pad_hides_no_sag_of_it(size):
    living = np.ones(24, bool)
    rest = rest_of_reference(living)
    sags = -size * np.abs(np.sin(np.arange(6) + np.arange(12)[:, None]))
    away = np.abs(rest.of_pads(log_with_contacts(sags), living) - sags.reshape(-1, 1))
    assert (away <= rest.near.max()).all()


@given(st.floats(-90, 90))
def test_a_contact_with_most_of_a_pad_hides_no_offset_of_a_recording(size):
    living = np.ones(24, bool)
    rest = rest_of_reference(living)
    offsets = np.repeat(size * np.sin(np.arange(12))[:, None], 6, axis=1)
    away = np.abs(rest.of_pads(log_with_contacts(offsets), living) - offsets.reshape(-1, 1))
    assert (away <= rest.near.max()).all()


@given(st.integers(0, 99), st.floats(0.1, 0.4))
def test_a_load_of_all_cells_of_a_pad_is_no_offset_of_it(seed, weakest):
    rng = np.random.default_rng(seed)
    pressed = np.linspace(weakest, 1, 12)
    recordings = []
    for _ in range(12):
        frames = 100 + rng.normal(0, 1, (48, 24))
        frames[8:40, :12] += 400 * rng.permutation(pressed) * np.sin(np.arange(32) / 10)[:, None]
        recordings.append(frames)
    living = np.ones(24, bool)
    rest = fit_rest(record_of(recordings, 8), 1000.0, 1.0, PAD, living)
    assert np.abs(rest.level - 100).max() <= 10
    assert rest.offsets.max() <= 20


@given(st.sampled_from([25.0, 50.0, 100.0]))
def test_a_coarser_converter_and_a_noisier_pad_widen_what_counts_as_rest(step):
    rng = np.random.default_rng(0)
    living = np.ones(24, bool)
    rest = rest_of_reference(living)
    log = touched(1)
    record = record_of(log, 8)
    assert (width_of_rest(rest, record, living)[0] == rest.near).all()
    coarse = record_of([np.floor(frames / step) * step for frames in log], 8)
    unsure, found = width_of_rest(rest, coarse, living)
    assert found == step
    assert (unsure >= step).all()
    noisy = record_of([frames + rng.normal(0, step, frames.shape) for frames in log], 8)
    unsure, _ = width_of_rest(rest, noisy, living)
    assert (unsure > step / 2).all()


@given(st.floats(1, 20))
def test_a_step_is_told_from_readings_that_are_few(step):
    rng = np.random.default_rng(0)
    living = np.ones(24, bool)
    rest = rest_of_reference(living)
    few = [100 + rng.uniform(0, 800, (8, 24)) for _ in range(3)]
    assert width_of_rest(rest, record_of(few, 8), living)[1] == 0
    many = [100 + rng.uniform(0, 800, (48, 24)) for _ in range(40)]
    coarse = record_of([np.floor(frames / step) * step for frames in many], 1)
    found = width_of_rest(rest, coarse, living)[1]
    assert found == (pytest.approx(step, rel=1e-3) if step > 2 else 0)


def test_cells_that_rest_and_are_then_stuck_are_no_steps_of_a_coarse_converter():
    readings = np.random.default_rng(0).uniform(0, 4000, (400, 30))
    readings[:200, :10] = 100.0
    readings[200:, :10] = np.linspace(900, 3000, 10)
    every = np.ones(30, bool)
    assert _step(record_of([readings], 8), every, 0.04) == 0
    coarse = 256 * np.floor(readings / 256)
    assert _step(record_of([coarse], 8), every, 0.04) == 256
