"""The part of a log that is its own reference: recordings in which no cell is suspect.

Of each class the first half is taken: a cell that fails later is compared with how it worked
before, and recordings that lie class by class say nothing of other classes. Recordings with suspect
cells take part, with these readings filled, only where the others are too few.

Such a reference does not tell how much a cell should read. The cells beside it do: one that never
moves half as far as they do may be worn, or hardly touched.

Not detected: worn cells beside worn ones, and a contact of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.preprocessing.levels import LEAST_LOADED, MAJORITY, SLIGHT
from diagnostics.preprocessing.quantiles import known_quantile
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.when.held import Held

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

# recordings from which on a log is its own reference
OWN_REFERENCE = 16
_LASTS = 8  # frames of a contact, at least


def own_reference(log: RecordingBlocks, held: Held, classes: ArrayLike | None) -> list[int]:
    """Return the numbers of the recordings of a log that serve as its reference, ascending."""
    n = len(log)
    label = np.zeros(n, np.intp)
    if classes is not None:
        _, label = np.unique(np.asarray(classes), return_inverse=True)
    clean = np.asarray(~held.suspect.any(axis=1))
    if clean.sum() < OWN_REFERENCE // 2:
        clean[:] = True
    half = n // 2 if classes is None else 0
    chosen = []
    for one in np.unique(label):
        of_class = label == one
        most = half or (int(of_class.sum()) + 1) // 2
        chosen += np.flatnonzero(of_class & clean)[:most].tolist()
    # Classes without a clean recording leave room for more of the others.
    others = [i for i in np.flatnonzero(clean).tolist() if i not in chosen]
    chosen += others[: max(0, n // 2 - len(chosen))]
    return sorted(chosen)


def known_classes(chosen: Sequence[int], classes: ArrayLike) -> frozenset[Any]:
    """Return the classes of which a quarter of the recordings are in a reference: how healthy cells
    move in those of another class is not known.

    Args:
        chosen: numbers of the recordings in the reference.
        classes: of all recordings, ``[n]``.
    """
    label = np.asarray(classes)
    own = label[list(chosen)]
    names = np.unique(label)
    known = [(own == name).sum() >= LEAST_LOADED * (label == name).sum() for name in names]
    return frozenset(names[known].tolist())


def reads_enough(ranges: NDArray[np.float64], layout: SensorLayout) -> NDArray[np.bool_]:
    """Return the cells that move at least half as far as those beside them, bool ``[D]``.

    Args:
        ranges: highest minus lowest reading of each cell, ``[D]``.
        layout: the array.
    """
    around = np.where(layout.beside >= 0, ranges[layout.beside], np.nan)
    beside = known_quantile(around, MAJORITY, axis=1)
    # where there are none, nothing contradicts
    found: NDArray[np.bool_] = ranges >= MAJORITY * np.nan_to_num(beside)
    return found


def shows_contacts(first: RecordingBlocks, log: RecordingBlocks, layout: SensorLayout) -> bool:
    """Return whether most cells are loaded in the ``first`` recordings of a log, by what loads
    there are in it: loads last, noise does not."""
    present = layout.is_cell
    given = first.valid(layout.full_scale, present)
    before = _typical_range(given, present)
    typical = _typical_range(log.valid(layout.full_scale, present), present)
    lasting = _typical_range(RecordingBlocks([_means(frames) for frames in given]), present)
    lasts = lasting >= MAJORITY * before
    return lasts and before > SLIGHT * layout.full_scale and before >= LEAST_LOADED * typical


def _means(frames: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the means of pieces of a recording ``[T, D]``, without missing readings; of a short
    one, its frames."""
    pieces = len(frames) // _LASTS
    if pieces < 2:
        return frames
    parts = frames[: pieces * _LASTS].reshape(pieces, _LASTS, -1)
    count = np.isfinite(parts).sum(axis=1)
    return np.where(count > 0, np.nansum(parts, axis=1) / np.maximum(count, 1), np.nan)


def _typical_range(recordings: RecordingBlocks, present: NDArray[np.bool_]) -> float:
    """Return the median over cells of the range of readings; 0 without any."""
    low, high = recordings.extremes()
    ranges = (high - low)[present]
    received = ranges[np.isfinite(ranges)]
    return float(np.median(received)) if len(received) else 0.0
