"""Coverage: what was tested, and which touches would test the rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout


@dataclass(frozen=True)
class Coverage:
    """How much of the array a log has put to the test, in the words of chip testing.

    Attributes:
        fault_coverage: estimated share of the faulty cells that were found: what P(faulty) sums to over the cells in
            F, out of what it sums to over all. One imaginary fault that may sit anywhere counts with them, found if
            its cell was tested: so a log that tests nothing has 0, and one that tests all and finds nothing has 1.
        test_coverage: share of the cells with a verdict other than UNTESTED.
        untested: int ``[u]``, the cells that neither proved alive nor faulty.
        advice: touches that would test them, one sentence a region, the largest first.
    """

    fault_coverage: float
    test_coverage: float
    untested: NDArray[np.intp]
    advice: tuple[str, ...]

    def __str__(self) -> str:
        return (
            f"{self.test_coverage:.0%} of the cells tested, an estimated {self.fault_coverage:.0%} of the faults found"
        )


def coverage(
    untested: NDArray[np.bool_], faulty: NDArray[np.bool_], probability: NDArray[np.float64], layout: SensorLayout
) -> Coverage:
    """Sum up a diagnosis.

    Args:
        untested: bool ``[D]``, cells without a verdict.
        faulty: bool ``[D]``, the cells in F.
        probability: float ``[D]``, P(faulty).
        layout: the array; positions without a cell count nowhere.
    """
    present = layout.present.ravel()
    tested = 1.0 - float(untested[present].mean())
    expected = float(probability[present].sum())
    found = float(probability[present & faulty].sum())
    return Coverage(
        fault_coverage=(found + tested) / (expected + 1.0),
        test_coverage=tested,
        untested=np.flatnonzero(untested & present),
        advice=_events(untested & present, layout),
    )


def _events(untested: NDArray[np.bool_], layout: SensorLayout) -> tuple[str, ...]:
    """Return one sentence for each connected region of untested cells: where to press."""
    from scipy import ndimage

    regions: list[tuple[int, str]] = []
    for pad, grid in enumerate(layout.grid(untested)):
        labelled, _ = ndimage.label(grid, structure=np.ones((3, 3)))
        sizes = np.bincount(labelled.ravel())
        for i, (rows, cols) in enumerate(ndimage.find_objects(labelled), start=1):
            size = int(sizes[i])
            where = f"pad {pad}, {_span('row', rows)}, {_span('column', cols)}"
            regions.append((size, f"press {where} ({size} {'cell' if size == 1 else 'cells'} untested)"))
    return tuple(text for _, text in sorted(regions, key=lambda region: -region[0]))


def _span(name: str, span: slice) -> str:
    return f"{name} {span.start}" if span.stop - span.start == 1 else f"{name}s {span.start}-{span.stop - 1}"
