"""How far is the injector from the circuit? Usage: python examples/circuit_vs_injector.py [READOUT
...]

READOUT is grounded, floating, floating_rows or floating_columns (default: the first two). Each
fault is put into the netlist, and into what the healthy circuit reads; the table gives how far
apart the two come out, in % of full scale.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from adaptfault.data.simulated_grasps import simulate
from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import SensorLayout
from diagnostics.simulation.circuit import (
    BridgedLines,
    Circuit,
    CutLine,
    NetlistFault,
    Readout,
    ShortedLine,
    StuckBit,
    StuckCell,
    StuckConverter,
)
from diagnostics.simulation.injection import bridge, inject, line_fault
from diagnostics.wiring import Line


def cases(circuit: Circuit) -> dict[str, tuple[NetlistFault, Fault]]:
    """Return each fault twice, in the middle of the pad: in the netlist, and as the injector has
    it."""
    layout = circuit.layout
    row = layout.rows // 2
    col = layout.cols // 2
    cell = layout.cell(0, row, col)
    stuck = 0.4 * layout.full_scale
    found: dict[str, tuple[NetlistFault, Fault]] = {
        "cell open": (StuckCell(cell, np.inf), Fault(FaultKind.OPEN, (cell,))),
        "cell stuck at 40 %": (
            StuckCell(cell, circuit.cell_ohms(stuck)),
            Fault(FaultKind.STUCK, (cell,), value=stuck),
        ),
        "cell shorted, 1 kiloohm": (StuckCell(cell, 1e3), Fault(FaultKind.SHORT, (cell,))),
        "cell shorted, dead": (StuckCell(cell, 0), Fault(FaultKind.SHORT, (cell,))),
    }
    for line, half in ((Line(0, "row", row), col), (Line(0, "column", col), row)):
        kind = line.kind
        found[f"{kind} cut in the middle"] = (
            CutLine(line, half),
            line_fault(layout, line, FaultKind.OPEN, break_at=half),
        )
        found[f"{kind} on ground"] = (
            ShortedLine(line, "ground"),
            line_fault(layout, line, FaultKind.OPEN),
        )
        found[f"{kind} on supply"] = (
            ShortedLine(line, "supply"),
            line_fault(layout, line, FaultKind.SHORT),
        )
        found[f"{kind} touches the next"] = BridgedLines(line), bridge(layout, line)
        bit = Line(0, "row_address" if kind == "row" else "column_address", 1)
        found[f"{kind} address bit 1 at 0"] = (
            StuckBit(bit, 0),
            line_fault(layout, bit, FaultKind.ALIAS, value=0),
        )
    converter = Line(0, "converter", 0)
    found["converter stuck at 40 %"] = (
        StuckConverter(converter, stuck),
        line_fault(layout, converter, FaultKind.STUCK, value=stuck),
    )
    return found


def distance(
    circuit: Circuit, forces: np.ndarray, readings: np.ndarray, netlist: NetlistFault, fault: Fault
):
    """Return median and 99th percentile of the difference in %, of the faulty cells and of all
    others.

    ``forces`` and ``readings`` are ``[T, D]``: what presses on the array, and what the healthy
    circuit reads of it.
    """
    layout = circuit.layout
    broken = circuit.with_faults(netlist).read(forces)
    apart = np.abs(broken - inject(readings, [fault], layout)) * (100 / layout.full_scale)
    faulty = np.isin(np.arange(layout.n_cells), fault.cells)
    return [
        np.percentile(apart[:, cells], [50, 99]) if cells.any() else None
        for cells in (faulty, ~faulty)
    ]


def main(readouts: Sequence[Readout]) -> None:
    layout = SensorLayout(1, 11, 10)  # pads share no wire: one tells it all
    grasps = simulate(
        5, layout, n_frames=20, classes=("normal", "foreign matter", "void", "deformation")
    )
    forces = np.concatenate(grasps.frames)
    table: dict[str, str] = {}
    for readout in readouts:
        circuit = Circuit(layout, readout)
        readings = circuit.read(forces)
        for name, (netlist, fault) in cases(circuit).items():
            figures = distance(circuit, forces, readings, netlist, fault)
            columns = "".join(
                f"{'-' if f is None else '{:.1f} / {:.1f}'.format(*f):>16}" for f in figures
            )
            table[name] = table.get(name, f"{name:26}") + columns
    print("|circuit - injector| in % of full scale: median / 99th percentile")
    print(f"{'':26}" + "".join(f"{readout:>32}" for readout in readouts))
    print(f"{'':26}" + f"{'faulty cells':>16}{'other cells':>16}" * len(readouts))
    print(*table.values(), sep="\n")


if __name__ == "__main__":
    main(sys.argv[1:] or ("grounded", "floating"))
