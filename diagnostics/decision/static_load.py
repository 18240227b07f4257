"""An object that lies still, as a diagnosis tells it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.decision.coverage import where

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

Cells = NDArray[np.intp]


@dataclass(frozen=True)
class StaticLoad:
    """An object or a strap that lies still on some cells: neither these are faulty, nor does the
    log test them.

    Attributes:
        cells: ascending.
        probability: P(object), against faults of these cells.
        onset: number of its first frame, about; None: from the start.
        reason: one plain sentence.
    """

    cells: tuple[int, ...]
    probability: float
    onset: int | None
    reason: str

    @classmethod
    def on(cls, cells: Cells, probability: float, since: int, layout: SensorLayout) -> StaticLoad:
        """Return the load with its sentence."""
        n = len(cells)
        from_when = f"since about frame {since}" if since else "from the start"
        reason = (
            f"something lies still on {where(cells, layout)} {from_when} ({n} cells, P ="
            f" {probability:.2f}); these cells are not tested: remove it and record again"
        )
        return cls(tuple(cells.tolist()), probability, since or None, reason)

    def of(self, order: Cells, layout: SensorLayout) -> StaticLoad:
        """Return the same load with cell i at ``order[i]`` of a layout."""
        return self.on(
            np.unique(order[list(self.cells)]), self.probability, self.onset or 0, layout
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        return {**asdict(self), "cells": list(self.cells)}

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> StaticLoad:
        """Rebuild from :meth:`to_dict`."""
        return cls(tuple(d["cells"]), d["probability"], d["onset"], d["reason"])
