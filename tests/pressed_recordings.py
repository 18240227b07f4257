"""Recordings of an array that is pressed here and there, in whole counts with noise."""

import numpy as np

from diagnostics import SensorLayout

LAYOUT = SensorLayout(1, 8, 8, full_scale=4095.0, rate=20.0, unit="count")
FRAMES = 60  # of a recording
REST = 40.0


def presses(seed: int, recordings: int, length: int = 20) -> list[np.ndarray]:
    """Presses of ``length`` frames that come and go anywhere."""
    rng = np.random.default_rng(seed)
    rows, cols = np.divmod(np.arange(64), 8)
    course = np.sin(np.linspace(0, np.pi, length))[:, None]
    found = []
    for _ in range(recordings):
        total = np.zeros((FRAMES, 64))
        for _ in range(3):
            row, col = rng.uniform(0, 7, 2)
            shape = np.exp(-((rows - row) ** 2 + (cols - col) ** 2) / 4)
            begin = int(rng.integers(0, FRAMES - length))
            total[begin : begin + length] += 3000 * course * shape
        noise = rng.normal(0, 2, total.shape)
        found.append(np.clip(REST + total + noise, 0, 4095).round())
    return found
