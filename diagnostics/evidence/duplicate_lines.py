"""Wiring evidence of addresses and bridges: lines that read exactly alike.

A stuck address bit selects the same line twice, a bridge joins two neighbours: either way two lines read the same,
frame by frame, to within the converter's step. Healthy lines do that only while nothing touches them, or by chance when
something lies evenly across both. So each pair of lines that one bit or one bridge could join is watched: since when
they have not differed, how often they have agreed on a load that moved (a witness), and whether what they differ by
is noise around zero, as of one cell read twice, or small but stays or comes and goes slowly, as of two cells under
equal loads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import LineKind, SensorLayout, address_bits

if TYPE_CHECKING:
    from diagnostics.preprocessing.scale import Scale

_EVERY = 4  # frames; a lasting fault does not hide between them
_FEWEST_WITNESSES = 4  # and three more than healthy lines ever had
_MOST_AT_ONCE = 3  # of these in one segment: neighbours under one thing are alike
_STEADY = 5.0  # squared z value of a difference, mean over the cells: 1 if it is noise around zero
_SMOOTH = 3.0  # standard deviations of the correlation of a difference with the one before: 0 if it is noise
_STEP = 0.1  # of the tolerance: so small a difference is none

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class DuplicatePair:
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
    seen_by: int
    witnesses: int


@cache
def pairs(count: int) -> tuple[tuple[int, int], ...]:
    """Return the pairs out of ``count`` lines that one address bit or one bridge can join, each once."""
    bits = [1 << b for b in range(address_bits(count))]
    by_bit = {(i, i | bit) for bit in bits for i in range(count) if not i & bit and (i | bit) < count}
    return tuple(sorted(by_bit | set(pairwise(range(count)))))


@dataclass(frozen=True)
class _Pairs:
    """What is known of all pairs of rows, or of columns.

    Attributes:
        first, second: int ``[pairs]``, the lines of each.
        there: bool ``[pads, pairs, positions]``, where both have a cell.
        since, told, witnesses: int ``[pads, pairs]``, see :class:`DuplicatePair`.
        sums: of what the cells of a pair differed by while both told something: the difference, its square, its product
            with the one before, and 1 for each of these, float ``[4, pads, pairs, positions]``; squares are above 0
            where there were witnesses.
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    there: Mask
    since: NDArray[np.intp]
    seen_by: NDArray[np.intp]
    witnesses: NDArray[np.intp]
    sums: NDArray[np.float32]

    @classmethod
    def begin(cls, present: Mask) -> _Pairs:
        """Nothing seen yet of lines ``[pads, lines, positions]``."""
        first, second = np.array(pairs(present.shape[1]) or np.empty((0, 2)), dtype=np.intp).reshape(-1, 2).T
        there = present[:, first] & present[:, second]
        nothing = np.zeros(there.shape[:2], np.intp)
        return cls(first, second, there, nothing, nothing, nothing, np.zeros((4, *there.shape), np.float32))

    def extend(
        self, lines: NDArray[np.float32], numbers: NDArray[np.intp], informative: Mask, tolerance: float
    ) -> _Pairs:
        """Return the pairs after readings ``[t, pads, lines, positions]`` of frames with these numbers."""
        # A missing reading differs from nothing; a position without a cell neither.
        difference = np.take(lines, self.first, axis=2)
        difference -= np.take(lines, self.second, axis=2)
        differ = np.abs(difference, out=difference) > tolerance
        differ &= self.there
        differ = np.asarray(differ.any(axis=3))  # [t, pads, pairs]
        ever = np.asarray(differ.any(axis=0))
        last = len(differ) - 1 - differ[::-1].argmax(axis=0)
        since = np.where(ever, numbers[last] + 1, self.since)
        both: Mask = np.take(informative, self.first, axis=1)  # [pads, pairs, positions]
        both &= np.take(informative, self.second, axis=1)
        seen_by, witnesses, sums = self.seen_by, self.witnesses, self.sums
        agree = both.any(axis=2) & ~ever
        if agree.any() or (ever & (witnesses > 0)).any():
            witnesses = np.where(ever, 0, witnesses + np.minimum(both.sum(axis=2), _MOST_AT_ONCE))
            seen_by = np.where(agree & (self.witnesses == 0), numbers[-1], seen_by)
            sums = self._summed(lines, both & ~ever[..., None], ever, tolerance)
        return _Pairs(self.first, self.second, self.there, since, seen_by, witnesses, sums)

    def _summed(self, lines: NDArray[np.float32], both: Mask, anew: Mask, tolerance: float) -> NDArray[np.float32]:
        """Return the sums with what ``both`` cells of a pair tell; pairs that differ clearly begin ``anew``."""
        after = np.where(anew[..., None], np.float32(0), self.sums)
        pad, pair, position = np.nonzero(both)
        difference = lines[:, pad, self.first[pair], position] - lines[:, pad, self.second[pair], position]
        difference[np.isnan(difference)] = 0
        after[0, pad, pair, position] += difference.sum(axis=0)
        after[1, pad, pair, position] += (difference**2).sum(axis=0) + len(lines) * np.float32(_STEP * tolerance) ** 2
        after[2, pad, pair, position] += (difference[1:] * difference[:-1]).sum(axis=0)
        after[3, pad, pair, position] += len(lines) - 1
        return after

    def matching(self, needed: int) -> list[tuple[int, int]]:
        """Return (pad, pair) of those with so many witnesses, 1 or more, that differ by nothing but noise."""
        return [(pad, i) for pad, i in np.argwhere(self.witnesses >= needed).tolist() if not self._steady(pad, i)]

    def _steady(self, pad: int, pair: int) -> bool:
        """Whether two lines differ by little, but not by noise: two cells under equal loads, not one read twice.

        The difference is then always the same, or goes from one value to another by and by.
        """
        difference, squares, products, count = self.sums[:, pad, pair]
        seen_by = squares > 0
        smooth = products[seen_by].sum() / squares[seen_by].sum() * np.sqrt(count[seen_by].sum())
        return bool((difference[seen_by] ** 2 / squares[seen_by]).mean() > _STEADY or smooth > _SMOOTH)


@dataclass(frozen=True)
class DuplicateLines:
    """What is known of all pairs of lines.

    Attributes:
        layout: the array.
        of: the pairs of rows and of columns.
        most: the most witnesses that any pair ever had that differed by nothing but noise.
    """

    layout: SensorLayout
    of: Mapping[LineKind, _Pairs]
    most: int = 0

    @classmethod
    def begin(cls, layout: SensorLayout) -> DuplicateLines:
        """Nothing seen yet."""
        present = layout.present
        return cls(layout, {"row": _Pairs.begin(present), "column": _Pairs.begin(present.swapaxes(1, 2))})

    def extend(
        self, frames: NDArray[np.float64], numbers: NDArray[np.intp], informative: Mask, tolerance: float
    ) -> DuplicateLines:
        """Return the pairs after more frames.

        Args:
            frames: ``[t, D]``.
            numbers: int ``[t]``, of the frames.
            telling: bool ``[D]``, cells that are loaded and move in these frames.
            tolerance: as far as two conversions of one cell may differ.
        """
        some = slice((len(frames) - 1) % _EVERY, None, _EVERY)  # up to the last, in which ``telling`` cells are loaded
        grid, seen_by = self.layout.grid(frames[some].astype(np.float32)), self.layout.grid(informative)
        of: dict[LineKind, _Pairs] = {
            "row": self.of["row"].extend(grid, numbers[some], seen_by, tolerance),
            "column": self.of["column"].extend(grid.swapaxes(2, 3), numbers[some], seen_by.swapaxes(1, 2), tolerance),
        }
        more = [int(each.witnesses[place]) for each in of.values() for place in each.matching(self.most + 1)]
        return DuplicateLines(self.layout, of, max([self.most, *more]))

    def duplicate_pairs(self, usual: int) -> list[DuplicatePair]:
        """Return the pairs that differ by noise and have more witnesses than healthy ones, up to ``usual``."""
        needed = max(_FEWEST_WITNESSES, usual + 3)
        return [
            DuplicatePair(
                pad, kind, int(each.first[i]), int(each.second[i]),
                *(int(values[pad, i]) for values in (each.since, each.seen_by, each.witnesses)),
            )
            for kind, each in self.of.items()
            for pad, i in each.matching(needed)
        ]  # fmt: skip

    def apart_since(self, pad: int, kind: LineKind, first: int, second: int) -> int:
        """Return the first frame from which on two lines did not differ."""
        each = self.of[kind]
        (i,) = np.flatnonzero((each.first == first) & (each.second == second))
        return int(each.since[pad, i])


def informative(frames: NDArray[np.float64], still: Mask, scale: Scale) -> Mask:
    """Return the cells ``[D]`` that are loaded, not saturated, and move in ``frames``: two alike are no chance."""
    now = frames[-1]  # a missing reading is neither above nor below anything
    found: Mask = ~still & (now > scale.baseline + scale.near) & (now < scale.full_scale - scale.near)
    return found
