"""The scan of a read-out that tests itself, on the circuit of an array.

For each crossing and level d the row is driven with d of the supply; at level 0 the switch of the
row is open, so that the row floats. Other lines are as the read-out of the circuit holds them. The
converter's range ends where a cell at full scale reads half of it at the low level; noise is
normal, in steps of the converter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.read_out import Scan
from diagnostics.simulation.circuit import Circuit, StuckConverter, _Pad

LOW = 1 / 64
"""The low level, as share of the drive."""


def scan_circuit(
    circuit: Circuit,
    forces: NDArray[np.floating],
    *,
    repeats: int = 16,
    noise: float = 1.0,
    bits: int = 12,
    seed: int = 0,
) -> Scan:
    """Return the scan of a circuit.

    Args:
        circuit: with its faults.
        forces: ``[D]``, on each cell during the scan, in the layout's unit.
        repeats: frames at each level.
        noise: standard deviation of a reading, in converter steps.
        bits: of the converter.
        seed: of the noise.
    """
    rng = np.random.default_rng(seed)
    layout = circuit.layout
    loads = layout.grid(np.asarray(forces, np.float64)[None])[0]
    series = circuit.load_ohms + 2 * circuit.switch_ohms
    full = circuit.load_ohms / (series + circuit.cell_ohms(layout.full_scale))
    top = 2 * LOW * full
    steps = 2**bits - 1
    levels = np.repeat([0.0, LOW, 1.0], repeats)
    volts = {level: _volts(circuit, loads, level) for level in (0.0, LOW, 1.0)}
    readings = np.stack([volts[level].ravel() for level in levels.tolist()]) / top
    noisy = np.rint(readings * steps + noise * rng.standard_normal(readings.shape)) / steps
    return Scan(levels, np.clip(noisy, 0.0, 1.0))


def _volts(circuit: Circuit, loads: NDArray[np.float64], level: float) -> NDArray[np.float64]:
    """Return the converter's input ``[pads, rows, cols]`` at one level, as shares of the supply."""
    found = np.stack(
        [_of_pad(circuit, _Pad.build(circuit, pad), loads[pad], level) for pad in range(len(loads))]
    )
    for fault in circuit.faults:
        if isinstance(fault, StuckConverter):
            found[fault.line.pad] = fault.value / circuit.layout.full_scale
    return np.where(circuit.layout.present, found, 0.0)


def _of_pad(
    circuit: Circuit, wires: _Pad, loads: NDArray[np.float64], level: float
) -> NDArray[np.float64]:
    """Return the converter's input ``[rows, cols]`` of one pad at one level."""
    idle = circuit._nodal_matrix(wires, loads[None])[0]
    found = np.zeros(loads.shape)
    for row, driven in enumerate(wires.drive.tolist()):
        matrix = idle.copy()
        source = wires.source.copy()
        if driven >= 0:
            change = float(level > 0) - float(circuit._grounds("row"))
            matrix[driven, driven] += change / circuit.switch_ohms
            source[driven] += level / circuit.switch_ohms
        found[row] = circuit._received(wires, matrix[None], source)[0]
    return found * circuit.load_ohms / (circuit.load_ohms + circuit.switch_ohms)
