"""Converts raw counts to newtons with one table a cell and linear interpolation (Section VI-C)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.data.atomic import atomic_write
from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.layout_file import MOST_CELLS
from adaptfault.data.recordings.formats.text import numbered_lines, read_text
from diagnostics import SensorLayout

_BLOCK = 4096
"""Frames converted at a time: a block that fits the cache is transposed faster."""


_MOST_POINTS = 50_000_000  # of a padded table [D, P], which takes 16 bytes a point


@dataclass(frozen=True, eq=False)
class OutOfRange:
    """The number of readings outside each cell's table, which were clamped to its ends.

    Attributes:
        below, above: int ``[D]``.
    """

    below: NDArray[np.int64]
    above: NDArray[np.int64]

    @property
    def total(self) -> int:
        """The number of readings clamped, over all cells."""
        return int(self.below.sum() + self.above.sum())


@dataclass(frozen=True, eq=False)
class Calibration:
    """One table a cell: at ``raw`` counts the cell was loaded with ``force`` newtons.

    Rows are padded with NaN where a cell has fewer points. A cell without any point reads 0 N: only
    positions where the layout has no cell may go without, see :meth:`check`.

    Attributes:
        raw: float64 ``[D, P]``, strictly increasing along each row.
        force: float64 ``[D, P]``, in newton, never decreasing along each row.

    Raises:
        ValueError: other shapes; a cell with one point; points that are infinite, or not in that
            order.
    """

    raw: NDArray[np.float64]
    force: NDArray[np.float64]

    def __post_init__(self) -> None:
        raw = np.array(self.raw, dtype=np.float64)
        force = np.array(self.force, dtype=np.float64)
        if raw.ndim != 2 or raw.shape != force.shape:
            raise ValueError(
                f"expected raw and force of one shape [D, P], got {list(raw.shape)} and"
                f" {list(force.shape)}"
            )
        for cell, (counts, newtons) in enumerate(zip(raw, force, strict=True)):
            points = int((~np.isnan(counts)).sum())
            for name, values in (("raw", counts), ("force", newtons)):
                if np.isnan(values[:points]).any() or not np.isnan(values[points:]).all():
                    raise ValueError(
                        f"cell {cell}: NaN in {name} may only pad the end, in raw and force alike"
                    )
            if points == 1:
                raise ValueError(f"cell {cell}: 1 point; a table needs at least 2")
            if problem := _disorder(counts[:points], newtons[:points]):
                raise ValueError(f"cell {cell}: {problem}")
        for name, table in (("raw", raw), ("force", force)):
            table.setflags(write=False)
            object.__setattr__(self, name, table)

    @property
    def n_cells(self) -> int:
        """D, the number of cells."""
        return int(self.raw.shape[0])

    @property
    def calibrated(self) -> NDArray[np.bool_]:
        """Bool ``[D]``: which cells have a table."""
        return np.asarray((~np.isnan(self.raw)).any(axis=1))

    @property
    def full_scale(self) -> float:
        """The largest force in any table, in newton."""
        return float(np.nanmax(self.force)) if self.calibrated.any() else 0.0

    def check(self, layout: SensorLayout) -> None:
        """Raise ValueError unless there is a table for each cell that ``layout`` has."""
        if self.n_cells != layout.n_cells:
            raise ValueError(
                f"tables for {self.n_cells} cells, but the layout has {layout.n_cells}"
            )
        if (lacking := np.flatnonzero(layout.is_cell & ~self.calibrated)).size:
            raise ValueError(
                f"cell {lacking[0]} has no table ({lacking.size} cells have none); calibrate it"
            )

    def apply(self, counts: ArrayLike) -> tuple[NDArray[np.float32], OutOfRange]:
        """Return newtons, float32 of the shape of ``counts`` (``[T, D]`` or ``[D]``), and the
        clamped readings.

        Readings outside a cell's table get the force at its end. NaN stays NaN.

        Raises:
            ValueError: the last axis is not D.
        """
        counts = np.asarray(counts)
        if counts.ndim not in (1, 2) or counts.shape[-1] != self.n_cells:
            raise ValueError(
                f"expected counts [T, {self.n_cells}] or [{self.n_cells}], got {list(counts.shape)}"
            )
        frames = np.atleast_2d(counts)
        newtons = np.empty(frames.shape, dtype=np.float32)
        below, above = np.zeros((2, self.n_cells), dtype=np.int64)
        for start in range(0, len(frames), _BLOCK):
            # [D, block]
            cells = np.array(frames[start : start + _BLOCK].T, dtype=np.float64, order="C")
            forces = np.zeros(cells.shape, dtype=np.float32)
            for cell, raw, force in self._tables:
                forces[cell] = np.interp(cells[cell], raw, force)
                below[cell] += np.count_nonzero(cells[cell] < raw[0])
                above[cell] += np.count_nonzero(cells[cell] > raw[-1])
            newtons[start : start + _BLOCK] = forces.T
        return newtons.reshape(counts.shape), OutOfRange(below, above)

    def invert(self, newtons: ArrayLike) -> NDArray[np.float64]:
        """Return counts at which :meth:`apply` gives these newtons ``[D]``; of several, any. 0
        without a table."""
        forces = np.asarray(newtons, dtype=np.float64)
        counts = np.zeros(self.n_cells)
        for cell, raw, force in self._tables:
            counts[cell] = np.interp(forces[cell], force, raw)
        return counts

    @cached_property
    def _tables(self) -> list[tuple[int, NDArray[np.float64], NDArray[np.float64]]]:
        """The calibrated cells and their points without the padding."""
        points = (~np.isnan(self.raw)).sum(axis=1)
        return [
            (int(c), self.raw[c, : points[c]], self.force[c, : points[c]])
            for c in np.flatnonzero(points)
        ]

    @classmethod
    def read(cls, path: str | PathLike[str], layout: SensorLayout | None = None) -> Calibration:
        """Read a CSV table with the header ``cell,raw,force``: one line a point, in any order.

        Args:
            path: the table.
            layout: the array, each cell of which must have a table. None: cells run from 0 to the
                highest named.

        Raises:
            InputError: the file cannot be read, or a line or a cell is wrong; named.
        """
        path = Path(path)
        return cls.decode(path, read_text(path), layout)

    @classmethod
    def decode(cls, path: Path, text: str, layout: SensorLayout | None = None) -> Calibration:
        """Return the table in a text; ``path`` names it in the errors of :meth:`read`."""
        points = _points(path, text)
        highest = max(points)
        width = highest + 1 if layout is None else layout.n_cells
        if highest >= width:
            line = points[highest][0][2]
            raise InputError.at(
                path, f"cell {highest}, but the layout has {width} cells, from 0", f"line {line}"
            )
        most = max(map(len, points.values()))
        if width * most > _MOST_POINTS:
            what = (
                f"{most} points of one cell and {width} cells need a table of over {_MOST_POINTS:,}"
                " points; thin them"
            )
            raise InputError.at(path, what)
        raw = np.full((width, most), np.nan)
        force = raw.copy()
        for cell, rows in points.items():
            _check_rows(path, cell, rows)
            raw[cell, : len(rows)] = [row[0] for row in rows]
            force[cell, : len(rows)] = [row[1] for row in rows]
        wanted = np.ones(width, bool) if layout is None else layout.is_cell
        if (lacking := np.flatnonzero(wanted & np.isnan(raw[:, 0]))).size:
            what = f"cell {lacking[0]} has no points ({lacking.size} cells have none); calibrate it"
            raise InputError.at(path, what)
        return cls(raw, force)

    def write(self, path: str | PathLike[str]) -> None:
        """Write the table so that :meth:`read` returns the same values. OSError if the file cannot
        be written."""
        atomic_write(path, self.encode())

    def encode(self) -> bytes:
        """Return the content of the file that :meth:`write` writes."""
        lines = ["cell,raw,force"]
        for cell, raw, force in self._tables:
            lines += (
                f"{cell},{r!r},{f!r}" for r, f in zip(raw.tolist(), force.tolist(), strict=True)
            )
        text = "\n".join(lines) + "\n"
        return text.encode()


_Point = tuple[float, float, int]
"""Raw count, force, line in the file."""


def _disorder(raw: NDArray[np.float64], force: NDArray[np.float64]) -> str:
    """Return what is wrong with the points of one cell; empty if nothing is."""
    if not (np.isfinite(raw).all() and np.isfinite(force).all()):
        return "a point is infinite"
    if (steps := np.flatnonzero(np.diff(raw) <= 0)).size:
        i = steps[0]
        return f"raw must increase from point to point, but {raw[i + 1]:g} comes after {raw[i]:g}"
    if (steps := np.flatnonzero(np.diff(force) < 0)).size:
        i = steps[0]
        return (
            f"force falls from {force[i]:g} to {force[i + 1]:g} while raw rises from {raw[i]:g} to"
            f" {raw[i + 1]:g}"
        )
    return ""


def _check_rows(path: Path, cell: int, rows: Sequence[_Point]) -> None:
    """Raise InputError, with the line, unless the sorted points of a cell make a table."""
    if len(rows) == 1:
        raise InputError.at(
            path, f"cell {cell} has 1 point; a table needs at least 2", f"line {rows[0][2]}"
        )
    for before, after in pairwise(rows):
        pair = (np.array(values) for values in zip(before[:2], after[:2], strict=True))
        if problem := _disorder(*pair):
            where = f"line {max(before[2], after[2])}"
            raise InputError.at(
                path,
                f"cell {cell}: {problem} (line {min(before[2], after[2])}); measure it again",
                where,
            )


def _points(path: Path, text: str) -> dict[int, list[_Point]]:
    """Return the points of each cell that the text of a file names, by raw count."""
    lines, numbers = numbered_lines(text)
    header = [name.strip().strip('"').casefold() for name in lines[0].split(",")] if lines else []
    if header != ["cell", "raw", "force"]:
        where = f"line {numbers[0] if numbers else 1}"
        raise InputError.at(
            path, "expected a first line 'cell,raw,force', separated by commas; add it", where
        )
    points: dict[int, list[_Point]] = {}
    for line, number in zip(lines[1:], numbers[1:], strict=True):
        where = f"line {number}"
        cells = line.split(",")
        if len(cells) != 3:
            raise InputError.at(path, f"{len(cells)} values, expected 3: cell,raw,force", where)
        try:
            cell = int(cells[0])
            raw = float(cells[1])
            force = float(cells[2])
        except ValueError:
            raise InputError.at(
                path, "expected three numbers: cell (whole), raw, force (newton); correct it", where
            ) from None
        if not (np.isfinite(raw) and np.isfinite(force)):
            raise InputError.at(path, "raw and force must be finite; remove the line", where)
        if not 0 <= cell < MOST_CELLS:
            raise InputError.at(path, f"cell {cell}: cells are numbered from 0; correct it", where)
        points.setdefault(cell, []).append((raw, force, number))
    if not points:
        raise InputError.at(path, "holds no points; write cell,raw,force in each line")
    return {cell: sorted(rows) for cell, rows in sorted(points.items())}
