"""Recordings of an array that thresholds, without noise: contacts in its upper half."""

import numpy as np

from diagnostics import SensorLayout

LAYOUT = SensorLayout(1, 8, 8, full_scale=1.0)
CELLS = LAYOUT.n_cells


def events(seed: int, recordings: int = 24, frames: int = 64) -> list[np.ndarray]:
    """Presses that come and go somewhere in the upper half; what they do not reach reads exactly
    0."""
    rng = np.random.default_rng(seed)
    places = np.argwhere(np.ones((8, 8)))
    found = []
    for _ in range(recordings):
        press = np.clip(1 - ((places - rng.uniform((0, 0), (3, 7))) ** 2).sum(axis=1) / 6, 0, None)
        found.append(
            0.6 * np.clip(np.sin(np.linspace(0, 3 * np.pi, frames)), 0, None)[:, None] * press
        )
    return found
