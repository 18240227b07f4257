"""Readings of suspect cells in a reference are replaced by healthy ones: those of the frame in
which the cells around read most alike (hot-deck imputation)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.readings import CELLS, RecordingBlocks
from diagnostics.when.held import Held

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

_AROUND = 24  # cells that are compared: a size
_TOGETHER = 256  # frames that are compared at a time: a size


def filled(recordings: RecordingBlocks, held: Held, layout: SensorLayout) -> RecordingBlocks:
    """Return recordings in which no reading of a suspect cell is left.

    Cells that are suspect in the same recordings get readings of the same frame. A cell that is
    suspect in all of them stays as it is.
    """
    given = [np.asarray(recording) for recording in recordings.given]
    changed = {
        i: given[i].astype(np.float64) for i in np.flatnonzero(held.suspect.any(axis=1)).tolist()
    }
    for suspect, cells in held.states():
        healthy = [i for i in range(len(given)) if i not in suspect]
        around = _around(cells, held, layout)
        if not healthy or not len(around):
            continue
        step = max(1, sum(len(given[i]) for i in healthy) // CELLS)
        donors = np.concatenate([given[i] for i in healthy])[::step].astype(np.float64)
        for i in suspect:
            for frames, like in _likest(given[i][:, around], donors[:, around]):
                changed[i][frames][:, cells] = donors[like][:, cells]
    return RecordingBlocks([changed.get(i, recording) for i, recording in enumerate(given)])


def _around(cells: NDArray[np.intp], held: Held, layout: SensorLayout) -> NDArray[np.intp]:
    """Return the cells nearest to some on the same pad that are never suspect."""
    places = np.array([layout.position(cell)[:3] for cell in range(layout.n_cells)])
    usable = layout.is_cell & ~held.suspect.any(axis=0)
    usable &= np.isin(layout.pad_of, layout.pad_of[cells])
    away = np.abs(places[:, None] - places[cells]).sum(axis=2).min(axis=1)
    nearest = np.argsort(np.where(usable, away, np.inf), kind="stable")[:_AROUND]
    return nearest[usable[nearest]]


def _likest(
    frames: NDArray[Any], donors: NDArray[np.float64]
) -> Iterator[tuple[slice, NDArray[np.intp]]]:
    """Yield parts of the frames ``[t, k]`` with the number of the donor ``[m, k]`` that is most
    alike; what is missing in either does not count."""
    others = np.nan_to_num(donors)
    size = (others**2).sum(axis=1)
    for first in range(0, len(frames), _TOGETHER):
        part = slice(first, first + _TOGETHER)
        some = np.nan_to_num(np.asarray(frames[part], dtype=np.float64))
        yield part, np.argmin(size - 2 * some @ others.T, axis=1)
