"""ALIVE is said of cells that worked in the later half of a log as well."""

import pytest
from round_contacts import presses

from diagnostics import SelfDiagnosis, SensorLayout, Verdict

LAYOUT = SensorLayout(1, 8, 8, full_scale=4095, unit="count", rate=20.0)


@pytest.fixture(scope="module")
def fitted() -> SelfDiagnosis:
    return SelfDiagnosis(LAYOUT).fit(presses(0, 48))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_cell_that_nothing_loads_in_the_later_half_of_a_log_is_untested(fitted, seed):
    cell = LAYOUT.cell(0, 0, 3)
    by_load = sorted(presses(seed, 120), key=lambda frames: frames[:, cell].max())
    log = by_load[-15:] + by_load[:15]
    assert fitted.diagnose(log).verdicts.ravel()[cell] is Verdict.UNTESTED


@pytest.mark.parametrize("seed", [1, 2])
def test_most_cells_of_a_healthy_log_are_alive(fitted, seed):
    verdicts = fitted.diagnose(presses(seed, 40)).verdicts
    assert (verdicts == Verdict.ALIVE).mean() > 0.9


def test_a_cell_that_repeats_another_one_from_the_middle_on_is_not_alive(fitted):
    log = presses(4, 40)
    cell = LAYOUT.cell(0, 4, 4)
    for frames in log[20:]:
        frames[:, cell] = frames[:, LAYOUT.cell(0, 4, 5)]
    assert fitted.diagnose(log).verdicts.ravel()[cell] is not Verdict.ALIVE
