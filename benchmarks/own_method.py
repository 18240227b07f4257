"""Runs somebody's own detector on the logs of the benchmark: any object with ``fit`` and
``detect``.

A detector is named as ``module:Name`` and is built without arguments. ``detect`` returns which
cells are faulty, so only rows that need no more than F are run for it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Protocol

import numpy as np

from diagnostics import Fault, FaultSet, SensorLayout

ROWS_OF_F = ("cells", "onset", "dither", "missing", "many", "healthy", "holds", "moving")
"""Rows that need no more than F."""

FIGURES_OF_F = (": precision", ": recall", ": false alarms")
"""How the names of their figures end that need no more than F."""


class Detector(Protocol):
    """What the benchmark asks of a method."""

    def fit(self, recordings: list[np.ndarray], layout: SensorLayout) -> Detector:
        """Learn from healthy recordings ``[T, D]``."""
        ...

    def detect(self, recordings: list[np.ndarray]) -> np.ndarray:
        """Return bool ``[D]``: True where a cell is faulty."""
        ...


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
        self.detector = find_method(name)()

    def fit(self, recordings: Iterable[np.ndarray]) -> OwnMethod:
        """Fit the detector to copies of healthy recordings."""
        self.detector.fit(copies(recordings), self.layout)
        return self

    def diagnose(self, log: Sequence[np.ndarray]) -> Found:
        """Return what the detector finds in a copy of a log. Positions without a cell are left out.

        Raises:
            ValueError: what it returns is no bool ``[D]``.
        """
        faulty = np.asarray(self.detector.detect(copies(log)))
        if faulty.dtype != bool or faulty.shape != (self.layout.n_cells,):
            raise ValueError(
                f"{self.name}: detect returned {faulty.dtype} of shape {faulty.shape}; expected"
                f" bool of shape ({self.layout.n_cells},), one value a cell, True where it is"
                " faulty; correct detect"
            )
        return Found(self.layout, faulty & self.layout.present.ravel())


def copies(recordings: Iterable[np.ndarray]) -> list[np.ndarray]:
    """Return recordings that a detector may change."""
    return [np.array(frames, dtype=np.float64) for frames in recordings]


def find_method(name: str) -> Callable[[], Detector]:
    """Return the class or function ``module:Name``; modules of the working directory are found,
    too.

    Raises:
        ValueError: the text is no such name, or it has no ``fit`` and ``detect``.
        ImportError: there is no such module, or it needs one that is missing.
    """
    module, colon, attribute = name.partition(":")
    if not (module and colon and attribute):
        raise ValueError(
            f"method {name!r}: expected module:Name, such as my_package:MyDetector; write it so"
        )
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        found = import_module(module)
    except ImportError as error:
        raise ImportError(
            f"method {name!r}: {module} cannot be imported ({error}); install it, or run the"
            " script where it lies"
        ) from error
    if not hasattr(found, attribute):
        raise ValueError(f"method {name!r}: {module} has no {attribute}; correct the name")
    build = getattr(found, attribute)
    lacking = [part for part in ("fit", "detect") if not hasattr(build, part)]
    if isinstance(build, type) and lacking:
        raise ValueError(
            f"method {name!r}: it has no {' and no '.join(lacking)}; a detector has"
            " fit(recordings, layout) and detect(recordings); add what is missing"
        )
    return build


def needs_only_f(figure: str) -> bool:
    """Return whether a figure of the table needs no more than F, by its name."""
    return figure.endswith(FIGURES_OF_F)
