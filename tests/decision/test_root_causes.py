from dataclasses import replace

import numpy as np
import pytest

from diagnostics import Fault, FaultKind, Line, SensorLayout
from diagnostics.decision.cell_findings import CellFindings
from diagnostics.decision.root_causes import root_causes

LAYOUT = SensorLayout(2, 11, 6)
CELLS = LAYOUT.n_cells
NONE = np.zeros(CELLS, bool)
ZERO = np.zeros(CELLS)

HEALTHY = CellFindings(
    faulty=NONE,
    alive=~NONE,
    silent=NONE,
    rests=NONE,
    full=NONE,
    intermittent=NONE,
    noisy=NONE,
    drifting=NONE,
    gain=np.full(CELLS, np.nan),
    value=np.full(CELLS, np.nan),
    since=np.zeros(CELLS, np.intp),
    probability=ZERO,
    weight=ZERO,
    events=np.zeros(CELLS, np.intp),
    known=NONE,
    refuted=np.full(CELLS, -1),
    unsure=np.full(CELLS, -1),
    wire=np.full(CELLS, -1),
    of_wire=np.zeros(CELLS),
    share=ZERO,
    as_one=NONE,
)


def at(cells: object) -> np.ndarray:
    return np.isin(np.arange(CELLS), np.asarray(cells))


def dead(found: CellFindings, cells: object, value: float = 0.0, onset: int = 0) -> CellFindings:
    """Return the findings with cells that hold ``value`` beyond doubt, as three events show."""
    which = at(cells)
    return replace(
        found,
        faulty=found.faulty | which,
        alive=found.alive & ~which,
        rests=found.rests | (which & (value == 0)),
        full=found.full | (which & (value == 5)),
        value=np.where(which, value, found.value),
        since=np.where(which, onset, found.since),
        probability=np.where(which, 0.99, found.probability),
        weight=np.where(which, 9.0, found.weight),
        events=np.where(which, 3, found.events),
    )


def moving(found: CellFindings, kind: str, cells: object) -> CellFindings:
    """Return the findings with cells that move, but wrongly."""
    which = at(cells)
    marked = {kind: getattr(found, kind) | which}
    return replace(
        found,
        faulty=found.faulty | which,
        alive=found.alive & ~which,
        probability=np.where(which, 0.999, 0),
        **marked,
    )


def untested(found: CellFindings, cells: object) -> CellFindings:
    """Return the findings with unloaded cells that no event tested."""
    which = at(cells)
    return replace(
        found,
        alive=found.alive & ~which,
        rests=found.rests | which,
        value=np.where(which, 0.0, found.value),
    )


def causes(found: CellFindings, *aliases: Fault) -> tuple[Fault, ...]:
    return root_causes(found, aliases, LAYOUT)[0]


def row(pad: int, index: int) -> np.ndarray:
    return LAYOUT.cells_on(Line(pad, "row", index))


def test_nothing_wrong_has_no_cause():
    assert causes(HEALTHY) == ()
    assert causes(untested(HEALTHY, range(40))) == ()


@pytest.mark.parametrize(
    ("value", "kind"), [(0.0, FaultKind.OPEN), (5.0, FaultKind.SHORT), (2.5, FaultKind.STUCK)]
)
def test_a_single_cell_is_named_by_what_it_reads_with_its_place_onset_and_evidence(
    value: float, kind: FaultKind
):
    cell = LAYOUT.cell(1, 3, 4)
    (fault,) = causes(dead(HEALTHY, [cell], value, onset=70))
    assert (fault.kind, fault.cells, fault.line, fault.onset, fault.evidence) == (
        kind,
        (cell,),
        None,
        70,
        3,
    )
    assert fault.probability == 0.99
    assert fault.value == value
    assert f"pad 1, row 3, column 4 is {kind}" in fault.reason
    assert "from frame 70 on (7.0 s)" in fault.reason


def test_a_broken_row_is_one_fault_that_says_what_to_check_and_what_else_it_could_be():
    (fault,) = causes(dead(HEALTHY, row(0, 2)))
    assert (fault.kind, fault.line, fault.cells) == (
        FaultKind.OPEN,
        Line(0, "row", 2),
        tuple(row(0, 2)),
    )
    assert "check the row wire" in fault.reason
    assert any("multiplexer" in text for text in fault.alternatives)


def test_untested_cells_on_a_wire_proven_open_are_inferred_and_the_fault_says_so():
    found = dead(untested(HEALTHY, row(0, 2)), row(0, 2)[:4])
    (fault,) = causes(found)
    assert fault.cells == tuple(row(0, 2))
    assert "2 more, not tested, are inferred from the wire" in fault.reason
    assert any("leaves the untested cells on it alive" in text for text in fault.alternatives)


def test_the_fault_of_a_cut_wire_names_the_cut():
    after = causes(dead(HEALTHY, row(0, 2)[2:]))
    before = causes(dead(HEALTHY, row(0, 2)[:4]))
    assert "from column 2 on" in after[0].reason
    assert "up to column 3" in before[0].reason
    assert after[0].line == before[0].line == Line(0, "row", 2)


def test_where_the_cell_beside_the_break_is_untested_the_break_may_be_closer():
    found = dead(untested(HEALTHY, [row(0, 2)[2]]), row(0, 2)[3:])
    (fault,) = causes(found)
    assert any("closer to the working end" in text for text in fault.alternatives)
    (sure,) = causes(dead(HEALTHY, row(0, 2)[3:]))
    assert sure.alternatives == ()


def test_cells_stuck_at_different_values_share_no_cause():
    found = HEALTHY
    for i, cell in enumerate(row(0, 2).tolist()):
        found = dead(found, [cell], 0.7 + 0.6 * i)
    assert [fault.line for fault in causes(found)] == [None] * 6


def test_a_wire_that_the_log_does_not_prove_is_possible_and_says_what_will_tell():
    cells = row(0, 3)[2:]
    found = untested(HEALTHY, cells)
    found = replace(found, weight=np.where(at(cells), 3.02, found.weight))
    certain, (possible,) = root_causes(found, (), LAYOUT)
    assert certain == ()
    assert (possible.line, possible.kind, possible.cells) == (
        Line(0, "row", 3),
        FaultKind.OPEN,
        tuple(cells),
    )
    assert "may be open" in possible.reason
    assert f"P = {possible.probability:.2f}" in possible.reason
    assert f"{len(cells)} cells on it" in possible.reason
    assert "one more contact along it will tell" in possible.reason


def test_a_cell_with_another_fault_is_not_attributed_to_the_wire():
    found = dead(dead(HEALTHY, row(0, 2)), [row(0, 2)[5]], 5.0)
    found = replace(found, rests=found.rests & ~at([row(0, 2)[5]]))
    by_kind = {fault.kind: fault for fault in causes(found)}
    assert by_kind[FaultKind.SHORT].cells == (row(0, 2)[5],)
    assert row(0, 2)[5] not in by_kind[FaultKind.OPEN].cells


@pytest.mark.parametrize(
    ("name", "kind", "reason"),
    [
        ("intermittent", FaultKind.INTERMITTENT, "blinks"),
        ("noisy", FaultKind.NOISY, "noisier"),
        ("drifting", FaultKind.DRIFT, "never returns to its baseline"),
    ],
)
def test_cells_that_move_wrongly_are_named_by_how(name: str, kind: FaultKind, reason: str):
    (fault,) = causes(moving(HEALTHY, name, [7]))
    assert (fault.kind, fault.cells) == (kind, (7,))
    assert reason in fault.reason


def test_a_lost_gain_is_a_weak_cell_and_an_offset_or_a_higher_gain_is_a_drift():
    found = moving(HEALTHY, "drifting", [*row(1, 5), 7])
    of_row, single = causes(replace(found, gain=np.where(at(row(1, 5)), 0.35, np.nan)))
    assert (of_row.kind, of_row.line) == (FaultKind.WEAK, Line(1, "row", 5))
    assert "reads about 0.35 times what it should" in of_row.reason
    assert (single.kind, single.cells) == (FaultKind.DRIFT, (7,))
    assert "never returns to its baseline" in single.reason
    gaining = moving(HEALTHY, "drifting", [7])
    (higher,) = causes(replace(gaining, gain=np.full(CELLS, 2.0)))
    assert (higher.kind, higher.cells) == (FaultKind.DRIFT, (7,))


def test_a_loose_wire_makes_its_whole_row_blink():
    (fault,) = causes(moving(HEALTHY, "intermittent", row(1, 5)))
    assert (fault.kind, fault.line) == (FaultKind.INTERMITTENT, Line(1, "row", 5))


def test_a_wire_that_opens_under_load_is_named_though_none_of_its_cells_is_certain():
    row = LAYOUT.cells_on(Line(1, "row", 4))
    comes_and_goes = 1
    found = replace(
        HEALTHY,
        alive=~at(row),
        unsure=np.where(at(row), comes_and_goes, -1),
        weight=np.where(at(row), 5.0, 0.0),
        share=np.where(at(row), 0.4, 0.0),
        since=np.zeros(CELLS, np.intp),
    )
    (fault,), _ = root_causes(found, (), LAYOUT)
    assert (fault.kind, fault.line, fault.cells) == (
        FaultKind.INTERMITTENT,
        Line(1, "row", 4),
        tuple(row.tolist()),
    )
    assert "reads nothing in 40% of the contacts" in fault.reason
    apart = [0, 13, 26, 39, 52, 65]
    scattered = replace(
        HEALTHY,
        alive=~at(apart),
        unsure=np.where(at(apart), comes_and_goes, -1),
        weight=np.where(at(apart), 5.0, 0.0),
    )
    assert root_causes(scattered, (), LAYOUT) == ((), ())


def test_a_wire_that_is_proved_to_fail_is_one_fault_with_all_of_its_cells():
    row = LAYOUT.cells_on(Line(1, "row", 4))
    found = replace(
        HEALTHY,
        alive=~at(row),
        wire=np.where(at(row[1:]), 0, -1),
        of_wire=np.where(at(row[1:]), 0.97, 0.0),
        since=np.zeros(CELLS, np.intp),
    )
    (fault,), _ = root_causes(found, (), LAYOUT)
    assert (fault.kind, fault.line, fault.probability) == (
        FaultKind.INTERMITTENT,
        Line(1, "row", 4),
        0.97,
    )
    assert fault.cells == tuple(row.tolist())


def test_cells_that_float_are_no_wire_where_others_on_it_are_at_rest():
    row = LAYOUT.cells_on(Line(1, "row", 4))
    floats = 0
    found = replace(
        dead(untested(HEALTHY, row[3:]), row[:3]),
        rests=NONE,
        refuted=np.where(at(row[:3]), floats, -1),
    )
    faults, possible = root_causes(found, (), LAYOUT)
    assert not possible
    blamed = [cell for fault in faults for cell in fault.cells]
    assert blamed == row[:3].tolist()


def test_cells_that_deliver_nothing_are_open_and_have_no_value():
    found = replace(dead(HEALTHY, [7]), silent=at([7]), rests=NONE, value=np.full(CELLS, np.nan))
    (fault,) = causes(found)
    assert (fault.kind, fault.value) == (FaultKind.OPEN, None)
    assert "delivers no reading" in fault.reason


def test_the_biggest_cause_comes_first():
    found = dead(dead(HEALTHY, [0], 5.0), row(1, 4))
    assert [len(fault.cells) for fault in causes(found)] == [6, 1]


def column(index: int) -> np.ndarray:
    return LAYOUT.cells_on(Line(0, "column", index))


def test_lines_that_one_dead_address_bit_explains_are_one_fault():
    # Bit 2 stuck at 0: columns 4 and 5 read columns 0 and 1, which nothing loads.
    dead_ones = np.r_[column(4), column(5)]
    sources = np.r_[column(0), column(1)]
    (fault,) = causes(dead(untested(HEALTHY, sources), dead_ones))
    assert (fault.kind, fault.line, fault.value) == (
        FaultKind.ALIAS,
        Line(0, "column_address", 2),
        0,
    )
    assert fault.cells == tuple(np.sort(dead_ones))
    assert any("independently of each other" in text for text in fault.alternatives)


def test_an_address_bit_is_named_though_one_of_its_lines_was_never_loaded():
    # Bit 3 stuck at 0: rows 8, 9 and 10 read rows 0, 1 and 2.
    idle = untested(HEALTHY, np.concatenate([row(0, i) for i in (0, 1, 2, 10)]))
    (fault,) = causes(dead(idle, np.r_[row(0, 8), row(0, 9)]))
    assert (fault.kind, fault.line, fault.value) == (FaultKind.ALIAS, Line(0, "row_address", 3), 0)
    assert set(row(0, 10)) <= set(fault.cells)
    assert "rows 8, 9 are open" in fault.alternatives[0]


def test_lines_are_not_attributed_to_an_address_bit_if_another_of_its_lines_works():
    idle = untested(HEALTHY, np.concatenate([row(0, i) for i in (0, 1, 2)]))
    faults = causes(dead(idle, np.r_[row(0, 8), row(0, 9)]))
    assert {fault.line for fault in faults} == {Line(0, "row", 8), Line(0, "row", 9)}


def test_lines_are_not_attributed_to_an_address_bit_if_what_they_would_read_is_loaded():
    faults = causes(dead(HEALTHY, np.r_[column(4), column(5)]))
    assert {fault.line for fault in faults} == {Line(0, "column", 4), Line(0, "column", 5)}


def test_the_cells_of_an_alias_have_no_other_cause():
    alias = Fault(FaultKind.ALIAS, row(0, 1).tolist(), line=Line(0, "row_address", 0), value=0)
    assert causes(dead(HEALTHY, row(0, 1)[:2]), alias) == (alias,)


@pytest.mark.parametrize("seed", range(6))
def test_each_faulty_cell_is_in_a_cause_and_no_working_one(seed: int):
    rng = np.random.default_rng(seed)
    order = rng.permutation(CELLS)
    found = untested(HEALTHY, order[60:])
    for cells, value in ((order[:12], 0.0), (order[12:20], 5.0), (order[20:25], 2.5)):
        found = dead(found, cells, value)
    found = moving(found, "noisy", order[25:28])
    named = {c for fault in causes(found) for c in fault.cells}
    assert set(order[:28].tolist()) <= named
    assert not named & set(np.flatnonzero(found.alive).tolist())


def test_cells_dead_in_the_reference_are_no_evidence_for_a_wire_that_broke_later():
    on = row(0, 3)
    found = untested(HEALTHY, on)
    found = replace(dead(found, on[-3:-1]), known=at(on[-3:-1]))
    assert [(fault.line, fault.cells) for fault in causes(found)] == [
        (None, (cell,)) for cell in on[-3:-1].tolist()
    ]
    found = dead(found, on[-1:])  # and one that died since
    assert sorted((fault.line, fault.cells) for fault in causes(found)) == [
        (None, (cell,)) for cell in on[-3:].tolist()
    ]


def test_a_wire_broken_in_the_reference_is_named_and_a_later_one_includes_cells_dead_before():
    on = row(0, 3)
    (fault,) = causes(replace(dead(HEALTHY, on), known=at(on)))
    assert (fault.line, fault.cells) == (Line(0, "row", 3), tuple(on.tolist()))
    assert "did so in the reference already" in fault.reason
    (fault,) = causes(replace(dead(HEALTHY, on), known=at(on[2])))
    assert (fault.line, fault.cells) == (Line(0, "row", 3), tuple(on.tolist()))
    assert "already" not in fault.reason
    assert "; 1 more, not tested, is inferred" in fault.reason


def test_cells_of_a_row_that_no_longer_return_to_their_rest_level_are_no_broken_wire():
    faults = causes(moving(HEALTHY, "drifting", row(1, 5)))
    assert {fault.line for fault in faults} == {None}
    assert sorted(cell for fault in faults for cell in fault.cells) == row(1, 5).tolist()


@pytest.mark.parametrize(
    ("cells", "said"),
    [([7], "pad 0, row 1, column 1 drifts: it is"), (row(1, 5), "pad 1, row 5 drifts: each of")],
)
def test_the_verb_of_a_sentence_fits_the_kind(cells, said):
    higher = replace(moving(HEALTHY, "drifting", cells), gain=np.where(at(cells), 2.0, np.nan))
    (fault,) = causes(higher)
    assert fault.reason.startswith(said)
    copied = replace(moving(HEALTHY, "noisy", [8]), noisy=NONE, refuted=np.where(at([8]), 3, -1))
    (copy,) = causes(replace(copied, value=np.where(at([8]), 9.0, np.nan)))
    assert copy.reason.startswith("pad 0, row 1, column 2 is a copy: it repeats pad 0")
    for kind in FaultKind:
        assert kind.verb().split()[0] in ("is", "drifts", "reads")
        assert kind.verb(plural=True).split()[0] in ("are", "drift", "read")


def test_a_wire_that_possibly_drifts_may_drift():
    cells = at(row(0, 3)[2:])
    weight = np.where(cells, 3.02, 0.0)
    gain = np.where(cells, 2.0, np.nan)
    found = replace(HEALTHY, alive=~cells, drifting=cells, weight=weight, gain=gain)
    _, (possible,) = root_causes(found, (), LAYOUT)
    assert "pad 0, row 3 may drift from column 2 on" in possible.reason


def test_a_stuck_wire_in_whole_counts_is_told_with_a_reading_and_not_with_a_mean():
    cells = row(0, 2)
    found = dead(HEALTHY, cells, 2.0)
    counts = np.full(CELLS, np.nan)
    counts[cells] = [2, 3, 2, 3, 2, 3]
    (fault,) = causes(replace(found, typical=counts))
    assert (fault.kind, fault.value) == (FaultKind.STUCK, 2.0)
    assert "reads 2 N" in fault.reason
