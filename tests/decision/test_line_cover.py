import numpy as np
import pytest

from diagnostics import Line, SensorLayout
from diagnostics.decision import line_cover
from diagnostics.decision.line_cover import (
    Cause,
    cheapest_of_few,
    cheapest_of_many,
)

LAYOUT = SensorLayout(2, 11, 10)
SURE = 8.0
WEAK = 5.0
NOTHING = 0.0


def mask(*cells: np.ndarray | list[int]) -> np.ndarray:
    return np.isin(
        np.arange(220), np.concatenate([np.asarray(c, int) for c in cells] or [np.zeros(0, int)])
    )


def solve(*given: object) -> tuple[Cause, ...]:
    """Return the causes that are more than possible."""
    return tuple(cause for cause in line_cover.solve(*given) if cause.proven)


def explained(
    faulty: np.ndarray,
    contradicting: np.ndarray,
    consistent: np.ndarray | None = None,
    weight: np.ndarray | None = None,
) -> tuple[Cause, ...]:
    """Explain ``faulty`` cells (bool); those that could be faulty too are the untested ones."""
    consistent = ~contradicting if consistent is None else consistent
    return solve(
        faulty,
        consistent | faulty,
        contradicting,
        np.where(faulty, SURE, NOTHING) if weight is None else weight,
        LAYOUT,
    )


def test_a_row_whose_cells_are_faulty_is_one_cause():
    row = LAYOUT.cells_on(Line(1, "row", 4))
    (cause,) = explained(mask(row), ~mask(row))
    assert cause.line == Line(1, "row", 4)
    assert cause.cells == cause.seen == tuple(row)
    assert cause.probability > 0.99
    assert cause.whole


def test_an_untested_cell_on_a_broken_wire_is_inferred():
    column = LAYOUT.cells_on(Line(0, "column", 2))
    (cause,) = explained(mask(column[:8]), ~mask(column))
    assert cause.line == Line(0, "column", 2)
    assert cause.seen == tuple(column[:8])
    assert cause.cells == tuple(column)


def test_two_witnesses_are_too_few_for_a_wire_of_ten_cells():
    column = LAYOUT.cells_on(Line(0, "column", 2))
    causes = explained(mask(column[[1, 8]]), ~mask(column))
    assert [cause.line for cause in causes] == [None, None]
    (cause,) = explained(mask(column[[1, 4, 8]]), ~mask(column))
    assert cause.line == Line(0, "column", 2)


def test_two_witnesses_are_enough_for_a_wire_of_three_cells():
    layout = SensorLayout(1, 3, 3)
    row = np.isin(np.arange(9), [0, 1, 2])
    faulty = np.isin(np.arange(9), [0, 2])
    (cause,) = solve(faulty, row, ~row, np.where(faulty, SURE, NOTHING), layout)
    assert cause.line == Line(0, "row", 0)


@pytest.mark.parametrize("alive", [0, 5, 10])
def test_a_working_cell_on_a_broken_wire_is_never_inferred_to_be_faulty(alive: int):
    column = LAYOUT.cells_on(Line(0, "column", 2))
    faulty = mask(np.delete(column, alive))
    causes = explained(faulty, ~faulty)
    assert {c for cause in causes for c in cause.cells} == set(np.flatnonzero(faulty).tolist())


def test_scattered_cells_have_a_cause_each():
    cells = np.array([3, 47, 81, 160, 219])
    causes = explained(mask(cells), ~mask(cells))
    assert [cause.line for cause in causes] == [None] * 5
    assert sorted(c for cause in causes for c in cause.cells) == cells.tolist()


def test_two_faulty_cells_on_a_line_of_working_ones_are_no_broken_line():
    assert [(cause.line, cause.cells) for cause in explained(mask([0, 5]), ~mask([0, 5]))] == [
        (None, (0,)),
        (None, (5,)),
    ]


def test_a_row_among_many_working_cells_is_not_reported():
    row = LAYOUT.cells_on(Line(0, "row", 3))
    faulty = mask(row[[0, 3, 6, 8]])
    assert [cause.line for cause in explained(faulty, ~faulty)] == [None] * 4


def test_a_whole_pad_is_attributed_to_its_converter():
    pad = mask(range(110, 220))
    (cause,) = explained(pad, ~pad)
    assert cause.line == Line(1, "converter", 0)


def test_no_faulty_cell_has_no_cause():
    assert explained(mask(), ~mask()) == ()
    assert explained(mask(), mask()) == ()


@pytest.mark.parametrize("cut", range(1, 7))
@pytest.mark.parametrize("from_the_end", [False, True])
def test_a_wire_cut_at_a_position_explains_only_the_cells_behind_the_cut(
    cut: int, from_the_end: bool
):
    line = Line(1, "row", 7)
    row = LAYOUT.cells_on(line)
    dead = row[:-cut] if from_the_end else row[cut:]
    (cause,) = explained(mask(dead), ~mask(dead))
    assert cause.line == line
    assert cause.cells == tuple(dead)
    assert not cause.whole


def test_untested_cells_behind_a_cut_are_inferred_and_those_before_it_are_not():
    line = Line(0, "column", 6)
    column = LAYOUT.cells_on(line)
    faulty = mask(column[[4, 5, 6, 8, 9]])
    untested = mask(column[[3, 7, 10]])
    (cause,) = explained(faulty, ~faulty & ~untested)
    assert (cause.line, cause.whole) == (line, False)
    assert cause.cells == tuple(column[4:])


def test_weak_evidence_along_one_wire_adds_up():
    row = LAYOUT.cells_on(Line(0, "row", 3))
    consistent = mask(row)
    (cause,) = explained(mask(), ~consistent, consistent, np.where(consistent, WEAK, NOTHING))
    assert cause.line == Line(0, "row", 3)
    assert cause.cells == tuple(row)
    assert 0.5 < cause.probability <= 1


def test_as_much_weak_evidence_at_scattered_cells_explains_no_wire():
    consistent = mask(np.random.default_rng(0).choice(220, 10, replace=False))
    assert explained(mask(), ~consistent, consistent, np.where(consistent, WEAK, NOTHING)) == ()


def test_a_long_line_of_weak_suspects_is_the_edge_of_a_contact_and_no_wire():
    layout = SensorLayout(1, 64, 32)
    consistent = np.isin(np.arange(2048), layout.cells_on(Line(0, "row", 5)))
    none = np.zeros(2048, bool)
    assert solve(none, consistent, ~consistent, np.where(consistent, 2.6, NOTHING), layout) == ()


@pytest.mark.parametrize(("weight", "reported"), [(2.65, False), (4.0, True)])
def test_correlated_evidence_along_one_wire_is_discounted(weight: float, reported: bool):
    layout = SensorLayout(1, 4, 10)
    consistent = np.isin(np.arange(40), layout.cells_on(Line(0, "column", 5)))
    none = np.zeros(40, bool)
    # 10.6 from one cell alone would suffice.
    causes = solve(none, consistent, ~consistent, np.where(consistent, weight, NOTHING), layout)
    assert bool(causes) == reported


@pytest.mark.parametrize("certain", [False, True])
def test_one_certain_cell_lowers_the_cost_of_its_wire(certain: bool):
    row = LAYOUT.cells_on(Line(0, "row", 3))
    consistent = mask(row[:3])
    faulty = mask(row[:1]) if certain else mask()
    (cause,) = solve(faulty, consistent, mask(), np.where(consistent, 4.6, NOTHING), LAYOUT) or (
        None,
    )
    assert (cause is not None and cause.line is not None) == certain


def test_a_few_uncertain_cells_do_not_prove_a_broken_wire():
    row = LAYOUT.cells_on(Line(0, "row", 3))
    consistent = mask(row[:2])
    assert explained(mask(), ~consistent, consistent, np.where(consistent, WEAK, NOTHING)) == ()


def test_untested_cells_at_rest_are_no_evidence():
    assert explained(mask(), mask(), np.ones(220, bool), np.full(220, NOTHING)) == ()


@pytest.mark.parametrize("weight", [WEAK, SURE])
def test_a_wire_with_several_working_cells_is_not_reported_whatever_the_others_read(weight: float):
    row = LAYOUT.cells_on(Line(0, "row", 3))
    alive = row[[1, 4, 7]]
    consistent = mask(np.setdiff1d(row, alive))
    causes = explained(mask(), ~consistent, consistent, np.where(consistent, weight, NOTHING))
    assert not {c for cause in causes for c in cause.cells} & set(alive.tolist())
    assert all(cause.line != Line(0, "row", 3) or not cause.whole for cause in causes)
    # if none of them worked
    (whole,) = explained(mask(), ~mask(row), mask(row), np.where(mask(row), weight, NOTHING))
    assert whole.line == Line(0, "row", 3)


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
    faulty = mask(broken, single)
    causes = explained(faulty & tested, ~faulty & tested)
    assert {cause.line for cause in causes if cause.line and cause.whole} == set(lines)
    found = {c for cause in causes for c in cause.cells}
    assert found >= set(broken.tolist()) | set(single[tested[single]].tolist())
    assert not found & set(np.flatnonzero(~faulty & tested).tolist())


@pytest.mark.parametrize("seed", range(10))
def test_every_faulty_cell_has_a_cause_and_no_contradicting_cell_is_in_one(seed: int):
    rng = np.random.default_rng(seed)
    faulty = rng.random(220) < rng.choice([0.05, 0.3, 0.7])
    contradicting = ~faulty & (rng.random(220) < 0.5)
    causes = explained(faulty, contradicting, weight=np.where(faulty, SURE, rng.normal(0, 1, 220)))
    found = {c for cause in causes for c in cause.cells}
    assert set(np.flatnonzero(faulty).tolist()) <= found
    assert not found & set(np.flatnonzero(contradicting).tolist())


def test_positions_without_a_cell_have_no_cause():
    present = np.ones(LAYOUT.shape, bool)
    present[0, 3, :4] = False
    layout = SensorLayout(2, 11, 10, present=present)
    row = layout.cells_on(Line(0, "row", 3))
    faulty = mask(row)
    contradicting = ~faulty & present.ravel()
    (cause,) = solve(faulty, faulty, contradicting, np.where(faulty, SURE, NOTHING), layout)
    assert (cause.line, cause.cells) == (Line(0, "row", 3), tuple(row))


def test_one_certain_cell_and_a_strong_suspect_behind_the_last_working_one_are_a_cut():
    row = LAYOUT.cells_on(Line(1, "row", 4))
    faulty = mask(row[9:])
    suspect = mask(row[8:9])
    for strength, cut in ((6.0, True), (2.6, False)):
        weight = np.where(faulty, SURE, np.where(suspect, strength, NOTHING))
        cause = explained(faulty, ~(faulty | suspect), weight=weight)[0]
        assert cause.cells == (tuple(row[8:]) if cut else tuple(row[9:]))
        assert (cause.line is not None) == cut


def test_where_single_faults_are_common_two_neighbours_at_the_end_of_a_line_are_no_cut():
    row = LAYOUT.cells_on(Line(1, "row", 4))
    faulty = mask(row[8:])
    for common, cut in ((0.0, True), (0.1, False)):
        causes = solve(faulty, faulty, ~faulty, np.where(faulty, SURE, NOTHING), LAYOUT, common)
        assert any(cause.line is not None for cause in causes) == cut


def test_a_wire_of_some_suspects_is_possible_with_a_probability_between_a_half_and_proof():
    row = LAYOUT.cells_on(Line(1, "row", 4))
    suspects = mask(row[6:])
    seen = []
    for strength in (2.6, 2.8, 3.0, 4.0):
        weight = np.where(suspects, strength, NOTHING)
        causes = line_cover.solve(mask(), suspects, ~suspects, weight, LAYOUT)
        seen.append([(cause.line, cause.proven) for cause in causes])
        for cause in causes:
            assert cause.cells == tuple(row[6:])
            assert (cause.probability > 0.9) == cause.proven
            assert cause.probability > 0.5
    assert seen == [[], [], [(Line(1, "row", 4), False)], [(Line(1, "row", 4), True)]]


def test_cells_of_a_possible_wire_stay_faults_of_their_own():
    row = LAYOUT.cells_on(Line(1, "row", 4))
    faulty = mask(row[7:])
    suspect = mask(row[6:7])
    weight = np.where(faulty, SURE, np.where(suspect, 3.1, NOTHING))
    # Single faults of this kind are common in the array.
    causes = line_cover.solve(
        faulty, faulty | suspect, ~(faulty | suspect), weight, LAYOUT, common=0.2
    )
    assert [(cause.line, cause.proven) for cause in causes] == [(None, True)] * 3 + [
        (Line(1, "row", 4), False)
    ]
    assert [cause.cells for cause in causes[:3]] == [(cell,) for cell in row[7:]]


def test_suspects_alone_need_more_than_a_certain_cell_does():
    row = LAYOUT.cells_on(Line(1, "row", 4))
    for certain in (0, 1):
        faulty = mask(row[9:][:certain])
        contradicting = ~mask(row[6:])
        weight = np.where(mask(row[6:]), 3.0, NOTHING)
        causes = explained(faulty, contradicting, weight=weight)
        assert any(cause.line is not None for cause in causes) == bool(certain)


@pytest.mark.parametrize("seed", range(30))
def test_trying_all_sets_of_wires_and_integer_programming_agree(seed: int):
    rng = np.random.default_rng(seed)
    wires = int(rng.integers(1, 9))
    cells = int(rng.integers(1, 20))
    covers = rng.random((wires, cells)) < 0.4
    cost = rng.uniform(1, 9, wires)
    saves = rng.uniform(-1, 6, cells)
    few = cheapest_of_few(cost, covers, saves)
    many = cheapest_of_many(cost, covers, saves)
    assert few.any() or many.sum() == 0
    np.testing.assert_array_equal(few, many)
