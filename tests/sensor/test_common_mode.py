"""What the cells of a pad share beyond the reference is told by what it looks like."""

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


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_a_swing_of_all_cells_is_a_hum_whatever_share_each_has(spread):
    gain = 1 + spread * np.random.default_rng(1).uniform(-1, 1, D)
    log = contacts(2)
    for frames in log:
        frames += gain * 200 * (1 + np.sin(np.arange(60) / 1.3))[:, None]
        frames[:, DEAD] = 2000.0
    found = find_common_mode(log, contacts(1), LAYOUT)
    assert found.name == "hum"
    assert 200 < found.size < 600


def test_a_constant_shift_is_an_offset():
    found = find_common_mode([frames + 300 for frames in contacts(2)], contacts(1), LAYOUT)
    assert found.name == "offset"
    assert found.size == pytest.approx(300, rel=0.1)


def test_a_shift_that_grows_from_recording_to_recording_is_a_ramp():
    log = [frames + 20 * i for i, frames in enumerate(contacts(2))]
    found = find_common_mode(log, contacts(1), LAYOUT)
    assert found.name == "ramp"
    assert found.size == pytest.approx(380, rel=0.2)


def test_readings_that_come_with_the_load_of_the_pad_are_crosstalk():
    def crossed(frames: np.ndarray) -> np.ndarray:
        of_pad = (frames - REST).reshape(len(frames), 2, -1).mean(axis=2)
        return frames + 0.5 * of_pad[:, LAYOUT.pad_of]

    found = find_common_mode([crossed(f) for f in contacts(2)], contacts(1), LAYOUT)
    assert found.name == "crosstalk"


def test_a_healthy_log_has_none():
    assert find_common_mode(contacts(2), contacts(1), LAYOUT) is None
