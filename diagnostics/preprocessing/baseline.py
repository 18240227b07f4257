"""Where cells rest, how far an untouched one wanders from there, and the least that each reads.

Skins that threshold their readings rest at one value. Others have noise, and their offsets wander from one recording to
the next: neither is to be taken for a touch. And on a skin whose cells rest above 0, or are never quite calm, a cell
that lost its wire gives itself away untouched, by a steady 0, and one that reads what it always did has most likely not
lost it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.contact_events import SEGMENT
from diagnostics.preprocessing.readings import RecordingBlocks

if TYPE_CHECKING:
    from diagnostics.events.constant_runs import ConstantRuns

_LOW = 0.05  # quantile of all readings of a cell
_LEAST = 0.03  # quantile of its readings in one recording: where it rested in that, if it was let go at all
_LIGHT = 0.05  # of full scale: a cell that never read less above its rest than this was touched all through
_CALM = 0.25  # quantile of the noise of cells in recordings: touched cells have more
_NOISE = 6.0  # standard deviations from the low quantile to the highest of many readings
_RARE = 0.001  # of the cells in recordings: what so few did is taken for none
FEWEST = 8  # recordings: fewer do not tell how rests change from one to the next
_OFTEN = 0.5  # share of the recordings: what a cell reads in so many is its rest, not a load
_BEYOND = 1.5  # times as far as ever from the usual: no healthy cell reads that little
_WORTH = 12.0  # log likelihood ratio of reading what no healthy cell does
_AS_EVER = -2.0  # and of what the cell itself always did, where that is not what a broken one reads
_CROWD = 0.5  # share of the cells: when so many are unlike ever, it is the skin that has changed
_BLOCK = 4096  # cells looked at together

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LowerLimit:
    """The least that each healthy cell reads at its highest, while it holds still.

    Attributes:
        reading: float ``[D]``; full scale where the noise lets no cell hold still; -inf: not known.
        usual: so far above it most untouched cells read at least; -inf: not known.
    """

    reading: Floats
    usual: float

    @classmethod
    def unknown(cls, n_cells: int) -> LowerLimit:
        """Without a reference nothing is less than healthy."""
        return cls(np.full(n_cells, -np.inf), -np.inf)

    @classmethod
    def fit(
        cls,
        low: Floats,
        last: Floats,
        peaks: Floats,
        most: Floats,
        present: NDArray[np.bool_],
        tolerance: float,
        full_scale: float,
    ) -> LowerLimit:
        """Learn from what :func:`_low` returns of a reference in which untouched cells read ``most`` (``[D]``)."""
        peak_values = peaks[:, present]
        reading = np.full(
            len(low), np.quantile(peak_values[np.isfinite(peak_values)], _RARE, method="lower") - 2 * tolerance
        )
        # Where most cells rest at 0, one that always reads more is loaded.
        if len(peaks) >= FEWEST and np.median(low[present]) > tolerance:
            peak = peaks - low
            unloaded = peak < _LIGHT * full_scale
            often = np.count_nonzero(unloaded, axis=0) >= _OFTEN * len(peaks)
            peak_values = peak[unloaded & present]
            rare = float(np.quantile(peak_values, _RARE, method="lower"))
            tail_slope = max((_BEYOND - 1) * (float(np.median(peak_values)) - rare), tolerance)
            reading = np.where(often, np.maximum(reading, low + rare - tail_slope), reading)
        above = (np.median((row - reading)[rests]) for row in last if (rests := present & (row <= most)).any())
        return cls(reading, float(min(above, default=-np.inf)))

    def lower(self, runs: ConstantRuns, rests: NDArray[np.bool_]) -> float:
        """Return by how much those that rest (bool ``[D]``) all read less than they ever did, 0 or below."""
        if not (np.isfinite(self.usual) and rests.any()):
            return 0.0
        return min(0.0, float(np.median((runs.value - self.reading)[rests])) - self.usual)

    def evidence(
        self, runs: ConstantRuns, rests: NDArray[np.bool_], tolerance: float, present: NDArray[np.bool_], lower: float
    ) -> Floats:
        """Return what a still stretch says of being open, whatever touches the cell, a log likelihood ratio ``[D]``.

        Args:
            runs: the still stretches.
            rests: bool ``[D]``, cells that read what an untouched one does, or less.
            tolerance: a reading wanders so far around 0, the low rail.
            present: bool ``[D]``.
            lower: see :meth:`lower`.
        """
        received = present & np.isfinite(runs.value)
        least = self.reading + lower
        less = received & (runs.length >= SEGMENT) & (runs.high < least)
        open_ = (runs.high <= 2 * tolerance) | (runs.high < least[present].min())
        as_ever = rests & received & (runs.high >= least) & (least > tolerance)
        return untouched_evidence(less, less & open_, as_ever, present)


def untouched_evidence(
    unusual: NDArray[np.bool_], broken: NDArray[np.bool_], as_ever: NDArray[np.bool_], present: NDArray[np.bool_]
) -> Floats:
    """Return what untouched cells give away, a log likelihood ratio ``[D]``; nothing where too many do.

    Args:
        unlike: bool ``[D]``, cells that do what they never did.
        broken: those of them that can only be broken.
        as_ever: bool ``[D]``, cells that do what they always did, and broken ones do not.
        present: bool ``[D]``.
    """
    if unusual.sum() > _CROWD * present.sum():
        return np.zeros(len(present))
    return np.where(broken, _WORTH, np.where(as_ever, _AS_EVER, 0.0))


def baseline(
    recordings: Sequence[Floats], present: NDArray[np.bool_], tolerance: float, full_scale: float
) -> tuple[Floats, LowerLimit]:
    """Return the most that each cell reads untouched, ``[D]``, and the least that healthy ones read.

    A cell without any reading rests at 0.

    Args:
        recordings: ``[T, D]`` each.
        present: bool ``[D]``, cells that tell how far they wander.
        tolerance: a cell is still while it stays within +- this; a wander within it counts as rest anyway.
        full_scale: of the layout.
    """
    low, last, peaks = _low(recordings)
    cells, some = RecordingBlocks.of(recordings).sample(present)
    offsets, bends = [], []
    for frames in some:
        received = ~np.isnan(frames).any(axis=0)
        if len(frames) > 2 and received.any():
            whole = frames[:, received]
            offsets.append(np.quantile(whole, _LEAST, axis=0) - low[cells[received]])
            bends.append(np.median(np.abs(np.diff(whole, 2, axis=0)), axis=0))  # a load moves, but hardly bends
    if not offsets:
        return low, LowerLimit.unknown(len(low))
    offset = np.concatenate(offsets)
    light = offset[offset < _LIGHT * full_scale]
    noise = float(np.quantile(np.concatenate(bends), _CALM)) / (0.6745 * np.sqrt(6))
    most = low + max(0.0, _highest(light) + _NOISE * noise - tolerance)
    if noise > tolerance:
        return most, LowerLimit(np.full(len(low), full_scale), -np.inf)
    return most, LowerLimit.fit(low, last, peaks, most, present, tolerance, full_scale)


def _highest(offset: Floats) -> float:
    """Return how far untouched cells wander up, from how far they wander down: light loads hide the other end.

    As far as from the lowest to the median again, if there is a sharp lowest; tails may reach half as far again.
    """
    if not len(offset):
        return 0.0
    usual = max(0.0, float(np.median(offset)))
    below = usual - float(np.quantile(offset, _RARE, method="lower"))
    return usual + min(max(below, usual), 2 * usual)


def _low(recordings: Sequence[Floats]) -> tuple[Floats, Floats, Floats]:
    """Return a low quantile of each cell's readings, ``[D]``; 0 for a cell without any.

    And the last in each recording, and the lowest that it read at its highest in half a segment, ``[recordings, D]``.
    """
    readings, n_cells = RecordingBlocks.of(recordings), recordings[0].shape[1]
    low, (last, peaks) = np.zeros(n_cells), np.full((2, len(readings), n_cells), np.nan)
    for first in range(0, n_cells, _BLOCK):
        cells = np.arange(first, min(first + _BLOCK, n_cells))
        pieces = [readings.piece(i, slice(None), cells) for i in range(len(readings))]
        for i, frames in enumerate(pieces):
            last[i, cells], peaks[i, cells] = frames[-1], _lowest_peak(frames)
        frames = np.concatenate(pieces)
        received = ~np.isnan(frames).all(axis=0)
        low[cells[received]] = np.nanquantile(frames[:, received], _LOW, axis=0)
    return low, last, peaks


def _lowest_peak(frames: Floats) -> Floats:
    """Return the lowest of the highest readings in half a segment, ``[D]``: a still stretch of one shows as much."""
    length = min(SEGMENT // 2, len(frames))
    whole = len(frames) // length * length
    lowest: Floats = np.fmin.reduce(np.fmax.reduce(frames[:whole].reshape(-1, length, frames.shape[1]), axis=1), axis=0)
    return lowest
