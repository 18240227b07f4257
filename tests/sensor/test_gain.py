"""A healthy array that reads more, or less, than in the reference has another gain; no cell is
blamed for it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import adaptfault as af
from diagnostics import Fault, SelfDiagnosis, SensorLayout, inject
from diagnostics.sensor.gain import UsualSizes

LAYOUT = SensorLayout(1, 4, 4, full_scale=1023.0, unit="count", rate=50.0)
PLACES = np.argwhere(np.ones((4, 4)))


def grasps(seed: int, n: int, gain: float = 1.0) -> list[np.ndarray]:
    """Return recordings in which an object is grasped, held and let go."""
    rng = np.random.default_rng(seed)
    device = np.exp(np.random.default_rng(7).normal(0, 0.12, 16))
    time = np.arange(50)[:, None]
    found = []
    for _ in range(n):
        begin = rng.integers(5, 12)
        end = rng.integers(36, 45)
        held = np.clip(np.minimum(time - begin, end - time) / 6, 0, 1)
        centre = rng.uniform(0, 3, 2) + rng.normal(0, 0.03, 2) * (time - begin)
        width = rng.uniform(1, 2)
        apart = ((PLACES - centre[:, None]) ** 2).sum(axis=2)
        load = rng.uniform(90, 330) * held * np.exp(-apart / (2 * width**2))
        frames = gain * device * load + rng.normal(0, 2, load.shape)
        found.append(np.clip(np.rint(frames), 0, 1023))
    return found


@pytest.fixture(scope="module")
def reference() -> list[np.ndarray]:
    return grasps(1, 60)


@pytest.fixture(scope="module")
def fitted(reference) -> SelfDiagnosis:
    return SelfDiagnosis(LAYOUT).fit(reference)


@pytest.mark.parametrize("gain", [0.3, 0.6, 2.0, 3.0])
def test_an_array_with_another_gain_is_told_and_diagnosis_and_inspection_blame_nobody(
    fitted, reference, gain
):
    log = grasps(2, 20, gain)
    found = af.inspect(log, fitted, reference=reference)
    assert {finding.name for finding in found.findings} <= {"gain", "noise"}
    assert "gain" in {finding.name for finding in found.findings}
    assert not found.diagnosis.fault_set
    assert not fitted.diagnose(log).fault_set


def test_grasps_that_begin_in_contact_with_another_gain_blame_nobody():
    layout = SensorLayout(2, 6, 5)
    healthy = list(af.simulate(12, layout, n_frames=60, seed=7, sensor_seed=7).frames)
    fitted = SelfDiagnosis(layout).fit(healthy)
    log = [2 * r for r in af.simulate(4, layout, n_frames=60, seed=57, sensor_seed=7).frames]
    dead = [inject(r, [Fault("open", (7,)), Fault("short", (40,))], layout) for r in log]
    found = af.inspect(log, fitted, reference=healthy)
    assert "gain" in {finding.name for finding in found.findings}
    assert not found.diagnosis.fault_set
    assert not fitted.diagnose(log).fault_set
    assert set(fitted.diagnose(dead).fault_set) == {7, 40}


@settings(max_examples=20)
@given(gain=st.floats(0.3, 3), seed=st.integers(0, 99))
def test_a_gain_is_measured_where_a_few_counts_are_a_load(gain, seed):
    def counts(recordings: list[np.ndarray]) -> list[np.ndarray]:
        return [np.rint(np.minimum(frames / 12, 60)) for frames in recordings]

    usual = UsualSizes.of(counts(grasps(1, 60)), 1.0, np.ones(16, bool))
    assert usual is not None
    measured = usual.gain(counts(grasps(100 + seed, 40, gain)), 1.0, np.ones(16, bool))
    assert 1 / 1.5 < measured / gain < 1.5


def test_a_gain_with_which_the_amplifier_saturates_is_told_with_both(fitted, reference):
    log = [np.minimum(frames, 500) for frames in grasps(2, 20, 3.0)]
    found = af.inspect(log, fitted, reference=reference)
    assert {"gain", "saturated"} <= {finding.name for finding in found.findings}
    assert found.change.gain == pytest.approx(3, rel=0.3)
    assert not found.diagnosis.fault_set


def test_a_dead_cell_is_found_beside_another_gain(fitted, reference):
    log = [
        inject(r, [Fault("short", (5,)), Fault("open", (10,))], LAYOUT) for r in grasps(2, 20, 2)
    ]
    assert set(fitted.diagnose(log).fault_set) == {5, 10}
    assert set(af.inspect(log, fitted, reference=reference).diagnosis.fault_set) == {5, 10}


def test_a_stored_diagnosis_keeps_the_usual_loads(fitted):
    log = grasps(2, 20, 2)
    about, arrays = fitted.state()
    same = SelfDiagnosis.from_state(about, arrays)
    assert same.without_gain(log) is not None
