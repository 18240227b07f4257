import numpy as np
import pytest

from adaptfault.data.windows import make_windows
from adaptfault.imputation.statistics import CellStatistics
from adaptfault.inspection.plausibility import contradiction, implausible
from diagnostics import FaultSet

NONE = FaultSet((), 60)


@pytest.fixture(scope="module")
def statistics(small_grasps):
    windows = make_windows(small_grasps.frames, small_grasps.labels, small_grasps.layout)
    return CellStatistics.fit(windows)


def test_a_healthy_recording_is_plausible(later_grasps, small_grasps):
    assert all(implausible(r, small_grasps.layout) is None for r in later_grasps)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda r: r * 800, "raw counts"),
        (lambda r: r - 3, "lie outside 0 to 5 N"),
        (lambda r: np.full_like(r, np.nan), "no reading"),
        (lambda r: np.where(r > 0.1, np.inf, r), "lie outside"),
    ],
)
def test_what_this_sensor_cannot_read_is_told(later_grasps, small_grasps, change, expected):
    recording = max(later_grasps, key=np.sum)
    assert expected in str(implausible(change(recording), small_grasps.layout))


def test_healthy_cells_explain_each_other(later_grasps, statistics, small_grasps):
    assert contradiction(later_grasps, NONE, statistics, small_grasps.layout) < 0.5


def test_cells_in_another_order_and_noise_contradict_each_other(
    later_grasps, statistics, small_grasps, rng
):
    order = rng.permutation(60)
    shuffled = [r[:, order] for r in later_grasps]
    assert contradiction(shuffled, NONE, statistics, small_grasps.layout) > 1
    noise = [rng.random(r.shape) * 5 for r in later_grasps]
    assert contradiction(noise, NONE, statistics, small_grasps.layout) > 1


def test_idle_and_static_recordings_contradict_nothing(later_grasps, statistics, small_grasps, rng):
    idle = [np.abs(rng.normal(0, 0.003, r.shape)) for r in later_grasps]
    static = [r[30] + rng.normal(0, 0.003, r.shape) for r in later_grasps]
    for log in (idle, static):
        assert contradiction(log, NONE, statistics, small_grasps.layout) == 0
    order = rng.permutation(60)
    mixed = [r[:, order] for r in later_grasps] + 10 * idle
    assert contradiction(mixed, NONE, statistics, small_grasps.layout) > 1


def test_faulty_cells_do_not_count(later_grasps, statistics, small_grasps, rng):
    broken = [r.copy() for r in later_grasps]
    for r in broken:
        r[:, :10] = 5.0 * rng.random((len(r), 10))
    without = FaultSet(tuple(range(10)), 60)
    assert contradiction(broken, without, statistics, small_grasps.layout) < 0.5
    assert contradiction(broken, NONE, statistics, small_grasps.layout) > 1
