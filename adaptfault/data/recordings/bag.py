"""Reads ROS 2 bags: a folder as rosbag2 writes it, or one of its files (.mcap, .db3); needs the extra "ros"."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.bag_fields import Extractor, Topic, choose
from adaptfault.data.recordings.bag_salvage import Salvage
from adaptfault.data.recordings.content import Content, Shape
from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.labels import natural_key
from adaptfault.data.recordings.message_arrays import join

STORAGES = (".mcap", ".db3")

_PAUSE = 1.0  # seconds without a message, after which another recording begins
_PERIODS = 5  # and so many periods


@dataclass(frozen=True, eq=False)
class Message:
    """The readings of one message.

    Attributes:
        time: when it was recorded, nanoseconds.
        values: float32 ``[D]``.
        counts: whole numbers by their type.
        shape: ``(pads, rows, cols)`` where the message states it.
    """

    time: int
    values: NDArray[np.float32]
    counts: bool
    shape: Shape | None


def is_bag(path: Path) -> bool:
    """Return whether a folder is a bag as rosbag2 writes it."""
    return (path / "metadata.yaml").is_file() and any(any(path.glob(f"*{storage}*")) for storage in STORAGES)


def read_bag(path: Path, *, topic: str | None = None, field: str | None = None) -> Content:
    """Read a bag: one recording, or several where there are pauses of a second or more.

    The readings are an array of numbers in each message: a ``std_msgs`` MultiArray, a type named after touch
    (TactileState, ...), or ``field`` of ``topic``. The rate comes from the times at which the messages
    were recorded. Of a bag that was cut off, the readable messages are returned, with a warning that counts them.

    Raises:
        InputError: rosbags is not installed, no message can be read, or topic or field are not clear.
    """
    problems: list[Problem] = []
    messages = list(bag_messages(path, problems, topic=topic, field=field))
    if not messages:
        raise InputError.at(path, "holds no message that can be read; record it again")
    width = len(messages[0].values)
    whole = [message for message in messages if len(message.values) == width]
    if others := len(messages) - len(whole):
        what = f"{others} messages hold another number of readings than the first, {width}: left out"
        problems.append(Problem("warning", located(path, what)))
    whole.sort(key=lambda message: message.time)
    values = np.stack([message.values for message in whole])
    seconds = np.diff([message.time for message in whole]) / 1e9
    period = float(np.median(seconds)) if len(seconds) else 0.0
    breaks = np.flatnonzero(seconds > max(_PAUSE, _PERIODS * period)) + 1
    return Content(
        path,
        tuple(np.split(values, breaks)),
        counts=whole[0].counts,
        shape=whole[0].shape,
        rate=float(f"{1 / period:.3g}") if period > 0 else None,
        problems=tuple(problems),
    )


def bag_messages(
    path: Path, problems: list[Problem], *, topic: str | None = None, field: str | None = None
) -> Iterator[Message]:
    """Yield the readings of a bag message by message, in constant memory; missing parts are added to ``problems``.

    Raises:
        InputError: as :func:`read_bag`.
    """
    try:
        import mcap  # noqa: F401  for bags that are damaged
        import rosbags  # noqa: F401
    except ImportError:
        raise InputError.at(path, "bags are read with rosbags; install it: pip install 'adaptfault[ros]'") from None
    given = 0
    try:
        for message in _whole(path, topic, field):
            given += 1
            yield message
        return
    except InputError:
        raise
    except Exception as error:  # damaged bags raise any of a dozen kinds: rosbags', sqlite's, struct's, yaml's
        reason = f"{type(error).__name__}: {error}"
    yield from _salvaged(path, topic, field, given, reason, problems)


def _whole(path: Path, topic: str | None, field: str | None) -> Iterator[Message]:
    from rosbags.rosbag2 import Reader

    with Reader(path) as reader:
        known = {Topic(c.topic, c.msgtype, c.msgdef.data or ""): c for c in reader.connections if c.msgcount}
        extractor = choose(path, list(known), topic, field)
        take = _taker(extractor)
        for _, time, data in reader.messages(connections=[known[extractor.topic]]):
            yield take(time, data)


def _salvaged(
    path: Path, topic: str | None, field: str | None, given: int, reason: str, problems: list[Problem]
) -> Iterator[Message]:
    """Yield what a damaged bag still holds, but for the first ``given`` messages."""
    files = [path] if path.is_file() else [file for file in path.iterdir() if file.suffix.lower() in STORAGES]
    parts = [Salvage(file) for file in sorted(files, key=lambda file: natural_key(file.name))]
    topics = list(dict.fromkeys(one for part in parts for one in part.topics()))
    if not topics:
        raise InputError.at(path, f"is damaged or cut off, and no message can be read ({reason}); record it again")
    extractor = choose(path, topics, topic, field)
    take = _taker(extractor)
    read, bad, first, last = 0, 0, 0, 0
    for part in parts:
        for one, time, data in part:
            if one != extractor.topic:
                continue
            try:
                message = take(time, data)
            except Exception:  # as above: one damaged message does not end the others
                bad += 1
                continue
            read += 1
            first, last = min(first or time, time), max(last, time)
            if read > given:
                yield message
    what = f"damaged or cut off: {read} messages of {extractor.topic.name}, {(last - first) / 1e9:.1f} s, could be read"
    counts = {"chunk": sum(part.skipped for part in parts), "message": bad}
    lost = [f"{n} damaged {what}{'s' * (n != 1)} left out" for what, n in counts.items() if n]
    ends = [f"reading ended at {part.reason}" for part in parts if part.reason]
    problems.append(Problem("warning", located(path, "; ".join([what, *lost, *ends]))))


def _taker(extractor: Extractor) -> Callable[[int, bytes], Message]:
    def take(time: int, data: Any) -> Message:
        message = extractor.deserialize(data)
        arrays = extractor.arrays_of(message)
        counts = all(array.dtype.kind in "iu" for array in arrays)
        return Message(int(time), join(arrays, np.float32), counts, extractor.shape(message))

    return take
