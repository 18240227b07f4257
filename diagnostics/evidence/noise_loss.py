"""Temporal evidence of missing noise: where even untouched cells flicker, one that does not any more is broken.

So a cell gives itself away untouched, whatever it holds. A skin that thresholds its readings has no such noise, nor has
one whose converter is coarser than its noise: there it depends on a hair where a cell flickers, and nothing is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.constant_runs import ConstantRuns, same_for
from diagnostics.preprocessing.baseline import FEWEST, untouched_evidence
from diagnostics.preprocessing.readings import RecordingBlocks, held

_CALM = 0.25  # of a recording: a cell that ever reads the same for longer does not flicker
# Of the cells so many flicker at least, and of those that do not so many at most are elsewhere than at the rails.
_FLICKERING, _QUIET = 0.5, 0.02
# So often as long as ever is too long to read the same, and so often as long as a recording: rests change in between.
_LONGER, _RECORDINGS = 2.0, 1.5

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class NoiseLoss:
    """How long healthy cells read exactly the same.

    Attributes:
        longest: float ``[D]``, frames on end in which each cell had the same reading; inf: it does not flicker, or not
            known.
        recording: frames of a recording.
    """

    longest: Floats
    recording: float

    @classmethod
    def fit(cls, recordings: Sequence[Floats], present: NDArray[np.bool_]) -> NoiseLoss:
        """Learn from fault-free recordings, ``[T, D]`` each, of the cells that are ``present`` (bool ``[D]``)."""
        every = np.arange(len(present))
        longest, same = np.zeros(len(present), np.intp), np.zeros(len(present), np.intp)
        value, last = np.full((2, len(present)), np.nan)
        lowest, highest = np.inf, -np.inf
        for frames in RecordingBlocks.of(recordings).blocks():
            readings = held(frames, last)
            of_each = same_for(readings, same)
            at = of_each.argmax(axis=0)
            value = np.where(of_each[at, every] > longest, readings[at + 1, every], value)
            longest = np.maximum(longest, of_each[at, every])
            same, last = of_each[-1], readings[-1]
            lowest = np.fmin.reduce(frames, None, initial=lowest)
            highest = np.fmax.reduce(frames, None, initial=highest)
        recording = float(np.median([len(r) for r in recordings]))
        has_noise = longest <= _CALM * recording
        quiet = ~has_noise & (value > lowest) & (value < highest)
        few = len(recordings) < FEWEST or has_noise[present].mean() < _FLICKERING or quiet[present].mean() > _QUIET
        return cls.unknown(len(present)) if few else cls(np.where(has_noise, longest, np.inf), recording)

    @classmethod
    def unknown(cls, n_cells: int) -> NoiseLoss:
        """Without a reference no cell is known to flicker."""
        return cls(np.full(n_cells, np.inf), 1.0)

    def evidence(self, runs: ConstantRuns, rests: NDArray[np.bool_], present: NDArray[np.bool_], sunk: bool) -> Floats:
        """Return what it says of a fault that a cell flickers, or does not, a log likelihood ratio ``[D]``.

        Args:
            runs: the still stretches.
            rests: bool ``[D]``, cells that read what an untouched one does, or less.
            present: bool ``[D]``.
            sunk: all cells at rest read less than they ever did: at the low rail they do not flicker.
        """
        too_long = np.maximum(_LONGER * self.longest, _RECORDINGS * self.recording)
        calm = present & (np.minimum(runs.same, runs.length) >= too_long)  # frames without a reading prove nothing
        as_ever = present & rests & (runs.length >= too_long) & (runs.same <= self.longest)
        return untouched_evidence(calm, calm & ~(rests & sunk), as_ever, present)
