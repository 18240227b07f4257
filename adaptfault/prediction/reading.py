"""What a predictor says of one frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnostics import Fault, FaultSet
from diagnostics.shown import shown


@shown
@dataclass(frozen=True, eq=False)
class Reading:
    """Result of one frame.

    Attributes:
        label: the class of the window that ends with this frame; None until a window is full, and
            of a regression.
        probabilities: float32 ``[n_classes]``; None where there is no label.
        fault_set: F, the cells that were not used.
        events: faults that are new, changed, or gone (probability 0).
        version: number of the version that computed the label, or the values.
        contact: float32 ``[n_classes]``, probabilities accumulated over the windows of the present
            contact; None without contact, or where the predictor does not accumulate.
        name: name of the class; None where there is no label, or classes have no names.
        faults: all faults that the monitor knows now, as :attr:`diagnostics.Monitor.faults`.
        classes: the set of classes that holds the true one as often as was asked for, ascending;
            None where there is no label, no sets were asked for, or the version has none.
        values: float32 ``[k]``, those of a regression for the window that ends with this frame;
            None until a window is full, and of a classifier.
    """

    label: int | None
    probabilities: NDArray[np.float32] | None
    fault_set: FaultSet
    events: tuple[Fault, ...]
    version: int
    contact: NDArray[np.float32] | None = None
    name: str | None = None
    faults: tuple[Fault, ...] = ()
    values: NDArray[np.float32] | None = None
    classes: tuple[int, ...] | None = None

    def __str__(self) -> str:
        confidence = "" if self.probabilities is None else f" ({self.probabilities.max():.2f})"
        named = self.name or f"class {self.label}"
        result = "window not full yet" if self.label is None else f"{named}{confidence}"
        if self.values is not None:
            result = f"values {', '.join(f'{value:.4g}' for value in self.values)}"
        news = "".join(f"; {event.reason}" for event in self.events)
        return f"{result}, {len(self.fault_set)} cells dropped, version {self.version}{news}"
