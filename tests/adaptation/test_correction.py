import numpy as np
import pytest

from adaptfault.adaptation.baselines.correction import CausalCorrection, correct
from adaptfault.data.windows import CONVERTER_STEP, Windows, make_windows
from adaptfault.imputation.statistics import CellStatistics
from diagnostics import FaultSet


def readings(rng, *shape):
    """Readings, a third of them at either rail."""
    return rng.choice([0.0, 1.0, 0.3, 0.7], shape, p=[0.2, 0.15, 0.35, 0.3]).astype(np.float32)


@pytest.fixture(scope="module")
def statistics(grasps) -> CellStatistics:
    return CellStatistics.fit(make_windows(grasps.frames, grasps.labels, grasps.layout))


def test_both_rails_become_the_neutral_value_and_nothing_else_changes(rng):
    x = readings(rng, 4, 10, 6)
    out = correct(x, neutral=0.5)
    np.testing.assert_array_equal(out, np.where((x == 0) | (x == 1), np.float32(0.5), x))
    assert out.dtype == np.float32


def test_the_default_leaves_an_open_cell_alone_and_makes_a_short_one_open(rng):
    x = readings(rng, 4, 10, 6)
    np.testing.assert_array_equal(correct(x), np.where(x == 1, 0, x))


def test_a_short_cell_corrected_is_an_open_cell_to_the_last_bit(rng):
    x = rng.uniform(0.1, 0.9, (3, 10, 6)).astype(np.float32)
    short = x.copy()
    opened = x.copy()
    short[..., [1, 4]] = 1
    opened[..., [1, 4]] = 0
    np.testing.assert_array_equal(correct(short), opened)


def test_one_converter_step_off_the_rail_is_still_abnormal_and_three_are_not():
    near = np.float32([1 - CONVERTER_STEP, 1 + CONVERTER_STEP, 1 - 3 * CONVERTER_STEP])
    np.testing.assert_array_equal(correct(near), np.float32([0, 0, 1 - 3 * CONVERTER_STEP]))
    assert (correct(near, tolerance=0) == near).all()


def test_each_cell_may_have_its_own_neutral_value():
    np.testing.assert_allclose(
        correct([[1.0, 0.4, 1.0]], neutral=[0.1, 0.2, 0.3]), [[0.1, 0.4, 0.3]]
    )


def test_missing_readings_stay_missing(statistics):
    frame = np.full(statistics.mean.size, 0.2)
    frame[[3, 5]] = np.nan, 1
    for neutral in (0.5, statistics):
        out = correct(frame, neutral=neutral)
        assert np.isnan(out[3])
        assert 0 <= out[5] < 1


def test_the_conditional_mean_is_what_the_linear_fill_says(grasps, statistics):
    frames = make_windows(grasps.frames[20:24], None, grasps.layout).x
    lost = FaultSet((37, 45, 160), grasps.layout.n_cells)
    short = frames.copy()
    short[..., list(lost)] = 1
    weight, bias = statistics.conditional_mean(lost)
    expected = np.clip(frames[..., lost.healthy] @ weight.T + bias, 0, 1)
    out = correct(short, abnormal=[1.0], neutral=statistics)
    np.testing.assert_allclose(out[..., list(lost)], expected, atol=1e-5)
    np.testing.assert_array_equal(out[..., lost.healthy], frames[..., lost.healthy])


def test_frames_with_different_cells_at_the_rail_are_each_filled_from_their_own_others(rng):
    x = rng.uniform(0.1, 0.9, (40, 10, 5)).astype(np.float32)
    x[..., 4] = x[..., 0]
    statistics = CellStatistics.fit(Windows(x, np.zeros(40), np.arange(40)))
    broken = x[0].copy()
    broken[:5, 4] = 1
    broken[5:, 0] = 1
    out = correct(broken, abnormal=[1.0], neutral=statistics)
    np.testing.assert_allclose(out, x[0], atol=0.08)


@pytest.mark.parametrize("wait", [1, 3, 10])
@pytest.mark.parametrize("neutral", [0.0, 0.5])
def test_batch_and_online_agree(rng, wait, neutral):
    x = np.repeat(readings(rng, 30, 6), rng.integers(1, 9, 30), axis=0)
    online, batch, halves = (CausalCorrection(wait=wait, neutral=neutral) for _ in range(3))
    expected = batch.correct(x)
    np.testing.assert_array_equal(np.stack([online.update(frame) for frame in x]), expected)
    np.testing.assert_array_equal(
        np.concatenate([halves.correct(x[:17]), halves.correct(x[17:])]), expected
    )
    if wait == 1:
        np.testing.assert_array_equal(expected, correct(x, neutral=neutral))


def test_a_press_shorter_than_the_wait_passes_and_a_fault_is_corrected_after_it():
    x = np.full((12, 2), 0.5)
    x[2:6, 0] = 1
    x[2:, 1] = 1
    out = CausalCorrection(wait=5).correct(x)
    np.testing.assert_array_equal(out[:, 0], x[:, 0])
    np.testing.assert_array_equal(out[:, 1], [0.5, 0.5, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0])


def test_a_cell_that_blinks_from_rail_to_rail_is_counted_anew_at_each():
    x = np.float64([1, 1, 0, 0, 1, 1, 1])[:, None]
    np.testing.assert_array_equal(
        CausalCorrection(wait=3, neutral=0.5).correct(x)[:, 0], [1, 1, 0, 0, 1, 1, 0.5]
    )


def test_what_does_not_fit_is_said():
    with pytest.raises(ValueError, match=r"each of the 3 cells; got shape \[2\]"):
        correct(np.ones((5, 3)), neutral=[0.0, 1.0])
    with pytest.raises(ValueError, match="tolerance >= 0"):
        correct([0.5], tolerance=-1)
    with pytest.raises(ValueError, match="abnormal values"):
        correct([0.5], abnormal=())
    with pytest.raises(ValueError, match="at least 1"):
        CausalCorrection(wait=0)
    online = CausalCorrection()
    online.update([0.5, 1.0])
    with pytest.raises(ValueError, match=r"expected frames \[T, 2\]"):
        online.update([0.5, 1.0, 0.2])


def test_statistics_of_another_array_are_refused(statistics):
    with pytest.raises(ValueError, match="statistics have 220 cells, the readings 3"):
        correct(np.ones((2, 3)), neutral=statistics)
