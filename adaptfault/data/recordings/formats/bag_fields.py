"""Chooses the topic of a bag that holds the readings, and the field of its messages."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.message_arrays import arrays_at
from adaptfault.data.recordings.recording import Shape

_TACTILE = re.compile(r"std_msgs/.*MultiArray|.*tactile.*", re.IGNORECASE)
_FLOATS = ("float32", "float64")
_NUMBERS = (*_FLOATS, *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))

# Types that bags before ROS 2 Iron do not describe, and that no distribution ships.
_KNOWN = {
    "tactile_msgs/msg/TactileState": (
        "std_msgs/Header header\nsensor_msgs/ChannelFloat32[] sensors\n"
    )
}


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, the type of its messages, and their definition (empty where the
    bag has none)."""

    name: str
    msgtype: str
    definition: str = ""

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
        return store

    @cached_property
    def arrays(self) -> dict[str, str]:
        """The fields that hold arrays of numbers, and the type of these:
        ``{"sensors.values": "float32"}``."""
        return dict(self._arrays(self.msgtype, ""))

    def _arrays(self, msgtype: str, before: str) -> Iterable[tuple[str, str]]:
        from rosbags.typesys.store import Nodetype

        for name, (kind, content) in self.store.fielddefs[msgtype][1]:
            inner, what = (
                content[0] if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else (kind, content)
            )
            if inner is Nodetype.NAME:
                yield from self._arrays(what, f"{before}{name}.")
            elif inner is not kind and what[0] in _NUMBERS:
                yield before + name, what[0]


@dataclass(frozen=True)
class Extractor:
    """Takes the readings out of the messages of one topic.

    Attributes:
        topic: the topic.
        field: dotted; where the path leads through a list of messages, their arrays are put one
            after another.
    """

    topic: Topic
    field: str

    @cached_property
    def deserialize(self) -> Callable[[bytes], Any]:
        """Turn a message's bytes into an object."""
        store = self.topic.store
        msgtype = self.topic.msgtype
        return lambda data: store.deserialize_cdr(data, msgtype)

    def arrays_of(self, message: Any) -> list[NDArray[Any]]:
        """Return the arrays of one message; their numbers, one after another, are its readings."""
        return arrays_at(message, self.field)

    def shape(self, message: Any) -> Shape | None:
        """Return ``(pads, rows, cols)`` where a MultiArray states three dimensions."""
        dims = getattr(getattr(message, "layout", None), "dim", [])
        if self.field != "data" or len(dims) != 3:
            return None
        sizes = tuple(int(dim.size) for dim in dims)
        return (sizes[0], sizes[1], sizes[2]) if np.prod(sizes) == len(message.data) else None


def choose(path: Path, topics: Sequence[Topic], topic: str | None, field: str | None) -> Extractor:
    """Return what takes the readings out of a bag with these topics.

    Without a topic there must be one whose type is a MultiArray or named after touch; without a
    field its messages must hold one array.

    Raises:
        InputError: nothing or too much to choose from; named.
    """
    listed = ", ".join(map(str, topics)) or "none"
    if topic is not None:
        found = [one for one in topics if one.name == topic]
        if not found:
            raise InputError.at(path, f"has no topic {topic}; it has {listed}")
    else:
        found = [one for one in topics if _TACTILE.fullmatch(one.msgtype)]
        if len(found) != 1:
            which = (
                "several topics that may hold readings" if found else "no topic of a tactile type"
            )
            raise InputError.at(
                path, f"has {which}: {', '.join(map(str, found)) or listed}; give --topic (topic=)"
            )
    chosen = found[0]
    try:
        arrays = chosen.arrays
    except (
        Exception
    ) as error:  # a definition that is missing or damaged: KeyError and all of rosbags' own
        what = (
            f"topic {chosen}: its messages are not described in the bag ({type(error).__name__});"
            " record it again"
        )
        raise InputError.at(path, f"{what} with ROS 2 Iron or later, or as MCAP") from None
    if field is None:
        if len(arrays) != 1:
            what = f"topic {chosen} holds {', '.join(arrays) or 'no arrays of numbers'}"
            raise InputError.at(
                path,
                f"{what}; {'give --field (field=)' if arrays else 'choose another with --topic'}",
            )
        return Extractor(chosen, next(iter(arrays)))
    if field not in arrays:
        raise InputError.at(
            path, f"topic {chosen} has no array {field}; it has {', '.join(arrays) or 'none'}"
        )
    return Extractor(chosen, field)
