import numpy as np

from diagnostics import FaultKind, SelfDiagnosis, SensorLayout

FRAMES = 100  # of a recording


def held_beside_contacts(count: int, share: float, seed: int) -> list[np.ndarray]:
    """Contacts on 4 x 6 cells; in a ``share`` of the recordings a hand holds a cell of the left
    column throughout."""
    rng = np.random.default_rng(seed)
    recordings = []
    for _ in range(count):
        load = np.zeros((FRAMES, 4, 6))
        for first in range(2, FRAMES, 20):
            row = rng.integers(0, 3)
            column = rng.integers(0, 5)
            load[first : first + 16, row : row + 2, column : column + 2] += (
                0.6 * np.hanning(16)[:, None, None]
            )
        if rng.random() < share:
            load[:, rng.integers(4), 0] += (
                rng.uniform(0.3, 0.5) + 0.005 * rng.standard_normal(FRAMES).cumsum()
            )
        readings = load.reshape(FRAMES, 24) + 0.002 * rng.standard_normal((FRAMES, 24))
        recordings.append(np.clip(np.round(readings * 255) / 255, 0, 1))
    return recordings


def test_loads_that_outlast_contacts_are_no_offsets_where_healthy_cells_hold_them_too():
    fitted = SelfDiagnosis(SensorLayout(1, 4, 6)).fit(held_beside_contacts(40, 0.15, 0))
    logs = held_beside_contacts(10, 1.0, 100)
    assert sum(len(fitted.diagnose(log).fault_set) for log in logs) <= 1
    broken = held_beside_contacts(6, 0.0, 200)
    for recording in broken:
        recording[:, 9] += 0.1
    (found,) = fitted.diagnose(broken).faults
    assert (found.kind, found.cells) == (FaultKind.DRIFT, (9,))
