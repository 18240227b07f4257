"""A change of all cells, or of a pad, is found against the reference; other grasps of the same
sensor are none."""

import numpy as np
import pytest

from diagnostics import SensorLayout
from diagnostics.sensor.sensor_change import differ, pad_change, sensor_change

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
    assert [
        sensor_change(grasps(12, seed), grasps(60, 99), LAYOUT, CELLS) for seed in range(20)
    ] == [None] * 20


def test_few_healthy_recordings_of_widely_different_loads_are_no_change():
    def loads(n: int, seed: int) -> list[np.ndarray]:
        force = np.random.default_rng(seed + 1000).lognormal(-1, 0.4, n)
        return [f * r for f, r in zip(force, grasps(n, seed), strict=True)]

    reference = loads(60, 99)
    assert [sensor_change(loads(5, seed), reference, LAYOUT, CELLS) for seed in range(70, 80)] == [
        None
    ] * 10


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_a_gain_of_all_cells_is_found_and_measured(gain):
    change = sensor_change([gain * r for r in grasps(12, 1)], grasps(60, 99), LAYOUT, CELLS)
    assert change.gain == pytest.approx(gain, rel=0.15)
    assert change.offset == 0
    assert f"about {change.gain:.2g}x" in change.reason


@pytest.mark.parametrize("gain", [0.3, 0.5])
def test_a_gain_is_found_where_loads_are_a_small_part_of_the_full_scale(gain):
    reference = grasps(60, 99)
    new = [gain * r for r in grasps(12, 1)]
    layout = SensorLayout(1, 6, 6, full_scale=50.0)
    change = sensor_change(new, reference, layout, CELLS)
    assert change is not None
    assert change.gain == pytest.approx(gain, rel=0.15)


def test_an_offset_of_all_cells_is_found_and_measured():
    change = sensor_change([r + 1.5 for r in grasps(12, 1)], grasps(60, 99), LAYOUT, CELLS)
    assert change.offset == pytest.approx(1.5, abs=0.01)
    assert change.gain == 1


def test_idle_recordings_and_too_few_are_no_change():
    idle = [np.abs(np.random.default_rng(i).normal(0, 0.003, (40, 36))) for i in range(20)]
    assert sensor_change(idle, grasps(60, 99), LAYOUT, CELLS) is None
    assert sensor_change([0.3 * r for r in grasps(4, 1)], grasps(60, 99), LAYOUT, CELLS) is None
    assert sensor_change([np.full((3, 36), np.nan)], grasps(60, 99), LAYOUT, CELLS) is None


PADS = SensorLayout(2, 6, 6)


def on_pads(n: int, seed: int) -> list[np.ndarray]:
    """Grasps of two pads, whose loads differ from grasp to grasp, for both alike."""
    force = np.random.default_rng(seed + 1000).permutation(np.linspace(0.2, 0.6, n))
    sides = [grasps(n, seed), grasps(n, seed + 500)]
    return [f * np.concatenate(both, axis=1) for f, *both in zip(force, *sides, strict=True)]


def replaced(
    recordings: list[np.ndarray], pad: int, gain: float, offset: float
) -> list[np.ndarray]:
    new = [r.copy() for r in recordings]
    for r in new:
        r[:, 36 * pad : 36 * (pad + 1)] = np.minimum(
            gain * r[:, 36 * pad : 36 * (pad + 1)] + offset, 5.0
        )
    return new


def test_pads_that_did_not_change_are_told_of_neither_at_another_force_nor_of_another_sensor():
    reference = on_pads(60, 99)
    every = np.arange(72)
    for seed in range(20):
        assert pad_change(on_pads(12, seed), reference, PADS, every) is None
        assert pad_change([0.4 * r for r in on_pads(12, seed)], reference, PADS, every) is None


@pytest.mark.parametrize(("pad", "gain"), [(0, 0.5), (1, 0.5), (0, 1.8), (1, 1.8)])
def test_of_two_pads_the_replaced_one_is_told_and_measured(pad: int, gain: float):
    change = pad_change(
        replaced(on_pads(24, 1), pad, gain, 0.0), on_pads(60, 99), PADS, np.arange(72)
    )
    assert change.pad == pad
    assert change.gain == pytest.approx(gain, rel=0.15)
    assert change.offset == 0
    assert f"pad {pad} changed" in change.reason
    assert "if it was replaced" in change.reason
    gains, offsets = change.of_cells(PADS)
    np.testing.assert_array_equal(gains != 1, np.arange(72) // 36 == pad)
    assert not offsets.any()


def test_an_offset_of_a_pad_is_told_and_measured():
    change = pad_change(replaced(on_pads(24, 1), 1, 1.0, 0.5), on_pads(60, 99), PADS, np.arange(72))
    assert change.pad == 1
    assert change.offset == pytest.approx(0.5, abs=0.05)
    assert change.of_cells(PADS)[1].sum() == pytest.approx(36 * change.offset)


def test_one_pad_alone_and_recordings_without_readings_tell_of_no_pad():
    assert pad_change(grasps(12, 1), grasps(60, 99), LAYOUT, CELLS) is None
    assert pad_change([np.full((3, 72), np.nan)] * 9, on_pads(60, 99), PADS, np.arange(72)) is None


@pytest.mark.parametrize("others", [1, 5, 200])
def test_hundreds_of_recordings_are_compared_without_a_warning(others: int):
    new = np.ones(400)
    new[:others] = 0.0
    assert differ(new, np.ones(400)) == (others == 200)
