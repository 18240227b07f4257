"""What the cells of a pad share: each has a gain of its own, a dead one has none."""

import numpy as np
import pytest

from diagnostics import SensorLayout
from diagnostics.sensor.common_mode import find_common_mode

LAYOUT = SensorLayout(2, 4, 6, full_scale=4095.0)
D = LAYOUT.n_cells
DEAD = 7
REST = np.random.default_rng(9).uniform(50, 150, D)


def contacts(seed: int, recordings: int = 20) -> list[np.ndarray]:
    """Return recordings in which contacts load a third of the cells for half of the time."""
    rng = np.random.default_rng(seed)
    press = np.clip(np.sin(np.linspace(0, 2 * np.pi, 60)), 0, None)[:, None]
    return [
        REST + 1500 * press * rng.random(D) * (rng.random(D) < 1 / 3) + rng.normal(0, 1, (60, D))
        for _ in range(recordings)
    ]


def shaking(seed: int, gain: np.ndarray) -> list[np.ndarray]:
    log = contacts(seed)
    for frames in log:
        frames += gain * 200 * (1 + np.sin(np.arange(60) / 1.3))[:, None]
        frames[:, DEAD] = 2000.0
    return log


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_the_gain_of_each_cell_is_recovered_and_that_of_a_dead_one_is_zero(spread):
    gain = 1 + spread * np.random.default_rng(1).uniform(-1, 1, D)
    found = find_common_mode(shaking(2, gain), contacts(1), LAYOUT)
    assert found.disturbance.name == "hum"
    assert found.gains[DEAD] == 0
    shared = np.median(found.gains[gain != 0] / gain[gain != 0])
    alive = np.arange(D) != DEAD
    assert np.abs(found.gains / shared / gain - 1)[alive].max() < 0.25


def test_without_it_the_cells_read_what_they_would_have():
    gain = 1 + 0.5 * np.random.default_rng(1).uniform(-1, 1, D)
    found = find_common_mode(shaking(2, gain), contacts(1), LAYOUT)
    undone = np.concatenate(found.undo(shaking(2, gain), LAYOUT))
    truth = np.concatenate(contacts(2))
    alive = np.arange(D) != DEAD
    assert np.median(np.abs(undone - truth)[:, alive]) < 15
    assert (undone[:, DEAD] == 2000).all()


def test_readings_that_come_with_the_load_of_the_pad_are_crosstalk_with_one_gain():
    def crossed(frames: np.ndarray) -> np.ndarray:
        of_pad = (frames - REST).reshape(len(frames), 2, -1).mean(axis=2)
        return frames + 0.5 * of_pad[:, LAYOUT.pad_of]

    found = find_common_mode([crossed(f) for f in contacts(2)], contacts(1), LAYOUT)
    assert found.disturbance.name == "crosstalk"
    assert set(found.gains) <= {0.0, 1.0}


def test_a_healthy_log_has_none():
    assert find_common_mode(contacts(2), contacts(1), LAYOUT) is None
