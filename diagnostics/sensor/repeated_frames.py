"""Repeated frames: a logger that is faster than the sensor writes each frame several times.

The rate of the log is not that of the sensor. Told where most frames equal the one before, and
where new ones come no sooner than every second frame while readings change. An idle array that
sends exact zeros repeats frames, too, but not while something touches it.

Not detected: cells or pads that are sent at different times, if one of them is new in each frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import MAJORITY
from diagnostics.preprocessing.transport import repetitions

_FEWEST = 32  # new frames after another one
_RECORDINGS = 64  # that are looked at: a size
_FRAMES = 1024  # of each: a size


@dataclass(frozen=True)
class RepeatedFrames:
    """How a log repeats frames.

    Attributes:
        share: of the frames that equal the one before.
        every: frames from one new frame to the next, the median.
    """

    share: float
    every: float

    def reason(self, rate: float) -> str:
        """Return one sentence; ``rate``: frames per second of the log."""
        return (
            f"{self.share:.0%} of the frames repeat the one before: new readings come about"
            f" {rate / self.every:.3g} times a second, the log has {rate:.3g} frames a second;"
            " harmless, unless the rate is needed"
        )


@dataclass(frozen=True)
class Repetitions:
    """How often frames repeat, counted; what several recordings have is the sum.

    Attributes:
        frames: number of frames.
        repeated: those that equal the one before.
        between: int ``[1025]``, how often a new frame came so many frames after the last new one.
    """

    frames: int
    repeated: int
    between: NDArray[np.intp]

    @classmethod
    def of(cls, frames: NDArray[Any]) -> Repetitions:
        """Return those of one recording, ``[T, D]``."""
        again = repetitions(frames)
        between = np.minimum(np.diff(np.flatnonzero(again == 0)), _FRAMES)
        counts = np.bincount(between, minlength=_FRAMES + 1)
        return cls(len(frames), int((again > 0).sum()), counts)

    @classmethod
    def joined(cls, parts: Sequence[Repetitions]) -> Repetitions:
        """Return the sum."""
        between = np.sum([part.between for part in parts], axis=0)
        frames = sum(part.frames for part in parts)
        return cls(frames, sum(part.repeated for part in parts), between)

    @property
    def told(self) -> RepeatedFrames | None:
        """How frames repeat; None where most are new, or hardly anything changes."""
        came = np.cumsum(self.between)
        if came[-1] < _FEWEST:
            return None
        share = self.repeated / self.frames
        lower, upper = np.searchsorted(came, ((came[-1] + 1) // 2, came[-1] // 2 + 1))
        every = float(lower + upper) / 2
        if share < MAJORITY or every < 2:
            return None
        return RepeatedFrames(share, every)


def find_repeated_frames(
    recordings: Sequence[NDArray[Any]], layout: SensorLayout
) -> RepeatedFrames | None:
    """Return how a log, ``[T, D]`` each, repeats frames; None where most frames are new, or hardly
    anything changes."""
    present = layout.is_cell
    step = max(1, len(recordings) // _RECORDINGS)
    some = [np.asarray(frames)[:_FRAMES, present] for frames in recordings[::step]]
    counted = [Repetitions.of(frames) for frames in some if len(frames)]
    return Repetitions.joined(counted).told if counted else None
