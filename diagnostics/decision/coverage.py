"""Coverage: which cells a log has tested, and where to press to test the others."""

from __future__ import annotations

from collections.abc import Sequence, Sized
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.shown import shown

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout


_NAMED = 8  # cells of a group that are named: a size


@shown
@dataclass(frozen=True)
class Coverage:
    """Coverage of a log, in the terms of integrated-circuit testing (Bushnell and Agrawal 2000).

    Attributes:
        fault_coverage: estimated share of the faulty cells that are in F, 0 to 1: (sum of P(faulty)
            over F + test coverage) / (sum of P(faulty) over all cells + 1). The 1 is a pseudo-count
            of one fault anywhere: a log that tests nothing has coverage 0, one that tests all cells
            and finds no fault has 1.
        test_coverage: share of the cells with a verdict other than UNTESTED, 0 to 1.
        untested: int ``[u]``, indices of the cells without a verdict.
        advice: where to press to test them, one sentence per region, the largest first.
    """

    fault_coverage: float
    test_coverage: float
    untested: NDArray[np.intp]
    advice: tuple[str, ...]

    def __str__(self) -> str:
        tested = f"{percent(self.test_coverage)}% of the cells tested"
        others = len(self.untested)
        if not others:
            return tested
        return (
            f"{tested}; a fault of the other {'cell' if others == 1 else f'{others} cells'} would"
            " not be found"
        )


def percent(share: float) -> int:
    """Return a share from 0 to 1 as whole percent; 100 only where nothing is missing."""
    return min(round(100 * share), 100 if share >= 1 else 99)


def coverage(
    untested: NDArray[np.bool_],
    faulty: NDArray[np.bool_],
    probability: NDArray[np.float64],
    layout: SensorLayout,
) -> Coverage:
    """Return the coverage of a diagnosis.

    Args:
        untested: bool ``[D]``, cells without a verdict.
        faulty: bool ``[D]``, the cells in F.
        probability: float ``[D]``, P(faulty).
        layout: the array; positions without a cell do not count.
    """
    present = layout.is_cell
    tested = 1.0 - float(untested[present].mean())
    expected = float(probability[present].sum())
    found = float(probability[present & faulty].sum())
    return Coverage(
        fault_coverage=(found + tested) / (expected + 1.0),
        test_coverage=tested,
        untested=np.flatnonzero(untested & present),
        advice=_advice(untested & present, layout),
    )


def _advice(untested: NDArray[np.bool_], layout: SensorLayout) -> tuple[str, ...]:
    """Return one sentence per connected region of untested cells, or per group or pad, the largest
    first."""
    if layout.is_matrix:
        region_of = layout.connected(untested)
        regions = np.split(np.argsort(region_of, kind="stable"), np.cumsum(np.bincount(region_of)))[
            1:-1
        ]
        found = [
            (len(cells), f"{where(cells, layout)} ({len(cells)} {_cells(cells)} untested)")
            for cells in regions
        ]
    else:
        groups: dict[str, list[str]] = {}
        for cell in np.flatnonzero(untested).tolist():
            groups.setdefault(layout.place(cell).rpartition(", ")[0], []).append(str(cell))
        found = [
            (len(of), f"{group}, {_cells(of)} {_listed(of)} ({len(of)} untested)")
            for group, of in groups.items()
        ]
    return tuple(f"press {text}" for _, text in sorted(found, key=lambda region: -region[0]))


def where(cells: NDArray[np.intp], layout: SensorLayout) -> str:
    """Return the place of neighbouring cells of one pad in words: the rows and columns around them,
    or their names."""
    if not layout.is_matrix:
        return _listed([layout.place(cell) for cell in cells.tolist()])
    pad, row, col = np.unravel_index(cells, layout.shape)
    return f"pad {pad[0]}, {_span('row', row)}, {_span('column', col)}"


def _cells(cells: Sized) -> str:
    return "cell" if len(cells) == 1 else "cells"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED]) + ", ..." * (len(names) > _NAMED)


def _span(name: str, at: NDArray[np.intp]) -> str:
    first = at.min()
    last = at.max()
    return f"{name} {first}" if first == last else f"{name}s {first}-{last}"
