"""Cells that were dead already when the reference was recorded, and so must not teach what healthy looks like.

Hardly any skin that has been used for a while is free of them. What was taken for fault-free is therefore diagnosed
itself first, as in a cold start: by the cells around each. Only cells that never moved in any recording come into
question, and of a large skin only those among them that have cells that moved on both sides; where all moved, nothing
is done.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from diagnostics.healthy.stacking import enclosed
from diagnostics.preprocessing.baseline import baseline
from diagnostics.preprocessing.readings import RecordingBlocks

if TYPE_CHECKING:
    from diagnostics.decision.result import Diagnosis
    from diagnostics.layout import SensorLayout

_PIECES, _FRAMES = 60, 200  # of the reference that are diagnosed, at most, spread evenly; frames of each
_SURE = 0.99  # P(faulty) from which on a cell counts as dead: it will be called so in every log
_TOUCHING = np.array([np.zeros((3, 3)), np.ones((3, 3)), np.zeros((3, 3))])  # also corner to corner; not across pads
_MOST = 0.5  # share of the cells: if more look dead, it is no reference, or it touched next to nothing


def find_reference_faults(
    recordings: RecordingBlocks,
    layout: SensorLayout,
    tolerance: float,
    diagnose: Callable[[RecordingBlocks, NDArray[np.bool_], NDArray[np.float64]], Diagnosis],
) -> NDArray[np.float64]:
    """Return P(dead) of the cells that are dead throughout the reference, ``[D]``; 0 for all others.

    Args:
        recordings: the reference.
        layout: the array.
        tolerance: how far the reading of a cell that does not move may wander to either side.
        diagnose: a diagnosis without a reference, but for where cells rest (float ``[D]``), of the cells in question
            (bool ``[D]``) at least.
    """
    present = layout.present.ravel()
    never_moved = present & _still(recordings, 2 * tolerance)
    suspects = _between(never_moved, layout)
    if not suspects.any() or never_moved[present].mean() > _MOST:
        return np.zeros(layout.n_cells)
    rest, _ = baseline(recordings, present & ~never_moved, tolerance, layout.full_scale)
    usual = rest[present & ~never_moved]
    # A cell that holds more than any rests at is loaded, or dead.
    rest = np.where(rest > usual.max(), np.median(usual), rest)
    found = diagnose(_sample(recordings), suspects, rest)
    dead = never_moved & found.fault_set.mask & (found.probability >= _SURE)
    return np.where(dead, found.probability, 0.0)


def _still(recordings: RecordingBlocks, most: float) -> NDArray[np.bool_]:
    """Return which cells stayed within ``most`` all through, and did read something, ``[D]``."""
    low, high = np.inf, -np.inf
    for frames in recordings.blocks():
        low, high = np.fmin(low, np.fmin.reduce(frames)), np.fmax(high, np.fmax.reduce(frames))
    still: NDArray[np.bool_] = np.asarray((high >= low) & (high - low <= most))
    return still


def _between(never_moved: NDArray[np.bool_], layout: SensorLayout) -> NDArray[np.bool_]:
    """Return the groups of ``never_moved`` cells in which one lies between cells that moved, bool ``[D]``."""
    moved = layout.grid(~never_moved & layout.present.ravel())
    groups, _ = label(layout.grid(never_moved), _TOUCHING)
    between: NDArray[np.bool_] = np.isin(groups, groups[enclosed(moved[..., None])[..., 0] & (groups > 0)]).ravel()
    return between


def _sample(recordings: RecordingBlocks) -> RecordingBlocks:
    """Return some recordings, the long ones shortened: a cold start learns little from more."""
    pieces = [(i, first) for i in range(len(recordings)) for first in range(0, len(recordings[i]), _FRAMES)]
    chosen = np.unique(np.linspace(0, len(pieces) - 1, _PIECES).round().astype(int))
    every = np.arange(recordings[0].shape[1])
    return RecordingBlocks(
        [recordings.piece(i, slice(first, first + _FRAMES), every) for i, first in map(pieces.__getitem__, chosen)]
    )
