"""The scans of a read-out that tests itself, as its frames arrive among the others.

A scan ends two seconds after its last frame, with silence, or at the end; ordinary frames may come
between its own. Its frames are neither monitored nor classified, and the time that they take is no
time of lost frames. What a scan lacks is told, and nothing is said of cells then.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adaptfault.acquisition.ordering import Frame
from diagnostics import ReadOut, Scan, SensorLayout, judge_scan

ENDS = 2.0
"""Seconds without a frame of a scan after which it has ended."""

_MOST = 1024  # frames of a scan that are kept, the last ones


class Scans:
    """Collects the scan of one device.

    Args:
        layout: the array.
        lines_held: whether the read-out holds lines that it does not select; None: not stated.

    Attributes:
        time: seconds that frames of scans took so far.
        last: the last scan that ended; None: there was none.
    """

    def __init__(self, layout: SensorLayout, lines_held: bool | None = None) -> None:
        self.layout = layout
        self.lines_held = lines_held
        self.time = 0.0
        self.last: Scan | None = None
        self._frames: deque[tuple[float, NDArray[np.float64]]] = deque(maxlen=_MOST)
        self._began: float | None = None  # the first frame of the scan since an ordinary one
        self._latest = 0.0

    def add(self, frame: Frame) -> None:
        """Add a frame of a scan."""
        assert frame.scan is not None
        if self._began is None:
            self._began = frame.time
        self._latest = frame.time
        self._frames.append((frame.scan, frame.values))

    def pass_by(self, frame: Frame) -> ReadOut | None:
        """Let an ordinary frame pass; return what a scan says that has ended before it, None where
        there is none."""
        if self._began is not None:
            self.time += max(frame.time - self._began, 0.0)
            self._began = None
        return self.ended(frame.time)

    def ended(self, now: float) -> ReadOut | None:
        """End the scan where its last frame is long past; return what it says, None where there is
        none, or it goes on."""
        return self.end() if now - self._latest > ENDS else None

    def end(self) -> ReadOut | None:
        """End the scan; return what it says, None where there is none."""
        if not self._frames:
            return None
        self.last = replace(Scan.of(list(self._frames)), holds_lines=self.lines_held)
        self._frames.clear()
        return judge_scan(self.last, self.layout)
