"""A recording may begin in a contact, though no recording of the reference does; and several may
lie in one array."""

import numpy as np
import pytest
from round_contacts import IDLE, presses

from diagnostics import SelfDiagnosis, SensorLayout

LAYOUT = SensorLayout(1, 8, 8, full_scale=4095, unit="count", rate=20.0)


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
