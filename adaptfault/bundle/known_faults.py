"""Known faults over all logs: a faulty cell stays faulty until several logs in a row show it
alive."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.documents import check_schema
from diagnostics import Diagnosis, Fault, FaultKind, FaultSet, Verdict

SCHEMA = "adaptfault.knowledge/1"

# A faulty cell recovers after it is ALIVE in so many logs with none in between that finds it
# FAULTY.
_ALIVE_LOGS = 3
_ALIVE_LOGS_INTERMITTENT = 6  # a loose contact works most of the time


@dataclass(frozen=True)
class KnownFaults:
    """The faults of one sensor, as known from all logs so far.

    Attributes:
        n_cells: D.
        faults: one for each root cause that still has faulty cells.
        proofs: number of logs that show a faulty cell alive since the last log that found it
            faulty.
    """

    n_cells: int
    faults: tuple[Fault, ...] = ()
    proofs: Mapping[int, int] = field(default_factory=dict)

    @property
    def fault_set(self) -> FaultSet:
        """F, the cells that a classifier must not use."""
        return FaultSet.of([cell for fault in self.faults for cell in fault.cells], self.n_cells)

    def merged(self, diagnosis: Diagnosis) -> KnownFaults:
        """Return the known faults after one more log.

        New faults are added at once. A known faulty cell recovers after three logs that show it
        alive (six for an intermittent fault). A log that does not test the cell changes nothing.
        """
        now = diagnosis.fault_set
        alive = FaultSet.of(diagnosis.verdicts == Verdict.ALIVE, self.n_cells)
        proofs = {cell: self.proofs.get(cell, 0) + (cell in alive) for cell in self.fault_set - now}
        kept = []
        for fault in self.faults:
            needed = (
                _ALIVE_LOGS_INTERMITTENT if fault.kind is FaultKind.INTERMITTENT else _ALIVE_LOGS
            )
            cells = tuple(cell for cell in fault.cells if cell not in now and proofs[cell] < needed)
            if cells:
                kept.append(fault if cells == fault.cells else replace(fault, cells=cells))
        merged = KnownFaults(self.n_cells, (*diagnosis.faults, *kept))
        return replace(
            merged, proofs={cell: n for cell, n in proofs.items() if n and cell in merged.fault_set}
        )

    def without(self, cells: NDArray[np.bool_]) -> KnownFaults:
        """Return the faults of the other cells; ``cells`` (bool ``[D]``) were replaced."""
        kept = [
            replace(f, cells=left)
            for f in self.faults
            if (left := tuple(c for c in f.cells if not cells[c]))
        ]
        return replace(
            self, faults=tuple(kept), proofs={c: n for c, n in self.proofs.items() if not cells[c]}
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        return {
            "schema": SCHEMA,
            "n_cells": self.n_cells,
            "faults": [fault.to_dict() for fault in self.faults],
            "proofs": {str(cell): n for cell, n in self.proofs.items()},
        }

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> KnownFaults:
        """Rebuild from :meth:`to_dict`.

        Raises:
            ValueError: another schema.
        """
        check_schema(d, SCHEMA)
        proofs = {int(cell): n for cell, n in d["proofs"].items()}
        return cls(d["n_cells"], tuple(Fault.from_dict(f) for f in d["faults"]), proofs)
