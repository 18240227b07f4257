"""Finds a method by its name and checks what it returns; our own ones, which enter by the same
door."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics import SelfDiagnosis, SensorLayout, Verdict

DIAGNOSER = ("fit(recordings, layout)", "detect(recordings)")
REPAIRER = ("fit(x, y, faults, layout)", "predict(x)")
EPOCHS = 20  # of our network


def copies(recordings: Iterable[NDArray[Any]]) -> list[NDArray[np.float64]]:
    """Return recordings that a method may change."""
    return [np.array(frames, dtype=np.float64) for frames in recordings]


def find_method(name: str, needs: tuple[str, ...]) -> Callable[[], Any]:
    """Return the class or function ``module:Name``; modules of the working directory are found,
    too.

    Args:
        name: ``module:Name``.
        needs: :data:`DIAGNOSER` or :data:`REPAIRER`.

    Raises:
        ValueError: the text is no such name, or it lacks a method.
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
    build: Callable[[], Any] = getattr(found, attribute)
    names = [part.partition("(")[0] for part in needs]
    lacking = [part for part in names if not hasattr(build, part)]
    if isinstance(build, type) and lacking:
        raise ValueError(
            f"method {name!r}: it has no {' and no '.join(lacking)}; a method has"
            f" {' and '.join(needs)}; add what is missing"
        )
    return build


def of_each_cell(
    found: ArrayLike, name: str, method: str, layout: SensorLayout
) -> NDArray[np.bool_]:
    """Return what a method says of each cell, bool ``[D]``, False where the layout has no cell.

    Raises:
        ValueError: it is no bool ``[D]``.
    """
    cells = np.asarray(found)
    if cells.dtype != bool or cells.shape != (layout.n_cells,):
        raise ValueError(
            f"{name}: {method} returned {cells.dtype} of shape {cells.shape}; expected bool of"
            f" shape ({layout.n_cells},), one value a cell; correct {method}"
        )
    return np.asarray(cells & layout.is_cell)


class Fitted:
    """:class:`diagnostics.SelfDiagnosis` with the healthy reference."""

    def fit(self, recordings: list[NDArray[np.float64]], layout: SensorLayout) -> None:
        """Learn from healthy recordings."""
        self.diagnoser = SelfDiagnosis(layout).fit(recordings)

    def detect(self, recordings: list[NDArray[np.float64]]) -> NDArray[np.bool_]:
        """Return F, bool ``[D]``."""
        self.found = self.diagnoser.diagnose(recordings)
        return self.found.fault_set.mask

    def untested(self) -> NDArray[np.bool_]:
        """Return the untested cells, bool ``[D]``."""
        return np.asarray(self.found.verdicts == Verdict.UNTESTED)

    def wires(self) -> list[tuple[int, str, int]]:
        """Return the broken wires."""
        lines = [fault.line for fault in self.found.faults if fault.line is not None]
        return [(line.pad, line.kind, line.index) for line in lines]


class Cold(Fitted):
    """The same without the reference."""

    def fit(self, recordings: list[NDArray[np.float64]], layout: SensorLayout) -> None:
        """Learn nothing."""
        self.diagnoser = SelfDiagnosis(layout)


class Repaired:
    """The network, trained once a sensor, and :class:`adaptfault.Adapter` for each F."""

    def fit(
        self,
        x: NDArray[np.float32],
        y: NDArray[np.int64],
        faults: NDArray[np.bool_],
        layout: SensorLayout,
    ) -> None:
        """Train if there is no network yet; repair it."""
        import adaptfault as af

        if not hasattr(self, "adapter"):
            windows = af.Windows(x, y, np.arange(len(x)))
            train, validation, _ = af.split(windows, test=0.0, validation=0.25)
            model = af.TactileTransformer(layout, int(y.max()) + 1, length=x.shape[1])
            af.train(model, train, validation, epochs=EPOCHS, progress=False)
            self.adapter = af.Adapter(model, train, validation)
        self.repaired = self.adapter.adapt(np.flatnonzero(faults).tolist(), progress=False)

    def predict(self, x: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return the class of each window ``[N]``."""
        return self.repaired.predict(x)
