"""Names that are new to a station: one is watched once it has sent frames for a while.

Anybody on the network can invent names. What a name costs before it is watched is a few frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field

from adaptfault.acquisition.ordering import Frame

TRIAL = 1.0  # seconds that a name sends before it is watched
_TELL = 10.0  # seconds between two lines about names that did not last
_LEAST = 64  # frames that are kept of a name, at least


@dataclass
class _Trial:
    began: float  # by the clock of the receiver
    frames: deque[Frame] = field(default_factory=deque)


class Newcomers:
    """The names that are not watched yet, with their frames.

    Args:
        rate: of the array, Hz.
        listed: names that the user stated, watched from their first frame on; None: none.
    """

    def __init__(self, rate: float, listed: Collection[str] | None) -> None:
        self.listed = frozenset(listed or ())
        self._kept = max(_LEAST, round(2 * TRIAL * rate))
        self._trials: dict[str, _Trial] = {}
        self._first = True  # the first name of all is watched at once
        self._gone = 0  # names that did not last, since the last line about them
        self._told: float | None = None

    def take(self, frame: Frame, now: float) -> list[Frame]:
        """Take a frame of a name that is not watched; return its frames once it is to be.

        Args:
            frame: that arrived.
            now: seconds of a monotonic clock.
        """
        name = frame.device
        if self._first or name in self.listed:
            self._first = False
            return [frame]
        trial = self._trials.setdefault(name, _Trial(now, deque(maxlen=self._kept)))
        trial.frames.append(frame)
        if now - trial.began < TRIAL:
            return []
        return list(self._trials.pop(name).frames)

    def forget(self, sending: Collection[str], now: float) -> str | None:
        """Forget the names that no longer send; return a line about them, at most one every
        10 s.

        Args:
            sending: names that the receiver knows.
            now: seconds of a monotonic clock.
        """
        gone = self._trials.keys() - sending
        for name in gone:
            del self._trials[name]
        self._gone += len(gone)
        recent = self._told is not None and now - self._told < _TELL
        if not self._gone or recent:
            return None
        names = "1 name" if self._gone == 1 else f"{self._gone} names"
        self._gone = 0
        self._told = now
        return (
            f"{names} sent for less than {TRIAL:g} s and went unwatched; --device NAME takes the"
            " named devices alone"
        )

    def rest(self) -> list[Frame]:
        """Return the frames that still wait, by name, at the end."""
        frames = [frame for trial in self._trials.values() for frame in trial.frames]
        self._trials.clear()
        return frames
