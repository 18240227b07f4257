"""In which recordings a stream stood still: one frame came many times in a row while cells were
loaded, and in hardly any other recording.

Of each recording only the longest such run is kept, so that parts are merged by putting them one
behind the other. Frames in which fewer than three cells are loaded do not count, as an untouched
array may read the same for long. A run is told from 20 frames on, where nine of ten recordings have
none of more than three: a sensor that sends what changed, and a logger that is far faster than it,
repeat frames everywhere. In the real sets of ``shared/data`` (1,180 recordings of four arrays) no
loaded frame is repeated at all.

Not detected: a stream that stands still in more than a tenth of the recordings, while fewer than
three cells are loaded, or from the first frame of a recording on; one of a sensor that sends what
changed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics import SensorLayout

_LOADED_CELLS = 3
_LOADED = 0.05  # of the full scale above the lowest reading
_LEAST = 20  # frames
_USUAL = 3  # frames that others may have in a row: a logger that is four times as fast
_OTHERS = 0.9  # share of the recordings
_LISTED = 3


@dataclass(frozen=True)
class StandsStill:
    """The longest run of each recording.

    Attributes:
        lengths: int ``[n]``, frames that repeat the one before.
        begins: int ``[n]``, first of them, in the recording.
    """

    lengths: NDArray[np.int64]
    begins: NDArray[np.int64]

    @classmethod
    def of(cls, recordings: Iterable[Iterable[NDArray[Any]]], layout: SensorLayout) -> StandsStill:
        """Return those of recordings, in pieces ``[t, D]`` each."""
        found = []
        for pieces in recordings:
            one = Longest(layout)
            for frames in pieces:
                one.add(frames)
            found.append(one.run())
        return cls.joined(found)

    @classmethod
    def joined(cls, parts: Sequence[StandsStill]) -> StandsStill:
        """Return those of all parts, in their order."""
        lengths = np.concatenate([part.lengths for part in parts])
        return cls(lengths, np.concatenate([part.begins for part in parts]))

    def told(self, names: Sequence[str]) -> str | None:
        """Return in which recordings the stream stood still, in one sentence; None: in none.

        Args:
            names: of all recordings.
        """
        stood = np.flatnonzero(self.lengths >= _LEAST)
        usual = float(np.quantile(self.lengths, _OTHERS, method="lower"))
        if not len(stood) or (usual > _USUAL and len(names) > 1):
            return None
        worst = stood[np.argsort(-self.lengths[stood], kind="stable")]
        some = [
            f"{self.lengths[i]} times in a row from frame {self.begins[i]} of {names[i]} on"
            for i in worst[:_LISTED]
        ]
        more = f", and in {len(worst) - _LISTED} more recordings" if len(worst) > _LISTED else ""
        return f"one frame came again {', '.join(some)}{more}, while cells were loaded"


class Longest:
    """The longest run of one recording, while its frames come; ``layout``: the array."""

    def __init__(self, layout: SensorLayout) -> None:
        self._present = layout.is_cell
        self._above = _LOADED * layout.full_scale
        self._lowest = np.full(int(self._present.sum()), np.nan)
        self._last: NDArray[Any] | None = None
        self._frames = 0
        self._run = 0
        self._longest = 0
        self._begin = 0

    def add(self, frames: NDArray[Any]) -> None:
        """Take in the next frames, ``[t, D]``; NaN = missing."""
        if not len(frames):
            return
        readings = frames if self._present.all() else frames[:, self._present]
        before = readings[:1] if self._last is None else self._last[None]
        equal = readings == np.concatenate([before, readings[:-1]])
        repeats = equal.all(axis=1)
        if self._last is None:
            repeats[0] = False
        places = np.flatnonzero(repeats)
        if len(places):
            lowest = np.fmin.accumulate(np.vstack([self._lowest, readings]), axis=0)[1:]
            above = readings[places] - lowest[places] > self._above
            repeats[places] = above.sum(axis=1) >= _LOADED_CELLS
            self._lowest = lowest[-1]
        else:
            self._lowest = np.fmin(self._lowest, np.fmin.reduce(readings))
        self._count(repeats)
        self._last = readings[-1]
        self._frames += len(frames)

    def _count(self, repeats: NDArray[np.bool_]) -> None:
        """Count the runs of some frames; one that goes on from those before is continued."""
        if not repeats.any():
            self._run = 0
            return
        ends = np.flatnonzero(np.diff(np.concatenate([[False], repeats, [False]]).astype(int)))
        for first, last in zip(ends[::2].tolist(), ends[1::2].tolist(), strict=True):
            length = last - first
            if not first:
                length += self._run
            if length > self._longest:
                self._longest = length
                self._begin = self._frames + last - length
        self._run = length if repeats[-1] else 0

    def run(self) -> StandsStill:
        """Return it."""
        return StandsStill(np.array([self._longest]), np.array([self._begin]))
