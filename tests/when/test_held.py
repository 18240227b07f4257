"""Recordings in which cells hold a value while those beside them move."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptfault.data.simulated_grasps import simulate
from diagnostics import SensorLayout
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.when import Spans, filled, find_held
from diagnostics.when.recording_numbers import ranges

LAYOUT = SensorLayout(1, 8, 8)
TOLERANCE = 0.025
ROW = [LAYOUT.cell(0, 3, column) for column in range(8)]
N = 42


@pytest.fixture(scope="module")
def grasps() -> list[np.ndarray]:
    """Grasps with noise, which every healthy cell has."""
    rng = np.random.default_rng(0)
    frames = simulate(6, LAYOUT, n_frames=50, seed=3).frames
    order = rng.permutation(len(frames))[:N]
    return [frames[i] + rng.normal(0, 0.01, frames[i].shape) + 0.1 for i in order]


def broken(grasps: list[np.ndarray], cells: list[int], where: set[int]) -> list[np.ndarray]:
    """Return the recordings with cells that hold a value in some of them."""
    log = [recording.copy() for recording in grasps]
    for i in where:
        log[i][:, cells] = 0.0
    return log


def found(log: list[np.ndarray], classes: np.ndarray | None = None) -> np.ndarray:
    return find_held(Spans.of(RecordingBlocks(log)), LAYOUT, TOLERANCE, classes).suspect


@settings(max_examples=12)
@given(
    cells=st.sampled_from([ROW, ROW[2:4], [LAYOUT.cell(0, 4, 4)]]),
    where=st.one_of(
        st.integers(3, N - 3).map(lambda n: set(range(n))),
        st.integers(3, N - 3).map(lambda n: set(range(n, N))),
        st.just(set(range(N // 3, 2 * N // 3))),
        st.sets(st.integers(0, N - 1), min_size=3, max_size=N - 8),
    ),
)
def test_any_set_of_recordings_in_which_cells_are_dead_is_found(grasps, cells, where):
    suspect = found(broken(grasps, cells, where))
    truth = np.zeros_like(suspect)
    truth[np.ix_(sorted(where), cells)] = True
    assert not np.delete(suspect, cells, axis=1).any()
    # A recording between two of them that does not touch a cell counts as one of them.
    between = ~truth & np.roll(truth, 1, axis=0) & np.roll(truth, -1, axis=0)
    assert not (suspect & ~truth & ~between).any()
    assert (suspect & truth).sum() >= 0.7 * truth.sum()


@settings(max_examples=12)
@given(
    since=st.integers(6, N - 6),
    value=st.sampled_from([0.0, 1.5, 2.5, 5.0]),
    cells=st.sampled_from([[0, 7], ROW[2:4], [18, 27, 56, 63]]),
    quiet=st.booleans(),
)
def test_what_a_cell_rested_at_before_it_stuck_is_no_held_value(grasps, since, value, cells, quiet):
    log = [
        np.where(recording > 0.3, recording, 0.1) if quiet else recording for recording in grasps
    ]
    log = [recording.copy() for recording in log]
    log[since - 1][-5:, cells] = value
    for recording in log[since:]:
        recording[:, cells] = value
    suspect = found(log)
    assert not suspect[:since].any()
    assert not np.delete(suspect, cells, axis=1).any()


def test_nothing_is_suspect_in_healthy_recordings(grasps):
    assert not found(grasps).any()
    quiet = [np.where(recording > 0.2, recording, 0.0) for recording in grasps]
    assert not found(quiet).any()


@pytest.mark.parametrize("seed", [2, 8])
def test_a_row_that_dies_between_two_tasks_is_suspect_in_the_later_ones(seed):
    hand = SensorLayout(2, 10, 8, full_scale=3.3)
    made = simulate(
        8, hand, n_frames=60, seed=seed, classes=("nothing", "normal", "softer", "harder")
    )
    order = np.argsort(made.labels, kind="stable")
    log = [np.array(made.frames[i]).reshape(60, -1) for i in order]
    tasks = np.asarray(made.labels)[order]
    spans = Spans.of(RecordingBlocks(log))
    assert not find_held(spans, hand, TOLERANCE, tasks).suspect.any()
    row = np.arange(64, 72)
    for frames in log[16:]:
        frames[:, row] = 0.0
    suspect = find_held(Spans.of(RecordingBlocks(log)), hand, TOLERANCE, tasks).suspect
    assert suspect[16:, row].mean() > 0.8
    assert not np.delete(suspect, row, axis=1).any()
    assert not suspect[:16].any()


@pytest.mark.parametrize("seed", [1, 3, 12])
def test_cells_that_hold_a_value_through_one_task_are_found_where_loads_last(seed):
    finger = SensorLayout(1, 12, 10, full_scale=3.3)
    made = simulate(16, finger, n_frames=60, seed=seed, classes=("nothing", "normal", "softer"))
    tasks = np.asarray(made.labels)
    log = [np.array(frames).reshape(60, -1) for frames in made.frames]
    assert not find_held(Spans.of(RecordingBlocks(log)), finger, TOLERANCE, tasks).suspect.any()
    rng = np.random.default_rng(seed)
    cells = rng.choice(finger.n_cells, 6, replace=False)
    where = (tasks == 2) & (rng.random(len(tasks)) < 0.94)
    for i in np.flatnonzero(where):
        log[i][:, cells] = 0.61
    suspect = find_held(Spans.of(RecordingBlocks(log)), finger, TOLERANCE, tasks).suspect
    assert suspect[np.ix_(where, cells)].mean() > 0.9
    assert not np.delete(suspect, cells, axis=1).any()


@pytest.mark.parametrize("seed", [0, 3, 4])
def test_a_row_that_is_dead_in_the_middle_of_few_recordings_does_not_hide_itself(seed):
    layout = SensorLayout(1, 12, 10, full_scale=3.3, rate=20.0)
    row = list(range(60, 70))
    made = simulate(12, layout, n_frames=60, seed=seed, classes=("nothing", "normal"))
    order = np.argsort(np.arange(len(made.frames)) % 12, kind="stable")  # in turn
    log = [np.asarray(made.frames[i], np.float64) for i in order]

    def suspects(log: list[np.ndarray]) -> list[int]:
        spans = Spans.of(RecordingBlocks(log))
        held = find_held(spans, layout, 0.0165, made.labels[order])
        return np.flatnonzero(held.suspect.any(axis=0)).tolist()

    assert suspects(log) == []
    assert suspects(broken(log, row, set(range(8, 16)))) == row


def test_a_cell_that_dies_among_cells_that_always_move_is_found():
    layout = SensorLayout(1, 3, 4, full_scale=1.0)
    rng = np.random.default_rng(0)
    course = np.sin(np.linspace(0, np.pi, 60))[:, None]
    log = [0.1 + course * rng.uniform(0.2, 0.8, 12) for _ in range(40)]
    for one in log[20:]:
        one[:, 7] = 0.1
    suspect = find_held(Spans.of(RecordingBlocks(log)), layout, 0.005).suspect
    assert np.argwhere(suspect).tolist() == [[i, 7] for i in range(20, 40)]


def test_few_recordings_say_nothing(grasps):
    assert not found(broken(grasps[:10], ROW, set(range(5)))).any()


def test_filled_recordings_hold_healthy_readings_only(grasps):
    where = set(range(20, N))
    log = broken(grasps, ROW, where)
    held = find_held(Spans.of(RecordingBlocks(log)), LAYOUT, TOLERANCE)
    whole = filled(RecordingBlocks(log), held, LAYOUT)
    others = np.setdiff1d(np.arange(64), ROW)
    for before, after in zip(log, whole, strict=True):
        np.testing.assert_array_equal(before[:, others], after[:, others])
    truth = np.concatenate([grasps[i][:, ROW] for i in where])
    known = np.concatenate([whole[i][:, ROW] for i in where])
    assert np.corrcoef(truth.ravel(), known.ravel())[0, 1] > 0.8


def test_numbers_are_told_as_ranges():
    assert ranges([3, 5, 6, 7, 9]) == "3, 5 to 7, 9"
    assert ranges(range(0, 40, 2)).endswith("and 14 more ranges")
