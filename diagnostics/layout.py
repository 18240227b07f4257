"""The shape of a tactile array, and the wires or named groups that serve its cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from diagnostics.positions import Positions
from diagnostics.wiring import Line, LineKind, members, nested

Wiring = Literal["matrix", "bus"]
Rest = Literal["low", "high", "middle", "learn"]

SCHEMA = "adaptfault.layout/1"

_MOST_CELLS = 10_000_000  # larger sizes are errors of a file


@dataclass(frozen=True, eq=False)
class SensorLayout(Positions):
    """A tactile array: ``pads`` arrays of ``rows`` x ``cols`` cells, by default behind row and
    column multiplexers.

    A cell's index runs pad, then row, then column (C order of ``[pads, rows, cols]``). Positions
    where ``present`` is False hold no sensing element (a masked corner); they keep their index, so
    that D is always ``pads * rows * cols``, and take no part in fitting or diagnosis.

    Args:
        pads, rows, cols: size, each at least 1. The paper's 11 x 10 pad has 11 rows here (Section
        III-A, H = 11).
        full_scale: the largest value a cell can report, in ``unit``; the smallest is 0.
        unit: name of the unit of recordings.
        rate: frames per second.
        present: bool ``[pads, rows, cols]`` (or flat ``[D]``); None means every position is a cell.
        wiring: ``"matrix"``: each pad has row and column wires; ``"bus"``: each pad is one bus,
            without rows and columns.
        groups: cells that share a fate, as a chip, triangle, patch, board or connector: lists of
            cells or of the names of other groups, by name. Two groups are disjoint, or one contains
            the other. With groups, causes are groups and cells, and no rows or columns, whatever
            ``wiring`` says.
        axes: readings of one position, as 3 of a magnetic taxel. Each axis is a cell of its own; D
            is ``pads * rows * cols * axes``, and the axis runs last. A dead axis is a faulty cell,
            a dead position is one cause with all its axes. There are no rows and columns of wires
            then, and ``rest="learn"`` means ``"middle"``.
        rest: what a cell reads without load: ``"low"``: its lower end, and load raises it;
            ``"high"``: its upper end, and load lowers it; ``"middle"``: in between, and load moves
            it either way; ``"learn"``: whichever the healthy recordings show, ``"low"`` without
            any.
        names: what the recordings call each cell, ``[D]``, as "L_ch10"; None: they do not. Layouts
            with other names are equal.
        device: which specimen it is, as a serial number or the name of the robot; None: unknown, or
            several. Layouts of other devices are equal.

    Raises:
        ValueError: a size below 1, a full scale or rate that is not positive, ``present`` of
            another shape, an unknown ``wiring`` or ``rest``, groups that overlap without nesting or
            name what is not there.
    """

    pads: int
    rows: int
    cols: int
    full_scale: float = field(default=5.0, kw_only=True)
    unit: str = field(default="N", kw_only=True)
    rate: float = field(default=10.0, kw_only=True)
    present: NDArray[np.bool_] = field(default=None, kw_only=True, repr=False)  # type: ignore[arg-type]
    wiring: Wiring = field(default="matrix", kw_only=True)
    groups: Mapping[str, Sequence[int | str]] | None = field(default=None, kw_only=True, repr=False)
    axes: int = field(default=1, kw_only=True)
    rest: Rest = field(default="learn", kw_only=True)
    names: Sequence[str] | None = field(default=None, kw_only=True, repr=False)
    device: str | None = field(default=None, kw_only=True, repr=False)

    def __post_init__(self) -> None:
        for name in ("pads", "rows", "cols", "axes"):
            size = getattr(self, name)
            if not isinstance(size, int | np.integer) or isinstance(size, bool) or size < 1:
                raise ValueError(f"a layout needs {name} >= 1, a whole number; got {size!r}")
            object.__setattr__(self, name, int(size))
        for name in ("full_scale", "rate"):
            number = float(getattr(self, name))
            if not (np.isfinite(number) and number > 0):
                raise ValueError(f"a layout needs {name} > 0; got {getattr(self, name)!r}")
            object.__setattr__(self, name, number)
        if self.n_cells > _MOST_CELLS:
            raise ValueError(f"a layout has at most {_MOST_CELLS:,} cells; got {self.n_cells:,}")
        if not isinstance(self.unit, str) or not self.unit.isprintable():
            raise ValueError(f"a layout needs the name of a unit; got {self.unit!r}")
        present = (
            np.ones(self.shape, bool) if self.present is None else np.array(self.present, bool)
        )
        if self.axes > 1 and present.size * self.axes == self.n_cells:
            present = np.repeat(present.ravel(), self.axes)
        if present.size != self.n_cells:
            raise ValueError(
                f"present has shape {present.shape}, the layout {self.shape}: give one bool for"
                " each position"
            )
        present = present.reshape(self.shape)
        if not present.any():
            raise ValueError("present is False everywhere: a layout needs at least one cell")
        present.setflags(write=False)
        object.__setattr__(self, "present", present)
        for name, choices in (("wiring", get_args(Wiring)), ("rest", get_args(Rest))):
            if getattr(self, name) not in choices:
                also = (
                    "; groups of cells are given as groups={name: cells}"
                    if name == "wiring"
                    else ""
                )
                raise ValueError(
                    f"{name} is one of {', '.join(choices)}; got {getattr(self, name)!r}{also}"
                )
        if self.device is not None and not (_is_name(self.device) and self.device):
            raise ValueError(f"device: expected a printable name; got {self.device!r}")
        if self.names is not None:
            names = tuple(self.names)
            if len(names) != self.n_cells or not all(map(_is_name, names)):
                raise ValueError(f"names: expected {self.n_cells} printable texts, one a cell")
            object.__setattr__(self, "names", names)
        if self.groups is not None:
            members_of = members(self.groups, self.n_cells)
            object.__setattr__(
                self,
                "groups",
                {
                    name: tuple(x if isinstance(x, str) else int(x) for x in self.groups[name])
                    for name in members_of
                },
            )
        _ = self._wires  # raises ValueError for groups that overlap

    @classmethod
    def paper(cls) -> SensorLayout:
        """The paper's sensor: 2 pads of 11 x 10 cells, 0..5 N, 10 Hz (Section II)."""
        return cls(2, 11, 10)

    @cached_property
    def lines(self) -> tuple[Line, ...]:
        """Every wire a fault can sit on: rows, columns, address bits of both, one converter channel
        a pad.

        With declared wiring: the buses and groups, an inner group before those that contain it.
        """
        if not self.is_matrix:
            return tuple(self._wires)
        counts: dict[LineKind, int] = {
            "row": self.rows,
            "column": self.cols,
            "row_address": address_bits(self.rows),
            "column_address": address_bits(self.cols),
            "converter": 1,
        }
        return tuple(
            Line(pad, kind, i)
            for pad in range(self.pads)
            for kind, n in counts.items()
            for i in range(n)
        )

    @property
    def is_matrix(self) -> bool:
        """Whether the cells are read through rows and columns."""
        return self.wiring == "matrix" and self.groups is None and self.axes == 1

    @cached_property
    def _wires(self) -> dict[Line, NDArray[np.intp]]:
        """The cells of each bus and group, by line, an inner one before those that contain it."""
        size = self.rows * self.cols * self.axes
        served = {}
        if self.axes > 1:
            for cell in range(0, self.n_cells, self.axes):
                line = Line(cell // size, "position", cell % size // self.axes)
                served[line] = np.arange(cell, cell + self.axes)
        if self.wiring == "bus":
            served = {
                Line(pad, "bus", 0): np.arange(pad * size, (pad + 1) * size)
                for pad in range(self.pads)
            }
        if self.groups is not None:
            for i, (name, cells) in enumerate(members(self.groups, self.n_cells).items()):
                served[Line(int(cells[0]) // size, "group", i, name)] = cells
        return nested(served)

    @cached_property
    def _innermost(self) -> dict[int, Line]:
        return {cell: line for line in reversed(self._wires) for cell in self._wires[line].tolist()}

    def place(self, cell: int) -> str:
        """Return where a cell is, in words: "pad 0, row 4, column 5", or "triangle 7, cell 72" with
        declared wiring. The name that recordings give it comes behind: "pad 0, row 0, column 3
        (L_ch3)".

        With several axes: "pad 0, position 24, axis 2 (cell 74)".
        """
        name = "" if self.names is None else self.names[cell]
        return self._place(cell) + (f" ({name})" if name else "")

    def _place(self, cell: int) -> str:
        """Return where a cell is, without its name."""
        pad, row, col = self.position(cell)
        if self.is_matrix:
            return f"pad {pad}, row {row}, column {col}"
        if self.axes > 1:
            return (
                f"pad {pad}, position {row * self.cols + col}, axis {cell % self.axes} (cell"
                f" {cell})"
            )
        line = self._innermost.get(cell)
        return f"{line if line and line.kind == 'group' else f'pad {pad}'}, cell {cell}"

    def parts(self, line: Line) -> tuple[Line, ...]:
        """Return the groups directly within a bus or group that together hold all its cells; none
        if there are none."""
        own = set(self.cells_on(line).tolist())
        within: list[Line] = []
        for other in self.lines[: self.lines.index(line)][::-1]:
            cells = set(self.cells_on(other).tolist())
            if (
                cells
                and cells < own
                and not any(cells <= set(self.cells_on(w).tolist()) for w in within)
            ):
                within.append(other)
        whole = sum(len(self.cells_on(w)) for w in within) == len(own)
        return tuple(sorted(within)) if whole else ()

    def cells_on(self, line: Line) -> NDArray[np.intp]:
        """Return the present cells that ``line`` serves, ascending.

        An address bit and a converter channel serve their whole pad: every cell is selected and
        read through them. The cells that a *stuck* bit misreads are those of :meth:`misaddressed`.

        Raises:
            IndexError: the layout has no such line.
        """
        try:
            return self._served[line]
        except KeyError:
            raise IndexError(f"{line} is not a wire of {self}") from None

    @cached_property
    def _served(self) -> dict[Line, NDArray[np.intp]]:
        present = self.is_cell
        served = {}
        for line in self.lines:
            pad = self._grid[line.pad]
            cells = (
                pad[line.index]
                if line.kind == "row"
                else pad[:, line.index]
                if line.kind == "column"
                else pad
            )
            cells = self._wires.get(line, cells)
            served[line] = cells.ravel()[present[cells.ravel()]]
            served[line].setflags(write=False)
        return served

    def misaddressed(self, line: Line, level: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return which cells an address bit stuck at ``level`` misreads, and what is read instead.

        Returns ``(cells, sources)``, int arrays of the same length. A source of -1 is an address
        with nothing connected to it.
        """
        if line not in self._served or line.kind not in ("row_address", "column_address"):
            raise IndexError(f"{line} is not an address bit of {self}")
        bit = 1 << line.index
        by_row = line.kind == "row_address"
        wires = np.arange(self.rows if by_row else self.cols)
        selected = (wires | bit) if level else (wires & ~bit)
        pad = self._grid[line.pad] if by_row else self._grid[line.pad].T  # [wire, across]
        moved = wires != selected
        sources = np.where(
            (selected < len(wires))[:, None], pad[np.minimum(selected, len(wires) - 1)], -1
        )
        present = self.is_cell
        cells = pad[moved].ravel()
        sources = sources[moved].ravel()
        sources = np.where((sources >= 0) & present[np.maximum(sources, 0)], sources, -1)
        return cells[present[cells]], sources[present[cells]]

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe description that :meth:`from_dict` reads."""
        d: dict[str, Any] = {
            "schema": SCHEMA,
            "pads": self.pads,
            "rows": self.rows,
            "cols": self.cols,
        }
        d |= {"full_scale": self.full_scale, "unit": self.unit, "rate": self.rate}
        if not self.present.all():
            d["present"] = self.present.tolist()
        if self.groups is not None:
            d["groups"] = {name: list(of) for name, of in self.groups.items()}
        if self.names is not None:
            d["names"] = list(self.names)
        if self.device is not None:
            d["device"] = self.device
        # What differs from the default.
        return d | {
            name: getattr(self, name)
            for name, usual in _DEFAULTS.items()
            if getattr(self, name) != usual
        }

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> SensorLayout:
        """Build a layout from a dict with ``pads``, ``rows``, ``cols`` and the optional other
        fields.

        Raises:
            ValueError: a field is missing, unknown, or of a wrong kind; another schema.
        """
        if not isinstance(d, Mapping):
            raise ValueError(
                f"expected a layout, a dict with pads, rows and cols; got {str(d)[:60]}"
            )
        if d.get("schema", SCHEMA) != SCHEMA:
            raise ValueError(f"expected schema {SCHEMA!r}, got {d['schema']!r}")
        known = [one.name for one in fields(cls)]
        if unknown := set(d) - set(known) - {"schema"}:
            raise ValueError(
                f"a layout has no field {sorted(unknown, key=str)[0]!r}: use {', '.join(known)}"
            )
        if missing := [name for name in known[:3] if name not in d]:
            raise ValueError(f"a layout needs the field {missing[0]!r}")
        try:
            return cls(**{name: d[name] for name in known if name in d})
        except (TypeError, OverflowError) as error:
            raise ValueError(f"a field of the layout is of a wrong kind: {error}") from None

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SensorLayout):
            return NotImplemented
        return self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def __str__(self) -> str:
        masked = self.n_cells - int(self.present.sum())
        axes = f" x {self.axes} axes" if self.axes > 1 else ""
        text = (
            f"{self.pads} x {self.rows} x {self.cols} cells{axes}, 0..{self.full_scale:g}"
            f" {self.unit}, {self.rate:g} Hz"
        )
        return f"{text}, {masked} position{'s' if masked > 1 else ''} masked" if masked else text

    def _key(self) -> tuple[Any, ...]:
        groups = tuple((self.groups or {}).items())
        declared = tuple(getattr(self, name) for name in _DEFAULTS)
        return (
            *self.shape,
            self.full_scale,
            self.unit,
            self.rate,
            self.present.tobytes(),
            groups,
            *declared,
        )


_DEFAULTS = {"wiring": "matrix", "axes": 1, "rest": "learn"}


def _is_name(name: object) -> bool:
    return isinstance(name, str) and name.isprintable()


def address_bits(wires: int) -> int:
    """Return the number of address bits for ``wires`` lines: 4 for the paper's 11 rows and 10
    columns (Section II)."""
    return (wires - 1).bit_length()
