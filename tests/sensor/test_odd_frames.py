"""Single frames that measured nothing are named and left out; contacts of one frame stay."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import adaptfault as af
from diagnostics import SelfDiagnosis, SensorLayout
from diagnostics.sensor.odd_frames import (
    chance_of,
    find_odd_frames,
    rank_correlation,
    without_odd_frames,
)

LAYOUT = SensorLayout(2, 7, 6, full_scale=1023.0, unit="count", rate=20.0)
D = LAYOUT.n_cells


@pytest.fixture(scope="module")
def log() -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    rest = rng.uniform(15, 30, D)
    simulated = af.simulate(4, SensorLayout(2, 7, 6), n_frames=50, seed=3)
    return [
        np.clip(np.rint(rest + frames * 200 + rng.normal(0, 1, frames.shape)), 0, 1023)
        for frames in simulated.frames
    ][:12]


def exchanged(frame: np.ndarray) -> np.ndarray:
    return (frame.astype("<u2").byteswap() & 1023).astype(float)


def a_byte_late(frame: np.ndarray) -> np.ndarray:
    late = frame.astype("<u2").tobytes()[1:] + b"\0"
    return (np.frombuffer(late, "<u2") & 1023).astype(float)


def all_ones(frame: np.ndarray) -> np.ndarray:
    return np.full_like(frame, 1023)


def at_random(frame: np.ndarray) -> np.ndarray:
    return np.random.default_rng(7).integers(0, 1024, frame.shape).astype(float)


def places(odd) -> list[tuple[str, int, int]]:
    return [(one.kind, one.recording, one.frame) for one in odd]


@pytest.mark.parametrize("corrupt", [exchanged, a_byte_late, all_ones, at_random])
def test_a_corrupt_frame_is_named_wherever_it_is_and_leaves_the_log_as_it_was(log, corrupt):
    broken = [frames.copy() for frames in log]
    where = [(0, 0), (3, 1), (5, 20), (5, 22), (7, 49)]
    for recording, frame in where:
        broken[recording][frame] = corrupt(broken[recording][frame])
    odd = find_odd_frames(broken, LAYOUT)
    assert places(odd) == [("corrupt", *place) for place in where]
    cleaned = without_odd_frames(broken, odd, LAYOUT)
    for i, frames in enumerate(cleaned):
        bad = [frame for recording, frame in where if recording == i]
        usual = np.delete(np.arange(50), bad)
        np.testing.assert_array_equal(frames[usual], log[i][usual])
    assert not find_odd_frames(cleaned, LAYOUT)


def test_a_corrupt_frame_of_one_pad_names_the_pad_and_leaves_the_other(log):
    broken = [frames.copy() for frames in log]
    broken[4][30, :42] = at_random(broken[4][30, :42])
    odd = find_odd_frames(broken, LAYOUT)
    assert [(one.pads, one.recording, one.frame) for one in odd] == [((0,), 4, 30)]
    np.testing.assert_array_equal(
        without_odd_frames(broken, odd, LAYOUT)[4][:, 42:], log[4][:, 42:]
    )


def test_healthy_logs_and_a_contact_of_one_frame_have_no_odd_frame(log):
    loaded = max((frames for frames in log), key=lambda frames: frames.max())
    tapped = [frames.copy() for frames in log]
    for recording, frame in ((0, 0), (1, 25), (2, 49)):
        tapped[recording][frame] = loaded[loaded.sum(axis=1).argmax()]
    assert find_odd_frames(log, LAYOUT) == ()
    assert find_odd_frames(tapped, LAYOUT) == ()


@settings(max_examples=20, deadline=None)
@given(
    rows=st.lists(st.integers(0, 6), min_size=2, max_size=2, unique=True),
    where=st.sets(st.integers(0, 11)),
)
def test_rows_that_are_exchanged_in_some_recordings_make_no_frame_odd(log, rows, where):
    swapped = [frames.reshape(-1, *LAYOUT.shape).copy() for frames in log]
    for recording in where:
        swapped[recording][:, 0, rows] = swapped[recording][:, 0, rows[::-1]]
    assert not find_odd_frames([frames.reshape(-1, D) for frames in swapped], LAYOUT)


def test_lost_frames_and_missing_readings_are_no_odd_frames(log):
    rng = np.random.default_rng(2)
    gaps = [np.where(rng.random((len(frames), 1)) < 0.4, np.nan, frames) for frames in log]
    holes = [np.where(rng.random(frames.shape) < 0.1, np.nan, frames) for frames in log]
    assert find_odd_frames(gaps, LAYOUT) == ()
    assert find_odd_frames(holes, LAYOUT) == ()


def test_common_spikes_are_told_with_period_and_size_and_nobody_is_blamed(log):
    together = np.concatenate(log)
    together[17::40] += 60
    diagnosis = SelfDiagnosis(LAYOUT).diagnose(together)
    (spike,) = diagnosis.transport
    assert (spike.kind, spike.frames, spike.onset) == ("common_spike", 15, 17)
    assert "all cells jump together for one frame, every 2 s, by 60 count" in spike.reason
    assert not diagnosis.faults
    assert diagnosis.exit_code == 1
    names = {f.name for f in af.inspect(together, SelfDiagnosis(LAYOUT)).findings}
    assert "common_spike" in names


def test_diagnosis_and_inspection_name_a_corrupt_frame_and_judge_as_without_it(log):
    broken = [frames.copy() for frames in log]
    broken[5][20] = exchanged(broken[5][20])
    cold = SelfDiagnosis(LAYOUT)
    plain = cold.diagnose(log)
    found = cold.diagnose(broken)
    inspected = af.inspect(broken, cold)
    assert [one.kind for one in found.transport] == ["corrupt_frame"]
    assert "frame 20 of recording 5" in found.transport[0].reason
    assert [finding.name for finding in inspected.findings][:1] == ["corrupt_frame"]
    np.testing.assert_array_equal(found.verdicts, plain.verdicts)
    np.testing.assert_array_equal(inspected.diagnosis.verdicts, plain.verdicts)


@pytest.mark.parametrize("count", [3, 10, 36, 150])
def test_ranks_correlate_as_those_of_scipy(count, rng):
    from scipy.stats import spearmanr

    for strength in (-5.0, 0.0, 0.5, 5.0):
        first = rng.normal(size=count).round(1)  # some are equal
        second = (strength * first + rng.normal(size=count)).round(1)
        expected = spearmanr(first, second, alternative="greater")
        correlation = rank_correlation(first, second)
        assert correlation == pytest.approx(expected.statistic, abs=1e-12)
        assert chance_of(correlation, count) == pytest.approx(expected.pvalue, abs=1e-12)
    assert chance_of(1.0, 0) == 1
