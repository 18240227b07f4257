"""Recordings become windows on the 0..1 scale, and recordings stay whole in a split."""

import numpy as np
import pytest

from adaptfault.data.windows import Windows, hold_missing, make_windows, scale, split
from diagnostics import SensorLayout

LAYOUT = SensorLayout(1, 2, 3, full_scale=4.0)


def ramp(frames: int) -> np.ndarray:
    return np.arange(frames * 6, dtype=float).reshape(frames, 6)


def dataset(per_class: list[int], windows_each: int = 3) -> Windows:
    y = np.repeat(np.repeat(np.arange(len(per_class)), per_class), windows_each)
    recording = np.repeat(np.arange(sum(per_class)), windows_each)
    return Windows(np.zeros((len(y), 2, 1), np.float32), y, recording)


def test_windows_hold_consecutive_frames_divided_by_the_full_scale_and_the_rest_is_dropped():
    windows = make_windows([ramp(25), ramp(9), ramp(10)], [4, 5, 6], LAYOUT)
    assert windows.x.shape == (3, 10, 6)
    assert windows.x.dtype == np.float32
    np.testing.assert_allclose(windows.x[1], ramp(25)[10:20] / 4)
    assert windows.y.tolist() == [4, 4, 6]
    assert windows.recording.tolist() == [0, 0, 2]


def test_a_stride_makes_windows_overlap():
    windows = make_windows([ramp(12)], [0], LAYOUT, length=6, stride=3)
    np.testing.assert_allclose(windows.x * 4, [ramp(12)[0:6], ramp(12)[3:9], ramp(12)[6:12]])


def test_grids_are_read_like_flat_recordings():
    flat = make_windows([ramp(10)], [0], LAYOUT)
    grid = make_windows([ramp(10).reshape(10, 1, 2, 3)], [0], LAYOUT)
    np.testing.assert_array_equal(flat.x, grid.x)


def test_scaling_neither_clips_nor_hides_missing_readings():
    np.testing.assert_array_equal(scale([[-1.0, 8.0, np.nan]], LAYOUT), [[-0.25, 2.0, np.nan]])


def test_a_missing_reading_is_held_from_the_same_recording_only():
    a = np.full((10, 6), 3.0)
    b = np.full((10, 6), 1.0)
    a[4:6, 2] = np.nan
    a[3, 2] = 2.0
    b[:2] = np.nan
    windows = make_windows([a, b], [0, 1], LAYOUT)
    assert windows.x[0, :, 2].tolist() == [0.75, 0.75, 0.75, 0.5, 0.5, 0.5, 0.75, 0.75, 0.75, 0.75]
    assert (windows.x[1, :2] == 0).all()
    assert (windows.x[1, 2:] == 0.25).all()


def test_holding_leaves_whole_frames_alone():
    frames = ramp(4)
    assert hold_missing(frames) is frames


def test_recordings_without_labels_give_class_minus_one():
    assert make_windows([ramp(20)], None, LAYOUT).y.tolist() == [-1, -1]


def test_values_of_a_recording_are_those_of_each_of_its_windows():
    recordings = [np.zeros((25, 4)), np.zeros((10, 4))]
    windows = make_windows(recordings, [[1.5, 2.0], [3.0, 4.0]], SensorLayout(1, 2, 2))
    assert windows.y.dtype == np.float32
    assert windows.y.tolist() == [[1.5, 2.0], [1.5, 2.0], [3.0, 4.0]]
    one = make_windows(recordings, np.array([1.5, 2.5]), SensorLayout(1, 2, 2))
    assert one.y.tolist() == [[1.5], [1.5], [2.5]]


def test_values_of_frames_are_those_of_the_last_frame_of_a_window():
    recordings = [np.zeros((25, 4)), np.zeros((10, 4))]
    of_frames = [np.arange(25.0), np.arange(10.0)]
    windows = make_windows(recordings, of_frames, SensorLayout(1, 2, 2), stride=5)
    assert windows.y[:, 0].tolist() == [9, 14, 19, 24, 9]
    pairs = [np.stack([of, -of], axis=1) for of in of_frames]
    two = make_windows(recordings, pairs, SensorLayout(1, 2, 2), stride=5)
    assert two.y[:, 1].tolist() == [-9, -14, -19, -24, -9]


@pytest.mark.parametrize(
    ("targets", "message"),
    [
        ([[1.0], [2.0], [3.0]], "2 recordings need as many targets, got 3"),
        ([[1.0, 2.0], [1.0]], r"as many values, got \[1, 2\]"),
        ([np.zeros((24, 1)), np.zeros((10, 1))], r"recording 0 has 25 frames: expected targets"),
        ([[np.nan], [1.0]], "targets of recording 0 are not all finite"),
        (["a", "b"], "whole numbers"),
    ],
)
def test_targets_that_fit_no_recording_are_refused(targets, message):
    with pytest.raises(ValueError, match=message):
        make_windows([np.zeros((25, 4)), np.zeros((10, 4))], targets, SensorLayout(1, 2, 2))


def test_a_regression_is_split_by_recording():
    recordings = [np.zeros((30, 4))] * 20
    windows = make_windows(recordings, np.arange(20.0), SensorLayout(1, 2, 2))
    parts = split(windows)
    assert [len(set(part.recording)) for part in parts] == [13, 3, 4]
    assert sum(len(part) for part in parts) == len(windows)
    with pytest.raises(ValueError, match="there are 2 recordings: a split"):
        split(make_windows(recordings[:2], np.arange(2.0), SensorLayout(1, 2, 2)))


def test_no_window_at_all_is_an_error_that_says_so():
    with pytest.raises(
        ValueError, match="no windows: a window needs 10 frames, the longest of 2 recordings has 9"
    ):
        make_windows([ramp(9), ramp(3)], [0, 1], LAYOUT)
    with pytest.raises(ValueError, match="no windows"):
        make_windows([], [], LAYOUT)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="recording 1"):
        make_windows([ramp(10), np.zeros((10, 5))], [0, 1], LAYOUT)
    with pytest.raises(ValueError, match="2 recordings need as many targets"):
        make_windows([ramp(10), ramp(10)], [0], LAYOUT)
    with pytest.raises(ValueError, match="stride >= 1"):
        make_windows([ramp(10)], [0], LAYOUT, stride=0)
    with pytest.raises(ValueError, match=r"\[N, T, D\]"):
        Windows(np.zeros((3, 2)), np.zeros(3), np.zeros(3))
    with pytest.raises(ValueError, match="need y of shape"):
        Windows(np.zeros((3, 2, 1)), np.zeros(2), np.zeros(3))


def test_select_takes_masks_indices_and_slices():
    windows = make_windows([ramp(40)], [7], LAYOUT)
    assert len(windows.select(np.array([True, False, True, False]))) == 2
    np.testing.assert_array_equal(windows.select([3, 0]).x, windows.x[[3, 0]])
    assert len(windows.select(slice(1, None))) == 3
    assert len(windows.select([])) == 0


def test_no_recording_is_on_two_sides_of_a_split_and_none_is_lost():
    windows = dataset([20, 13, 7])
    sides = [set(part.recording.tolist()) for part in split(windows)]
    assert set.union(*sides) == set(range(40))
    assert sum(map(len, sides)) == 40
    assert sum(map(len, split(windows))) == len(windows)


def test_the_default_shares_are_64_16_20_percent_of_every_class():
    parts = split(dataset([200] * 3))
    for part, n in zip(parts, (128, 32, 40), strict=True):
        assert np.bincount(part.y).tolist() == [3 * n] * 3


def test_the_shares_hold_over_all_classes_even_where_no_class_divides():
    train, validation, test = split(dataset([7] * 30, windows_each=1))
    assert (len(train), len(validation), len(test)) == (134, 34, 42)


def test_three_recordings_of_a_class_put_one_on_each_side():
    for part in split(dataset([3, 50])):
        assert set(part.y.tolist()) == {0, 1}


def test_too_few_recordings_of_a_class_are_an_error_that_names_it():
    with pytest.raises(
        ValueError, match="class 1 has 2 recordings: a split into 3 parts needs at least 3"
    ):
        split(dataset([5, 2]))


def test_a_share_of_zero_leaves_that_side_empty():
    train, validation, test = split(dataset([2, 2]), test=0, validation=0.5)
    assert (len(train), len(validation), len(test)) == (6, 6, 0)
    with pytest.raises(ValueError, match="test share"):
        split(dataset([5]), test=1.0)


def test_the_same_seed_gives_the_same_split_and_another_seed_another():
    windows = dataset([30, 30])
    a, b, c = (split(windows, seed=s)[2].recording.tolist() for s in (1, 1, 2))
    assert a == b != c


def test_a_recording_with_two_classes_is_refused():
    with pytest.raises(ValueError, match="recording 5 has windows of two classes"):
        split(Windows(np.zeros((2, 1, 1)), np.array([0, 1]), np.array([5, 5])))


def test_a_copy_lies_on_the_side_of_its_recording_in_every_split(grasps):
    touched = np.flatnonzero(grasps.labels)[:24]  # the first class holds nothing
    originals = [grasps.frames[i].astype(float) for i in touched]
    rng = np.random.default_rng(0)
    step = grasps.layout.full_scale / 1023
    copies = [
        np.concatenate([frames[:1], frames[:-1]]) + rng.integers(-1, 2, frames.shape) * step
        for frames in originals
    ]
    labels = np.tile(np.arange(24) % 3, 2)
    windows = make_windows([*originals, *copies], labels, grasps.layout)
    assert np.array_equal(windows.sources % 24, windows.recording % 24)
    assert len(np.unique(windows.sources)) == len(np.unique(windows.independent.recording)) == 24
    for seed in range(3):
        sides = [set(part.recording.tolist()) for part in split(windows, seed=seed)]
        assert sum(map(len, sides)) == 48
        for side in sides:
            assert {(number + 24) % 48 for number in side} == side
    few = make_windows([originals[0], originals[0], originals[1]], [0, 0, 0], grasps.layout)
    with pytest.raises(ValueError, match=r"class 0 has 2 recordings \(copies count once\)"):
        split(few)
