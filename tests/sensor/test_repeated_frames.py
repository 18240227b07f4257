"""A logger that is faster than the sensor repeats frames; that is told, and nobody is blamed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import adaptfault as af
from adaptfault.data.simulated_grasps import simulate
from diagnostics import SelfDiagnosis, SensorLayout
from diagnostics.sensor.repeated_frames import find_repeated_frames

LAYOUT = SensorLayout(1, 6, 6, rate=20.0)


@pytest.fixture(scope="module")
def grasps() -> list[np.ndarray]:
    """Grasps with noise."""
    rng = np.random.default_rng(0)
    frames = simulate(8, LAYOUT, n_frames=40, seed=3).frames
    return [frame + rng.normal(0, 0.01, frame.shape) for frame in frames]


@settings(max_examples=15)
@given(times=st.integers(2, 9), lost=st.booleans(), sends=st.floats(0.3, 1.0))
def test_the_share_and_the_true_rate_are_found_at_any_ratio_of_the_rates(
    grasps, times, lost, sends
):
    rng = np.random.default_rng(times)
    log = []
    for frames in grasps:
        new = np.cumsum(rng.random(len(frames)) < sends) - 1
        held = np.repeat(frames[np.maximum(new, 0)], times, axis=0)
        if lost:
            held[rng.random(len(held)) < 0.02] = np.nan
        log.append(held)
    found = find_repeated_frames(log, LAYOUT)
    if lost and times == 2:  # what is lost may be what is new
        return
    assert found is not None
    assert found.every >= times * (1 if not lost else 0.6)
    assert found.share > 0.45 + 0.05 * (times > 2)


def test_frames_that_an_idle_array_repeats_are_no_repeated_frames(grasps):
    idle = [np.where(frames > 0.2, frames, 0.0) for frames in grasps]
    rests = [np.concatenate([frames, np.zeros((400, 36))]) for frames in idle]
    assert find_repeated_frames(rests, LAYOUT) is None
    assert find_repeated_frames(grasps, LAYOUT) is None
    assert find_repeated_frames([np.zeros((500, 36))], LAYOUT) is None


def test_a_healthy_log_that_repeats_frames_is_told_so_and_blames_nobody(grasps):
    reference = grasps[::2]
    log = [np.repeat(frames, 4, axis=0) for frames in grasps[1::2]]
    fitted = SelfDiagnosis(LAYOUT).fit(reference)
    found = af.inspect(log, fitted, reference=reference)
    told = {finding.name: finding for finding in found.findings}
    assert "75% of the frames repeat" in told["repeated_frames"].reason
    assert "come about 5 times a second" in told["repeated_frames"].reason
    assert told["repeated_frames"].severity == 0
    assert not found.diagnosis.fault_set
