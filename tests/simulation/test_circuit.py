"""The resistive array as a circuit, and where the injector's laws hold in it.

``FORCES`` are 40 frames of one 7 x 6 pad, six cells in ten untouched and the others under 0..2 N.
"""

import numpy as np
import pytest

from diagnostics.faults import Fault
from diagnostics.layout import SensorLayout
from diagnostics.simulation.circuit import (
    BridgedLines,
    Circuit,
    CutLine,
    ShortedLine,
    StuckBit,
    StuckCell,
    StuckConverter,
)
from diagnostics.simulation.injection import bridge, inject, line_fault
from diagnostics.wiring import Line

READOUTS = ("grounded", "floating", "floating_rows", "floating_columns")
LAYOUT = SensorLayout(1, 7, 6)
ROW = Line(0, "row", 3)
COLUMN = Line(0, "column", 2)
CELL = LAYOUT.cell(0, 3, 2)


def some_forces(layout: SensorLayout = LAYOUT, frames: int = 40) -> np.ndarray:
    rng = np.random.default_rng(0)
    loaded = rng.random((frames, layout.n_cells)) < 0.4
    return rng.uniform(0, 2, loaded.shape) * loaded


FORCES = some_forces()


def group_excluded(circuit: Circuit, netlist, fault: Fault) -> tuple[float, float]:
    """Return the 99th percentile of |circuit - injector| on the faulty cells and on the others, in
    % of full scale."""
    injected = inject(circuit.read(FORCES), [fault], LAYOUT)
    difference = (
        np.abs(circuit.with_faults(netlist).read(FORCES) - injected) * 100 / LAYOUT.full_scale
    )
    faulty = np.isin(np.arange(LAYOUT.n_cells), fault.cells)
    others = difference[:, ~faulty]
    return float(np.percentile(difference[:, faulty], 99)), float(
        np.percentile(others, 99)
    ) if others.size else 0.0


# The network itself


def test_a_floating_2x2_array_reads_the_cell_beside_the_three_others_in_series():
    layout = SensorLayout(1, 2, 2)
    force = np.array([0.5, 1.0, 2.0, 0.8])
    g = 1 / 10e6 + force / 5 / 10e3
    neighbourhood = g[0] + 1 / (1 / g[1] + 1 / g[3] + 1 / g[2])  # row 0, column 1, row 1, column 0
    by_hand = (neighbourhood - 1 / 10e6) * 10e3 * 5
    assert Circuit(layout, "floating").read(force[None])[0, 0] == pytest.approx(by_hand, rel=1e-6)


def test_a_grounded_2x2_array_divides_the_supply_by_the_load_beside_the_other_cell_of_the_column():
    layout = SensorLayout(1, 2, 2)
    force = np.array([0.5, 1.0, 2.0, 0.8])
    g = 1 / 10e6 + force / 5 / 10e3
    load = 1000.0
    volts = g[0] / (g[0] + g[2] + 1 / load)
    by_hand = (1 / (load / volts - load) - 1 / 10e6) * 10e3 * 5
    assert by_hand < 0.49  # the other cell takes its share
    circuit = Circuit(layout, load_ohms=load, switch_ohms=1e-4)
    assert circuit.read(force[None])[0, 0] == pytest.approx(by_hand, rel=1e-5)


@pytest.mark.parametrize("readout", READOUTS)
def test_what_flows_into_a_wire_flows_out_of_it_with_faults_too(readout):
    cut = CutLine(ROW, 2)
    bridged = BridgedLines(Line(0, "column", 3))
    shorted = ShortedLine(Line(0, "row", 1), "supply")
    circuit = Circuit(LAYOUT, readout, (cut, bridged, shorted), leak_ohms=1e15)
    row = 4
    col = 1
    volts = circuit.wire_voltages(FORCES, 0, row, col)
    assert volts.shape == (40, 7 + 6 + 1)
    rows = volts[:, :7]
    cols = volts[:, 7:13]
    tail_slope = volts[:, 13]
    at_cell = np.repeat(rows[:, :, None], 6, axis=2)
    at_cell[:, 3, 2:] = tail_slope[:, None]
    g = 1 / 10e6 + LAYOUT.grid(FORCES)[:, 0] / 5 / 10e3
    current = g * (at_cell - cols[:, None, :])  # from row to column [T, rows, cols]
    np.testing.assert_allclose(current[:, 3, 2:].sum(1), 0, atol=1e-12)
    # from the row terminals
    ground_rows = readout in ("grounded", "floating_columns")
    supplied = np.where(ground_rows, -rows / 70, 0.0)
    supplied[:, row] = (1 - rows[:, row]) / 70
    supplied[:, 1] += (1 - rows[:, 1]) / 1.0
    out = current.sum(2)
    out[:, 3] = current[:, 3, :2].sum(1)
    np.testing.assert_allclose(supplied, out, atol=1e-12)
    # into the column terminals and across the bridge
    drained = np.where(readout in ("grounded", "floating_rows"), cols / 70, 0.0)
    drained[:, col] = cols[:, col] / 170
    across = (cols[:, 3] - cols[:, 4]) / 1.0
    drained[:, 3] += across
    drained[:, 4] -= across
    np.testing.assert_allclose(drained, current.sum(1), atol=1e-12)


@pytest.mark.parametrize("readout", READOUTS)
def test_a_scan_is_what_the_same_network_gives_solved_cell_by_cell(readout):
    circuit = Circuit(
        LAYOUT,
        readout,
        (CutLine(COLUMN, 4, "last"), StuckCell(9, 0), StuckBit(Line(0, "row_address", 1), 1)),
    )
    readings = LAYOUT.grid(circuit.read(FORCES))[:, 0]
    for row, col in np.ndindex(7, 6):
        volts = circuit.wire_voltages(FORCES, 0, row, col)[:, 7 + col] * 100 / 170
        top = 100 / (240 + 1 / (1 / 10e6 + 1 / 10e3))
        volts = volts.clip(0, top)
        force = (volts / (100 - 240 * volts) - 1 / 10e6) * 10e3 * 5
        np.testing.assert_allclose(readings[:, row, col], force.clip(0, 5), atol=1e-6)


@pytest.mark.parametrize("readout", ["grounded", "floating"])
def test_driving_columns_and_reading_rows_gives_the_same(readout):
    turned = SensorLayout(1, 6, 7)
    forces = LAYOUT.grid(FORCES).swapaxes(2, 3)
    straight = LAYOUT.grid(Circuit(LAYOUT, readout, load_ohms=1e-3).read(FORCES))
    across = turned.grid(Circuit(turned, readout, load_ohms=1e-3).read(forces))
    np.testing.assert_allclose(across, straight.swapaxes(2, 3), atol=1e-4)


@pytest.mark.parametrize("readout", ["grounded", "floating_rows", "floating_columns"])
def test_small_load_and_switches_give_the_force_back_unless_all_lines_float(readout):
    read = Circuit(LAYOUT, readout, load_ohms=0.01, switch_ohms=0.01).read(FORCES)
    np.testing.assert_allclose(read, FORCES, atol=0.001)


def test_with_all_lines_floating_half_of_what_is_read_sneaks_through_other_cells():
    read = Circuit(LAYOUT, "floating").read(FORCES)
    assert read.sum() > 2 * FORCES.sum()
    assert (read - FORCES).min() > -0.02


def test_pads_share_no_wire():
    two = SensorLayout(2, 7, 6)
    short = Circuit(two, "floating", (StuckCell(two.cell(1, 3, 2), 0),))
    read = two.grid(short.read(np.hstack([FORCES, FORCES])))
    one = LAYOUT.grid(Circuit(LAYOUT, "floating").read(FORCES))
    np.testing.assert_allclose(read[:, 0], one[:, 0], atol=1e-9)
    assert np.abs(read[:, 1] - one[:, 0]).max() > 1


def test_two_stuck_address_bits_act_together():
    bits = StuckBit(Line(0, "row_address", 2), 1), StuckBit(Line(0, "row_address", 1), 0)
    healthy, read = (
        LAYOUT.grid(Circuit(LAYOUT, faults=faults).read(FORCES))[:, 0] for faults in ((), bits)
    )
    # row 3 alone would go to 7, which is none
    np.testing.assert_array_equal(read, healthy[:, [4, 5, 4, 5, 4, 5, 4]])


def test_a_converter_of_4_bits_has_16_voltages():
    read = Circuit(LAYOUT, bits=4).read(
        np.linspace(0, 5, 500)[:, None] * np.eye(LAYOUT.n_cells)[CELL]
    )[:, CELL]
    assert len(np.unique(read)) == 16
    assert read[-1] == pytest.approx(5)


def test_missing_forces_stay_missing_and_absent_cells_conduct_nothing():
    present = np.ones((1, 7, 6), bool)
    present[0, 3, 2] = False
    masked = SensorLayout(1, 7, 6, present=present)
    forces = FORCES.copy()
    forces[:, CELL] = 4.0
    forces[5, 0] = np.nan
    read = Circuit(masked, "floating").read(forces)
    assert np.isnan(read).sum() == 1
    assert np.isnan(read[5, 0])
    assert (read[:, CELL] == 0).all()
    forces[:, CELL] = 0.0
    np.testing.assert_array_equal(Circuit(masked, "floating").read(forces), read)


# Where the injector agrees

BIT = Line(0, "row_address", 2)
CONVERTER = Line(0, "converter", 0)
STUCK = 1 / (1 / 10e6 + 0.4 / 10e3)  # ohms of a cell under 2 N of 5

# netlist, fault, 99th percentile of the difference on faulty cells and on the others, % of full
# scale
AGREES = {
    "a cell open": (StuckCell(CELL, np.inf), Fault("open", (CELL,)), 0.0, 0.1),
    "a cell stuck": (StuckCell(CELL, STUCK), Fault("stuck", (CELL,), value=2.0), 2.0, 0.5),
    "a cell shorted through 1 kiloohm": (StuckCell(CELL, 1e3), Fault("short", (CELL,)), 0.0, 5.0),
    "a row cut": (CutLine(ROW, 2), line_fault(LAYOUT, ROW, "open", break_at=2), 0.0, 0.3),
    "a row cut, driven from its last column": (
        CutLine(ROW, 2, "last"),
        line_fault(LAYOUT, ROW, "open", break_at=2, driven_from="last"),
        0.0,
        0.3,
    ),
    "a column cut": (CutLine(COLUMN, 4), line_fault(LAYOUT, COLUMN, "open", break_at=4), 0.0, 0.3),
    "a row on ground": (ShortedLine(ROW, "ground"), line_fault(LAYOUT, ROW, "open"), 0.5, 0.1),
    "a column on ground": (
        ShortedLine(COLUMN, "ground"),
        line_fault(LAYOUT, COLUMN, "open"),
        0.5,
        0.1,
    ),
    "a column on supply": (
        ShortedLine(COLUMN, "supply"),
        line_fault(LAYOUT, COLUMN, "short"),
        0.0,
        0.3,
    ),
    "an address bit stuck": (StuckBit(BIT, 0), line_fault(LAYOUT, BIT, "alias", value=0), 0.0, 0.0),
    "an address without a row": (
        StuckBit(BIT, 1),
        line_fault(LAYOUT, BIT, "alias", value=1),
        0.0,
        0.0,
    ),
    "a converter stuck": (
        StuckConverter(CONVERTER, 2.2),
        line_fault(LAYOUT, CONVERTER, "stuck", value=2.2),
        0.0,
        0.0,
    ),
}


@pytest.mark.parametrize(
    ("netlist", "fault", "on_faulty", "on_others"), AGREES.values(), ids=AGREES
)
def test_with_grounded_lines_the_injector_reads_what_the_circuit_reads(
    netlist, fault, on_faulty, on_others
):
    faulty, others = group_excluded(Circuit(LAYOUT, "grounded"), netlist, fault)
    assert faulty <= on_faulty
    assert others <= on_others


@pytest.mark.parametrize(
    ("line", "readout"), [(ROW, "floating_rows"), (COLUMN, "floating_columns")]
)
def test_bridged_lines_read_the_sum_where_the_one_not_selected_floats(line, readout):
    faulty, others = group_excluded(
        Circuit(LAYOUT, readout), BridgedLines(line), bridge(LAYOUT, line)
    )
    assert faulty < 1
    assert others < 0.1


# Where it does not


@pytest.mark.parametrize(
    ("line", "readout"), [(ROW, "floating_columns"), (COLUMN, "floating_rows")]
)
def test_bridged_lines_read_the_mean_where_an_equal_switch_grounds_the_one_not_selected(
    line, readout
):
    circuit = Circuit(LAYOUT, readout, load_ohms=0.1)
    healthy = circuit.read(FORCES)
    read = circuit.with_faults(BridgedLines(line)).read(FORCES)
    pair = [LAYOUT.cells_on(line), LAYOUT.cells_on(Line(0, line.kind, line.index + 1))]
    mean = (healthy[:, pair[0]] + healthy[:, pair[1]]) / 2
    for cells in pair:
        np.testing.assert_allclose(read[:, cells], mean, atol=0.02 * LAYOUT.full_scale)


def test_water_between_two_rows_drives_the_other_one_through_a_voltage_divider():
    """Supply, switch of the driven row, water, switch of the grounded row, ground."""
    below = LAYOUT.cell(0, ROW.index + 1, 2)
    force = np.zeros((1, LAYOUT.n_cells))
    force[0, below] = 2.0
    circuit = Circuit(LAYOUT, faults=(BridgedLines(ROW, 630.0),), load_ohms=0.1)
    read = circuit.read(force)[0]
    assert read[CELL] == pytest.approx(2.0 * 70 / (70 + 630 + 70), rel=0.03)
    assert read[below] == pytest.approx(2.0 * 700 / 770, rel=0.03)


def test_a_row_on_the_supply_stays_alive_and_adds_itself_to_all_other_rows():
    circuit = Circuit(LAYOUT, "grounded", load_ohms=0.1, switch_ohms=10, short_ohms=0.1)
    read = LAYOUT.grid(circuit.with_faults(ShortedLine(ROW, "supply")).read(FORCES))[:, 0]
    forces = LAYOUT.grid(FORCES)[:, 0]
    np.testing.assert_allclose(read[:, 3], forces[:, 3], atol=0.05)
    np.testing.assert_allclose(read[:, 0], forces[:, 0] + forces[:, 3], atol=0.1)


def test_a_dead_short_divides_the_readings_of_its_row_and_column_even_with_grounded_lines():
    forces = np.full((1, LAYOUT.n_cells), 0.5)
    circuit = Circuit(LAYOUT, "grounded")
    share = LAYOUT.grid(
        circuit.with_faults(StuckCell(CELL, 0)).read(forces) / circuit.read(forces)
    )[0, 0]
    # 70 ohms drive the row, which 1 + 70 ohms hold at ground
    np.testing.assert_allclose(np.delete(share[3], 2), 71 / 141, rtol=0.02)
    # 71 ohms to ground beside the 170 of switch and load
    np.testing.assert_allclose(np.delete(share[:, 2], 3), 71 / 241, rtol=0.02)
    np.testing.assert_allclose(np.delete(np.delete(share, 3, 0), 2, 1), 1, rtol=0.02)


def test_with_floating_lines_a_shorted_cell_drags_its_row_and_column_up():
    circuit = Circuit(LAYOUT, "floating")
    healthy = LAYOUT.grid(circuit.read(FORCES))[:, 0]
    short = LAYOUT.grid(circuit.with_faults(StuckCell(CELL, 0)).read(FORCES))[:, 0]
    rise = short - healthy
    elsewhere = np.delete(np.delete(rise, 3, 1), 2, 2)
    dragged = np.concatenate([np.delete(rise[:, 3], 2, 1), np.delete(rise[:, :, 2], 3, 1)], axis=1)
    assert np.median(dragged) > 0.02 * LAYOUT.full_scale
    assert np.median(dragged) > 20 * np.median(elsewhere)


@pytest.mark.parametrize("line", [ROW, COLUMN])
def test_with_floating_lines_the_cells_beyond_a_cut_read_what_sneaks_to_them(line):
    cut = CutLine(line, 2)
    tail_slope = line_fault(LAYOUT, line, "open", break_at=2).cells
    grounded = Circuit(LAYOUT, "grounded", (cut,)).read(FORCES)[:, tail_slope]
    floating = Circuit(LAYOUT, "floating", (cut,)).read(FORCES)[:, tail_slope]
    assert grounded.max() == 0
    assert np.median(floating) > 0.02 * LAYOUT.full_scale


def test_with_floating_lines_an_open_cell_reads_what_sneaks_around_it():
    circuit = Circuit(LAYOUT, "floating", (StuckCell(CELL, np.inf),))
    assert np.median(circuit.read(FORCES)[:, CELL]) > 0.05 * LAYOUT.full_scale


# What is refused


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (StuckCell(42, 0), "42 cells"),
        (StuckCell(0, -1.0), "0 or more"),
        (CutLine(ROW, 7), "0 to 6"),
        (CutLine(BIT, 1), "row or column"),
        (CutLine(Line(0, "row", 7), 1), "not a wire"),
        (ShortedLine(ROW, "earth"), "'supply' or 'ground'"),
        (BridgedLines(ROW, -5.0), "must be positive"),
        (BridgedLines(Line(0, "column", 5)), "last of its kind"),
        (StuckBit(ROW, 1), "row_address or column_address"),
        (StuckBit(BIT, 2), "level 0 or 1"),
        (StuckConverter(ROW, 1.0), "converter"),
        (StuckConverter(CONVERTER, np.nan), "finite"),
    ],
)
def test_a_fault_that_fits_nothing_is_refused(fault, message):
    with pytest.raises(ValueError, match=message):
        Circuit(LAYOUT, faults=(fault,))


def test_a_circuit_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="unknown readout"):
        Circuit(LAYOUT, "flying")
    with pytest.raises(ValueError, match="load_ohms > 0"):
        Circuit(LAYOUT, load_ohms=0)
    with pytest.raises(ValueError, match="bits >= 1"):
        Circuit(LAYOUT, bits=0)
    with pytest.raises(ValueError, match="cut more than once"):
        Circuit(LAYOUT, faults=(CutLine(ROW, 2), CutLine(ROW, 4)))
    with pytest.raises(ValueError, match="expected"):
        Circuit(LAYOUT).read(np.zeros((3, 5)))
