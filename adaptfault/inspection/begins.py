"""Recordings that begin in contact, and those that were tared in contact.

A driver that tares at the start takes the contact out that it begins with. With s the median over
the recordings of the mean of the first readings of each cell, l_i(t) the mean over the cells of the
readings minus s, signed so that load rises, L the median over the recordings of the lowest l_i, and
p that of the highest minus the lowest, a recording begins in contact where l_i(0) exceeds L by 30 %
of p. It was tared in contact where it begins at L, and goes 10 % of p below: of three recordings or
more, most of which begin at their lowest. Recordings agree more in what they read without load than
with it, which shows the sign. A missing reading counts as the first ones of its cell in the
recording.

It takes one pass, and parts of a data set are put one behind the other.

Not detected: zeroing in contact whose readings are cut off at 0, and one where most recordings
begin in contact.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics import SensorLayout
from diagnostics.preprocessing.levels import MAJORITY
from diagnostics.preprocessing.quantiles import known_quantile

_FIRST = 3  # frames of a recording from which its begin is taken
_IN_CONTACT = 0.3  # of the median peak, as the begin of a contact event
_BELOW = 0.1  # of the median peak, on the other side of rest
_RECORDINGS = 3  # that show what rest is

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Begins:
    """How n recordings begin, and what their frames read on average.

    Attributes:
        starts: float ``[n, D]``, mean of the first readings of each cell; NaN: none.
        means: float ``[n, 3]``, the lowest, the median and the highest mean of a frame.
        zeros: float ``[n, 2]``, share of the cells that read 0 in the lowest and highest of these
            frames.
        lowest: float ``[n, D]``, reading of each cell.
    """

    starts: Floats
    means: Floats
    zeros: Floats
    lowest: Floats

    @classmethod
    def of(cls, recordings: Iterable[NDArray[Any]], layout: SensorLayout) -> Begins:
        """Return those of recordings ``[T, D]``, each read once; NaN = missing."""
        found = []
        for frames in recordings:
            one = Begun(layout)
            one.add(frames)
            found.append(one.begins())
        return cls.joined(found)

    @classmethod
    def joined(cls, parts: Sequence[Begins]) -> Begins:
        """Return those of all parts, in their order."""
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def in_contact(
        self, names: Sequence[str], layout: SensorLayout
    ) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the names of the recordings that begin in contact, and of those that were tared in
        contact.

        Args:
            names: of all.
            layout: the array.
        """
        present = layout.is_cell
        origin = np.nan_to_num(known_quantile(self.starts[:, present], 0.5, axis=0))
        begins = np.nan_to_num(self.starts[:, present] - origin).mean(axis=1)
        loads = self.means - origin.mean()
        ends = loads[:, [0, 2]]
        peak = float(np.median(ends[:, 1] - ends[:, 0]))
        if not peak > 0:
            return (), ()
        floor = np.fmin.reduce(self.lowest[:, present])
        if len(loads) >= _RECORDINGS:  # they agree in rest
            from_rest = [_spread(end) for end in ends.T]
        elif (floor == 0).mean() > MAJORITY:
            from_rest = [0.0, 1.0]
        else:  # most frames are at rest
            from_rest = [float(np.median(np.abs(loads[:, 1] - end))) for end in ends.T]
        rests = int(np.argmin(from_rest))
        sign = 1 - 2 * rests
        lowest = sign * ends[:, rests]
        rest = np.median(lowest)
        begins = sign * begins
        begun = begins - rest > _IN_CONTACT * peak
        is_usual = begins - lowest <= _BELOW * peak
        # a sensor that reads 0 is not below its rest
        is_below = (lowest < rest - _BELOW * peak) & (self.zeros[:, rests] < MAJORITY)
        many = len(loads) >= _RECORDINGS and is_usual.mean() > MAJORITY
        every = np.array(names, dtype=object)
        return tuple(every[begun]), tuple(every[is_below & ~is_usual & ~begun & many])


class Begun:
    """How one recording begins, while its frames come; ``layout``: the array."""

    def __init__(self, layout: SensorLayout) -> None:
        self._present = layout.is_cell
        self._first = np.zeros((0, layout.n_cells))
        self._start = np.full(layout.n_cells, np.nan)
        self._lowest = np.full(layout.n_cells, np.nan)
        self._means: list[Floats] = []
        self._ends = np.array([np.inf, -np.inf])
        self._zeros = np.zeros(2)

    def add(self, frames: NDArray[Any]) -> None:
        """Take in the next frames, ``[t, D]``; NaN = missing."""
        if not len(frames):
            return
        if len(self._first) < _FIRST:
            self._first = np.concatenate([self._first, frames[: _FIRST - len(self._first)]])
            self._start = _mean(self._first)
        self._lowest = np.fmin(self._lowest, np.fmin.reduce(frames))
        present = frames[:, self._present]
        missing = np.isnan(present)
        filled = present
        if missing.any():
            filled = np.where(missing, np.nan_to_num(self._start[self._present]), present)
        means = filled.mean(axis=1, dtype=np.float64)
        self._means.append(means)
        for end, at in enumerate((int(means.argmin()), int(means.argmax()))):
            outermost = (np.fmin, np.fmax)[end](self._ends[end], means[at])
            if outermost != self._ends[end]:
                self._ends[end] = outermost
                self._zeros[end] = (present[at] == 0).mean()

    def begins(self) -> Begins:
        """Return how it begins."""
        means = np.concatenate([*self._means, np.zeros(0)])
        middle = float(np.median(means)) if len(means) else 0.0
        found = np.array([self._ends[0], middle, self._ends[1]])
        return Begins(self._start[None], found[None], self._zeros[None], self._lowest[None])


def _spread(values: Floats) -> float:
    """Return the median distance from the median."""
    return float(np.median(np.abs(values - np.median(values))))


def _mean(frames: NDArray[Any]) -> Floats:
    """Return the mean of each cell; NaN where it has no reading."""
    known = np.isfinite(frames)
    total = np.where(known, frames, 0.0).sum(axis=0)
    counts = known.sum(axis=0)
    return np.where(counts > 0, total / np.maximum(counts, 1), np.nan)
