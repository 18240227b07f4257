"""Coverage: which cells a log has tested, and where to press to test the others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout


_NAMED = 8  # cells of a group that are named: a size


@dataclass(frozen=True)
class Coverage:
    """Coverage of a log, in the terms of integrated-circuit testing (Bushnell and Agrawal 2000).

    Attributes:
        fault_coverage: estimated share of the faulty cells that are in F, 0 to 1: (sum of P(faulty) over F + test
            coverage) / (sum of P(faulty) over all cells + 1). The 1 is a pseudo-count of one fault anywhere: a log that
            tests nothing has coverage 0, one that tests all cells and finds no fault has 1.
        test_coverage: share of the cells with a verdict other than UNTESTED, 0 to 1.
        untested: int ``[u]``, indices of the cells without a verdict.
        advice: where to press to test them, one sentence per region, the largest first.
    """

    fault_coverage: float
    test_coverage: float
    untested: NDArray[np.intp]
    advice: tuple[str, ...]

    def __str__(self) -> str:
        tested, others = f"{percent(self.test_coverage)}% of the cells tested", len(self.untested)
        if not others:
            return tested
        return f"{tested}; a fault of the other {'cell' if others == 1 else f'{others} cells'} would not be found"


def percent(share: float) -> int:
    """Return a share from 0 to 1 as whole percent; 100 only where nothing is missing."""
    return min(round(100 * share), 100 if share >= 1 else 99)


def coverage(
    untested: NDArray[np.bool_], faulty: NDArray[np.bool_], probability: NDArray[np.float64], layout: SensorLayout
) -> Coverage:
    """Return the coverage of a diagnosis.

    Args:
        untested: bool ``[D]``, cells without a verdict.
        faulty: bool ``[D]``, the cells in F.
        probability: float ``[D]``, P(faulty).
        layout: the array; positions without a cell do not count.
    """
    present = layout.present.ravel()
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
    """Return one sentence per connected region of untested cells, the largest first."""
    from scipy import ndimage

    regions: list[tuple[int, str]] = []
    if not layout.is_matrix:
        return _advice_by_group(untested, layout)
    region_of = layout.connected(untested)
    sizes = np.bincount(region_of).tolist()
    for i, (pad, rows, cols) in enumerate(ndimage.find_objects(layout.grid(region_of)), start=1):
        where = f"pad {pad.start}, {_span('row', rows)}, {_span('column', cols)}"
        regions.append((sizes[i], f"press {where} ({sizes[i]} {'cell' if sizes[i] == 1 else 'cells'} untested)"))
    return tuple(text for _, text in sorted(regions, key=lambda region: -region[0]))


def where(cells: NDArray[np.intp], layout: SensorLayout) -> str:
    """Return the place of neighbouring cells of one pad in words: the rows and columns around them, or their names."""
    if not layout.is_matrix:
        named = [layout.place(cell) for cell in cells.tolist()]
        return ", ".join(named[:_NAMED]) + ", ..." * (len(named) > _NAMED)
    pad, row, col = np.array([layout.position(cell) for cell in cells.tolist()]).T
    rows, cols = (slice(int(at.min()), int(at.max()) + 1) for at in (row, col))
    return f"pad {pad[0]}, {_span('row', rows)}, {_span('column', cols)}"


def _advice_by_group(untested: NDArray[np.bool_], layout: SensorLayout) -> tuple[str, ...]:
    """Return one sentence per group, or pad, with untested cells, the one with most first."""
    cells: dict[str, list[int]] = {}
    for cell in np.flatnonzero(untested).tolist():
        cells.setdefault(layout.place(cell).rpartition(", ")[0], []).append(cell)
    named = {
        where: ", ".join(map(str, some[:_NAMED])) + ", ..." * (len(some) > _NAMED) for where, some in cells.items()
    }
    return tuple(
        f"press {where}, {'cell' if len(cells[where]) == 1 else 'cells'} {named[where]} ({len(cells[where])} untested)"
        for where in sorted(cells, key=lambda where: -len(cells[where]))
    )


def _span(name: str, span: slice) -> str:
    return f"{name} {span.start}" if span.stop - span.start == 1 else f"{name}s {span.start}-{span.stop - 1}"
