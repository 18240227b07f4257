"""What is known of a robot's cells over all logs so far: a dead cell stays dead until it has proven life again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from diagnostics import Diagnosis, Fault, FaultKind, FaultSet, Verdict

SCHEMA = "adaptfault.knowledge/1"

# In how many logs a faulty cell has to be ALIVE, with none in between that calls it faulty, until it is believed.
_PROOFS = 3
_PROOFS_BLINKING = 6  # a loose contact is fine most of the time


@dataclass(frozen=True)
class Knowledge:
    """What is known of the cells.

    Attributes:
        n_cells: D.
        faults: one for each root cause that still has cells.
        proofs: for a faulty cell, in how many logs since it was alive.
    """

    n_cells: int
    faults: tuple[Fault, ...] = ()
    proofs: Mapping[int, int] = field(default_factory=dict)

    @property
    def fault_set(self) -> FaultSet:
        """F, the cells not to be used."""
        return FaultSet(tuple({cell for fault in self.faults for cell in fault.cells}), self.n_cells)

    def merged(self, diagnosis: Diagnosis) -> Knowledge:
        """Return what is known after one more log.

        New faults count at once. A faulty cell that the log shows alive has one proof more; with three of them (six if
        it blinked) it has recovered. One that the log did not test stays as it is.
        """
        now = diagnosis.fault_set
        alive = FaultSet(tuple(np.flatnonzero(diagnosis.verdicts == Verdict.ALIVE).tolist()), self.n_cells)
        proofs = {cell: self.proofs.get(cell, 0) + (cell in alive) for cell in self.fault_set - now}
        kept = []
        for fault in self.faults:
            needed = _PROOFS_BLINKING if fault.kind is FaultKind.INTERMITTENT else _PROOFS
            cells = tuple(cell for cell in fault.cells if cell not in now and proofs[cell] < needed)
            if cells:
                kept.append(fault if cells == fault.cells else replace(fault, cells=cells))
        merged = Knowledge(self.n_cells, (*diagnosis.faults, *kept))
        return replace(merged, proofs={cell: n for cell, n in proofs.items() if n and cell in merged.fault_set})

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        return {
            "schema": SCHEMA,
            "n_cells": self.n_cells,
            "faults": [fault.to_dict() for fault in self.faults],
            "proofs": {str(cell): n for cell, n in self.proofs.items()},
        }

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> Knowledge:
        """Rebuild it.

        Raises:
            ValueError: another schema.
        """
        if d.get("schema") != SCHEMA:
            raise ValueError(f"expected schema {SCHEMA!r}, got {d.get('schema')!r}")
        proofs = {int(cell): n for cell, n in d["proofs"].items()}
        return cls(d["n_cells"], tuple(Fault.from_dict(f) for f in d["faults"]), proofs)
