"""Copies of a recording are found whatever was done to them, and no two recordings are taken for
one."""

import numpy as np
import pytest

from diagnostics.preprocessing.copies import find_copies

HOW = {
    "exact": lambda frames, rng: frames.copy(),
    "noise of a step": lambda frames, rng: frames + rng.integers(-1, 2, frames.shape) * 5 / 1023,
    "cut": lambda frames, rng: frames[len(frames) // 5 : -len(frames) // 6],
    "shifted": lambda frames, rng: np.concatenate([frames[:1], frames[:-1]]),
}


def touched(grasps):
    """Recordings of the first class hold nothing."""
    return [grasps.frames[i] for i in np.flatnonzero(grasps.labels)]


@pytest.mark.parametrize("how", HOW)
def test_copies_are_found_and_no_other_recording_is_one(grasps, how):
    given = [frames.astype(float) for frames in touched(grasps)[:60]]
    rng = np.random.default_rng(0)
    copied = rng.permutation(60)[:20]
    copies = [HOW[how](given[i], rng) for i in copied]
    expected = np.concatenate([np.arange(60), copied])
    np.testing.assert_array_equal(find_copies([*given, *copies]), expected)


def test_a_cut_recording_is_the_copy_of_the_whole_one_wherever_it_stands(grasps):
    whole, other = touched(grasps)[:2]
    assert find_copies([whole[20:], other, whole]).tolist() == [2, 1, 2]


@pytest.mark.parametrize("frames", [np.zeros((40, 30)), np.full((40, 30), 2.5), np.zeros((0, 30))])
def test_recordings_in_which_nothing_moves_are_no_copies(frames):
    assert find_copies([frames, frames, frames]).tolist() == [0, 1, 2]
    assert find_copies([]).tolist() == []


def test_what_no_converter_sends_is_no_copy_and_no_warning(grasps):
    given = [frames.astype(float) for frames in touched(grasps)[:4]]
    given[1][::2, ::3] = -1e308
    given[2][5] = np.inf
    given[3][:] = np.nan
    assert find_copies([*given, given[0][2:]]).tolist() == [0, 1, 2, 3, 0]


@pytest.mark.parametrize("corrupt", [1, 3])
def test_recordings_that_share_corrupt_frames_alone_are_no_copies(corrupt):
    rng = np.random.default_rng(corrupt)
    y, x = np.mgrid[:16, :8]
    given = []
    for _ in range(4):  # somebody lies, a little elsewhere in each, and breathes
        body = 300 * np.exp(-((y - 8) ** 2) / 10 - (x - 3.5 - rng.normal(0, 0.5)) ** 2 / 6)
        breath = 1 + 0.3 * np.sin(np.arange(160) / 7 + rng.uniform(0, 6))
        frames = np.round(body.ravel() * breath[:, None] + rng.gamma(0.4, 1.2, (160, 128)))
        frames[rng.permutation(160)[:corrupt]] = 4095
        given.append(frames)
    assert find_copies(given).tolist() == [0, 1, 2, 3]
    assert find_copies([*given, given[2][10:]]).tolist() == [0, 1, 2, 3, 2]
