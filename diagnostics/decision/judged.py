"""What is known of each cell of a log, before root causes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnostics.decision.cell_findings import CellFindings
from diagnostics.decision.static_load import StaticLoad
from diagnostics.faults import Fault

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Judged:
    """What is known of each cell of a log, before root causes.

    Attributes:
        found: findings about each cell.
        aliases: causes of lines that read the same.
        shown: bool ``[D]``, cells that depend on the others as healthy ones do.
        evidence: by name, ``[D]``.
        still: objects that lie still.
        contradicting: share of the cells that contradict them, where nobody is blamed for it.
        pulled: returns the cells on lines that shorted crossings pull, bool ``[D]``, of these cells
            and of those that are faulty, bool ``[D]``; None: lines are not tested.
    """

    found: CellFindings
    aliases: Sequence[Fault]
    shown: Mask
    evidence: Mapping[str, NDArray[np.float64]]
    still: Sequence[StaticLoad] = ()
    contradicting: float = 0.0
    pulled: Callable[[NDArray[np.intp], Mask], Mask] | None = None
