"""Makes frames of the messages of a bag: of one topic a message each, of several the messages that
arrived together."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.formats.bag_fields import Extractor, Found, Topic
from adaptfault.data.recordings.formats.datasets.features import Pads
from adaptfault.data.recordings.formats.message_arrays import join

NEAR = 500_000_000
"""Nanoseconds within which messages of several topics are one frame."""


@dataclass(frozen=True, eq=False)
class Message:
    """The readings of one message, or of those of several topics that arrived together.

    Attributes:
        time: when it was recorded, nanoseconds.
        values: float32 ``[D]``.
        counts: whole numbers by their type.
        pads: which of the messages' arrays are which pads.
    """

    time: int
    values: NDArray[np.float32]
    counts: bool
    pads: Pads


class Frames:
    """Makes frames of the messages of some topics.

    Args:
        extractors: of each topic, one a pad.
        pads: how their readings are one frame.

    Attributes:
        bad: messages that could not be read, and were left out.
    """

    def __init__(self, extractors: Sequence[Extractor], pads: Pads) -> None:
        self.extractors = {one.topic: one for one in extractors}
        self.pads = pads
        self.bad = 0

    @property
    def topics(self) -> list[Topic]:
        """The topics that are read."""
        return list(self.extractors)

    def of(
        self, messages: Iterable[Found], counts: Mapping[Topic, int], *, keep_on: bool = False
    ) -> Iterator[Message]:
        """Yield the frames.

        Args:
            messages: of the topics.
            counts: how many each topic has: that with most gives the times of the frames.
            keep_on: whether a message that cannot be read is left out; else its error is raised.
        """
        taken = self._taken(messages, keep_on)
        if len(self.extractors) == 1:
            for _, message in taken:
                yield message
            return
        lead = max(self.topics, key=lambda one: counts[one])
        yield from self._joined(taken, lead)

    def _taken(self, messages: Iterable[Found], keep_on: bool) -> Iterator[tuple[Topic, Message]]:
        for topic, time, data in messages:
            try:
                arrays = self.extractors[topic].arrays_of(data)
                values = join(arrays, np.float32)
            # one damaged message does not end the others: any of rosbags' and numpy's kinds
            except Exception:
                if not keep_on and topic.encoding == "cdr":
                    raise
                self.bad += 1
                continue
            counts = topic.encoding == "cdr" and all(array.dtype.kind in "iu" for array in arrays)
            yield topic, Message(time, values, counts, self.pads)

    def _joined(self, taken: Iterator[tuple[Topic, Message]], lead: Topic) -> Iterator[Message]:
        """Yield a frame for each message of the ``lead``, with the nearest of each other topic; a
        pad without one is missing."""
        near: dict[Topic, deque[Message]] = {topic: deque() for topic in self.topics}
        waiting: deque[Message] = deque()
        for topic, message in taken:
            if topic == lead:
                waiting.append(message)
            near[topic].append(message)
            while waiting and message.time > waiting[0].time + NEAR:
                yield self._frame(waiting.popleft(), near)
        while waiting:
            yield self._frame(waiting.popleft(), near)

    def _frame(self, first: Message, near: Mapping[Topic, deque[Message]]) -> Message:
        parts: list[NDArray[np.float32]] = []
        counts = first.counts
        for topic, extractor in self.extractors.items():
            held = near[topic]
            while held and held[0].time < first.time - NEAR:
                held.popleft()
            size = int(np.prod(extractor.sizes))
            fitting = [one for one in held if len(one.values) == size]
            nearest = min(fitting, key=lambda one: abs(one.time - first.time), default=None)
            if nearest is None or abs(nearest.time - first.time) > NEAR:
                parts.append(np.full(size, np.nan, np.float32))
            else:
                parts.append(nearest.values)
                counts = counts and nearest.counts
        values = self.pads.frames([part[None] for part in parts])[0]
        return Message(first.time, values, counts, self.pads)
