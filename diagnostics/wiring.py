"""Wires, and declared wiring: named groups of cells that share a fate, nested as chips on boards
behind a connector."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

Cells = NDArray[np.intp]
LineKind = Literal[
    "row", "column", "row_address", "column_address", "converter", "position", "bus", "group"
]

DECLARED = "position", "group", "bus"
"""Kinds of lines that are no wires of a matrix; of lines with the same cells, inside out."""

_ACTIONS = {
    "position": "check the chip and the solder joints of {}",
    "connector": "reseat {}",
    "bus": "check the cable and the connectors of {}",
    "board": "check the supply and the connector of {}",
    "patch": "check the connector of {}",
    "triangle": "check the solder joints and the supply of {}",
    "chip": "check the solder joints and the supply of {}",
}


@dataclass(frozen=True, order=True)
class Line:
    """One wire of a pad, or a group of cells that share a fate.

    ``kind`` is ``"row"`` or ``"column"`` (``index`` counts the wires), ``"row_address"`` or
    ``"column_address"`` (``index`` is the bit, 0 the least significant), ``"converter"`` (``index``
    0: each pad has one channel), ``"position"`` (all axes of one position, counted row by row),
    ``"bus"`` (``index`` 0: the pad is one bus) or ``"group"`` (``index`` counts the groups of the
    layout, ``name`` is that of the group, and ``pad`` the pad of its first cell).
    """

    pad: int
    kind: LineKind
    index: int
    name: str = ""

    def __post_init__(self) -> None:
        if self.kind not in get_args(LineKind):
            raise ValueError(
                f"unknown kind of line {self.kind!r}: use one of {', '.join(get_args(LineKind))}"
            )
        if not all(isinstance(n, int | np.integer) and n >= 0 for n in (self.pad, self.index)):
            raise ValueError(
                f"a line needs a pad and an index, whole and >= 0; got {self.pad!r} and"
                f" {self.index!r}"
            )

    def __str__(self) -> str:
        match self.kind:
            case "row_address":
                return f"pad {self.pad}, row address bit {self.index}"
            case "column_address":
                return f"pad {self.pad}, column address bit {self.index}"
            case "converter":
                return f"pad {self.pad}, converter channel"
            case "position":
                return f"pad {self.pad}, position {self.index}"
            case "bus":
                return f"pad {self.pad}, bus"
            case "group":
                return self.name or f"group {self.index}"
            case kind:
                return f"pad {self.pad}, {kind} {self.index}"


def members(groups: Any, n_cells: int) -> dict[str, Cells]:
    """Return the cells of each group, ascending, by name; a group comes after those that it names.

    Args:
        groups: lists of cells or of names of other groups, by name.
        n_cells: number of cells of the array.

    Raises:
        ValueError: not such a mapping, an empty group, a group that contains itself, a cell or a
            name that is not there.
    """
    if not isinstance(groups, Mapping) or not all(
        isinstance(name, str) and name for name in groups
    ):
        raise ValueError(
            f"groups are lists of cells or of names of groups, by name; got {str(groups)[:60]}"
        )
    found: dict[str, set[int]] = {}

    def cells_of(name: str, outer: tuple[str, ...]) -> set[int]:
        if name in outer:
            raise ValueError(f"group {name!r} contains itself: {' > '.join((*outer, name))}")
        if name not in found:
            given = groups[name]
            is_list = isinstance(given, Sequence | np.ndarray) and not isinstance(given, str)
            if not is_list or not len(given):
                raise ValueError(
                    f"group {name!r} needs a list of cells or of names of groups; got"
                    f" {str(given)[:60]}"
                )
            cells: set[int] = set()
            for item in given:
                cells |= (
                    cells_of(item, (*outer, name))
                    if isinstance(item, str) and item in groups
                    else {_cell(item)}
                )
            found[name] = cells
        return found[name]

    def _cell(item: Any) -> int:
        if isinstance(item, str):
            raise ValueError(
                f"a group names {item!r}, which is no group: use cells or"
                f" {', '.join(list(groups)[:5])}"
            )
        if (
            isinstance(item, bool)
            or not isinstance(item, int | np.integer)
            or not 0 <= item < n_cells
        ):
            raise ValueError(
                f"a group names cell {item!r}: use whole numbers from 0 to {n_cells - 1}"
            )
        return int(item)

    for name in groups:
        cells_of(name, ())
    return {name: np.array(sorted(cells), dtype=np.intp) for name, cells in found.items()}


def nested(served: Mapping[Line, Cells]) -> dict[Line, Cells]:
    """Return lines and their cells sorted from the inside out.

    Raises:
        ValueError: two lines overlap, and neither contains the other.
    """
    # Of two groups with the same cells the earlier one is the inner one.
    order = sorted(
        served, key=lambda line: (len(served[line]), DECLARED.index(line.kind), line.index)
    )
    inner: dict[int, Line] = {}
    for line in reversed(order):
        outer = {inner.get(cell) for cell in served[line].tolist()}
        if len(outer) > 1:
            names = {
                str(line),
                *(
                    str(o)
                    for o in outer
                    if o is not None and not set(served[line]) <= set(served[o])
                ),
            }
            one, other = sorted(names)[:2]
            raise ValueError(
                f"{one!r} and {other!r} overlap, and neither contains the other: nest them, or part"
                " them"
            )
        inner.update(dict.fromkeys(served[line].tolist(), line))
    return {line: served[line] for line in order}


def action(line: Line) -> str:
    """Return what to do about a dead bus or group: "reseat connector J3"."""
    return _ACTIONS.get(_word(line).lower(), "check the wiring of {}").format(line)


def counted(parts: Sequence[Line]) -> str:
    """Return the number of some groups, and what they are: "4 triangles"."""
    word, *others = sorted({_word(part).lower() for part in parts})
    word = (
        "groups"
        if others or not word
        else f"{word}{'es' if word.endswith(('s', 'h', 'x')) else 's'}"
    )
    return f"{len(parts)} {word}"


def _word(line: Line) -> str:
    match = re.match(r"[^\W\d_]+", line.name or line.kind)
    return match.group() if match else ""
