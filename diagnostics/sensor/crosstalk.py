"""Crosstalk of lines: a cell reads at least a share of the highest reading of its row or column.

Where the lines of a matrix that are not selected float, current takes side paths, and a contact
shows as a cross (D'Alessio 1999). The floor of a cell is the median of its reading, above rest,
over the highest one of its line, in the frames that load the line. Without crosstalk a cell is at
rest in some of them, and its floor is 0. With it many floors of a pad are equal, hardly any is
lower, and their lower quartiles are equal, too: their mode is the share.

A cell that never reads clearly more than that has carried nothing of its own: it was not tested.

Not detected: a share below 0.05 or above 0.75, one that the reference has too, lines of fewer than
four cells, and what fewer than five recordings show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import FEWEST, LEAST_LOADED, LIGHT, MAJORITY, RARE, SLIGHT
from diagnostics.preprocessing.quantiles import known_quantile
from diagnostics.sensor.odd_frames import evenly

_RECORDINGS = 5  # at least
_CELLS = 4  # of a line, at least
_MOST = 0.75  # a larger share is none
_AGREE = 0.15  # share of the floors of a pad that are equal
_LOWER = 0.15  # share of the cells of a pad that may be broken, and read less

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Crosstalk:
    """Which share of the highest reading of its lines a cell reads at least.

    Attributes:
        shares: ``[2, pads]``, along rows and along columns; 0: none.
        own: bool ``[D]``, cells that carried a load of their own, or are on a pad without it.
        reason: one plain sentence.
    """

    shares: Floats
    own: Mask
    reason: str

    def joined(self, other: Crosstalk | None) -> Crosstalk:
        """Return that of two parts of a log: with the cells that carried a load in either."""
        return self if other is None else replace(self, own=self.own | other.own)


def find_crosstalk(
    recordings: Sequence[NDArray[np.floating]],
    rest: Floats,
    usual: Floats,
    layout: SensorLayout,
) -> Crosstalk | None:
    """Return the crosstalk of a log; None where it is as in the reference.

    Args:
        recordings: loads ``[T, D]`` each; NaN = missing.
        rest: ``[D]``, load of each cell without a contact.
        usual: the :func:`lowest_floors` of the reference, ``[2, pads]``.
        layout: the array.
    """
    floors = _floors(recordings, rest, layout)
    shares = np.array([[_mode(of_cells) for of_cells in of_pads] for of_pads in floors])
    shares[(shares <= LIGHT) | (shares >= _MOST)] = 0.0
    shares[:, ~(shares > usual + SLIGHT).any(axis=0)] = 0.0
    if not shares.any():
        return None
    own = np.asarray(shares.sum(axis=0)[layout.pad_of] == 0)
    for frames in recordings:
        own |= _carried(np.asarray(frames, dtype=np.float64) - rest, shares, layout)
    return Crosstalk(shares, own, _told(shares))


def lowest_floors(
    recordings: Sequence[NDArray[np.floating]], rest: Floats, layout: SensorLayout
) -> Floats:
    """Return the floor that hardly any cell of a pad is below, along rows and columns,
    ``[2, pads]``; 0: unknown. Arguments as of :func:`find_crosstalk`."""
    floors = _floors(recordings, rest, layout)
    return np.array(
        [
            [np.quantile(cells[1], _LOWER) if cells.size else 0.0 for cells in pads]
            for pads in floors
        ]
    )


def _floors(
    recordings: Sequence[NDArray[np.floating]], rest: Floats, layout: SensorLayout
) -> list[list[Floats]]:
    """Return what each cell of a pad reads of the highest reading of its line, lower quartile and
    median over the frames that load it, ``[2, cells]``, along rows and columns; empty: unknown.

    A cell that does not move, or rests higher than in the reference, tells nothing.
    """
    found = [[np.zeros((2, 0))] * layout.pads for _ in range(2)]
    if not layout.is_matrix or len(recordings) < _RECORDINGS:
        return found
    above = evenly(recordings) - rest
    lowest = known_quantile(above, RARE, axis=0)
    near = SLIGHT * layout.full_scale
    telling = layout.is_cell & (np.fmax.reduce(above) - lowest > near) & (lowest < near)
    grid = layout.grid(np.where(telling, above, np.nan))
    for pad in range(layout.pads):
        idle = np.nan_to_num(grid[:, pad]).max(axis=(1, 2)) < LIGHT * layout.full_scale
        if idle.sum() >= FEWEST:
            grid[:, pad] -= np.median(grid[idle, pad], axis=0)
        of_cells = np.nan_to_num(np.fmax.reduce(grid[:, pad])).ravel()
        most = float(np.quantile(of_cells, 1 - LEAST_LOADED))
        for i, along in enumerate((2, 1)):
            if grid.shape[along + 1] < _CELLS or most <= LIGHT * layout.full_scale:
                continue
            of_line = np.fmax.reduce(grid[:, pad], axis=along, keepdims=True)
            highest = np.fmax.reduce(of_line, axis=3 - along, keepdims=True)
            # less may be the floor of the lines that cross it
            loaded = (of_line >= MAJORITY * most) & (of_line >= _MOST * highest)
            ratio = np.where(loaded, grid[:, pad] / np.where(loaded, of_line, 1.0), np.nan)
            ratio = ratio.reshape(len(ratio), -1)
            often = np.isfinite(ratio).sum(axis=0) >= 2 * FEWEST
            if often.sum() >= MAJORITY * telling[layout.pad_of == pad].sum() >= _CELLS:
                quantiles = (LEAST_LOADED, MAJORITY)
                found[i][pad] = np.stack(
                    [known_quantile(ratio[:, often], share, axis=0) for share in quantiles]
                )
    return found


def _mode(floors: Floats) -> float:
    """Return the median that most cells of a pad agree on, each in most frames, unless many read
    less; then 0. ``floors``: lower quartile and median of each, ``[2, n]``."""
    low, middle = floors
    ordered = np.sort(middle[middle - low <= LIGHT])
    if not len(ordered):
        return 0.0
    agree = np.searchsorted(ordered, ordered + SLIGHT, side="right") - np.arange(len(ordered))
    first = int(agree.argmax())
    lower = (low < ordered[first] - LIGHT).sum()
    if agree[first] < max(FEWEST, _AGREE * len(low)) or lower > _LOWER * len(low):
        return 0.0
    # a light load of its own raises a floor, and nothing lowers it
    return float(np.quantile(ordered[first : first + agree[first]], LEAST_LOADED))


def _carried(above: Floats, shares: Floats, layout: SensorLayout) -> Mask:
    """Return the cells that read clearly more than their lines give them, bool ``[D]``; ``above``:
    loads above rest, ``[t, D]``."""
    grid = layout.grid(above)
    floor = np.zeros(grid.shape)
    for along, share in zip((3, 2), shares, strict=True):
        highest = np.fmax.reduce(grid, axis=along, keepdims=True)
        floor = np.fmax(floor, (share + LIGHT)[:, None, None] * highest)
    clear = grid > floor + SLIGHT * layout.full_scale
    return np.asarray(clear.any(axis=0).ravel())


def _told(shares: Floats) -> str:
    kinds = [kind for kind, of_kind in zip(("row", "column"), shares, strict=True) if of_kind.any()]
    pads = np.flatnonzero(shares.any(axis=0))
    where = "" if shares.shape[1] == 1 else f" of pad{'s' * (len(pads) > 1)} "
    where += ", ".join(map(str, pads)) if where else ""
    return (
        f"cells{where} read also what other cells of their {' and '.join(kinds)} carry"
        f" ({shares.max():.2f}): crosstalk, lines that are not selected may float; check the"
        " read-out"
    )
