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


def find_repeated_frames(
    recordings: Sequence[NDArray[Any]], layout: SensorLayout
) -> RepeatedFrames | None:
    """Return how a log, ``[T, D]`` each, repeats frames; None where most frames are new, or hardly
    anything changes."""
    present = layout.present.ravel()
    step = max(1, len(recordings) // _RECORDINGS)
    some = [np.asarray(frames)[:_FRAMES] for frames in recordings[::step]]
    again = [repetitions(frames[:, present]) for frames in some if len(frames)]
    distances = [np.diff(np.flatnonzero(times == 0)) for times in again]
    between = np.concatenate([*distances, np.zeros(0, np.intp)])
    if len(between) < _FEWEST:
        return None
    share = float((np.concatenate(again) > 0).mean())
    every = float(np.median(between))
    if share < MAJORITY or every < 2:
        return None
    return RepeatedFrames(share, every)
