"""Chooses the topics of a bag that hold the readings, one a pad, and the field of their
messages."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.labels import natural_key
from adaptfault.data.recordings.formats.datasets.features import Sizes, is_no_touch, is_touch
from adaptfault.data.recordings.formats.message_arrays import arrays_at, fields_of

_TACTILE = re.compile(r"std_msgs/.*MultiArray|.*tactile.*", re.IGNORECASE)
_LOOKED = 10  # first messages of a topic in which its fields are looked for
_CDR = "cdr"
_JSON = "json"

Found = tuple["Topic", int, bytes]
"""Topic, time of arrival in nanoseconds, the message."""

# Types that bags before ROS 2 Iron do not describe, and that no distribution ships.
_KNOWN = {
    "tactile_msgs/msg/TactileState": (
        "std_msgs/Header header\nsensor_msgs/ChannelFloat32[] sensors\n"
    )
}


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, the type of its messages, their definition (empty where the bag
    has none), and how they are written."""

    name: str
    msgtype: str
    definition: str = ""
    encoding: str = _CDR

    def __str__(self) -> str:
        return f"{self.name} ({self.msgtype})"

    @cached_property
    def store(self) -> Any:
        """The type store of rosbags with the types of its messages."""
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

        definition = self.definition or _KNOWN.get(self.msgtype, "")
        if self.definition.startswith("=" * 80 + "\nIDL: "):
            parts = self.definition.split("=" * 80 + "\n")[1:]
            types = {
                name: kind
                for part in parts
                for name, kind in get_types_from_idl(part.split("\n", 1)[1]).items()
            }
        else:
            types = get_types_from_msg(definition, self.msgtype) if definition else {}
        store = get_typestore(Stores.EMPTY if self.definition else Stores.ROS2_HUMBLE)
        store.register({name: kind for name, kind in types.items() if name not in store.fielddefs})
        for name, (constants, fields) in store.fielddefs.items():
            unsigned = [(field, _without_sign(kind)) for field, kind in fields]
            store.fielddefs[name] = (constants, unsigned)
        return store

    @cached_property
    def deserialize(self) -> Callable[[bytes], Any]:
        """Turn a message's bytes into an object."""
        if self.encoding == _JSON:
            return json.loads
        store = self.store
        return lambda data: store.deserialize_cdr(data, self.msgtype)

    @property
    def may_hold_readings(self) -> bool:
        """Whether it is one of touch by the type of its messages; JSON has none, so its name
        tells."""
        if _TACTILE.fullmatch(self.msgtype):
            return True
        return self.encoding == _JSON and is_touch(self.name)


@dataclass(frozen=True)
class Extractor:
    """Takes the readings out of the messages of one topic.

    Attributes:
        topic: the topic.
        field: dotted; where the path leads through a list of messages, their arrays are put one
            after another.
        sizes: of what the first message holds there.
    """

    topic: Topic
    field: str
    sizes: Sizes

    def arrays_of(self, data: bytes) -> list[NDArray[Any]]:
        """Return the arrays of one message; their numbers, one after another, are its readings."""
        return arrays_at(self.topic.deserialize(data), self.field)


def _without_sign(kind: Any) -> Any:
    """Return the type of a field with a byte as the octet that it is in ROS 2: rosbags gives it a
    sign."""
    node, inner = kind
    if inner == ("byte", 0):
        return node, ("uint8", 0)
    if isinstance(inner[0], tuple):  # of an array or a sequence
        return node, (_without_sign(inner[0]), inner[1])
    return kind


def choose(
    path: Path,
    topics: Sequence[Topic],
    messages: Callable[[Topic], Iterable[Found]],
    topic: str | None,
    field: str | None,
) -> list[Extractor]:
    """Return what takes the readings out of a bag with these topics, one a pad.

    Without a topic, those whose type is a MultiArray or named after touch are meant: one, or
    several of one type whose names are those of touch. Without a field their messages must hold one
    array.

    Args:
        path: of the bag, for messages.
        topics: that it has.
        messages: yields the messages of a topic.
        topic: names or patterns as ``/tactile/*``, divided by commas.
        field: of the messages.

    Raises:
        InputError: nothing or too much to choose from; named.
    """
    chosen = _named(path, topics, topic) if topic is not None else _found(path, topics)
    return [_extractor(path, one, messages(one), field) for one in chosen]


def _named(path: Path, topics: Sequence[Topic], given: str) -> list[Topic]:
    chosen: list[Topic] = []
    for pattern in filter(None, map(str.strip, given.split(","))):
        found = [one for one in topics if one.name == pattern]
        found = found or [one for one in topics if fnmatchcase(one.name, pattern)]
        if not found:
            raise InputError.at(path, f"has no topic {pattern}; it has {_listed(topics)}")
        found.sort(key=lambda one: natural_key(one.name))
        chosen += [one for one in found if one not in chosen]
    return chosen


def _found(path: Path, topics: Sequence[Topic]) -> list[Topic]:
    found = [one for one in topics if one.may_hold_readings]
    are_pads = len({one.msgtype for one in found}) == 1 and all(is_touch(one.name) for one in found)
    is_grid = any(one.msgtype == "foxglove.Grid" for one in found)  # states, restored readings, too
    if len(found) == 1 or (are_pads and not is_grid):
        return sorted(found, key=lambda one: natural_key(one.name))
    which = "several topics that may hold readings" if found else "no topic of a tactile type"
    told = f"has {which}: {_listed(found or topics)}; give --topic (topic=), as --topic"
    example = ",".join(one.name for one in (found or topics)[:2])
    raise InputError.at(path, f"{told} {example}" if example else told.partition(", as")[0])


def _listed(topics: Sequence[Topic]) -> str:
    return ", ".join(map(str, topics)) or "none"


def _extractor(path: Path, topic: Topic, messages: Iterable[Found], field: str | None) -> Extractor:
    if topic.encoding not in (_CDR, _JSON):
        what = f"topic {topic}: its messages are written as {topic.encoding or 'nothing known'}"
        raise InputError.at(path, f"{what}; expected CDR (ROS 2) or JSON: record it again as such")
    some = []
    reason = "none of them can be read"
    for _, _, data in islice(messages, _LOOKED):
        # a definition that is missing or damaged, or a message that is: any of rosbags' own
        try:
            message = topic.deserialize(data)
            fields_of(message)
        except Exception as error:
            reason = type(error).__name__
        else:
            some.append(message)
    if not some:
        what = f"topic {topic}: its messages are not described in the bag, or damaged ({reason});"
        raise InputError.at(path, f"{what} record it again with ROS 2 Iron or later, or as MCAP")
    fields: dict[str, Sizes] = {}
    for message in reversed(some):
        fields |= fields_of(message)
    if field is not None:
        return Extractor(topic, field, _sizes_at(path, topic, some, fields, field))
    arrays = [name for name, sizes in fields.items() if math.prod(sizes) > 1]
    arrays = [name for name in arrays if not is_no_touch(name.rpartition(".")[2])]
    named = [name for name in arrays if is_touch(name)]
    chosen = arrays if len(arrays) == 1 else named
    if len(chosen) != 1:
        remedy = "give --field (field=)" if arrays else "choose another with --topic"
        held = ", ".join(arrays) or "no arrays of numbers"
        raise InputError.at(path, f"topic {topic} holds {held}; {remedy}")
    return Extractor(topic, chosen[0], fields[chosen[0]])


def _sizes_at(
    path: Path, topic: Topic, some: Sequence[Any], fields: Mapping[str, Sizes], field: str
) -> Sizes:
    """Return the sizes of what a field that the user names holds: numbers, or messages of them."""
    if field in fields:
        return fields[field]
    below = [name for name in fields if name.startswith(f"{field}.")]
    if not below:
        held = ", ".join(fields) or "none"
        raise InputError.at(path, f"topic {topic} has no array {field}; it has {held}")
    return (sum(array.size for array in arrays_at(some[0], field)),)
