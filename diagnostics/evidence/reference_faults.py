"""Reference faults: cells that were dead already while the reference was recorded.

Used arrays often have some. The reference is therefore diagnosed first as in a cold start, by the
k-NN spatial model; cells with P(faulty) >= 0.999 are excluded from fitting. Candidates are
connected groups of cells that never moved in any recording and that have, somewhere, cells that
moved on two opposite sides. Cells that fail during the reference, and groups at the border without
such neighbours, are not detected.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.baseline import baseline
from diagnostics.preprocessing.levels import MAJORITY, RARE
from diagnostics.preprocessing.readings import RecordingBlocks

if TYPE_CHECKING:
    from diagnostics.decision.result import Diagnosis
    from diagnostics.layout import SensorLayout

# pieces that are diagnosed, evenly spread, and frames of each: sizes
_PIECES = 60
_FRAMES = 200


def find_reference_faults(
    recordings: RecordingBlocks,
    layout: SensorLayout,
    tolerance: float,
    diagnose: Callable[
        [RecordingBlocks, NDArray[np.bool_], NDArray[np.float64], SensorLayout], Diagnosis
    ],
) -> NDArray[np.float64]:
    """Return P(dead) of the cells that are dead throughout the reference, ``[D]``; 0 for all
    others.

    Args:
        recordings: the reference.
        layout: the array.
        tolerance: a constant cell stays within +- this, in the layout's unit.
        diagnose: a cold-start diagnosis of the candidate cells (bool ``[D]``) with known baselines
            (float ``[D]``).
    """
    present = layout.is_cell
    still = present & never_moved(recordings, tolerance)
    candidates = _enclosed_groups(still, layout)
    if not candidates.any() or still[present].mean() > MAJORITY:
        return np.zeros(layout.n_cells)
    rest = baseline(recordings, present & ~still, tolerance, layout.full_scale)
    typical = rest[present & ~still]
    # A cell that holds more than any baseline is loaded, or dead.
    rest = np.where(rest > typical.max(), np.median(typical), rest)
    found = diagnose(_sample(recordings), candidates, rest, layout)
    dead = still & found.fault_set.mask & (found.probability >= 1 - RARE)
    return np.where(dead, found.probability, 0.0)


def never_moved(recordings: RecordingBlocks, tolerance: float) -> NDArray[np.bool_]:
    """Return the cells whose readings stay within +- ``tolerance`` of a value, bool ``[D]``; False
    without any."""
    low, high = recordings.extremes()
    still: NDArray[np.bool_] = high - low <= 2 * tolerance
    return still


def _enclosed_groups(still: NDArray[np.bool_], layout: SensorLayout) -> NDArray[np.bool_]:
    """Return the groups of cells that are ``still`` in which one is enclosed by cells that moved,
    bool ``[D]``."""
    moved = layout.grid(~still & layout.is_cell)
    groups = layout.connected(still)
    candidates: NDArray[np.bool_] = np.isin(groups, groups[_enclosed(moved).ravel() & still])
    return candidates


def _enclosed(moved: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the cells with cells that ``moved`` on two opposite sides, bool
    ``[pads, rows, cols]``."""
    padded = np.pad(moved, ((0, 0), (1, 1), (1, 1)))
    rows, cols = moved.shape[1:]
    found = np.zeros_like(moved)
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        one = padded[:, 1 + down : 1 + down + rows, 1 + right : 1 + right + cols]
        other = padded[:, 1 - down : 1 - down + rows, 1 - right : 1 - right + cols]
        found |= one & other
    return found


def _sample(recordings: RecordingBlocks) -> RecordingBlocks:
    """Return evenly spread pieces of the recordings: more add little to a cold start."""
    pieces = [
        (i, first)
        for i in range(len(recordings))
        for first in range(0, len(recordings[i]), _FRAMES)
    ]
    chosen = np.unique(np.linspace(0, len(pieces) - 1, _PIECES).round().astype(int))
    some = (pieces[k] for k in chosen)
    return RecordingBlocks(
        [recordings.piece(i, slice(first, first + _FRAMES), slice(None)) for i, first in some]
    )
