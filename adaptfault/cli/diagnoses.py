"""The fault set or the diagnosis that a command is given."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diagnostics import Diagnosis, FaultSet, SensorLayout


def fault_set(text: str, layout: SensorLayout) -> FaultSet:
    """Read F: a diagnosis written by ``adaptfault diagnose --out``, or cell indices as ``3,17,200``
    ("" = none).

    Raises:
        ValueError: neither, or F is over another array.
    """
    from diagnostics import FaultSet

    try:
        cells = tuple(int(part) for part in text.replace(",", " ").split())
    except ValueError:
        return _diagnosed(Path(text), layout)
    return FaultSet(cells, layout.n_cells)


def _diagnosed(path: Path, layout: SensorLayout) -> FaultSet:
    if not path.is_file():
        raise ValueError(f"--faults {path}: no such file, and not cell indices as 3,17,200")
    diagnosis = read_diagnosis(path)
    if diagnosis.layout.shape != layout.shape:
        raise ValueError(
            f"{path}: a diagnosis of {diagnosis.layout}, but the model is for {layout}"
        )
    return diagnosis.fault_set


def read_diagnosis(path: Path) -> Diagnosis:
    """Read a diagnosis that ``adaptfault diagnose --out`` wrote.

    Raises:
        ValueError: the file holds none.
    """
    from adaptfault.data.recordings.formats.text import read_json_object
    from diagnostics import Diagnosis

    try:
        return Diagnosis.from_dict(read_json_object(path))
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path}: not a diagnosis ({error}); write one with adaptfault diagnose --out"
        ) from None
