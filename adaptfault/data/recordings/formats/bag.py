"""Reads ROS 2 bags: a folder as rosbag2 writes it, or one of its files (.mcap, .db3); needs the
extra "ros"."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, Problem
from adaptfault.data.recordings.facts.labels import natural_key
from adaptfault.data.recordings.facts.sizes import check_kind
from adaptfault.data.recordings.formats.bag_fields import Found, Topic, choose
from adaptfault.data.recordings.formats.bag_frames import NEAR, Frames, Message
from adaptfault.data.recordings.formats.bag_salvage import Salvage
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.data.recordings.formats.datasets.features import Pads
from adaptfault.data.recordings.recording import BLOCK, Block, Facts, Recording, Shape

SUFFIXES = (".mcap", ".db3")

_PAUSE = 1.0  # seconds without a message, after which another recording begins
_PERIODS = 5  # and so many periods


def accepts(path: Path) -> bool:
    """Return whether a folder is a bag as rosbag2 writes it."""
    return (path / "metadata.yaml").is_file() and any(
        any(path.glob(f"*{suffix}*")) for suffix in SUFFIXES
    )


def open(
    path: Path,
    *,
    shape: Shape | None = None,
    topic: str | None = None,
    field: str | None = None,
    **stated: Any,
) -> list[Recording]:
    """Return the recordings of a bag: one, or several where there are pauses of a second or more.

    The readings are an array of numbers in each message: a ``std_msgs`` MultiArray, a type named
    after touch (TactileState, ...), JSON on a topic named after it, or ``field`` of ``topic``.
    Several topics are the pads of one array: a frame is a message of the one that has most, with
    the nearest of the others. The rate comes from the times at which the messages were recorded. Of
    a bag that was cut off, the readable messages are returned, with a warning that counts them.

    Args:
        path: the folder, or one of its files.
        shape: ``(pads, rows, cols)`` where the user states it.
        topic: names of topics, or patterns as ``/tactile/*``, divided by commas.
        field: of their messages; it may lead through lists of messages, as
            ``sensors.taxels.z``. None for both: found by the types of the messages.
        stated: what other readers ask for.

    Raises:
        InputError: rosbags is not installed, no message can be read, or topic or field are not
            clear.
    """
    problems: list[Problem] = []
    source = partial(_messages, _Asked(path, shape, topic, field))
    messages = source(problems)
    first = next(messages, None)
    if first is None:
        raise InputError.at(path, "holds no message that can be read; record it again")
    width = len(first.values)
    times = [first.time]
    others = 0
    for message in messages:
        if len(message.values) == width:
            times.append(message.time)
        else:
            others += 1
    if others:
        what = f"{others} messages hold another number of readings than the first, {width}"
        problems.append(Problem.warning(path, f"{what}: left out"))
    stamps = np.sort(np.array(times))
    facts = Facts(
        path,
        counts=first.counts,
        shape=first.pads.shape,
        present=first.pads.present,
        problems=tuple(problems),
    )

    def blocks(begin: int, end: int) -> Callable[[], Iterator[Block]]:
        return lambda: _blocks(source([], begin, end), width)

    return [Recording(facts, blocks(int(part[0]), int(part[-1]) + 1)) for part in _parts(stamps)]


def _parts(stamps: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Return the times of each recording, in nanoseconds."""
    seconds = np.diff(stamps) / 1e9
    period = float(np.median(seconds)) if len(seconds) else 0.0
    breaks = np.flatnonzero(seconds > max(_PAUSE, _PERIODS * period)) + 1
    return np.split(stamps, breaks)


def _blocks(messages: Iterator[Message], width: int) -> Iterator[Block]:
    """Yield the messages of one recording in the order of their times."""
    while some := list(islice(messages, BLOCK)):
        whole = [message for message in some if len(message.values) == width]
        if not whole:
            continue
        whole.sort(key=lambda message: message.time)
        times = np.array([message.time for message in whole], dtype=np.float64)
        yield Block(np.stack([message.values for message in whole]), None, times, "ns")


def _messages(
    asked: _Asked, problems: list[Problem], begin: int | None = None, end: int | None = None
) -> Iterator[Message]:
    """Yield the readings of a bag message by message, in constant memory.

    Args:
        asked: what is read of which bag.
        problems: missing parts are added to them.
        begin, end: times in nanoseconds, ``begin`` included; None: all.

    Raises:
        InputError: as :func:`open`.
    """
    what = "bags are read with rosbags; install it: pip install 'adaptfault[ros]'"
    for package in ("mcap", "rosbags"):  # the former for bags that are damaged, and for JSON
        imported(package, asked.path, what)
    for file in _files(asked.path):
        check_kind(file)
    given = 0

    def is_within(message: Message) -> bool:
        return (begin is None or message.time >= begin) and (end is None or message.time < end)

    try:
        for message in filter(is_within, _whole(asked, begin, end)):
            given += 1
            yield message
        return
    except InputError:
        raise
    # damaged bags raise any of a dozen kinds: rosbags', sqlite's, struct's, yaml's; JSON, too
    except Exception as error:
        reason = type(error).__name__
    yield from islice(filter(is_within, _salvaged(asked, reason, problems)), given, None)


def _files(path: Path) -> list[Path]:
    """Return the files of a bag, in order."""
    if not path.is_dir():
        return [path]
    files = [file for file in path.iterdir() if file.suffix.lower() in SUFFIXES]
    return sorted(files, key=lambda file: natural_key(file.name))


@dataclass(frozen=True)
class _Asked:
    """What is read of which bag, as the user says; see :func:`open`."""

    path: Path
    shape: Shape | None
    topic: str | None
    field: str | None

    def choose(
        self, topics: Sequence[Topic], messages: Callable[[Topic], Iterable[Found]]
    ) -> Frames:
        """Return what makes frames of the messages of a bag with these topics."""
        extractors = choose(self.path, topics, messages, self.topic, self.field)
        sizes = [one.sizes for one in extractors]
        return Frames(extractors, Pads.of(sizes, self.shape))


def _whole(asked: _Asked, begin: int | None, end: int | None) -> Iterator[Message]:
    from rosbags.rosbag2 import Reader

    with Reader(asked.path) as reader:
        known = {
            Topic(c.topic, c.msgtype, c.msgdef.data or ""): c
            for c in reader.connections
            if c.msgcount
        }
        names = {(one.name, one.msgtype): one for one in known}

        def messages(
            topics: Sequence[Topic], begin: int | None = None, end: int | None = None
        ) -> Iterator[Found]:
            connections = [known[one] for one in topics]
            stored = reader.messages(connections=connections, start=begin, stop=end)
            for connection, time, data in stored:
                yield names[connection.topic, connection.msgtype], int(time), data

        frames = asked.choose(list(known), lambda one: messages([one]))
        counts = {one: connection.msgcount for one, connection in known.items()}
        # the nearest message of another topic may lie just outside
        margin = NEAR if len(frames.topics) > 1 else 0
        first = None if begin is None else max(begin - margin, 0)
        last = None if end is None else end + margin
        yield from frames.of(messages(frames.topics, first, last), counts)


def _salvaged(asked: _Asked, reason: str, problems: list[Problem]) -> Iterator[Message]:
    """Yield what a damaged bag still holds, and what is written as JSON, which rosbags does not
    read."""
    path = asked.path
    parts = [Salvage(file) for file in _files(path)]
    counts = Counter(one for part in parts for one, _, _ in part)
    if not counts:
        raise InputError.at(
            path, f"is damaged or cut off, and no message can be read ({reason}); record it again"
        )

    def messages(topics: Sequence[Topic]) -> Iterator[Found]:
        return (one for part in parts for one in part if one[0] in topics)

    frames = asked.choose(list(counts), lambda one: messages([one]))
    read = 0
    first = 0
    last = 0
    for message in frames.of(messages(frames.topics), counts, keep_on=True):
        read += 1
        first = min(first or message.time, message.time)
        last = max(last, message.time)
        yield message
    lost = {"chunk": sum(part.skipped for part in parts), "message": frames.bad}
    is_foreign = any(one.encoding != "cdr" for one in counts)
    ends = [f"reading ended at {part.reason}" for part in parts if part.reason]
    if is_foreign and not any(lost.values()) and not ends:
        return
    names = ", ".join(one.name for one in frames.topics)
    what = f"damaged or cut off: {read} messages of {names}, {(last - first) / 1e9:.1f} s, could"
    told = [f"{n} damaged {one}{'s' * (n != 1)} left out" for one, n in lost.items() if n]
    problems.append(Problem.warning(path, "; ".join([f"{what} be read", *told, *ends])))
