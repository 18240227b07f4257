"""Divides the frames of a file into recordings: where the number of the episode changes, and where
the class does.

A class holds for a whole recording. Where it changes inside, and mostly holds for at least as many
frames as a window has, each stretch of one class is a recording. Where it changes faster, a
recording has its most frequent class, and what is lost is told.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

SHORTEST = 10
"""Frames of a window: a class that mostly holds for as many is that of a recording."""


@dataclass(frozen=True)
class Episode:
    """Some frames of a file, one recording.

    Attributes:
        first, last: its first frame, and the one behind its last.
        name: "episode 3"; None where no number is given.
        label: its class; None without one.
    """

    first: int
    last: int
    name: str | None = None
    label: str | None = None


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


def divide(
    frames: int, numbers: Sequence[Any] | None = None, classes: Sequence[Any] | None = None
) -> Division:
    """Return the recordings of a file.

    Args:
        frames: in it.
        numbers: of the episode of each frame.
        classes: of each frame; None and "" are none, and the frame has that of the one before it.
    """
    begins = _changes(numbers, 0, frames)
    parts = list(pairwise([*begins, frames]))
    names = [None if numbers is None else f"episode {numbers[first]}" for first, _ in parts]
    if classes is None:
        every = [Episode(*part, name) for part, name in zip(parts, names, strict=True)]
        return Division(tuple(every))
    held = [_filled(classes[first:last]) for first, last in parts]
    stretches = []
    lengths: list[int] = []
    changes = 0
    for labels, (first, last) in zip(held, parts, strict=True):
        of_it = _changes(labels, first, last)
        stretches.append(of_it)
        changes += len(of_it) - 1
        if len(of_it) > 1:
            lengths += np.diff([*of_it, last]).tolist()
    if lengths and np.median(lengths) >= SHORTEST:
        return _by_class(parts, names, held, stretches)
    episodes = []
    lost = 0
    for (first, last), name, labels in zip(parts, names, held, strict=True):
        label = _most(labels)
        lost += sum(one not in (label, None) for one in labels)
        episodes.append(Episode(first, last, name, label))
    told = (
        f"the class changes {changes} time{'s' * (changes != 1)} within a recording, which has its"
        f" most frequent one: that of {lost} of {frames} frames is lost; cut the recordings where"
        " it changes"
    )
    return Division(tuple(episodes), lost=told if lost else "")


def _by_class(
    parts: Sequence[tuple[int, int]],
    names: Sequence[str | None],
    held: Sequence[list[str | None]],
    stretches: Sequence[list[int]],
) -> Division:
    episodes = []
    for (first, last), name, labels, begins in zip(parts, names, held, stretches, strict=True):
        for k, (begin, end) in enumerate(pairwise([*begins, last])):
            called = name if name is None or len(begins) == 1 else f"{name}, part {k}"
            episodes.append(Episode(begin, end, called, labels[begin - first]))
    told = f"a recording begins where the class changes, {len(episodes)} in all"
    return Division(tuple(episodes), told)


def _changes(values: Sequence[Any] | None, first: int, last: int) -> list[int]:
    """Return ``first``, and each frame before ``last`` whose value is another than the one before
    it; the values are those from ``first`` on."""
    if values is None or last - first < 2:
        return [first]
    held: NDArray[Any] = np.empty(last - first, dtype=object)
    held[:] = list(values)
    changed = np.flatnonzero(held[1:] != held[:-1]) + 1
    return [first, *(changed + first).tolist()]


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


def _most(labels: Sequence[str | None]) -> str | None:
    """Return the most frequent class."""
    counts = Counter(label for label in labels if label is not None)
    return max(sorted(counts), key=counts.__getitem__, default=None)
