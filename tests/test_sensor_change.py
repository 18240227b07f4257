"""A change of all cells at once is found against the reference; other grasps of the same sensor are none."""

import numpy as np
import pytest

from diagnostics import SensorLayout
from diagnostics.evidence.sensor_change import sensor_change

LAYOUT = SensorLayout(1, 6, 6)
CELLS = np.arange(36)


def grasps(n: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(n):
        frames = np.abs(rng.normal(0, 0.003, (40, 36)))
        frames[10:30, rng.choice(36, 8, replace=False)] += rng.uniform(1.5, 3.5, 8)
        made.append(frames)
    return made


def test_healthy_recordings_are_no_change():
    assert [sensor_change(grasps(12, seed), grasps(60, 99), LAYOUT, CELLS) for seed in range(20)] == [None] * 20


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_a_gain_of_all_cells_is_found_and_measured(gain):
    change = sensor_change([gain * r for r in grasps(12, 1)], grasps(60, 99), LAYOUT, CELLS)
    assert change.gain == pytest.approx(gain, rel=0.15)
    assert change.offset == 0
    assert f"about {change.gain:.2g}x" in change.reason


def test_an_offset_of_all_cells_is_found_and_measured():
    change = sensor_change([r + 1.5 for r in grasps(12, 1)], grasps(60, 99), LAYOUT, CELLS)
    assert change.offset == pytest.approx(1.5, abs=0.01)
    assert change.gain == 1


def test_idle_recordings_and_too_few_are_no_change():
    idle = [np.abs(np.random.default_rng(i).normal(0, 0.003, (40, 36))) for i in range(20)]
    assert sensor_change(idle, grasps(60, 99), LAYOUT, CELLS) is None
    assert sensor_change([0.3 * r for r in grasps(4, 1)], grasps(60, 99), LAYOUT, CELLS) is None
    assert sensor_change([np.full((3, 36), np.nan)], grasps(60, 99), LAYOUT, CELLS) is None
