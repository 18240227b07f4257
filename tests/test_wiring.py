import numpy as np
import pytest

from diagnostics import Line, SensorLayout
from diagnostics.wiring import explain

LAYOUT = SensorLayout(2, 11, 10)


def untested() -> np.ndarray:
    return np.zeros(LAYOUT.n_cells, bool)


def test_a_row_whose_cells_are_faulty_is_one_cause():
    row = LAYOUT.cells_on(Line(1, "row", 4))
    alive = ~np.isin(np.arange(220), row)
    (cause,) = explain(row, alive, LAYOUT)
    assert cause.line == Line(1, "row", 4)
    assert cause.cells == cause.seen == tuple(row)
    assert cause.probability > 0.99


def test_an_untested_cell_on_a_broken_wire_is_inferred_and_a_live_one_is_not():
    column = LAYOUT.cells_on(Line(0, "column", 2))
    alive = untested()
    alive[column[10]] = True
    (cause,) = explain(column[:8], alive, LAYOUT)
    assert cause.line == Line(0, "column", 2)
    assert cause.seen == tuple(column[:8])
    assert cause.cells == tuple(column[:10])


def test_scattered_cells_have_a_cause_each():
    cells = np.array([3, 47, 81, 160, 219])
    causes = explain(cells, untested(), LAYOUT)
    assert [cause.line for cause in causes] == [None] * 5
    assert sorted(c for cause in causes for c in cause.cells) == cells.tolist()


def test_two_faulty_cells_on_a_line_are_no_broken_line():
    assert all(cause.line is None for cause in explain(np.array([0, 5]), untested(), LAYOUT))


def test_a_row_among_many_live_cells_of_it_is_not_blamed():
    row = LAYOUT.cells_on(Line(0, "row", 3))
    alive = untested()
    alive[row[4:]] = True
    assert all(cause.line is None for cause in explain(row[:4], alive, LAYOUT))


def test_a_whole_pad_is_blamed_on_its_converter():
    pad = np.arange(110, 220)
    (cause,) = explain(pad, np.arange(220) < 110, LAYOUT)
    assert cause.line == Line(1, "converter", 0)


@pytest.mark.parametrize("seed", range(25))
def test_broken_lines_are_found_exactly_among_single_faults_and_untested_cells(seed: int):
    rng = np.random.default_rng(seed)
    lines = [
        Line(0, "row", int(rng.integers(11))),
        Line(0, "column", int(rng.integers(10))),
        Line(1, "row", int(rng.integers(11))),
    ]
    broken = np.unique(np.concatenate([LAYOUT.cells_on(line) for line in lines]))
    single = rng.choice(np.setdiff1d(np.arange(220), broken), 8, replace=False)
    tested = rng.random(220) > 0.3
    faulty = np.zeros(220, bool)
    faulty[broken] = faulty[single] = True
    causes = explain(np.flatnonzero(faulty & tested), ~faulty & tested, LAYOUT)
    assert {cause.line for cause in causes} - {None} == set(lines)
