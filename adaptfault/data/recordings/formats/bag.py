"""Reads ROS 2 bags: a folder as rosbag2 writes it, or one of its files (.mcap, .db3); needs the
extra "ros"."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.facts.labels import natural_key
from adaptfault.data.recordings.formats.bag_fields import Extractor, Topic, choose
from adaptfault.data.recordings.formats.bag_salvage import Salvage
from adaptfault.data.recordings.formats.message_arrays import join
from adaptfault.data.recordings.recording import BLOCK, Block, Facts, Recording, Shape

SUFFIXES = (".mcap", ".db3")

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


def accepts(path: Path) -> bool:
    """Return whether a folder is a bag as rosbag2 writes it."""
    return (path / "metadata.yaml").is_file() and any(
        any(path.glob(f"*{suffix}*")) for suffix in SUFFIXES
    )


def open(
    path: Path, *, topic: str | None = None, field: str | None = None, **stated: Any
) -> list[Recording]:
    """Return the recordings of a bag: one, or several where there are pauses of a second or more.

    The readings are an array of numbers in each message: a ``std_msgs`` MultiArray, a type named
    after touch (TactileState, ...), or ``field`` of ``topic``. The rate comes from the times at
    which the messages were recorded. Of a bag that was cut off, the readable messages are returned,
    with a warning that counts them.

    Args:
        path: the folder, or one of its files.
        topic, field: where the readings are; None: found by the types of the messages.
        stated: what other readers ask for.

    Raises:
        InputError: rosbags is not installed, no message can be read, or topic or field are not
            clear.
    """
    problems: list[Problem] = []
    times: list[int] = []
    width = 0
    others = 0
    first: Message | None = None
    for message in bag_messages(path, problems, topic=topic, field=field):
        if first is None:
            first = message
            width = len(message.values)
        if len(message.values) == width:
            times.append(message.time)
        else:
            others += 1
    if first is None:
        raise InputError.at(path, "holds no message that can be read; record it again")
    if others:
        what = (
            f"{others} messages hold another number of readings than the first, {width}: left out"
        )
        problems.append(Problem("warning", located(path, what)))
    stamps = np.sort(np.array(times))
    facts = Facts(path, counts=first.counts, shape=first.shape, problems=tuple(problems))

    def blocks(begin: int, end: int) -> Callable[[], Iterator[Block]]:
        return lambda: _blocks(path, topic, field, width, begin, end)

    return [Recording(facts, blocks(int(part[0]), int(part[-1]) + 1)) for part in _parts(stamps)]


def _parts(stamps: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Return the times of each recording, in nanoseconds."""
    seconds = np.diff(stamps) / 1e9
    period = float(np.median(seconds)) if len(seconds) else 0.0
    breaks = np.flatnonzero(seconds > max(_PAUSE, _PERIODS * period)) + 1
    return np.split(stamps, breaks)


def _blocks(
    path: Path, topic: str | None, field: str | None, width: int, begin: int, end: int
) -> Iterator[Block]:
    """Yield the messages of one recording in the order of their times, which are seconds."""
    messages = bag_messages(path, [], topic=topic, field=field, begin=begin, end=end)
    while some := list(islice(messages, BLOCK)):
        whole = [message for message in some if len(message.values) == width]
        if not whole:
            continue
        whole.sort(key=lambda message: message.time)
        times = np.array([message.time for message in whole], dtype=np.float64)
        yield Block(np.stack([message.values for message in whole]), None, times, "ns")


def bag_messages(
    path: Path,
    problems: list[Problem],
    *,
    topic: str | None = None,
    field: str | None = None,
    begin: int | None = None,
    end: int | None = None,
) -> Iterator[Message]:
    """Yield the readings of a bag message by message, in constant memory.

    Args:
        path: the bag.
        problems: missing parts are added to them.
        topic, field: as for :func:`open`.
        begin, end: times in nanoseconds, ``begin`` included; None: all.

    Raises:
        InputError: as :func:`open`.
    """
    try:
        import mcap  # noqa: F401  for bags that are damaged
        import rosbags  # noqa: F401
    except ImportError:
        raise InputError.at(
            path, "bags are read with rosbags; install it: pip install 'adaptfault[ros]'"
        ) from None
    given = 0
    try:
        for message in _whole(path, topic, field, begin, end):
            given += 1
            yield message
        return
    except InputError:
        raise
    # damaged bags raise any of a dozen kinds: rosbags', sqlite's, struct's, yaml's
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
    within = (
        message
        for message in _salvaged(path, topic, field, reason, problems)
        if (begin is None or message.time >= begin) and (end is None or message.time < end)
    )
    yield from islice(within, given, None)


def _whole(
    path: Path, topic: str | None, field: str | None, begin: int | None, end: int | None
) -> Iterator[Message]:
    from rosbags.rosbag2 import Reader

    with Reader(path) as reader:
        known = {
            Topic(c.topic, c.msgtype, c.msgdef.data or ""): c
            for c in reader.connections
            if c.msgcount
        }
        extractor = choose(path, list(known), topic, field)
        take = _taker(extractor)
        for _, time, data in reader.messages(
            connections=[known[extractor.topic]], start=begin, stop=end
        ):
            yield take(time, data)


def _salvaged(
    path: Path,
    topic: str | None,
    field: str | None,
    reason: str,
    problems: list[Problem],
) -> Iterator[Message]:
    """Yield what a damaged bag still holds."""
    files = (
        [path]
        if path.is_file()
        else [file for file in path.iterdir() if file.suffix.lower() in SUFFIXES]
    )
    parts = [Salvage(file) for file in sorted(files, key=lambda file: natural_key(file.name))]
    topics = list(dict.fromkeys(one for part in parts for one in part.topics()))
    if not topics:
        raise InputError.at(
            path, f"is damaged or cut off, and no message can be read ({reason}); record it again"
        )
    extractor = choose(path, topics, topic, field)
    take = _taker(extractor)
    read = 0
    bad = 0
    first = 0
    last = 0
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
            first = min(first or time, time)
            last = max(last, time)
            yield message
    what = (
        f"damaged or cut off: {read} messages of {extractor.topic.name}, {(last - first) / 1e9:.1f}"
        " s, could be read"
    )
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
