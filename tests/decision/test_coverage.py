import numpy as np
import pytest

from diagnostics import SensorLayout
from diagnostics.decision.coverage import coverage

LAYOUT = SensorLayout(2, 4, 5)
NONE = np.zeros(40, bool)


def cells(*indices: int) -> np.ndarray:
    return np.isin(np.arange(40), indices)


def test_a_log_that_tests_nothing_finds_nothing_and_one_that_tests_all_finds_all():
    probability = np.full(40, 0.02)
    assert coverage(~NONE, NONE, probability, LAYOUT).fault_coverage == 0
    tested = coverage(NONE, NONE, np.zeros(40), LAYOUT)
    assert (tested.fault_coverage, tested.test_coverage) == (1, 1)


def test_faults_among_untested_cells_lower_the_fault_coverage():
    faulty = cells(0, 1, 2)
    untested = cells(20, 21, 22, 23)
    probability = np.where(faulty, 1.0, np.where(untested, 0.25, 0.0))
    result = coverage(untested, faulty, probability, LAYOUT)
    assert result.test_coverage == pytest.approx(0.9)
    assert result.fault_coverage == pytest.approx((3 + 0.9) / (4 + 1))
    assert result.untested.tolist() == [20, 21, 22, 23]


def test_advice_names_each_region_of_untested_cells_the_largest_first():
    untested = cells(0, *(20 + row * 5 + column for row in (2, 3) for column in (1, 2, 3)))
    assert coverage(untested, NONE, np.zeros(40), LAYOUT).advice == (
        "press pad 1, rows 2-3, columns 1-3 (6 cells untested)",
        "press pad 0, row 0, column 0 (1 cell untested)",
    )


def test_100_percent_are_tested_only_if_no_cell_is_left():
    layout = SensorLayout(1, 20, 20)
    untested = np.arange(400) == 7
    nothing = np.zeros(400)
    told = str(coverage(untested, nothing > 0, nothing, layout))
    assert told == "99% of the cells tested; a fault of the other cell would not be found"
    assert str(coverage(nothing > 0, nothing > 0, nothing, layout)) == "100% of the cells tested"


def test_the_text_counts_the_untested_cells_and_estimates_nothing():
    told = str(coverage(cells(0, 1, 2, 3), NONE, np.full(40, 0.3), LAYOUT))
    assert told == "90% of the cells tested; a fault of the other 4 cells would not be found"


def test_positions_without_a_cell_do_not_count():
    present = np.ones((2, 4, 5), bool)
    present[0] = False
    layout = SensorLayout(2, 4, 5, present=present)
    result = coverage(cells(*range(20)), NONE, np.zeros(40), layout)
    assert result.test_coverage == 1
    assert result.advice == ()
