import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptfault import inspect
from adaptfault.data.simulated_grasps import simulate
from diagnostics import FaultKind, SelfDiagnosis, SensorLayout
from diagnostics.preprocessing.noise import NoiseNow, UsualNoise

LAYOUT = SensorLayout(1, 8, 8, full_scale=4095, unit="count", rate=20.0)
PRESENT = np.ones(64, bool)


def touched(
    seed: int, noise: float, layout: SensorLayout = LAYOUT, each: int = 12
) -> list[np.ndarray]:
    """Grasps at a rest of 1 %, with noise of this share of full scale."""
    rng = np.random.default_rng(seed)
    frames = simulate(each, layout, n_frames=60, seed=seed).frames
    read = (
        0.01 * layout.full_scale + 0.9 * f + rng.normal(0, noise * layout.full_scale, f.shape)
        for f in frames
    )
    return [np.clip(np.rint(f), 0, layout.full_scale) for f in read]


def untouched(
    seed: int, noise: float, rest: float = 0.01, layout: SensorLayout = LAYOUT
) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    full = layout.full_scale
    return [
        np.clip(np.rint(full * (rest + rng.normal(0, noise, (80, layout.n_cells)))), 0, full)
        for _ in range(20)
    ]


@pytest.fixture(scope="module")
def fitted() -> SelfDiagnosis:
    return SelfDiagnosis(LAYOUT).fit(touched(0, 0.0005, each=20))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**20), st.floats(0.5, 50), st.integers(0, 40))
def test_the_deviation_is_that_of_the_noise_whatever_a_part_of_the_cells_does(
    seed: int, size: float, loaded: int
):
    rng = np.random.default_rng(seed)
    now = NoiseNow()
    for _ in range(5):
        frames = np.rint(rng.normal(500, size, (32, 64)))
        frames[:, :loaded] += rng.uniform(0, 1000, (32, loaded))
        now = now.extend(frames, PRESENT)
    assert now.deviation == pytest.approx(size, rel=0.5, abs=0.3)


def test_missing_readings_and_short_segments_tell_nothing():
    assert NoiseNow().extend(np.full((32, 64), np.nan), PRESENT) == NoiseNow()
    assert NoiseNow().extend(np.arange(7 * 64.0).reshape(7, 64), PRESENT) == NoiseNow()


def test_noise_as_in_the_reference_raises_nothing():
    recordings = untouched(1, 0.002)
    usual = UsualNoise.fit(recordings, PRESENT, step=1.0)
    now = NoiseNow()
    for frames in untouched(2, 0.002):
        now = now.extend(frames[:32], PRESENT)
        assert usual.raises(now) == 0


def test_noise_within_half_a_converter_step_raises_nothing():
    assert UsualNoise(0.1, 1.0).raises(NoiseNow((0.55,))) == 0
    assert UsualNoise(0.1, 1.0).raises(NoiseNow((0.65,))) == pytest.approx(8 * 0.55)


def test_the_step_between_readings_counts_where_it_is_twice_that_of_the_reference():
    usual = UsualNoise(most=0.1, step=4.0)
    assert usual.raises(NoiseNow((0.1,), (8.0, 16.0, 8.0, 12.0, 9.0))) == 0
    assert usual.raises(NoiseNow((0.1,), (9.0, 16.0, 12.0, 12.0, 10.0))) == 9
    assert usual.raises(NoiseNow((0.1,), (9.0, 16.0, 12.0, 12.0))) == 0  # too few segments


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**20), st.integers(1, 200))
def test_the_step_is_that_of_the_converter(seed: int, step: int):
    rng = np.random.default_rng(seed)
    now = NoiseNow()
    for _ in range(5):
        now = now.extend(step * rng.integers(0, 4, (32, 64)).astype(float), PRESENT)
        now = now.extend(np.zeros((32, 64)), PRESENT)  # where nothing changes, it is unknown
    assert now.step == step


def test_coarser_readings_than_in_the_reference_are_no_blinks(fitted: SelfDiagnosis):
    coarse = [128 * np.rint(frames / 128) for frames in touched(5, 0.0005)]
    kinds = {fault.kind for fault in fitted.diagnose(coarse).faults}
    assert FaultKind.INTERMITTENT not in kinds


def test_noise_that_is_cut_off_at_the_lower_end_is_no_contact(fitted: SelfDiagnosis):
    diagnosis = fitted.diagnose(untouched(4, 0.01, rest=0.0))
    assert diagnosis.coverage.test_coverage <= 0.05


@pytest.mark.parametrize("times", [2.5, 5, 15, 25])
def test_where_nobody_touches_the_array_noise_is_no_contact(fitted: SelfDiagnosis, times: float):
    diagnosis = fitted.diagnose(untouched(3, 0.0005 * times))
    assert diagnosis.coverage.test_coverage <= 0.05
    assert not diagnosis.fault_set


@pytest.mark.parametrize("rest", [0.01, 0.1, 0.25])
@pytest.mark.parametrize("noise", [0.001, 0.0025, 0.0075, 0.02])
def test_without_a_reference_noise_is_no_contact_wherever_cells_rest(noise: float, rest: float):
    diagnosis = SelfDiagnosis(LAYOUT).diagnose(untouched(4, noise, rest))
    assert diagnosis.coverage.test_coverage == 0
    assert not diagnosis.fault_set


def test_an_untested_log_is_told_with_exit_code_1(fitted: SelfDiagnosis):
    found = inspect(untouched(5, 0.005), fitted)
    assert found.severity == 1
    assert "untested" in {one.name for one in found.findings}


@pytest.mark.parametrize("times", [5, 30])
def test_contacts_still_test_cells_where_the_noise_grew_and_nobody_is_blamed(
    fitted: SelfDiagnosis, times: float
):
    diagnosis = fitted.diagnose(touched(6, 0.0005 * times))
    assert diagnosis.coverage.test_coverage > 0.5
    assert not diagnosis.fault_set


def test_coarse_converters_are_not_blamed_for_noise_that_grew_fifteenfold():
    layout = SensorLayout(1, 6, 6, full_scale=255, unit="count", rate=20.0)
    fitted = SelfDiagnosis(layout).fit(touched(7, 0.0005, layout))
    assert not fitted.diagnose(touched(8, 0.0075, layout)).fault_set
