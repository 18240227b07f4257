"""What stands beside the readings of a file: where times and classes are, and the class of each
recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.episodes import Division, Episode, divide
from adaptfault.data.recordings.facts.labels import natural_key
from adaptfault.data.recordings.facts.roles import EPISODES, LABELS, is_clock
from adaptfault.data.recordings.formats.datasets.contents import DEVICES, Array, Contents, texts

_GROUPS = ("", "data", "meta")  # in which arrays of the whole file stand
_SHOWN = 12  # arrays in a message


@dataclass(frozen=True)
class Stated:
    """Names of the arrays of times and of classes, or of an attribute with the class, whole or the
    last part; None: found by their names."""

    clock: str | None = None
    label: str | None = None


def last_part(name: str) -> str:
    """Return the name of an array without its groups."""
    return name.rpartition("/")[2].lower()


@dataclass(frozen=True)
class Classes:
    """The classes beside an array of readings.

    Attributes:
        path: of the file.
        stated: the option of the user.
        holder: the array that holds them.
        values: one a recording, or one a frame.
        common: the class of all.
    """

    path: Path
    stated: str | None
    holder: str = ""
    values: Sequence[str] | None = None
    common: str | None = None

    def of_recording(self, place: int, count: int) -> str | None:
        """Return the class of one of ``count`` recordings."""
        if self.values is None:
            return self.common
        if len(self.values) == count:
            return self.values[place] or None
        if self.stated is None:
            return None
        what = f"{self.holder} holds {len(self.values)} classes"
        what += "; expected one a recording, or one a frame"
        raise InputError.at(self.path, f"--label-column {self.stated}: {what}")

    def divided(self, episodes: Sequence[Episode], first: int, count: int) -> Division:
        """Return episodes with their classes, divided where these change.

        Args:
            episodes: in their order.
            first: place of the first of them.
            count: of all episodes of the file.
        """
        frames = max((episode.last for episode in episodes), default=0)
        if self.values is not None and len(self.values) != count and len(self.values) >= frames:
            return divide(episodes, self.values[:frames])
        places = range(first, first + len(episodes))
        labels = [self.of_recording(place, count) for place in places]
        each = zip(episodes, labels, strict=True)
        return Division(tuple(replace(episode, label=label) for episode, label in each))


def is_vector(array: Array, length: int) -> bool:
    """Return whether an array holds one number, time or text a frame."""
    shape = tuple(map(int, array.shape))
    return shape in ((length,), (length, 1), (1, length))


def plain_number(value: Any) -> int | str:
    """Return the number of an episode; a text stays one."""
    plain = value.item()
    if isinstance(plain, float) and plain.is_integer():
        return int(plain)
    return plain if isinstance(plain, int) else str(plain)


class Beside:
    """The arrays of times, classes, episodes and devices beside the readings of an open file."""

    def __init__(self, path: Path, contents: Contents, stated: Stated) -> None:
        self._path = path
        self._contents = contents
        self._stated = stated
        self.given = [last_part(name) for name in (stated.clock, stated.label) if name is not None]
        self._named: dict[str, list[str]] = {}
        for name in contents.arrays:
            if self.tells(last_part(name)):
                self._named.setdefault(name.rpartition("/")[0], []).append(name)
        self._texts: dict[str, list[str]] = {}

    def tells(self, last: str) -> bool:
        """Return whether an array with this last part of its name is one of them."""
        return last in (*EPISODES, *LABELS, *DEVICES, *self.given) or is_clock(last)

    def near(self, name: str, wanted: Sequence[str], length: int | None = None) -> str | None:
        """Return an array in the group of ``name``, or above it: the first of the names that are
        wanted.

        Args:
            name: of an array of readings.
            wanted: the last part of names.
            length: how many values it holds; None: any number.
        """
        arrays = self._contents.arrays
        for group in self._groups(name):
            named = {last_part(one): one for one in reversed(group)}
            for one in wanted:
                found = named.get(one)
                if found and (length is None or is_vector(arrays[found], length)):
                    return found
        return None

    def _groups(self, name: str) -> list[list[str]]:
        """Return the names in the group of an array, in those above it, and in those of the whole
        file."""
        groups = name.split("/")[:-1]
        above = ["/".join(groups[:depth]) for depth in range(len(groups), 0, -1)]
        return [self._named.get(group, []) for group in dict.fromkeys([*above, *_GROUPS])]

    def times(self, name: str) -> list[int]:
        """Return how many values the arrays of times near an array hold, each one a vector."""
        near = [one for group in self._groups(name) for one in group if is_clock(last_part(one))]
        found = [self._contents.arrays[one].shape for one in near]
        return [max(sizes) for sizes in found if sizes and math.prod(sizes) == max(sizes) > 1]

    def clock(self, name: str, length: int, lost: list[str]) -> str | None:
        """Return the times of an array of so many frames; others that are passed over are told in
        ``lost``."""
        stated = self._stated.clock
        arrays = self._contents.arrays
        near = [one for group in self._groups(name) for one in group]
        wrong = []
        for other in near if stated is None else [*near, stated]:
            if stated is None:
                is_meant = is_clock(last_part(other))
            else:
                is_meant = f"/{other.lower()}".endswith(f"/{stated.lower()}")
            if is_meant and other in arrays:
                if is_vector(arrays[other], length):
                    return other
                sizes = arrays[other].shape
                if len(sizes) == 1 and sizes[0] > 1:
                    what = f"{other} holds {sizes[0]} values where {name} has {length} frames"
                    wrong.append(f"{what}: passed over")
        lost += wrong
        if stated is None:
            return None
        raise self._absent("time-column", stated, " of one number a frame")

    def _absent(self, option: str, name: str, what: str) -> InputError:
        held = ", ".join(sorted(self._contents.arrays, key=natural_key)[:_SHOWN])
        told = f"--{option} {name}: holds no such array{what}; it holds {held}"
        return InputError.at(self._path, told)

    def classes(self, name: str) -> Classes:
        """Return the classes of recordings, or of frames, beside an array of readings."""
        stated = self._stated.label
        wanted = LABELS if stated is None else (last_part(stated),)
        value = self._contents.attribute(name, wanted)
        if value is not None:
            return Classes(self._path, stated, common=str(value))
        holder = self.near(name, wanted)
        if stated is not None and (holder is None or stated in self._contents.arrays):
            holder = stated
        if holder is None:
            return Classes(self._path, stated)
        if holder not in self._contents.arrays:
            raise self._absent("label-column", str(stated), " or attribute")
        if holder not in self._texts:
            self._texts[holder] = texts(self._contents.arrays[holder][:])
        return Classes(self._path, stated, holder, self._texts[holder])
