"""What the evidence says of each cell, before causes are sought."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diagnostics.faults import FaultKind
from diagnostics.preprocessing.levels import MAJORITY

# Of cells that move and are proved not to be alive.
REFUTED_KINDS = (
    FaultKind.FLOATING,
    FaultKind.INTERMITTENT,
    FaultKind.LATE,
    FaultKind.COPY,
    FaultKind.CLAMPED,
    FaultKind.WEAK,
)

# Those that a wire has which fails now and then, as one that opens under load.
OF_WIRES = REFUTED_KINDS[:2]

Cells = NDArray[np.intp]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CellFindings:
    """Findings about each cell, arrays ``[D]``; masks are bool.

    Attributes:
        faulty: certainly faulty cells.
        alive: cells that move as no dead cell does.
        silent: cells that deliver no reading, or no longer do.
        rests: constant cells at their baseline.
        full: constant cells at full scale, and not at their baseline.
        zero: constant cells at 0, and not at their baseline; None for sensors that rest low.
        typical: float, reading that is told of constant cells; None: ``value``.
        intermittent, noisy, drifting: cells that move, but wrongly.
        gain: float, gain relative to the reference of cells with a changed gain; NaN: others.
        value: float, reading (not load) of constant cells, and reading to which intermittent cells
            blink; NaN: none.
        since: int, number of the first frame of the fault.
        probability: float, P(faulty).
        weight: float, log likelihood ratio faulty : healthy.
        events: int, number of events that tested the cell, or number of its blinks.
        known: cells that were dead in the reference already.
        refuted: int, number in ``REFUTED_KINDS`` of cells that move and are proved not to be alive;
            -1: others.
        unsure: int, the same of cells that may have one of the ``OF_WIRES``; -1: others.
        wire: int, number of the proven wire of such a cell, from 0; -1: others.
        of_wire: float, P(this wire fails).
        share: float, of the contacts in which such a cell was dead.
        as_one: bool, cells that read as one with those of their wire, while it fails.
    """

    faulty: Mask
    alive: Mask
    silent: Mask
    rests: Mask
    full: Mask
    intermittent: Mask
    noisy: Mask
    drifting: Mask
    gain: Floats
    value: Floats
    since: Cells
    probability: Floats
    weight: Floats
    events: Cells
    known: Mask
    refuted: Cells
    unsure: Cells
    wire: Cells
    of_wire: Floats
    share: Floats
    as_one: Mask
    zero: Mask | None = None
    typical: Floats | None = None

    def of(self, cells: Cells) -> CellFindings:
        """Return the findings in the order of ``cells``."""
        return replace(
            self,
            **{name: values[cells] for name, values in vars(self).items() if values is not None},
        )

    def without(self, cells: Mask) -> CellFindings:
        """Return the findings without those about some cells, bool ``[D]``, which have readings but
        were not tested."""
        masks = ("faulty", "alive", "rests", "full", "zero", "intermittent", "noisy", "drifting")
        numbers = ("refuted", "unsure", "wire")
        found = {name: getattr(self, name) for name in (*masks, *numbers)}
        return replace(
            self,
            probability=np.where(cells, np.minimum(self.probability, MAJORITY), self.probability),
            **{name: found[name] & ~cells for name in masks if found[name] is not None},
            **{name: np.where(cells, -1, found[name]) for name in numbers},
        )
