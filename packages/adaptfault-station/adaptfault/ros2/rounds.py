"""Puts messages of several topics, one a finger, together to frames of one array. Needs no ROS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Part:
    """The readings of one topic in a frame.

    Attributes:
        values: ``[k]``.
        message: which holds them; None where none came for this frame, and all values are NaN.
        stamp: of the message, seconds; None: unknown.
    """

    values: NDArray[np.float64]
    message: Any = None
    stamp: float | None = None


class Rounds:
    """Puts one message of each topic together to a frame.

    A frame is complete with the last topic. A topic that sends again before is faster than the
    others, or they have failed: the frame is complete without them, and their readings are missing.

    Args:
        n: number of topics.
    """

    def __init__(self, n: int) -> None:
        self._sizes: list[int | None] = [None] * n
        self._parts: list[Part | None] = [None] * n

    @property
    def silent(self) -> list[int]:
        """The topics that have never sent, where others have."""
        silent = [topic for topic, size in enumerate(self._sizes) if size is None]
        return [] if len(silent) == len(self._sizes) else silent

    def add(self, topic: int, part: Part) -> list[list[Part]]:
        """Take in a message of a topic; return the frames that it completes, each as its parts.

        There is none until each topic has sent once: how many cells it has is unknown.
        """
        self._sizes[topic] = part.values.size
        complete = []
        if self._parts[topic] is not None:
            complete.append(self._close())
        self._parts[topic] = part
        if all(one is not None for one in self._parts):
            complete.append(self._close())
        return [frame for frame in complete if frame]

    def _close(self) -> list[Part]:
        parts = self._parts
        self._parts = [None] * len(parts)
        frame = []
        for part, size in zip(parts, self._sizes, strict=True):
            if size is None:
                return []
            frame.append(Part(np.full(size, np.nan)) if part is None else part)
        return frame
