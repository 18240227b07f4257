"""Circuit model of the array: readings of the converter with faults in the netlist, not in the
readings.

Each cell is a resistor between its row wire and its column wire. To read cell (i, j), row i is
driven with the supply, column j goes to the load resistor of a voltage divider, and the converter
measures across the load. With Y the matrix of conductances between wires, a scan solves Y v = s
(nodal analysis, Kirchhoff's current law) once for each driven row and frame. Which column is read
changes one term on the diagonal of Y, so all columns follow from the same solution
(Sherman-Morrison): v_j = u_j / (1 + d Z_jj) with Z = Y^-1, u = Z s, and d what column j's terminal
gains.

Wires are ideal. A cut makes a second wire of the part beyond it, which no terminal reaches.

Where the laws of :func:`diagnostics.inject` hold: its output on the healthy circuit's readings
against the broken circuit's, with the resistances below, on simulated grasps
(``examples/circuit_vs_injector.py``; 99th percentile of the difference, in % of full scale;
"others" are the cells that the injector leaves alone).

- Grounded lines: open and stuck cells, cuts, lines on ground, columns on the supply, address bits
  and converters agree within 1.6, others within 0.4. A short of 1 kiloohm moves others by 2.4, of 1
  ohm by 13: it halves the rest of its row and leaves 0.3 of the rest of its column.
- A row on the supply never reads full scale: its cells stay alive (92 off at the median) and their
  forces are added to those of all other rows of their column. Bridged lines read the same: the sum
  of the two where the line that is not selected floats (within 1.5), their mean where a switch like
  the driver's grounds it, still less of two columns where the load is not small.
- Floating lines: nothing but address bits and converters agrees on all cells. The median loaded
  cell reads 28 too high without any fault; an open cell reads 34 and cells beyond a cut 16 to 18 at
  the median, because of sneak currents around the break; a short moves others by 20, a line on
  ground by 30, a line on the supply by 85.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.layout import SensorLayout
from diagnostics.wiring import Line

Readout = Literal["grounded", "floating", "floating_rows", "floating_columns"]
"""Which lines float while they are not selected; the others are held at ground by their switch."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class StuckCell:
    """Cell ``cell`` has ``ohms`` whatever touches it; infinite: it is open, 0: its layers touch."""

    cell: int
    ohms: float


@dataclass(frozen=True)
class CutLine:
    """A row or column is cut between positions ``before - 1`` and ``before``, as in
    ``line_fault(break_at=...)``."""

    line: Line
    before: int = 0
    driven_from: Literal["first", "last"] = "first"


@dataclass(frozen=True)
class ShortedLine:
    """A row or column touches the supply or ground, at its driven end.

    ``ohms`` is the resistance between the two, as of dirt; None: ``short_ohms``, two conductors.
    """

    line: Line
    to: Literal["supply", "ground"]
    ohms: float | None = None


@dataclass(frozen=True)
class BridgedLines:
    """A row or column touches the next one (index + 1), at their driven ends.

    ``ohms`` is the resistance between the two, as of water; None: ``short_ohms``, two conductors.
    """

    line: Line
    ohms: float | None = None


@dataclass(frozen=True)
class StuckBit:
    """An address bit stays at ``level`` 0 or 1: another line than addressed is driven or read, or
    none."""

    line: Line
    level: int


@dataclass(frozen=True)
class StuckConverter:
    """A pad's converter channel reports ``value``, in the layout's unit, whatever its input."""

    line: Line
    value: float


NetlistFault = StuckCell | CutLine | ShortedLine | BridgedLines | StuckBit | StuckConverter


@dataclass(frozen=True)
class Circuit:
    """A resistive array with its readout and its faults.

    A cell under force f conducts ``1 / idle_ohms + f / full_scale / full_scale_ohms``.

    Args:
        layout: the array; absent positions have no resistor and read 0.
        readout: ``"grounded"``, ``"floating"`` (all lines that are not selected),
            ``"floating_rows"`` (columns grounded) or ``"floating_columns"`` (rows grounded). Lines
            that float let current sneak through other cells.
        faults: faults of the netlist; at most one cut for each line.
        full_scale_ohms: resistance of a cell at full scale, without ``idle_ohms`` in parallel.
        idle_ohms: resistance of an unloaded cell.
        load_ohms: the divider's lower resistor. Small against the cells, it keeps the other cells
            of a column from dividing the reading; near 0 it stands for an amplifier's virtual
            ground.
        switch_ohms: a closed switch of the multiplexer (70: a 74HC4067 at 4.5 V), also what holds a
            line at ground.
        short_ohms: contact of two conductors.
        leak_ohms: from every wire to ground.
        bits: of the converter; None: no rounding. Its range ends at the voltage of a cell at full
            scale, as with an amplifier before it.

    Raises:
        ValueError: a resistance that is not positive, an unknown readout, a fault that fits no wire
            or cell.
    """

    layout: SensorLayout
    readout: Readout = "grounded"
    faults: tuple[NetlistFault, ...] = ()
    full_scale_ohms: float = field(default=10e3, kw_only=True)
    idle_ohms: float = field(default=10e6, kw_only=True)
    load_ohms: float = field(default=100.0, kw_only=True)
    switch_ohms: float = field(default=70.0, kw_only=True)
    short_ohms: float = field(default=1.0, kw_only=True)
    leak_ohms: float = field(default=1e12, kw_only=True)
    bits: int | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if self.readout not in get_args(Readout):
            raise ValueError(
                f"unknown readout {self.readout!r}: use one of {', '.join(get_args(Readout))}"
            )
        for name in ("full_scale", "idle", "load", "switch", "short", "leak"):
            ohms = getattr(self, f"{name}_ohms")
            if not (np.isfinite(ohms) and ohms > 0):
                raise ValueError(
                    f"a circuit needs {name}_ohms > 0 and finite; got {ohms!r} (nearly 0 will do"
                    " for 0)"
                )
        if self.bits is not None and self.bits < 1:
            raise ValueError(
                f"a converter needs bits >= 1, or None for no rounding; got {self.bits!r}"
            )
        object.__setattr__(self, "faults", tuple(self.faults))
        for fault in self.faults:
            _check(fault, self.layout)
        cut = [fault.line for fault in self.faults if isinstance(fault, CutLine)]
        if twice := {line for line in cut if cut.count(line) > 1}:
            raise ValueError(
                f"{min(twice)} is cut more than once: give the cut nearest to its driven end"
            )

    def with_faults(self, *faults: NetlistFault) -> Circuit:
        """Return the same circuit with these faults instead of its own."""
        return replace(self, faults=faults)

    def cell_ohms(self, force: float) -> float:
        """Return the resistance of a healthy cell under ``force``, in the layout's unit."""
        return float(1 / self._conductance(np.float64(force)))

    def read(self, recording: ArrayLike) -> FloatArray:
        """Return the readings of the array under the forces of ``recording``.

        The converter's calibration is that of a healthy cell alone in the divider; readings are
        clipped to its range.

        Args:
            recording: forces ``[T, D]`` or ``[T, pads, rows, cols]``, in the layout's unit;
                negative ones count as 0. A missing force (NaN) loads nothing, and its reading is
                missing.

        Returns:
            float64 ``[T, D]``, in the layout's unit, 0..full_scale.

        Raises:
            ValueError: the shape does not fit the layout.
        """
        forces = self.layout.check_recording(recording)
        grid = self.layout.grid(forces)
        pads = [self._scan(_Pad.build(self, pad), grid[:, pad]) for pad in range(self.layout.pads)]
        readings = self._calibrated(np.stack(pads, axis=1))  # [T, pads, rows, cols]
        for fault in self.faults:
            if isinstance(fault, StuckConverter):
                readings[:, fault.line.pad] = np.clip(fault.value, 0, self.layout.full_scale)
        readings[:, ~self.layout.present] = 0.0
        readings[np.isnan(grid)] = np.nan
        return readings.reshape(forces.shape)

    def wire_voltages(self, recording: ArrayLike, pad: int, row: int, col: int) -> FloatArray:
        """Return the voltage of every wire while one cell is addressed, as shares of the supply.

        Args:
            recording: as for :meth:`read`.
            pad, row, col: the cell whose address is set.

        Returns:
            float64 ``[T, rows + cols + cuts]``: rows, columns,
            then the part beyond each cut, in the order of ``faults``.
        """
        forces = self.layout.grid(self.layout.check_recording(recording))[:, pad]
        wires = _Pad.build(self, pad)
        matrix, source = self._driven(wires, self._nodal_matrix(wires, forces), wires.drive[row])
        read = wires.listen[col]
        if read >= 0:
            matrix[:, wires.rows + read, wires.rows + read] += self._reading_gain
        solved = np.linalg.solve(
            matrix, np.broadcast_to(source[:, None], (len(forces), len(source), 1))
        )
        return np.asarray(solved[..., 0], np.float64)

    def _scan(self, wires: _Pad, forces: FloatArray) -> FloatArray:
        """Return the converter's input ``[T, rows, cols]`` for forces of the same shape, as shares
        of the supply."""
        out = np.zeros(forces.shape)
        step = max(1, _BATCH // len(wires.static) ** 2)
        for start in range(0, len(forces), step):
            part = slice(start, start + step)
            idle = self._nodal_matrix(wires, forces[part])
            for driven in np.unique(wires.drive):
                matrix, source = self._driven(wires, idle, int(driven))
                received = self._received(wires, matrix, source)
                out[part, wires.drive == driven] = received[:, None]
        out *= self.load_ohms / (self.load_ohms + self.switch_ohms)
        return out

    def _received(self, wires: _Pad, matrix: FloatArray, source: FloatArray) -> FloatArray:
        """Return what the converter receives of each column, ``[T, cols]``, for Y ``[T, wires,
        wires]`` and s ``[wires]``."""
        columns = np.arange(wires.rows, wires.rows + len(wires.listen))
        sides = np.concatenate([source[:, None], np.eye(len(source))[:, columns]], axis=1)
        solved = np.linalg.solve(matrix, np.broadcast_to(sides, (len(matrix), *sides.shape)))
        own = solved[:, columns, np.arange(1, len(columns) + 1)]  # Z_jj [t, cols]
        at_load = solved[:, columns, 0] / (1 + self._reading_gain * own)
        return np.where(wires.listen >= 0, at_load[:, np.maximum(wires.listen, 0)], 0.0)

    def _nodal_matrix(self, wires: _Pad, forces: FloatArray) -> FloatArray:
        """Return Y ``[T, wires, wires]`` with nothing selected, for forces ``[T, rows, cols]``."""
        cells = self._conductance(np.nan_to_num(np.maximum(forces, 0.0)))
        # [T, rows * cols]
        cells = np.where(np.isnan(wires.stuck), cells, wires.stuck).reshape(len(forces), -1)
        n = len(wires.static)
        # no two cells join the same two wires
        a = wires.row_wire
        b = wires.column_wire
        matrix = np.repeat(wires.static[None], len(forces), axis=0)
        matrix[:, a, b] -= cells
        matrix[:, b, a] -= cells
        ends = np.eye(n)[a] + np.eye(n)[b]  # [rows * cols, wires]
        matrix[:, np.arange(n), np.arange(n)] += cells @ ends
        return matrix

    def _driven(self, wires: _Pad, matrix: FloatArray, row: int) -> tuple[FloatArray, FloatArray]:
        """Return Y ``[T, wires, wires]`` and s ``[wires]`` while ``row`` is driven; -1: an address
        without a row."""
        matrix = matrix.copy()
        source = wires.source.copy()
        if row >= 0:
            # the switch moves over
            matrix[:, row, row] += 0.0 if self._grounds("row") else 1 / self.switch_ohms
            source[row] += 1 / self.switch_ohms
        return matrix, source

    @property
    def _reading_gain(self) -> float:
        """Change of the conductance at the terminal of a column when it is read, in siemens."""
        return 1 / (self.switch_ohms + self.load_ohms) - (
            1 / self.switch_ohms if self._grounds("column") else 0.0
        )

    def _grounds(self, kind: str) -> bool:
        return self.readout not in ("floating", f"floating_{kind}s")

    def _conductance(self, force: FloatArray | np.float64) -> FloatArray:
        share = np.asarray(force, np.float64) / self.layout.full_scale
        return np.asarray(1 / self.idle_ohms + share / self.full_scale_ohms)

    def _calibrated(self, volts: FloatArray) -> FloatArray:
        """Return the forces for which a healthy cell alone gives these voltages, rounded as the
        converter does."""
        series = self.load_ohms + 2 * self.switch_ohms
        top = self.load_ohms / (series + self.cell_ohms(self.layout.full_scale))
        volts = np.clip(volts, 0.0, top)
        if self.bits is not None:
            steps = 2**self.bits - 1
            volts = np.rint(volts / top * steps) * (top / steps)
        conductance = volts / (self.load_ohms - volts * series)
        force = (conductance - 1 / self.idle_ohms) * self.full_scale_ohms * self.layout.full_scale
        return np.clip(force, 0.0, self.layout.full_scale)


# numbers in one batch of nodal matrices: 32 MB, and as much again while it is solved
_BATCH = 4_000_000


@dataclass(frozen=True, eq=False)
class _Pad:
    """The wires of one pad: numbered rows, then columns, then the parts beyond a cut."""

    rows: int
    static: FloatArray  # Y without cells and selection [wires, wires]
    source: FloatArray  # s without the driven row [wires]
    row_wire: NDArray[np.intp]  # wire of each cell [rows * cols]
    column_wire: NDArray[np.intp]
    stuck: FloatArray  # conductance of stuck and absent cells, NaN elsewhere [rows, cols]
    drive: NDArray[np.intp]  # which row each row address drives, -1: none [rows]
    listen: NDArray[np.intp]  # which column each column address reads, -1: none [cols]

    @classmethod
    def build(cls, circuit: Circuit, pad: int) -> _Pad:
        """Return the wires of a pad with the faults of the circuit in them."""
        layout = circuit.layout
        rows = layout.rows
        cols = layout.cols
        row_wire, column_wire = (w.copy() for w in np.indices((rows, cols)))
        column_wire += rows
        stuck = np.where(layout.present[pad], np.nan, 0.0)
        drive = np.arange(rows)
        listen = np.arange(cols)
        cuts = sum(isinstance(fault, CutLine) for fault in circuit.faults)
        held = np.repeat(
            [circuit._grounds("row"), circuit._grounds("column"), False], [rows, cols, cuts]
        )
        static = np.diag(1 / circuit.leak_ohms + held / circuit.switch_ohms)
        source = np.zeros(len(held))
        beyond = rows + cols
        for fault in circuit.faults:
            if isinstance(fault, StuckCell):
                where, row, col = layout.position(fault.cell)
                if where == pad and layout.present[pad, row, col]:
                    stuck[row, col] = 1 / max(fault.ohms, circuit.short_ohms)
                continue
            number = beyond
            beyond += isinstance(fault, CutLine)
            if fault.line.pad != pad:
                continue
            wire = fault.line.index + (rows if fault.line.kind == "column" else 0)
            match fault:
                case CutLine(line, before, end):
                    part = slice(before, None) if end == "first" else slice(None, before)
                    of_line = (
                        row_wire[line.index] if line.kind == "row" else column_wire[:, line.index]
                    )
                    of_line[part] = number
                case ShortedLine(to=to, ohms=ohms):
                    joined = 1 / (ohms or circuit.short_ohms)
                    static[wire, wire] += joined
                    source[wire] += joined if to == "supply" else 0.0
                case BridgedLines(ohms=ohms):
                    pair = np.array([wire, wire + 1])
                    joined = 1 / (ohms or circuit.short_ohms)
                    static[pair, pair] += joined
                    static[pair, pair[::-1]] -= joined
                case StuckBit(line, level) if line.kind == "row_address":
                    drive = _stick(drive, line.index, level)
                case StuckBit(line, level):
                    listen = _stick(listen, line.index, level)
        drive = np.where(drive < rows, drive, -1)
        listen = np.where(listen < cols, listen, -1)
        return cls(
            rows, static, source, row_wire.ravel(), column_wire.ravel(), stuck, drive, listen
        )


def _stick(addresses: NDArray[np.intp], bit: int, level: int) -> NDArray[np.intp]:
    """Return the addresses with one bit stuck at ``level``."""
    return addresses | (1 << bit) if level else addresses & ~(1 << bit)


def _check(fault: NetlistFault, layout: SensorLayout) -> None:
    """Raise ValueError where a fault fits no wire or cell of the layout."""
    if isinstance(fault, StuckCell):
        if not 0 <= fault.cell < layout.n_cells:
            raise ValueError(f"{fault}: the layout has {layout.n_cells} cells, numbered from 0")
        if not fault.ohms >= 0:
            raise ValueError(f"{fault}: ohms must be 0 or more; infinite for an open cell")
        return
    line = fault.line
    if line not in layout.lines:
        raise ValueError(f"{fault}: {line} is not a wire of {layout}")
    special = {StuckBit: ("row_address", "column_address"), StuckConverter: ("converter",)}
    kinds = special.get(type(fault), ("row", "column"))
    if line.kind not in kinds:
        raise ValueError(
            f"{fault}: this fault sits on a {' or '.join(kinds)}, not on a {line.kind}"
        )
    along = layout.cols if line.kind == "row" else layout.rows
    match fault:
        case CutLine(_, before, end) if not 0 <= before <= along or end not in ("first", "last"):
            raise ValueError(
                f"{fault}: cut before position 0 to {along}, driven from 'first' or 'last'"
            )
        case ShortedLine(to=to) if to not in ("supply", "ground"):
            raise ValueError(f"{fault}: shorted to 'supply' or 'ground'")
        case BridgedLines() if line.index + 1 >= (
            layout.rows if line.kind == "row" else layout.cols
        ):
            raise ValueError(f"{fault}: {line} is the last of its kind; name the one before it")
        case BridgedLines(_, float(ohms)) | ShortedLine(ohms=float(ohms)) if not ohms > 0:
            raise ValueError(f"{fault}: ohms must be positive; None for short_ohms")
        case StuckBit(_, level) if level not in (0, 1):
            raise ValueError(f"{fault}: a bit sticks at level 0 or 1")
        case StuckConverter(_, value) if not np.isfinite(value):
            raise ValueError(f"{fault}: the value must be finite, in {layout.unit}")
