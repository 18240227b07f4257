"""Wiring evidence of addresses and bridges: lines that read exactly alike.

A stuck address bit selects the same line twice, a bridge joins two neighbours: either way two lines read the same,
frame by frame, to within the converter's step. Healthy lines do that only while nothing touches them, or by chance when
something lies evenly across both. So each pair of lines that one bit or one bridge could join is watched: since when
they have not differed, how often they have agreed on a load that moved (a witness), and whether what they differ by
is noise around zero, as of one cell read twice, or a small but steady difference, as of two cells under equal loads.
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
_STEADY = 5.0  # squared z value of a difference, mean over the cells: 1 if it is noise around zero
_STEP = 0.1  # of the tolerance: so small a difference is none


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
        sums: of what the cells of a pair differed by while both told something, for rows and for columns: the
            difference, and its square, float ``[2, pads, pairs, positions]``.
        most: the most witnesses that any pair ever had.
    """

    layout: SensorLayout
    since: tuple[NDArray[np.intp], NDArray[np.intp]]
    told: tuple[NDArray[np.intp], NDArray[np.intp]]
    witnesses: tuple[NDArray[np.intp], NDArray[np.intp]]
    sums: tuple[NDArray[np.float32], NDArray[np.float32]]
    most: int = 0

    @classmethod
    def begin(cls, layout: SensorLayout) -> Twins:
        """Nothing seen yet."""
        nothing = tuple(np.zeros((layout.pads, len(pairs(n))), np.intp) for n in (layout.rows, layout.cols))
        both = (nothing[0], nothing[1])
        no_sums = (
            np.zeros((2, *nothing[0].shape, layout.cols), np.float32),
            np.zeros((2, *nothing[1].shape, layout.rows), np.float32),
        )
        return cls(layout, both, both, both, no_sums)

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
        since, told_at, witnesses, sums, most = [], [], [], [], self.most
        for axis, count in enumerate((layout.rows, layout.cols)):
            a, b = np.array(pairs(count) or np.empty((0, 2)), dtype=np.intp).reshape(-1, 2).T
            lines = grid if axis == 0 else grid.swapaxes(2, 3)  # [t, pads, lines, positions]
            present = layout.present if axis == 0 else layout.present.swapaxes(1, 2)
            moving = told if axis == 0 else told.swapaxes(1, 2)
            # A missing reading differs from nothing; a position without a cell neither.
            difference = np.take(lines, a, axis=2)
            difference -= np.take(lines, b, axis=2)
            differ = np.abs(difference, out=difference) > tolerance
            differ &= present[:, a] & present[:, b]
            apart = differ.any(axis=3)  # [t, pads, pairs]
            ever = apart.any(axis=0)
            last = len(apart) - 1 - apart[::-1].argmax(axis=0)
            since.append(np.where(ever, numbers[::_EVERY][last] + 1, self.since[axis]))
            both = moving[:, a] & moving[:, b]  # [pads, pairs, positions]
            seen = both.sum(axis=2)
            count_now = np.where(ever, 0, self.witnesses[axis] + seen)
            sums.append(_summed(self.sums[axis], lines, a, b, both, ever, tolerance))
            witnesses.append(count_now)
            fresh = (count_now > 0) & ((self.witnesses[axis] == 0) | ever)
            told_at.append(np.where(fresh, numbers[-1], self.told[axis]))
            most = max(most, int(count_now.max(initial=0)))
        return Twins(
            layout, (since[0], since[1]), (told_at[0], told_at[1]), (witnesses[0], witnesses[1]),
            (sums[0], sums[1]), most,
        )  # fmt: skip

    def joined(self, usual: int) -> list[Joined]:
        """Return the pairs without a steady difference that have more witnesses than healthy ones, up to ``usual``."""
        needed = max(FEWEST_WITNESSES, usual + 2)
        found = []
        kinds: tuple[LineKind, LineKind] = ("row", "column")
        for axis, count in enumerate((self.layout.rows, self.layout.cols)):
            of_lines = pairs(count)
            for pad, i in np.argwhere(self.witnesses[axis] >= needed).tolist():
                difference, squares = self.sums[axis][:, pad, i]
                told = squares > 0
                if (difference[told] ** 2 / squares[told]).mean() > _STEADY:
                    continue
                numbers = (int(of[axis][pad, i]) for of in (self.since, self.told, self.witnesses))
                found.append(Joined(pad, kinds[axis], *of_lines[i], *numbers))
        return found

    def apart_since(self, pad: int, kind: LineKind, first: int, second: int) -> int:
        """Return the first frame from which on two lines did not differ."""
        axis = 0 if kind == "row" else 1
        of_lines = pairs(self.layout.rows if axis == 0 else self.layout.cols)
        return int(self.since[axis][pad, of_lines.index((first, second))])


def _summed(
    sums: NDArray[np.float32],
    lines: NDArray[np.float32],
    a: NDArray[np.intp],
    b: NDArray[np.intp],
    both: NDArray[np.bool_],
    apart: NDArray[np.bool_],
    tolerance: float,
) -> NDArray[np.float32]:
    """Return the sums of :class:`Twins` after readings of lines ``[t, pads, lines, positions]``.

    Args:
        sums: before.
        lines: the readings.
        a, b: int ``[pairs]``, the lines of each pair.
        both: bool ``[pads, pairs, positions]``, where both cells tell something.
        apart: bool ``[pads, pairs]``, that differ clearly: they begin anew.
        tolerance: as far as two conversions of one cell may differ.
    """
    pad, pair, position = np.nonzero(both & ~apart[..., None])
    if not (len(pad) or sums[1][apart].any()):
        return sums
    after = np.where(apart[..., None], np.float32(0), sums)
    difference = lines[:, pad, a[pair], position] - lines[:, pad, b[pair], position]  # [t, cells that tell]
    difference[np.isnan(difference)] = 0
    after[0, pad, pair, position] += difference.sum(axis=0)
    after[1, pad, pair, position] += (difference**2).sum(axis=0) + len(lines) * np.float32(_STEP * tolerance) ** 2
    return after


def telling(frames: NDArray[np.float64], still: NDArray[np.bool_], scale: Scale) -> NDArray[np.bool_]:
    """Return the cells ``[D]`` that are loaded, not saturated, and move in ``frames``: two alike are no chance."""
    now = np.nan_to_num(frames[-1])
    found: NDArray[np.bool_] = ~still & (now > scale.resting + scale.near) & (now < scale.full_scale - scale.near)
    return found
