"""Worn cells of small pads that contacts load as a whole."""

import numpy as np
import pytest

from diagnostics import FaultKind, SelfDiagnosis, SensorLayout

LAYOUT = SensorLayout(2, 3, 4, full_scale=255.0, rest="low", wiring="bus")
WORN = (5, 6)
ROWS, COLS = np.mgrid[0:3, 0:4]


def pressed(seed: int, count: int) -> list[np.ndarray]:
    """Recordings in which a wide contact wanders over each pad."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        frames = rng.normal(0, 1, (60, 2, 3, 4))
        for pad in range(2):
            row, col = rng.uniform((0, 0), (2, 3))
            path = np.linspace(0, rng.uniform(-1, 1), 60)[:, None, None]
            away = (ROWS - row - path) ** 2 + (COLS - col + path) ** 2
            grip = np.maximum(np.sin(np.linspace(-0.5, np.pi + 0.5, 60)), 0)[:, None, None]
            frames[:, pad] += rng.uniform(80, 240) * grip * np.exp(-away / 4)
        found.append(np.clip(np.rint(frames), 0, 255).reshape(60, 24))
    return found


@pytest.fixture(scope="module")
def fitted() -> SelfDiagnosis:
    return SelfDiagnosis(LAYOUT).fit(pressed(1, 80))


@pytest.mark.parametrize("gain", [0.1, 0.2, 0.35])
def test_worn_cells_are_told_with_their_gain_and_nobody_else_is_blamed(fitted, gain):
    log = pressed(2, 40)
    for frames in log:
        frames[:, WORN] = np.rint(gain * frames[:, WORN])
    diagnosis = fitted.diagnose(log)
    assert set(diagnosis.fault_set) == set(WORN)
    told = {fault.cells[0]: fault for fault in diagnosis.faults}
    for cell in WORN:
        assert told[cell].kind is FaultKind.WEAK
        assert told[cell].value == pytest.approx(gain, abs=0.06)
