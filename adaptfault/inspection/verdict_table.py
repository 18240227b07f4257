"""Verdicts of a data set as a table in Parquet, a row for each recording and cell; needs the extra
"datasets".

Columns: ``recording`` (its name), ``class``, ``pad`` (its name, or its number), ``row``,
``column``, ``cell`` (numbers from 0, as in a layout), ``verdict`` (``ALIVE``, ``FAULTY``,
``UNTESTED``), ``probability`` (P(cell is faulty in the recording)) and ``code`` of the fault that
shows there, null where none does. Positions without a cell have no row.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.atomic import atomic_file
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.inspection.codes import code_of
from diagnostics import Diagnosis, Verdict

_ROWS = 1 << 20  # of a row group: a size


def write_table(
    path: str | PathLike[str],
    diagnosis: Diagnosis,
    pads: Sequence[str] = (),
    classes: Sequence[str] | None = None,
) -> None:
    """Write the table; a file holds the old content or the new, never a part.

    Args:
        path: of the file.
        diagnosis: of the data set, with the names of its recordings.
        pads: names of its pads; empty: they have none.
        classes: of each recording; None: unknown.

    Raises:
        InputError: pyarrow is not installed.
        OSError: it cannot be written.
    """
    pa = imported("pyarrow", path)
    parquet = imported("pyarrow.parquet", path)
    layout = diagnosis.layout
    cells = np.flatnonzero(layout.is_cell)
    places = np.array([layout.position(cell) for cell in cells.tolist()]).reshape(len(cells), -1)
    names = [pads[pad] if pads else str(pad) for pad in places[:, 0].tolist()]
    verdicts = [str(one) for one in Verdict]
    codes = sorted({str(code_of(str(fault.kind))) for fault in diagnosis.faults})
    by_recording = diagnosis.by_recording
    step = max(1, _ROWS // max(len(cells), 1))
    with atomic_file(Path(path)) as new:
        written = None
        for first in range(0, len(by_recording.names), step):
            some = range(first, min(first + step, len(by_recording.names)))
            numbers = np.repeat(np.arange(len(some)), len(cells))
            tested = by_recording.verdicts[some.start : some.stop, cells]
            chance = by_recording.probability[some.start : some.stop, cells]
            shows = _codes(diagnosis, some, codes)[:, cells].ravel()
            told = [by_recording.names[i] for i in some]
            of_class = [None if classes is None else classes[i] for i in some]
            columns: dict[str, Any] = {
                "recording": _named(pa, numbers, told),
                "class": _named(pa, numbers, of_class),
                "pad": _named(pa, np.tile(np.arange(len(cells)), len(some)), names),
                "row": np.tile(places[:, 1].astype(np.int32), len(some)),
                "column": np.tile(places[:, 2].astype(np.int32), len(some)),
                "cell": np.tile(cells.astype(np.int32), len(some)),
                "verdict": _named(pa, tested.astype(np.int64).ravel(), verdicts),
                "probability": chance.astype(np.float32).ravel(),
                "code": _named(pa, shows, [*codes, None]),
            }
            table = pa.table(columns)
            if written is None:
                written = parquet.ParquetWriter(new, table.schema)
            written.write_table(table)
        assert written is not None
        written.close()


def _codes(diagnosis: Diagnosis, recordings: range, codes: Sequence[str]) -> NDArray[np.int64]:
    """Return which of the codes shows in each recording and cell, ``[n, D]``; their number where
    none does. Where several faults share a cell, the first one is told."""
    found = np.full((len(recordings), diagnosis.layout.n_cells), len(codes))
    for fault in reversed(diagnosis.faults):
        code = codes.index(str(code_of(str(fault.kind))))
        shown = list(range(len(recordings)))
        if fault.recordings is not None:
            shown = [i - recordings.start for i in fault.recordings if i in recordings]
        found[np.ix_(shown, list(fault.cells))] = code
    faulty = diagnosis.by_recording.verdicts[recordings.start : recordings.stop]
    return np.where(faulty == Verdict.FAULTY, found, len(codes))


def _named(pa: Any, numbers: NDArray[Any], names: Sequence[str | None]) -> Any:
    """Return a column of texts, of which these are the numbers."""
    return pa.array(names, pa.string()).take(pa.array(numbers))
