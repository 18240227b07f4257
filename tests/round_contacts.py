"""Round contacts on a pad of 8 x 8 cells, each in the middle of its recording."""

import numpy as np

IDLE = 10  # frames before a contact


def presses(seed: int, count: int = 48) -> list[np.ndarray]:
    """One or two round contacts in each recording, that come and go."""
    rng = np.random.default_rng(seed)
    row, column = np.divmod(np.arange(64), 8)
    swell = np.clip(np.minimum(np.arange(80) - IDLE, 65 - np.arange(80)) / 4, 0, 1)[:, None]
    recordings = []
    for _ in range(count):
        load = np.zeros(64)
        for _ in range(rng.integers(1, 3)):
            squared = (row - rng.uniform(0, 7)) ** 2 + (column - rng.uniform(0, 7)) ** 2
            load += rng.uniform(600, 2500) * np.exp(-squared / 2 / rng.uniform(0.8, 1.8) ** 2)
        recordings.append(np.clip(np.rint(40 + swell * load + rng.normal(0, 2, (80, 64))), 0, 4095))
    return recordings
