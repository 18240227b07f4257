"""The range of each cell in each recording: all that the search for held values needs of a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.load import LoadDirection
from diagnostics.preprocessing.readings import RecordingBlocks

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Spans:
    """The lowest and the highest reading of each cell in each recording, ``[n, D]`` each.

    NaN: the cell has no reading in the recording.
    """

    low: Floats
    high: Floats

    @classmethod
    def of(cls, recordings: RecordingBlocks) -> Spans:
        """Return the spans of recordings ``[T, D]``."""
        each = [RecordingBlocks([given]).extremes() for given in recordings.given]
        return cls(np.stack([low for low, _ in each]), np.stack([high for _, high in each]))

    @classmethod
    def joined(cls, parts: Sequence[Spans]) -> Spans:
        """Return the spans of all parts as one."""
        return cls(
            np.concatenate([part.low for part in parts]),
            np.concatenate([part.high for part in parts]),
        )

    def whole(self, pieces: Sequence[int], lengths: Sequence[int]) -> Spans:
        """Return the spans of whole recordings, of which these are pieces.

        Args:
            pieces: frames of each, in order.
            lengths: frames of each recording.
        """
        if list(pieces) == list(lengths):
            return self
        begins = first_pieces(pieces, lengths)
        return Spans(np.fmin.reduceat(self.low, begins), np.fmax.reduceat(self.high, begins))

    def loads(self, load: LoadDirection) -> Spans:
        """Return the spans of the loads; of cells that rest in the middle and pass it, from 0."""
        if load.direction == "high":
            return Spans(load.full_scale - self.high, load.full_scale - self.low)
        ends = np.stack([np.abs(self.low - load.rest), np.abs(self.high - load.rest)])
        passes = (self.low <= load.rest) & (self.high >= load.rest)
        return Spans(np.where(passes, 0.0, ends.min(axis=0)), ends.max(axis=0))

    def of_cells(self, cells: NDArray[np.intp]) -> Spans:
        """Return the spans of some cells."""
        return Spans(self.low[:, cells], self.high[:, cells])

    def __len__(self) -> int:
        return len(self.low)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether a cell has a reading in a recording, bool ``[n, D]``."""
        return np.isfinite(self.low)

    @property
    def ranges(self) -> Floats:
        """Highest minus lowest reading, ``[n, D]``; 0 without any."""
        return np.nan_to_num(self.high - self.low)

    @property
    def middles(self) -> Floats:
        """Middle of the readings, ``[n, D]``; NaN without any."""
        return (self.high + self.low) / 2


def first_pieces(pieces: Sequence[int], lengths: Sequence[int]) -> NDArray[np.intp]:
    """Return the number of the first piece of each recording; arguments as for
    :meth:`Spans.whole`."""
    begins = np.cumsum(lengths) - np.array(lengths)
    found: NDArray[np.intp] = np.searchsorted(np.cumsum(pieces), begins, side="right")
    return found
