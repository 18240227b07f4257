"""A run of one frame under load is told, a rate of repeated frames is none; cuts do not matter."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptfault.data.recordings import Recordings
from adaptfault.inspection.quick import quick, quick_check
from adaptfault.inspection.quick_statistics import Statistics
from adaptfault.inspection.stands_still import Longest, StandsStill
from diagnostics import SensorLayout

LAYOUT = SensorLayout(1, 3, 4, full_scale=1.0, unit="V", rate=50.0)
N = 12
NAMES = tuple(f"recording {i}" for i in range(N))


@pytest.fixture
def log():
    rng = np.random.default_rng(0)
    course = np.maximum(np.sin(np.linspace(-0.5, np.pi + 0.5, 80)), 0)[:, None]
    return [
        (0.1 + course * rng.uniform(0.2, 0.8, 12) + rng.normal(0, 0.002, (80, 12)))
        for _ in range(N)
    ]


def told(log):
    return StandsStill.of(([frames] for frames in log), LAYOUT).told(NAMES)


def test_a_frame_that_comes_again_and_again_under_load_is_told_with_its_place(log):
    assert told(log) is None
    log[7][30:55] = log[7][29]
    assert told(log) == (
        "one frame came again 25 times in a row from frame 30 of recording 7 on, while cells were"
        " loaded"
    )
    statistics = Statistics.of(Recordings(tuple(log), LAYOUT, names=NAMES))
    checked = quick_check(statistics, quick(statistics), None)
    (finding,) = [one for one in checked.findings if one.name == "frozen"]
    assert str(finding.code) == "TOUCH-140"
    assert "frame 30 of recording 7" in finding.reason


def test_some_repeated_frames_are_no_run(log):
    rng = np.random.default_rng(1)
    for i in rng.choice(N, 9, replace=False):
        log[i][40] = log[i][39]
    assert told(log) is None


def test_a_logger_that_repeats_everywhere_and_an_untouched_array_are_no_run(log):
    assert told([np.repeat(frames, 25, axis=0) for frames in log]) is None
    assert told([np.repeat(frames, 4, axis=0) for frames in log]) is None
    rng = np.random.default_rng(4)
    sent = [np.repeat(frames, rng.integers(1, 40, len(frames)), axis=0) for frames in log]
    assert told(sent) is None  # what changed
    untouched = [frames.copy() for frames in log]
    untouched[3][:] = 0.1
    assert told(untouched) is None


@given(
    cuts=st.sets(st.integers(1, 79), max_size=6),
    runs=st.lists(st.tuples(st.integers(1, 78), st.integers(1, 40)), max_size=3),
    missing=st.booleans(),
)
def test_how_a_recording_is_cut_into_pieces_does_not_matter(cuts, runs, missing):
    rng = np.random.default_rng(2)
    frames = rng.uniform(0.2, 1, (80, 12))
    frames[0] = 0
    for begin, length in runs:
        frames[begin : begin + length] = frames[begin - 1]
    if missing:
        frames[10:20, 3] = np.nan
    whole = Longest(LAYOUT)
    whole.add(frames)
    piecewise = Longest(LAYOUT)
    for piece in np.split(frames, sorted(cuts)):
        piecewise.add(piece)
    assert vars(piecewise.run()) == vars(whole.run())


def test_the_longest_run_is_that_of_a_loop():
    rng = np.random.default_rng(3)
    for _ in range(50):
        frames = rng.integers(0, 2, (60, 12)) * 0.5
        frames[rng.random(60) < 0.7] = 0.5
        lowest = np.full(12, np.inf)
        longest = run = 0
        for i, frame in enumerate(frames):
            lowest = np.minimum(lowest, frame)
            is_loaded = (frame - lowest > 0.05).sum() >= 3
            run = run + 1 if i and (frame == frames[i - 1]).all() and is_loaded else 0
            longest = max(longest, run)
        one = Longest(LAYOUT)
        one.add(frames)
        assert one.run().lengths.tolist() == [longest]
