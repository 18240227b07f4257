"""Noise loss: cells that read exactly the same for longer than any healthy cell, on arrays with
noise without contact.

Detects broken cells without any contact, whatever value they hold. The statistic is the number r of
consecutive frames with an identical reading, against the longest run L of the cell in the
reference:

    12   if r >= max(2 L, 1.5 recordings)          (log likelihood ratio fault : healthy)
    -3   if the constant run is as long but r <= L
    0    else

A runs test for a sensor "flatline", as in data quality control (QARTOD 2020). It detects nothing on
arrays that threshold their readings, or whose converter step is larger than the noise; then it is
switched off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.constant_runs import same_for
from diagnostics.evidence.term import untouched_evidence
from diagnostics.preprocessing.levels import FEWEST, MAJORITY, MARGIN
from diagnostics.preprocessing.readings import RecordingBlocks, held

if TYPE_CHECKING:
    from diagnostics.evidence.term import ConstantCells

_LONGER = 2.0  # times the longest run
_CALM = 0.25  # of a recording: a cell with a longer identical run has no noise
_QUIET = 0.02  # share of cells without noise off the rails, at most

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class NoiseLoss:
    """Longest runs of identical readings of healthy cells.

    Attributes:
        longest: float ``[D]``, L in frames; inf: the cell has no noise, or unknown.
        recording: median length of a recording, in frames.
    """

    longest: Floats
    recording: float

    @classmethod
    def fit(cls, recordings: Sequence[Floats], present: NDArray[np.bool_]) -> NoiseLoss:
        """Fit to fault-free recordings, ``[T, D]`` each, of the ``present`` cells (bool
        ``[D]``)."""
        every = np.arange(len(present))
        longest = np.zeros(len(present), np.intp)
        same = np.zeros(len(present), np.intp)
        value, last = np.full((2, len(present)), np.nan)
        lowest = np.inf
        highest = -np.inf
        for frames in RecordingBlocks.of(recordings).blocks():
            readings = held(frames, last)
            of_each = same_for(readings, same)
            at = of_each.argmax(axis=0)
            value = np.where(of_each[at, every] > longest, readings[at + 1, every], value)
            longest = np.maximum(longest, of_each[at, every])
            same = of_each[-1]
            last = readings[-1]
            lowest = np.fmin.reduce(frames, None, initial=lowest)
            highest = np.fmax.reduce(frames, None, initial=highest)
        recording = float(np.median([len(r) for r in recordings]))
        has_noise = longest <= _CALM * recording
        quiet = ~has_noise & (value > lowest) & (value < highest)
        few = (
            len(recordings) < FEWEST
            or has_noise[present].mean() < MAJORITY
            or quiet[present].mean() > _QUIET
        )
        return (
            cls.unknown(len(present))
            if few
            else cls(np.where(has_noise, longest, np.inf), recording)
        )

    @classmethod
    def unknown(cls, n_cells: int) -> NoiseLoss:
        """Return the state of a cold start: no cell is known to have noise."""
        return cls(np.full(n_cells, np.inf), 1.0)

    def evidence(self, cells: ConstantCells) -> Floats:
        """Return the log likelihood ratio faulty : healthy, ``[D]``.

        Where all cells at rest read less than in the reference, they may lie at the low rail, and
        have no noise there.
        """
        runs = cells.runs
        present = cells.present
        sunk = cells.lower < -cells.tolerance
        too_long = np.maximum(_LONGER * self.longest, MARGIN * self.recording)
        # missing readings are not identical ones
        calm = present & (np.minimum(runs.same, runs.length) >= too_long)
        as_ever = present & cells.rests & (runs.length >= too_long) & (runs.same <= self.longest)
        return untouched_evidence(calm, calm & ~(cells.rests & sunk), as_ever, present)
