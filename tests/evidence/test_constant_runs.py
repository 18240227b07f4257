import numpy as np
import pytest

from diagnostics.events.constant_runs import ConstantRuns
from diagnostics.preprocessing.readings import held

TOLERANCE = 0.02
FULL_SCALE = 5.0


def runs_of(log: np.ndarray, *sizes: int) -> ConstantRuns:
    """Feed ``log`` in chunks of the sizes, the rest in one."""
    runs = ConstantRuns.begin(log.shape[1])
    first = 0
    for size in (*sizes, len(log) - sum(sizes)):
        if size:
            runs = runs.extend(log[first : first + size], np.arange(first, first + size), TOLERANCE)
        first += size
    return runs


def steps(rng: np.random.Generator, frames: int, cells: int) -> np.ndarray:
    """Cells that hold one value after another, each up to a small dither."""
    levels = rng.integers(1, 5, (frames, cells)) * 1.0
    fresh = rng.random((frames, cells)) < 0.05
    fresh[0] = True
    at = np.maximum.accumulate(np.where(fresh, np.arange(frames)[:, None], 0), axis=0)
    return (
        np.take_along_axis(levels, at, axis=0) + rng.uniform(-0.9, 0.9, (frames, cells)) * TOLERANCE
    )


def test_a_constant_run_starts_where_a_cell_last_moved():
    runs = runs_of(np.array([[1, 1, 0], [2, 1, 0], [2, 1, 4], [2, 1.01, 4]], float))
    assert runs.start.tolist() == [1, 0, 2]
    assert runs.length.tolist() == [3, 4, 2]
    assert runs.value == pytest.approx([2, 1.005, 4])


def test_a_cell_that_never_moved_starts_at_frame_0():
    runs = runs_of(np.array([[1, 0]] * 30 + [[1, 3]] * 10, float), 7, 20)
    assert runs.start.tolist() == [0, 30]
    assert runs.moved.tolist() == [False, True]
    assert runs.length.tolist() == [40, 10]


def test_a_missing_reading_neither_ends_nor_extends_a_run():
    runs = runs_of(np.array([[1, np.nan, 1], [np.nan, np.nan, 2], [1, np.nan, np.nan]]))
    assert runs.start[:2].tolist() == [0, 0]
    assert runs.length[:2].tolist() == [2, 0]
    assert runs.value[0] == 1
    assert np.isnan(runs.value[1])
    assert runs.last[[0, 2]].tolist() == [1, 2]


def test_a_run_starts_with_a_reading():
    log = np.array([[3, 3], [3, np.nan], [np.nan, np.nan], [0, 3], [np.nan, 3], [0, 0]])
    for size in range(1, 6):
        runs = runs_of(log, size)
        assert runs.start.tolist() == [3, 5]


def test_how_long_a_cell_has_been_silent_is_counted_over_blocks():
    log = np.array(
        [
            [1, np.nan, 1],
            [np.nan, np.nan, 1],
            [1, np.nan, np.nan],
            [1, np.nan, np.nan],
            [1, 0, np.nan],
        ]
    )
    for size in range(1, 5):
        runs = runs_of(log, size)
        assert runs.missed.tolist() == [0, 0, 3]
        assert runs.missed_since[2] == 2
        silent = runs_of(log[:4], size)
        assert silent.missed.tolist() == [0, 4, 2]
        assert silent.missed_since[1:].tolist() == [0, 2]


def test_dither_is_constant_and_a_slow_drift_is_not():
    t = np.arange(200)
    log = np.column_stack([2 + TOLERANCE * np.sin(t), 2 + 0.002 * t])
    runs = runs_of(log, 50, 50, 50)
    assert runs.start[0] == 0
    assert runs.start[1] > 150


@pytest.mark.parametrize("seed", range(5))
def test_the_run_is_the_longest_at_the_end_of_the_log_with_one_value(seed: int):
    log = steps(np.random.default_rng(seed), 60, 30)
    runs = runs_of(log)
    for cell, start in enumerate(runs.start.tolist()):
        assert np.ptp(log[start:, cell]) <= 2 * TOLERANCE
        assert start == 0 or np.ptp(log[start - 1 :, cell]) > 2 * TOLERANCE
        assert runs.length[cell] == 60 - start


@pytest.mark.parametrize("sizes", [(1,) * 59, (7, 7, 7, 7), (32,), (59,)])
def test_runs_are_the_same_however_the_frames_come_in(sizes: tuple[int, ...]):
    log = steps(np.random.default_rng(1), 60, 30)
    at_once = runs_of(log)
    in_parts = runs_of(log, *sizes)
    for name in ("start", "length", "low", "high", "last"):
        np.testing.assert_array_equal(getattr(in_parts, name), getattr(at_once, name), err_msg=name)


def test_how_long_a_cell_has_read_the_same_is_counted_over_blocks_and_gaps():
    rng = np.random.default_rng(0)
    log = rng.integers(0, 2, (60, 5)).astype(float)
    log[:, 4] = 1.0
    log[rng.random(log.shape) < 0.3] = np.nan
    readings = held(log, np.full(5, np.nan))
    whole = np.zeros((61, 5), np.intp)
    for frame in range(60):
        same = np.isnan(readings[frame]) | (readings[frame + 1] == readings[frame])
        whole[frame + 1] = np.where(same, whole[frame] + 1, 1)
    whole = whole[1:]
    assert whole[-1, 4] == 60
    for size in (1, 7, 32):
        runs = ConstantRuns.begin(5)
        for first in range(0, 60, size):
            frames = log[first : first + size]
            runs = runs.extend(frames, np.arange(first, first + len(frames)), 0.005)
            np.testing.assert_array_equal(runs.same, whole[first + len(frames) - 1])
