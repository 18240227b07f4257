"""The protocol of the evidence terms of constant cells: what they are given, and what they return.

A term returns log P(constant run | faulty) - log P(constant run | healthy) of each cell, 0 where it
does not tell. Terms with a reference: :mod:`~diagnostics.evidence.jumps`,
:mod:`~diagnostics.evidence.lower_limit`,
:mod:`~diagnostics.evidence.noise_loss`, :mod:`~diagnostics.evidence.pad_level`; without one:
:mod:`~diagnostics.evidence.rest_level`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import CERTAIN_RATIO, MAJORITY, SUSPICIOUS

if TYPE_CHECKING:
    from diagnostics.events.constant_runs import ConstantRuns
    from diagnostics.layout import SensorLayout

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ConstantCells:
    """What a term is given.

    Attributes:
        layout: the array.
        full_scale, tolerance: in the layout's unit; readings within +- tolerance of a value count
        as that value.
        runs: the constant runs.
        rests: bool ``[D]``, cells whose run lies at their baseline.
        lower: by how much all cells at rest read less than ever in the reference, 0 or below.
    """

    layout: SensorLayout
    full_scale: float
    tolerance: float
    runs: ConstantRuns
    rests: Mask
    lower: float = 0.0

    @property
    def present(self) -> Mask:
        """bool ``[D]``, where there is a cell."""
        return self.layout.present.ravel()


class Term(Protocol):
    """A term of evidence of constant cells."""

    def evidence(self, cells: ConstantCells) -> Floats:
        """Return the log likelihood ratio faulty : healthy, ``[D]``."""


def untouched_evidence(
    unusual: NDArray[np.bool_],
    broken: NDArray[np.bool_],
    as_ever: NDArray[np.bool_],
    present: NDArray[np.bool_],
) -> Floats:
    """Return the log likelihood ratio fault : healthy of cells without contact, ``[D]``: 12, -3 or
    0.

    All are 0 where more than half of the cells are unusual.

    Args:
        unusual: bool ``[D]``, cells that behave as they never did in the reference.
        broken: bool ``[D]``, those of them that only a fault explains: 12.
        as_ever: bool ``[D]``, cells that behave as ever, unlike broken ones: -3.
        present: bool ``[D]``.
    """
    if unusual.sum() > MAJORITY * present.sum():
        return np.zeros(len(present))
    return np.where(broken, CERTAIN_RATIO, np.where(as_ever, -SUSPICIOUS, 0.0))
