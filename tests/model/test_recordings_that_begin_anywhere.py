"""A recording may begin in a contact, though no recording of the reference does; and several may
lie in one array."""

import numpy as np
import pytest

from diagnostics import SelfDiagnosis, SensorLayout

LAYOUT = SensorLayout(1, 8, 8, full_scale=4095, unit="count", rate=20.0)
IDLE = 10  # frames before a contact


def presses(seed: int, count: int) -> list[np.ndarray]:
    """One or two round contacts in each recording, after some frames without."""
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


@pytest.fixture(scope="module")
def fitted() -> SelfDiagnosis:
    return SelfDiagnosis(LAYOUT).fit(presses(0, 48))


@pytest.mark.parametrize("seed", [1, 34])
@pytest.mark.parametrize("joined", [False, True])
def test_a_healthy_log_that_begins_in_contacts_blames_nobody_and_a_dead_cell_is_found_in_it(
    fitted, seed, joined
):
    log = [frames[IDLE + 5 :] for frames in presses(seed, 20)]
    if joined:
        log = [np.concatenate(log)]
    assert not fitted.diagnose(log).fault_set
    cell = LAYOUT.cell(0, 3, 4)
    for frames in log:
        frames[:, cell] = 40
    assert list(fitted.diagnose(log).fault_set) == [cell]
