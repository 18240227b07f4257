"""Duplicate lines: pairs of rows or columns that read the same, as with a stuck address bit or a
bridge.

Detects, among the pairs that one address bit or one bridge can join, those that agree within a
tolerance in every frame while informative cells (loaded, moving, not saturated) support the
agreement: a *coincidence*. With p the chance that two lines agree, n coincidences count n log2(1 /
p), and at most n: models err. p is the share of the other pairs on the pad, rows and columns, that
agreed where they could, in the same frames; what moves all cells alike is no evidence. It is no
less than the share of the reference in which the pair itself agreed: what presses two cells alike
there does so in the log. A pair is found when it counts 3 more than any healthy pair, and when its
difference d is white noise around zero, as of one cell read twice:

    sqrt(n) sum d_t d_{t-1} / sum d^2 <= 3

This is a one-sided test of the lag-1 autocorrelation (Box and Pierce 1970). Two cells under equal
loads differ by a constant or a slow difference, which is correlated with itself. Lines that nothing
loads are not detected.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import SensorLayout, address_bits
from diagnostics.wiring import LineKind

if TYPE_CHECKING:
    from diagnostics.preprocessing.scale import Scale

_EVERY = 4  # every fourth frame is compared: faults last longer
_MOST_AT_ONCE = 3  # coincidences counted in one segment: neighbours under one object are correlated
_SMOOTH = 3.0  # standard deviations of the lag-1 autocorrelation of a difference; 0 for noise
_LEAST_CHANCE = 0.5  # of agreement: models err
_STEP = 0.1  # of the tolerance: smaller differences are none

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class DuplicatePair:
    """Two lines that read the same.

    Attributes:
        pad: the pad.
        kind: ``"row"`` or ``"column"``.
        first, second: indices of the lines, ascending.
        since: number of the first frame from which on they did not differ.
        seen_by: number of the frame of the first coincidence.
        coincidences: number of coincidences since.
        chance: probability of one of them where the lines are not joined, at least 1/2.
    """

    pad: int
    kind: LineKind
    first: int
    second: int
    since: int
    seen_by: int
    coincidences: int
    chance: float


class _Comparison(NamedTuple):
    """What some frames say of pairs of lines.

    Attributes:
        ever: bool ``[pads, pairs]``, whether they differ in one of the frames.
        since: int ``[pads, pairs]``, number of the frame after the last in which they do.
        both: bool ``[pads, pairs, positions]``, where the cells of both lines are informative.
    """

    ever: Mask
    since: NDArray[np.intp]
    both: Mask

    @property
    def supported(self) -> Mask:
        """Pairs with informative cells, bool ``[pads, pairs]``."""
        return np.asarray(self.both.any(axis=2))


@cache
def pairs(count: int) -> tuple[tuple[int, int], ...]:
    """Return the pairs out of ``count`` lines that one address bit or one bridge can join, each
    once."""
    bits = [1 << b for b in range(address_bits(count))]
    by_bit = {
        (i, i | bit) for bit in bits for i in range(count) if not i & bit and (i | bit) < count
    }
    return tuple(sorted(by_bit | set(pairwise(range(count)))))


@dataclass(frozen=True)
class _Pairs:
    """All pairs of rows, or of columns.

    Attributes:
        first, second: int ``[pairs]``, indices of the lines.
        there: bool ``[pads, pairs, positions]``, where both lines have a cell.
        since, seen_by, coincidences: int ``[pads, pairs]``, see :class:`DuplicatePair`.
        sums: float ``[3, pads, pairs]``, over the informative cells and frames since: the square of
            the difference, its product with the one before, and 1.
        others: int ``[2, pads, pairs]``, how many other pairs could agree when these did, and how
            many of them agreed.
        own: int ``[2, pads, pairs]``, in how many segments these could agree, and in how many they
            did.
        usual: float ``[pads, pairs]``, share of these in the reference.
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    there: Mask
    since: NDArray[np.intp]
    seen_by: NDArray[np.intp]
    coincidences: NDArray[np.intp]
    sums: NDArray[np.float32]
    others: NDArray[np.intp]
    own: NDArray[np.intp]
    usual: NDArray[np.float64]

    @classmethod
    def begin(cls, present: Mask, usual: NDArray[np.float64]) -> _Pairs:
        """Return the state before any frame, for cells ``present`` (bool
        ``[pads, lines, positions]``)."""
        first, second = np.array(pairs(present.shape[1]), dtype=np.intp).reshape(-1, 2).T
        there = present[:, first] & present[:, second]
        nothing = np.zeros(there.shape[:2], np.intp)
        sums = np.zeros((3, *nothing.shape), np.float32)
        counts = np.zeros((2, *nothing.shape), np.intp)
        return cls(first, second, there, nothing, nothing, nothing, sums, counts, counts, usual)

    def compare(
        self,
        lines: NDArray[np.float32],
        numbers: NDArray[np.intp],
        informative: Mask,
        tolerance: float,
    ) -> _Comparison:
        """Compare readings ``[t, pads, lines, positions]`` of frames ``numbers``."""
        # Missing readings and positions without a cell do not differ from anything.
        difference = np.take(lines, self.first, axis=2)
        difference -= np.take(lines, self.second, axis=2)
        differ = np.abs(difference, out=difference) > tolerance
        differ &= self.there
        differ = np.asarray(differ.any(axis=3))  # [t, pads, pairs]
        ever = np.asarray(differ.any(axis=0))
        last = len(differ) - 1 - differ[::-1].argmax(axis=0)
        both: Mask = np.take(informative, self.first, axis=1)  # [pads, pairs, positions]
        both &= np.take(informative, self.second, axis=1)
        return _Comparison(ever, numbers[last] + 1, both)

    def extend(
        self,
        lines: NDArray[np.float32],
        number: int,
        compared: _Comparison,
        totals: NDArray[np.intp],
        tolerance: float,
    ) -> _Pairs:
        """Return the pairs after readings ``[t, pads, lines, positions]``, the last of them in
        frame ``number``.

        ``totals``, int ``[2, pads]``: pairs of the pad that could agree in these frames, and those
        that did.
        """
        ever = compared.ever
        both = compared.both
        since = np.where(ever, compared.since, self.since)
        seen_by = self.seen_by
        coincidences = self.coincidences
        sums = self.sums
        others = self.others
        supported = compared.supported
        agree = supported & ~ever
        own = self.own + np.stack([supported, agree])
        if agree.any() or (ever & (coincidences > 0)).any():
            coincidences = np.where(
                ever, 0, coincidences + np.minimum(both.sum(axis=2), _MOST_AT_ONCE)
            )
            seen_by = np.where(agree & (self.coincidences == 0), number, seen_by)
            sums = np.where(ever, np.float32(0), sums) + self._summed(
                lines, both & ~ever[..., None], tolerance
            )
            others = np.where(ever, 0, others + agree * (totals[..., None] - 1))
        return replace(
            self,
            since=since,
            seen_by=seen_by,
            coincidences=coincidences,
            sums=sums,
            others=others,
            own=own,
        )

    @property
    def chance(self) -> NDArray[np.float64]:
        """Probability that two lines agree which are not joined, at least 1/2,
        ``[pads, pairs]``."""
        chance: NDArray[np.float64] = np.maximum(agreement(self.others), self.usual)
        return np.maximum(chance, _LEAST_CHANCE)

    def _summed(
        self, lines: NDArray[np.float32], both: Mask, tolerance: float
    ) -> NDArray[np.float32]:
        """Return the sums over the informative cells (``both``) in more frames,
        ``[3, pads, pairs]``."""
        pad, pair, position = np.nonzero(both)
        difference = (
            lines[:, pad, self.first[pair], position] - lines[:, pad, self.second[pair], position]
        )
        difference[np.isnan(difference)] = 0
        least = np.float32(_STEP * tolerance)
        more = np.zeros_like(self.sums)
        products = difference[1:] * difference[:-1]
        for total, values in zip(
            more, (difference**2 + least**2, products, np.ones_like(products)), strict=True
        ):
            np.add.at(total, (pad, pair), values.sum(axis=0))
        return more

    @property
    def counted(self) -> NDArray[np.intp]:
        """What the coincidences count, rounded down, int ``[pads, pairs]``; see the module."""
        return np.asarray(self.coincidences * -np.log2(self.chance), dtype=np.intp)

    def matching(self, needed: int) -> list[tuple[int, int]]:
        """Return (pad, pair) of the pairs that count at least ``needed`` and differ by noise
        only."""
        often = self.counted >= needed
        if not often.any():
            return []
        squares, products, count = self.sums
        noise = products * np.sqrt(count) <= _SMOOTH * squares
        return [(pad, i) for pad, i in np.argwhere(often & noise).tolist()]


def agreement(counts: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the probability that pairs agree, from how often they could and did (Laplace),
    ``[pads, pairs]`` of ``[2, pads, pairs]``."""
    could, did = counts
    share: NDArray[np.float64] = (did + 1) / (could + 2)
    return share


@dataclass(frozen=True)
class DuplicateLines:
    """All pairs of lines of an array.

    Attributes:
        layout: the array.
        of: the pairs of rows and of columns.
        most: the most that any pair counted which differed by noise only.
    """

    layout: SensorLayout
    of: Mapping[LineKind, _Pairs]
    most: int = 0

    @classmethod
    def begin(
        cls, layout: SensorLayout, usual: NDArray[np.float64] | None = None
    ) -> DuplicateLines:
        """Return the state before any frame. With declared wiring there are no rows and columns to
        compare.

        Args:
            layout: the array.
            usual: float ``[pads, pairs]``, P(a pair agrees) in the reference, rows before columns;
                None: unknown.
        """
        if not layout.is_matrix:
            return cls(layout, {})
        n_rows = len(pairs(layout.rows))
        if usual is None:
            usual = np.zeros((layout.pads, n_rows + len(pairs(layout.cols))))
        return cls(
            layout,
            {
                "row": _Pairs.begin(layout.present, usual[:, :n_rows]),
                "column": _Pairs.begin(layout.present.swapaxes(1, 2), usual[:, n_rows:]),
            },
        )

    @property
    def agreed(self) -> NDArray[np.intp]:
        """In how many segments each pair of rows, then of columns, could agree, and did, int
        ``[2, pads, pairs]``."""
        none = np.zeros((2, self.layout.pads, 0), np.intp)
        return np.concatenate([none, *(each.own for each in self.of.values())], axis=2)

    def extend(
        self,
        frames: NDArray[np.float64],
        numbers: NDArray[np.intp],
        informative: Mask,
        tolerance: float,
    ) -> DuplicateLines:
        """Return the pairs after more frames.

        Args:
            frames: ``[t, D]``.
            numbers: int ``[t]``, of the frames.
            informative: bool ``[D]``, cells that are loaded and move in these frames.
            tolerance: largest difference of two conversions of one cell.
        """
        if not self.of:
            return self
        # With the last frame, in which informative cells are loaded.
        some = slice((len(frames) - 1) % _EVERY, None, _EVERY)
        grid, loaded = (
            self.layout.grid(frames[some].astype(np.float32)),
            self.layout.grid(informative),
        )
        lines: dict[LineKind, tuple[NDArray[np.float32], Mask]] = {
            "row": (grid, loaded),
            "column": (grid.swapaxes(2, 3), loaded.swapaxes(1, 2)),
        }
        compared = {
            kind: self.of[kind].compare(readings, numbers[some], moving, tolerance)
            for kind, (readings, moving) in lines.items()
        }
        totals = np.zeros((2, self.layout.pads), np.intp)
        for each in compared.values():
            supported = each.supported
            totals += np.stack([supported.sum(axis=1), (supported & ~each.ever).sum(axis=1)])
        of: dict[LineKind, _Pairs] = {
            kind: self.of[kind].extend(
                readings, int(numbers[some][-1]), compared[kind], totals, tolerance
            )
            for kind, (readings, _) in lines.items()
        }
        more = [
            int(each.counted[place])
            for each in of.values()
            for place in each.matching(self.most + 1)
        ]
        return DuplicateLines(self.layout, of, max([self.most, *more]))

    def duplicate_pairs(self, usual: int) -> list[DuplicatePair]:
        """Return the pairs that differ by noise and count more than healthy ones (``usual``)."""
        needed = usual + _MOST_AT_ONCE
        found = []
        for kind, each in self.of.items():
            for pad, i in each.matching(needed):
                found.append(
                    DuplicatePair(
                        pad=pad,
                        kind=kind,
                        first=int(each.first[i]),
                        second=int(each.second[i]),
                        since=int(each.since[pad, i]),
                        seen_by=int(each.seen_by[pad, i]),
                        coincidences=int(each.coincidences[pad, i]),
                        chance=float(each.chance[pad, i]),
                    )
                )
        return found

    def apart_since(self, pad: int, kind: LineKind, first: int, second: int) -> int:
        """Return the first frame from which on two lines did not differ."""
        each = self.of[kind]
        (i,) = np.flatnonzero((each.first == first) & (each.second == second))
        return int(each.since[pad, i])


def informative(frames: NDArray[np.float64], still: Mask, scale: Scale) -> Mask:
    """Return the cells ``[D]`` that are loaded, not saturated, and move in ``frames``."""
    now = frames[-1]  # comparisons with NaN are False
    found: Mask = (
        ~still & (now > scale.baseline + scale.near) & (now < scale.full_scale - scale.near)
    )
    return found
