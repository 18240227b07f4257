"""Random faults of one shape: scattered cells as in the paper, whole lines, or rectangular
patches."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from diagnostics import SensorLayout

FaultPattern = Literal["cells", "lines", "blocks"]
_WIDEST = 4  # cells on a side of a block


class RandomFaults:
    """Draws faults that read 0 or full scale, each with equal chance.

    Args:
        layout: the array.
        kind: "cells" anywhere, whole "lines" (rows and columns of one pad) or "blocks" (up to 4 x 4
            cells, which may overlap).

    Attributes:
        most: the largest number of faults that can be drawn at once.

    Raises:
        ValueError: an unknown kind.
    """

    def __init__(self, layout: SensorLayout, kind: FaultPattern = "cells") -> None:
        if kind not in get_args(FaultPattern):
            raise ValueError(
                f"unknown kind {kind!r}: use one of {', '.join(get_args(FaultPattern))}"
            )
        self.layout = layout
        self.kind = kind
        self.cells = np.flatnonzero(layout.present)
        wires = [
            layout.cells_on(line)
            for line in layout.lines
            if line.kind in ("row", "column", "bus", "group")
        ]
        self.lines = [cells for cells in wires if len(cells)]
        self.most = len(self.lines if kind == "lines" else self.cells)

    def draw(self, k: int, rng: np.random.Generator) -> list[tuple[Any, Any]]:
        """Return cells and readings (0..1 scale) of k faults; scattered cells come as one pair of
        arrays."""
        values = rng.integers(0, 2, k).astype(np.float32)
        match self.kind:
            case "cells":
                return [(rng.choice(self.cells, k, replace=False), values)]
            case "lines":
                which = rng.choice(len(self.lines), k, replace=False)
                return [(self.lines[i], value) for i, value in zip(which, values, strict=True)]
            case _:
                return [(self._block(rng), value) for value in values]

    def _block(self, rng: np.random.Generator) -> NDArray[np.intp]:
        """Draw a patch around a random cell."""
        pad, row, col = self.layout.position(int(rng.choice(self.cells)))
        high, wide = rng.integers(1, _WIDEST + 1, 2)
        top = max(0, row - high // 2)
        left = max(0, col - wide // 2)
        pads = np.arange(self.layout.n_cells).reshape(self.layout.shape)
        return np.intersect1d(
            pads[pad, top : row + (high + 1) // 2, left : col + (wide + 1) // 2], self.cells
        )
