import numpy as np
import pytest

from adaptfault.data.determination import r2
from adaptfault.data.windows import Windows
from adaptfault.robot.model_comparison import compare_candidate, score, with_faults
from diagnostics import Fault, FaultKind, SensorLayout

LAYOUT = SensorLayout(1, 2, 3, full_scale=4.0)


@pytest.fixture
def windows(rng) -> Windows:
    return Windows(rng.random((120, 5, 6)), np.repeat([0, 1, 2], 40), np.repeat(np.arange(24), 5))


def answering(windows: Windows, share: float, seed: int, only=None):
    """A classifier that is right on about this share of the windows, of the classes in ``only``."""
    right = np.random.default_rng(seed).random(len(windows)) < share
    if only is not None:
        right |= ~np.isin(windows.y, only)
    return lambda x: np.where(right, windows.y, (windows.y + 1) % 3)


def test_a_clearly_better_candidate_is_better_and_the_gain_lies_in_its_interval(windows):
    judgement = compare_candidate(answering(windows, 0.4, 0), answering(windows, 0.9, 1), windows)
    assert judgement.better
    assert judgement.low < judgement.gain < judgement.high
    assert judgement.gain == pytest.approx(judgement.candidate - judgement.running)


def test_the_same_answers_are_never_better(windows):
    same = answering(windows, 0.7, 0)
    judgement = compare_candidate(same, same, windows)
    assert (judgement.gain, judgement.better, judgement.collapsed) == (0.0, False, ())


def test_what_is_better_on_one_recording_and_worse_on_the_other_is_not_better(windows):
    few = windows.select(np.isin(windows.recording, (0, 1)))
    one, other = (np.where(few.recording == i, few.y, -1) for i in (0, 1))
    judgement = compare_candidate(lambda x: one, lambda x: other, few)
    assert judgement.gain == 0
    assert not judgement.better


def test_candidates_that_are_better_by_chance_alone_are_rarely_called_better(windows):
    better = sum(
        compare_candidate(
            answering(windows, 0.6, i), answering(windows, 0.6, 500 + i), windows
        ).better
        for i in range(60)
    )
    assert better <= 8  # 5 % of 60 are 3


def test_a_class_that_collapses_is_named(windows):
    judgement = compare_candidate(
        answering(windows, 0.9, 0), answering(windows, 0.1, 1, only=[2]), windows
    )
    assert judgement.collapsed == (2,)


def test_faults_are_put_into_the_windows_and_nothing_else_changes(windows):
    faults = [Fault(FaultKind.SHORT, (1,), onset=3), Fault(FaultKind.STUCK, (4,), value=1.0)]
    broken = with_faults(windows, faults, LAYOUT)
    np.testing.assert_allclose(broken.x[:, :, 1], 1.0)
    np.testing.assert_allclose(broken.x[:, :, 4], 0.25)
    np.testing.assert_allclose(
        broken.x[:, :, [0, 2, 3, 5]], windows.x[:, :, [0, 2, 3, 5]], rtol=1e-6
    )
    np.testing.assert_array_equal(broken.recording, windows.recording)


# Regressions

UNITS = np.array([4000.0, 0.001])


@pytest.fixture
def values(windows, rng) -> Windows:
    return Windows(windows.x, rng.normal(2, 1, (120, 2)) * UNITS, windows.recording)


def naming(windows: Windows, error: tuple[float, float], seed: int):
    """A regression with an error of so many deviations in each value."""
    off = np.random.default_rng(seed).normal(0, 1, windows.y.shape) * error * UNITS
    return lambda x: windows.y + off


def test_regressions_are_compared_by_r2_whatever_the_units_of_the_values(values):
    judgement = compare_candidate(
        naming(values, (0.8, 0.8), 0), naming(values, (0.3, 0.3), 1), values
    )
    assert judgement.measure == "R2"
    assert judgement.better
    assert judgement.collapsed == ()
    assert judgement.low < judgement.gain < judgement.high
    assert judgement.candidate == pytest.approx(r2(values.y, naming(values, (0.3, 0.3), 1)(0)))
    assert str(judgement).startswith("R2 under these faults: running ")
    assert score(naming(values, (0.3, 0.3), 1), values) == pytest.approx(judgement.candidate)


def test_a_value_that_collapses_is_named_though_the_other_gets_better(values):
    judgement = compare_candidate(
        naming(values, (1.5, 0.2), 0), naming(values, (0.1, 0.9), 1), values
    )
    assert judgement.better
    assert judgement.collapsed == (1,)


def test_a_value_without_any_r2_cannot_collapse_unless_it_gets_worse(values):
    for error, collapsed in ((2.0, ()), (6.0, (0,))):
        judgement = compare_candidate(
            naming(values, (3.0, 0.1), 0), naming(values, (error, 0.1), 1), values
        )
        assert judgement.collapsed == collapsed


def test_a_value_that_is_constant_in_the_windows_counts_for_nothing(values):
    constant = values.y.copy()
    constant[:, 1] = 0.1
    windows = Windows(values.x, constant, values.recording)
    judgement = compare_candidate(
        naming(windows, (0.5, 9.0), 0), naming(windows, (0.1, 0.0), 1), windows
    )
    assert judgement.better
    assert judgement.running == pytest.approx(
        r2(constant[:, :1], naming(windows, (0.5, 9.0), 0)(0)[:, :1])
    )
