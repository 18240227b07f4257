"""What a scan of the read-out says, on the circuit of an array that nobody touches.

``scan_of`` scans 8 x 7 cells with a preload that differs by cell, with 12 bits and noise of one
step.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diagnostics import FaultKind, Line, SelfDiagnosis, SensorLayout, Verdict
from diagnostics.evidence.crossings import REPEATS
from diagnostics.evidence.read_out import ReadOut, Scan, judge_scan, with_scan
from diagnostics.simulation.circuit import Circuit, CutLine, ShortedLine, StuckCell
from diagnostics.simulation.scan import LOW, scan_circuit

LAYOUT = SensorLayout(1, 8, 7)
READ_OUTS = {"grounded": 100.0, "virtual ground": 1.0}


def scan_of(
    *faults, seed: int = 0, load_ohms: float = 100.0, forces=None, noise=1.0, read_out="grounded"
) -> Scan:
    rng = np.random.default_rng(seed)
    idle = rng.uniform(0, 0.02, LAYOUT.n_cells)
    circuit = Circuit(LAYOUT, read_out, faults, load_ohms=load_ohms, leak_ohms=1e7)
    loads = idle if forces is None else np.maximum(idle, forces)
    return held(scan_circuit(circuit, loads, seed=seed, noise=noise))


def held(scan: Scan) -> Scan:
    """Return a scan that states that lines are held."""
    return replace(scan, holds_lines=True)


def blamed(found: ReadOut) -> set[int]:
    return {cell for fault in found.faults for cell in fault.cells}


cells = st.integers(0, LAYOUT.n_cells - 1)
loads = st.sampled_from(list(READ_OUTS.values()))


@given(st.integers(0, 10**6), loads, st.sampled_from([0.0, 0.5, 2.0]))
def test_an_untouched_healthy_array_is_alive_whatever_its_preload_and_noise(seed, load, noise):
    found = judge_scan(scan_of(seed=seed, load_ohms=load, noise=noise), LAYOUT)
    assert not found.faults
    assert found.alive.all()
    assert not found.incomplete


@given(cells, cells, loads)
def test_an_open_and_a_shorted_crossing_are_found_untouched_and_no_other(open_, short, load):
    if open_ == short:
        return
    scan = scan_of(StuckCell(open_, np.inf), StuckCell(short, 0.0), load_ohms=load)
    found = judge_scan(scan, LAYOUT)
    assert {fault.cells: fault.kind for fault in found.faults} == {
        (open_,): FaultKind.OPEN,
        (short,): FaultKind.SHORT,
    }
    assert found.alive.sum() == LAYOUT.n_cells - 2


@given(st.sampled_from(["row", "column"]), st.integers(0, 6), st.integers(0, 4), loads)
def test_a_cut_line_is_one_fault_with_the_cells_beyond_the_cut(kind, index, before, load):
    line = Line(0, kind, index)
    found = judge_scan(scan_of(CutLine(line, before), load_ohms=load), LAYOUT)
    (fault,) = found.faults
    assert fault.line == line
    assert fault.kind is FaultKind.OPEN
    assert set(fault.cells) == set(LAYOUT.cells_on(line)[before:].tolist())


@pytest.mark.parametrize("to", ["supply", "ground"])
@pytest.mark.parametrize("line", [Line(0, "row", 2), Line(0, "column", 5)], ids=str)
def test_a_line_on_the_supply_or_on_ground_is_one_fault_and_no_other_cell_is_blamed(line, to):
    found = judge_scan(scan_of(ShortedLine(line, to)), LAYOUT)
    (fault,) = found.faults
    assert fault.line == line
    assert fault.kind is (FaultKind.SHORT if to == "supply" else FaultKind.OPEN)
    assert set(fault.cells) == set(LAYOUT.cells_on(line).tolist())
    assert found.alive.sum() == LAYOUT.n_cells - len(fault.cells)


LEAKS = st.sampled_from([1e12, 1e8, 1e7, 1e6, 3e5, 1e5, 3e4, 1e4, 1e3])
CONDUCTION = st.sampled_from([0.0, 0.3, 1.0])  # deviation of its logarithm


@given(st.integers(0, 10**6), cells, LEAKS, CONDUCTION, loads, st.sampled_from([0.5, 2.0]))
def test_where_lines_float_no_open_crossing_is_alive(seed, cell, leak, spread, load, noise):
    faults = (StuckCell(cell, np.inf), *leaking(leak, seed))
    circuit = Circuit(LAYOUT, "floating", faults, load_ohms=load)
    idle = np.clip(idle_of(spread, seed), 0.001, None)
    found = judge_scan(scan_circuit(circuit, idle, seed=seed, noise=noise), LAYOUT)
    assert not found.alive[cell]
    assert blamed(found) <= {cell}
    assert found.faults or "stay untested" in str(found)


def leaking(ohms: float, seed: int) -> tuple[ShortedLine, ...]:
    """Return lines that leak to ground, differently by up to a factor of ten."""
    rng = np.random.default_rng(seed)
    lines = [line for line in LAYOUT.lines if line.kind in ("row", "column")]
    return tuple(ShortedLine(line, "ground", ohms * 10 ** rng.uniform(0, 1)) for line in lines)


@given(
    st.integers(0, 10**6),
    st.sets(cells, max_size=4),
    st.sampled_from([None, 0, 2]),
    st.sets(cells, max_size=1),
    LEAKS,
    CONDUCTION,
)
def test_where_lines_float_none_of_several_is_alive(seed, opens, before, short, leak, spread):
    opens = opens - short
    faults = [StuckCell(cell, np.inf) for cell in opens]
    faults += [StuckCell(cell, 0.0) for cell in short]
    if before is not None:
        faults.append(CutLine(Line(0, "row", 3), before))
        opens = opens | set(LAYOUT.cells_on(Line(0, "row", 3))[before:].tolist())
    circuit = Circuit(LAYOUT, "floating", (*faults, *leaking(leak, seed)))
    found = judge_scan(scan_circuit(circuit, idle_of(spread, seed), seed=seed), LAYOUT)
    assert not found.alive[list(opens)].any()
    assert blamed(found) <= opens | short


@given(st.integers(0, 10**6), loads, cells)
def test_an_open_crossing_shows_that_lines_are_held_and_the_others_conduct(seed, load, cell):
    idle = np.random.default_rng(seed).uniform(0, 0.02, LAYOUT.n_cells)
    circuit = Circuit(LAYOUT, faults=(StuckCell(cell, np.inf),), load_ohms=load, leak_ohms=1e7)
    found = judge_scan(scan_circuit(circuit, idle, seed=seed), LAYOUT)
    assert blamed(found) == {cell}
    assert np.flatnonzero(~found.alive).tolist() == [cell]


@given(st.integers(0, 10**6), st.integers(0, 3), st.sampled_from(["row", "column"]), loads)
def test_an_open_crossing_beside_a_shorted_one_and_a_cut_line_is_not_alive(
    seed, before, kind, load
):
    cut = Line(0, kind, 0)
    beyond = [LAYOUT.position(cell)[1:] for cell in LAYOUT.cells_on(cut)[before:].tolist()]
    (row, col), (other_row, other_col) = beyond[-1], beyond[-2]
    short = (row, 4) if kind == "column" else (4, col)
    open_ = (other_row, 4) if kind == "column" else (4, other_col)
    cell = LAYOUT.cell(0, *open_)
    faults = (CutLine(cut, before), StuckCell(LAYOUT.cell(0, *short), 0.0))
    scan = scan_of(*faults, StuckCell(cell, np.inf), seed=seed, load_ohms=load)
    for stated in (True, None):
        found = judge_scan(replace(scan, holds_lines=stated), LAYOUT)
        assert not found.alive[cell]
        assert not stated or (~found.alive).sum() <= len(beyond) * 2 + 1


def test_where_crossings_conduct_alike_the_scan_has_to_state_that_lines_are_held():
    idle = np.full(LAYOUT.n_cells, 0.01)
    scan = scan_circuit(Circuit(LAYOUT), idle)
    unknown = judge_scan(scan, LAYOUT)
    assert not unknown.alive.any()
    assert not unknown.faults
    assert "state --lines-held, or Scan(..., holds_lines=True)" in unknown.incomplete
    assert judge_scan(held(scan), LAYOUT).alive.all()
    assert not judge_scan(replace(scan, holds_lines=False), LAYOUT).alive.any()
    broken = Circuit(LAYOUT, faults=(StuckCell(9, np.inf),))
    found = judge_scan(scan_circuit(broken, idle), LAYOUT)
    assert blamed(found) == {9}
    assert found.alive.sum() == LAYOUT.n_cells - 1


@pytest.mark.parametrize("read_out", ["floating_rows", "floating_columns"])
def test_one_side_that_floats_hides_no_open_crossing(read_out):
    found = judge_scan(scan_of(StuckCell(9, np.inf), read_out=read_out), LAYOUT)
    assert blamed(found) == {9}


def test_of_two_crossings_that_shorts_join_in_parallel_nothing_is_told():
    shorts = [StuckCell(LAYOUT.cell(0, *at), 0.0) for at in ((1, 2), (4, 6))]
    found = judge_scan(scan_of(*shorts, StuckCell(LAYOUT.cell(0, 1, 6), np.inf)), LAYOUT)
    joined = [LAYOUT.cell(0, 1, 6), LAYOUT.cell(0, 4, 2)]
    assert not found.alive[joined].any()
    assert blamed(found).isdisjoint(joined)


@given(st.integers(0, 10**6))
def test_the_order_of_the_frames_does_not_matter(seed):
    scan = scan_of(StuckCell(5, np.inf), StuckCell(17, 0.0))
    order = np.random.default_rng(seed).permutation(len(scan.levels))
    found = judge_scan(Scan(scan.levels[order], scan.readings[order], True), LAYOUT)
    assert blamed(found) == {5, 17}


@given(st.integers(0, 47), st.integers(0, 47))
def test_an_interrupted_scan_says_what_it_lacks_or_tells_the_same(first, last):
    scan = scan_of(StuckCell(5, np.inf))
    kept = slice(min(first, last), max(first, last) + 1)
    found = judge_scan(Scan(scan.levels[kept], scan.readings[kept], True), LAYOUT)
    count = [int((scan.levels[kept] == level).sum()) for level in (0.0, LOW, 1.0)]
    if min(count) < REPEATS:
        assert "incomplete" in found.incomplete
        assert not found.faults
        assert not found.alive.any()
    else:
        assert not found.incomplete
        assert blamed(found) == {5}


def test_missing_readings_of_a_cell_leave_it_untested():
    scan = scan_of()
    readings = scan.readings.copy()
    readings[:, 9] = np.nan
    found = judge_scan(replace(scan, readings=readings), LAYOUT)
    assert not found.faults
    assert np.flatnonzero(~found.alive).tolist() == [9]


def test_a_scan_under_load_says_so_and_blames_no_loaded_cell():
    forces = np.zeros(LAYOUT.n_cells)
    forces[LAYOUT.grid(np.arange(LAYOUT.n_cells))[0, 2:5, 2:5].ravel()] = 5.0
    found = judge_scan(scan_of(forces=forces), LAYOUT)
    assert not found.faults
    assert found.under_load == 9
    assert "scan untouched" in str(found)


def test_a_scan_that_sees_no_crossing_conduct_calls_none_open_or_alive():
    circuit = Circuit(LAYOUT, "grounded", (StuckCell(3, 0.0),), idle_ohms=1e12)
    found = judge_scan(scan_circuit(circuit, np.zeros(LAYOUT.n_cells)), LAYOUT)
    assert blamed(found) == {3}
    assert not found.alive.any()


def test_crossings_that_did_not_answer_in_the_healthy_array_are_not_tested():
    silent = [StuckCell(cell, np.inf) for cell in (3, 11, 40)]
    healthy = judge_scan(scan_of(*silent), LAYOUT)
    today = judge_scan(scan_of(*silent, StuckCell(20, np.inf)), LAYOUT)
    assert blamed(today) == {3, 11, 20, 40}
    found = today.since(healthy)
    assert blamed(found) == {20}
    assert not found.alive[[3, 11, 40]].any()
    assert not healthy.since(healthy).faults


def idle_of(spread: float, seed: int) -> np.ndarray:
    """Return preloads of which the logarithm has a standard deviation."""
    rng = np.random.default_rng(seed)
    return np.clip(0.005 * np.exp(rng.normal(0, spread, LAYOUT.n_cells)), 0, 1)


@given(st.integers(0, 10**6), st.floats(0, 4))
def test_no_healthy_crossing_is_blamed_however_differently_they_conduct(seed, spread):
    circuit = Circuit(LAYOUT, idle_ohms=1e9)
    found = judge_scan(scan_circuit(circuit, idle_of(spread, seed), seed=seed), LAYOUT)
    assert not found.faults


@given(st.integers(0, 10**6), st.floats(0, 4))
def test_a_healthy_scan_tells_which_silent_crossing_is_open(seed, spread):
    idle = idle_of(spread, seed)
    circuit = Circuit(LAYOUT, idle_ohms=1e9)
    healthy = judge_scan(held(scan_circuit(circuit, idle, seed=seed)), LAYOUT)
    cell = int(np.nanargmax(np.where(healthy.alive, healthy.response, np.nan)))
    broken = circuit.with_faults(StuckCell(cell, np.inf))
    today = held(scan_circuit(broken, idle, seed=seed + 1))
    found = judge_scan(today, LAYOUT).since(healthy)
    assert blamed(found) == {cell}


def test_an_array_of_which_most_crossings_do_not_conduct_untouched_has_no_open_one():
    few = [StuckCell(cell, np.inf) for cell in range(LAYOUT.n_cells) if cell % 5]
    assert not judge_scan(scan_of(*few), LAYOUT).faults


def test_a_diagnosis_with_a_scan_leaves_no_cell_untested():
    rng = np.random.default_rng(0)
    untouched = rng.integers(0, 2, (60, LAYOUT.n_cells)) * 0.001
    without = SelfDiagnosis(LAYOUT).diagnose(untouched)
    assert (without.verdicts == Verdict.UNTESTED).all()
    scan = scan_of(StuckCell(5, np.inf), CutLine(Line(0, "row", 6), 3))
    found = SelfDiagnosis(LAYOUT).diagnose(untouched, scan=scan)
    assert set(found.fault_set) == {5, *LAYOUT.cells_on(Line(0, "row", 6))[3:].tolist()}
    assert (found.verdicts == Verdict.UNTESTED).sum() == 0
    assert found.coverage.test_coverage == 1.0
    assert type(found).from_dict(found.to_dict()).fault_set == found.fault_set
    assert (found.probability[found.fault_set.healthy] < 0.01).all()


def test_a_fault_of_the_log_stays_where_its_crossing_answers_the_scan(fitted, grasps):
    layout = grasps.layout
    frames = np.concatenate(grasps.frames[1::2])
    frames[:, 44] = 0.0
    diagnosis = fitted.diagnose(frames)
    assert 44 in diagnosis.fault_set
    circuit = Circuit(layout, "grounded")
    scan = held(scan_circuit(circuit, np.full(layout.n_cells, 0.01)))
    found = with_scan(diagnosis, judge_scan(scan, layout))
    assert found.fault_set == diagnosis.fault_set
    assert (found.verdicts[found.fault_set.healthy] == Verdict.ALIVE).all()


def test_a_scan_of_another_array_or_of_no_levels_is_refused_in_one_line():
    scan = scan_of()
    with pytest.raises(ValueError, match=r"a scan of 56 cells, but the array has 4 .* this array"):
        judge_scan(scan, SensorLayout(1, 2, 2))
    with pytest.raises(ValueError, match=r"0 to 1 of the full drive; got levels 0 to 3"):
        Scan(np.array([0.0, 3.0]), np.zeros((2, 4)))
    with pytest.raises(ValueError, match=r"levels \[n\] and readings \[n, D\]; got \[2\] and \[3"):
        Scan(np.zeros(2), np.zeros((3, 4)))
    with pytest.raises(TypeError, match=r"expected Scan\(levels \[n\], readings .* got ndarray"):
        judge_scan(scan.readings, LAYOUT)
    with pytest.raises(ValueError, match="no frames"):
        Scan.of([])
