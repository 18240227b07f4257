"""Runs somebody's own detector on the logs of the benchmark: any object with ``fit`` and
``detect``.

A detector is named as ``module:Name`` and is built without arguments. ``detect`` returns which
cells are faulty, so only rows that need no more than F are run for it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from adaptfault.bench.methods import DIAGNOSER, copies, find_method, of_each_cell
from diagnostics import Fault, FaultSet, SensorLayout

ROWS_OF_F = ("cells", "onset", "dither", "missing", "many", "healthy", "holds", "moving")
"""Rows that need no more than F."""

FIGURES_OF_F = (": precision", ": recall", ": false alarms")
"""How the names of their figures end that need no more than F."""


@dataclass(frozen=True)
class Found:
    """F as a detector found it, with the names that the rows read of a diagnosis.

    Attributes:
        layout: the array.
        faulty: bool ``[D]``.
    """

    layout: SensorLayout
    faulty: np.ndarray
    faults: tuple[Fault, ...] = ()
    possible: tuple[Fault, ...] = ()
    static_loads: tuple = ()

    @cached_property
    def fault_set(self) -> FaultSet:
        """F."""
        return FaultSet(tuple(np.flatnonzero(self.faulty).tolist()), self.layout.n_cells)

    @property
    def probability(self) -> np.ndarray:
        """1 in F, 0 elsewhere."""
        return self.faulty.astype(np.float64)

    @property
    def verdicts(self) -> np.ndarray:
        """None of any cell: a detector says no more than F."""
        return np.full(self.layout.n_cells, None)


class OwnMethod:
    """A detector in the place of :class:`diagnostics.SelfDiagnosis`.

    Args:
        name: ``module:Name``.
        layout: the array.
    """

    def __init__(self, name: str, layout: SensorLayout) -> None:
        self.name = name
        self.layout = layout
        self.detector = find_method(name, DIAGNOSER)()

    def fit(self, recordings: Iterable[np.ndarray]) -> OwnMethod:
        """Fit the detector to copies of healthy recordings."""
        self.detector.fit(copies(recordings), self.layout)
        return self

    def diagnose(self, log: Sequence[np.ndarray]) -> Found:
        """Return what the detector finds in a copy of a log. Positions without a cell are left out.

        Raises:
            ValueError: what it returns is no bool ``[D]``.
        """
        faulty = of_each_cell(self.detector.detect(copies(log)), self.name, "detect", self.layout)
        return Found(self.layout, faulty)


def needs_only_f(figure: str) -> bool:
    """Return whether a figure of the table needs no more than F, by its name."""
    return figure.endswith(FIGURES_OF_F)
