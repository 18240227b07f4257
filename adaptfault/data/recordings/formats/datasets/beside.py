"""What stands beside the readings of a file: where times and classes are, and the class of each
recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.episodes import Division, Episode, divide
from adaptfault.data.recordings.formats.datasets.contents import Array


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


def given_names(stated: Stated) -> list[str]:
    """Return the last part of each name that is stated."""
    return [last_part(name) for name in (stated.clock, stated.label) if name is not None]


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
