"""Divides the frames of a file into recordings: where the number of the episode changes, and where
the class does.

A class holds for a whole recording. Where it changes inside, and mostly holds for at least as many
frames as a window has, each stretch of one class is a recording. Where it changes faster, a
recording has its most frequent class, and what is lost is told.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from adaptfault.data.recordings.errors import InputError

SHORTEST = 10
"""Frames of a window: a class that mostly holds for as many is that of a recording."""


@dataclass(frozen=True)
class Episode:
    """Some frames of a file, one recording.

    Attributes:
        first, last: its first frame, and the one behind its last.
        number: how the file numbers it; None: it does not.
        label: its class; None without one.
        part: which stretch of one class it is; None: the whole episode.
    """

    first: int
    last: int
    number: Any = None
    label: str | None = None
    part: int | None = None

    @property
    def name(self) -> str | None:
        """How it is called: "episode 3"; None where it has no number."""
        if self.number is None:
            return None
        return f"episode {self.number}" + ("" if self.part is None else f", part {self.part}")


@dataclass(frozen=True)
class Division:
    """How the frames of a file are divided.

    Attributes:
        episodes: at least one.
        inferred: that recordings begin where the class changes; "" where they do not.
        lost: that classes of some frames are lost; "" where they are not.
    """

    episodes: tuple[Episode, ...]
    inferred: str = ""
    lost: str = ""


def numbered(numbers: Sequence[Any]) -> list[Episode]:
    """Return the episodes of frames with the number of theirs."""
    begins = [0, *(i for i in range(1, len(numbers)) if numbers[i] != numbers[i - 1])]
    return [Episode(a, b, numbers[a]) for a, b in pairwise([*begins, len(numbers)])]


def refuse_a_row_each(path: Path, episodes: Sequence[Episode]) -> None:
    """Raise InputError where each of several episodes of a table (``path``) is a single row."""
    if len(episodes) > 1 and all(one.last - one.first == 1 for one in episodes):
        what = (
            f"each row is another recording, {episodes[0].name} to {episodes[-1].name}: values of a"
            " whole grasp or step and no frames, so nothing tells how a cell moves; give the"
            " recordings themselves"
        )
        raise InputError.at(path, what)


def divide(episodes: Sequence[Episode], classes: Sequence[Any]) -> Division:
    """Return the recordings of a file.

    Args:
        episodes: in it.
        classes: of each frame; None and "" are none, and the frame has that of the one before it.
    """
    stretches: list[list[Episode]] = []
    lengths: list[int] = []
    usual: list[Episode] = []
    lost = 0
    for episode in episodes:
        labels = _filled(classes[episode.first : episode.last])
        counts = Counter(label for label in labels if label is not None)
        label = max(sorted(counts), key=counts.__getitem__, default=None)
        lost += len(labels) - labels.count(label)
        usual.append(replace(episode, label=label))
        parts = [
            replace(
                episode,
                first=episode.first + one.first,
                last=episode.first + one.last,
                label=one.number,
                part=place,
            )
            for place, one in enumerate(numbered(labels))
        ]
        stretches.append(parts if len(parts) > 1 else usual[-1:])
        if len(parts) > 1:
            lengths += [part.last - part.first for part in parts]
    if not lost:
        return Division(tuple(usual))
    if np.median(lengths) >= SHORTEST:
        found = tuple(part for parts in stretches for part in parts)
        return Division(found, f"a recording begins where the class changes, {len(found)} in all")
    changes = sum(len(parts) - 1 for parts in stretches)
    told = (
        f"the class changes {changes} time{'s' * (changes != 1)} within a recording, which has its"
        f" most frequent one: that of {lost} of {len(classes)} frames is lost; cut the recordings"
        " where it changes"
    )
    return Division(tuple(usual), lost=told)


def _filled(classes: Sequence[Any]) -> list[str | None]:
    """Return the class of each frame; one without has that of the frame before it, or else the
    first that there is."""
    texts = [None if one is None or str(one) in ("", "nan") else str(one) for one in classes]
    known = next((text for text in texts if text is not None), None)
    filled = []
    for text in texts:
        known = text or known
        filled.append(known)
    return filled
