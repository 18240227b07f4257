"""Wiring evidence of addresses and bridges: lines that read exactly alike.

A stuck address bit selects the same line twice, a bridge joins two neighbours: either way two lines read the same,
frame by frame, to within the converter's step. Healthy lines do that only while nothing touches them. So each pair of
lines that one bit or one bridge could join is watched: since when they have not differed, and how often they have
agreed on a load that moved (a witness).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import LineKind, SensorLayout, address_bits
from diagnostics.touches import Scale

_EVERY = 4  # frames; a lasting fault does not hide between them
FEWEST_WITNESSES = 4  # and two more than healthy lines ever had


@dataclass(frozen=True)
class Joined:
    """Two lines that read alike.

    Attributes:
        pad: the pad; kind: ``"row"`` or ``"column"``.
        first, second: the lines, ascending.
        since: number of the first frame from which on they did not differ.
        told: number of the frame by which the first witness had been seen.
        witnesses: how often they agreed on a moving load since.
    """

    pad: int
    kind: LineKind
    first: int
    second: int
    since: int
    told: int
    witnesses: int


@cache
def pairs(count: int) -> tuple[tuple[int, int], ...]:
    """Return the pairs out of ``count`` lines that one address bit or one bridge can join, each once."""
    bits = [1 << b for b in range(address_bits(count))]
    by_bit = {(i, i | bit) for bit in bits for i in range(count) if not i & bit and (i | bit) < count}
    return tuple(sorted(by_bit | set(pairwise(range(count)))))


@dataclass(frozen=True)
class Twins:
    """What is known of all pairs of lines.

    Attributes:
        layout: the array.
        since: for rows and for columns, int ``[pads, pairs]``; told, witnesses: likewise (see :class:`Joined`).
        most: the most witnesses that any pair ever had.
    """

    layout: SensorLayout
    since: tuple[NDArray[np.intp], NDArray[np.intp]]
    told: tuple[NDArray[np.intp], NDArray[np.intp]]
    witnesses: tuple[NDArray[np.intp], NDArray[np.intp]]
    most: int = 0

    @classmethod
    def begin(cls, layout: SensorLayout) -> Twins:
        """Nothing seen yet."""
        nothing = tuple(np.zeros((layout.pads, len(pairs(n))), np.intp) for n in (layout.rows, layout.cols))
        both = (nothing[0], nothing[1])
        return cls(layout, both, both, both)

    def extend(
        self, frames: NDArray[np.float64], numbers: NDArray[np.intp], telling: NDArray[np.bool_], tolerance: float
    ) -> Twins:
        """Return the pairs after more frames.

        Args:
            frames: ``[t, D]``.
            numbers: int ``[t]``, of the frames.
            telling: bool ``[D]``, cells that are loaded and move in these frames.
            tolerance: as far as two conversions of one cell may differ.
        """
        layout = self.layout
        grid = layout.grid(frames[::_EVERY].astype(np.float32))
        told = layout.grid(telling)
        since, told_at, witnesses, most = [], [], [], self.most
        for axis, count in enumerate((layout.rows, layout.cols)):
            a, b = np.array(pairs(count) or np.empty((0, 2)), dtype=np.intp).reshape(-1, 2).T
            lines = grid if axis == 0 else grid.swapaxes(2, 3)  # [t, pads, lines, positions]
            present = layout.present if axis == 0 else layout.present.swapaxes(1, 2)
            moving = told if axis == 0 else told.swapaxes(1, 2)
            # A missing reading differs from nothing; a position without a cell neither.
            differ = np.abs(lines[:, :, a] - lines[:, :, b]) > tolerance
            differ &= present[:, a] & present[:, b]
            apart = differ.any(axis=3)  # [t, pads, pairs]
            ever = apart.any(axis=0)
            last = len(apart) - 1 - apart[::-1].argmax(axis=0)
            since.append(np.where(ever, numbers[::_EVERY][last] + 1, self.since[axis]))
            seen = (moving[:, a] & moving[:, b]).sum(axis=2)
            count_now = np.where(ever, 0, self.witnesses[axis] + seen)
            witnesses.append(count_now)
            fresh = (count_now > 0) & ((self.witnesses[axis] == 0) | ever)
            told_at.append(np.where(fresh, numbers[-1], self.told[axis]))
            most = max(most, int(count_now.max(initial=0)))
        return Twins(layout, (since[0], since[1]), (told_at[0], told_at[1]), (witnesses[0], witnesses[1]), most)

    def joined(self, usual: int) -> list[Joined]:
        """Return the pairs with more witnesses than healthy ones, which had up to ``usual``."""
        needed = max(FEWEST_WITNESSES, usual + 2)
        found = []
        kinds: tuple[LineKind, LineKind] = ("row", "column")
        for axis, count in enumerate((self.layout.rows, self.layout.cols)):
            of_lines = pairs(count)
            for pad, i in np.argwhere(self.witnesses[axis] >= needed).tolist():
                numbers = (int(of[axis][pad, i]) for of in (self.since, self.told, self.witnesses))
                found.append(Joined(pad, kinds[axis], *of_lines[i], *numbers))
        return found

    def apart_since(self, pad: int, kind: LineKind, first: int, second: int) -> int:
        """Return the first frame from which on two lines did not differ."""
        axis = 0 if kind == "row" else 1
        of_lines = pairs(self.layout.rows if axis == 0 else self.layout.cols)
        return int(self.since[axis][pad, of_lines.index((first, second))])


def telling(frames: NDArray[np.float64], still: NDArray[np.bool_], scale: Scale) -> NDArray[np.bool_]:
    """Return the cells ``[D]`` that are loaded, not saturated, and move in ``frames``: two alike are no chance."""
    now = np.nan_to_num(frames[-1])
    found: NDArray[np.bool_] = ~still & (now > scale.resting + scale.near) & (now < scale.full_scale - scale.near)
    return found
