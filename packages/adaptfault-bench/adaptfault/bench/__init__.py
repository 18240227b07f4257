"""A bench that others can enter: frozen logs, the truth apart, one file a submission, a page of
results: ``python -m adaptfault.bench --help``."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics import SensorLayout

__all__ = ["Diagnoser", "Repairer"]


class Diagnoser(Protocol):
    """Finds faulty cells. It is built without arguments, once a sensor.

    It may also have ``untested() -> bool [D]``, True where the last log does not tell whether the
    cell works, and ``wires() -> [(pad, "row" or "column", index), ...]``, those broken in the last
    log.
    """

    def fit(self, recordings: list[NDArray[np.float64]], layout: SensorLayout) -> object:
        """Learn from healthy recordings ``[T, D]``, in the unit of the layout."""
        ...

    def detect(self, recordings: list[NDArray[np.float64]]) -> ArrayLike:
        """Return bool ``[D]``: True where a cell is faulty in this log."""
        ...


class Repairer(Protocol):
    """Classifies windows although cells are dead. It is built without arguments, once a sensor.

    ``fit`` is called once a fault set, always with the same windows: what depends on them alone
    may be kept.
    """

    def fit(
        self,
        x: NDArray[np.float32],
        y: NDArray[np.int64],
        faults: NDArray[np.bool_],
        layout: SensorLayout,
    ) -> object:
        """Learn from healthy windows x ``[N, T, D]``, readings as shares of full scale, each of a
        recording of its own, with classes y ``[N]``; ``faults``: bool ``[D]``, the cells that are
        dead from now on."""
        ...

    def predict(self, x: NDArray[np.float32]) -> ArrayLike:
        """Return the class of each window ``[N]``; the dead cells read what dead cells read."""
        ...
