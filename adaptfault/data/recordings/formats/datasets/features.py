"""Which features of a data set hold the readings of touch, and how several of them are one array.

A feature is an array with a name and one frame after the other. Without a name from the user, those
with a word for touch in their names are meant. Several with the same word are the pads of one
array, in natural order of their names, unless some are another version of others, as ``raw`` and
``filtered``. Pads of different shapes become one layout: rows and columns
of the largest, the positions that a pad does not have are absent.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.labels import natural_key
from adaptfault.data.recordings.facts.roles import TOUCH, readings
from adaptfault.data.recordings.recording import Shape

VALID = ".valid"
"""What the name of a mask has behind that of the array whose valid readings it tells."""

# an index counts what is named before it; else it is a finger
_NO_TOUCH = re.compile(
    r"temp|time|stamp|valid|mask|image|rgb|depth|video|calib|^index$|indices"
    r"|(?:frame|sample|episode|task|row|step|taxel|cell|electrode|channel)[_ -]?index",
    re.IGNORECASE,
)
_VERSION = re.compile(r"raw|filter|smooth|normali|scaled|baseline|diff|mean|std", re.IGNORECASE)
_EPISODE = re.compile(
    r"(?:demo|ep|episode|traj|trajectory|trial|rec|recording|sample|run|grasp|seq|sequence|rollout"
    r"|log|)[_-]?\d+",
    re.IGNORECASE,
)
_SEPARATOR = re.compile(r"[/.]")
_SHOWN = 12  # features in a message

GUESSED = (
    "nothing states rows and columns, so each is taken as one row, and a broken row or column shows"
    " as single cells; --shape states them"
)
"""What is said of flat features."""

Sizes = tuple[int, ...]


def choose(path: Path, features: Mapping[str, Sizes], key: str | None = None) -> list[str]:
    """Return the names of the features that hold the readings, one a pad.

    Args:
        path: of the data set, for messages.
        features: sizes of one frame of each feature; ``()`` for a single number.
        key: names, last parts of names, or patterns as ``*.left``, divided by commas; None: found
            by their names.

    Raises:
        InputError: no feature, or two that could be meant.
    """
    if key is not None:
        return _named(path, features, key)
    arrays = {name: sizes for name, sizes in features.items() if math.prod(sizes) > 1}
    words = _by_word(arrays) or _by_word(features)
    named = [name for names in words.values() for name in names]
    versions = {_version(name) for name in named}
    if len(words) > 1 or len(versions) > 1:
        found = ", ".join(_shown(name, features[name]) for name in named)
        what = f"several features could hold the readings of touch: {found}; name one with --key"
        raise InputError.at(path, what)
    if words:
        (names,) = words.values()
        return names
    if len(arrays) == 1:
        return list(arrays)
    cells = [name for name in features if not _NO_TOUCH.search(name)]
    if cells and not arrays:  # each is a cell
        return [cells[i] for i in readings(cells)]
    what = "no feature has touch, tactile, taxel, pressure, skin, fsr or electrode in its name"
    raise InputError.at(path, f"{what}; {_held(features)}; name one with --key")


def by_episode(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return the arrays of each episode by the names that they have in every episode.

    ``{"demo_0": {"data/tactile": "data/demo_0/tactile"}}``; groups whose names count, as
    ``demo_0``, are episodes.
    """
    grouped: dict[str, dict[str, str]] = {}
    for name in names:
        *groups, last = name.split("/")
        episode = [group for group in groups if _EPISODE.fullmatch(group)]
        common = [group for group in groups if group not in episode]
        grouped.setdefault("/".join(episode), {})["/".join([*common, last])] = name
    return grouped


def common_features(arrays: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Return the names that the arrays of all recordings have in common, without those of episodes;
    empty where there are none.

    Args:
        arrays: names of the arrays of each recording.
    """
    common = {tuple(map(_without_episode, names)) for names in arrays}
    return common.pop() if len(common) == 1 else ()


def _without_episode(name: str) -> str:
    ((common, _),) = by_episode([name]).popitem()[1].items()
    return common


def is_touch(name: str) -> bool:
    """Return whether a feature holds touch by its name."""
    return TOUCH.search(name) is not None and _NO_TOUCH.search(name) is None


def is_no_touch(name: str) -> bool:
    """Return whether a feature holds something else than touch by its name, as temperatures."""
    return _NO_TOUCH.search(name) is not None


def _by_word(features: Mapping[str, Sizes]) -> dict[str, list[str]]:
    """Return the features of touch by the word that tells it, in natural order."""
    words: dict[str, list[str]] = {}
    for name in sorted(features, key=natural_key):
        word = TOUCH.search(name)
        if word and is_touch(name):
            words.setdefault(word[0].lower(), []).append(name)
    return words


def _version(name: str) -> str:
    """Return the word of a name that tells how its readings were processed; "" for none."""
    found = _VERSION.search(name)
    return "" if found is None else found[0].lower()


def _named(path: Path, features: Mapping[str, Sizes], key: str) -> list[str]:
    chosen: list[str] = []
    for pattern in filter(None, (part.strip() for part in key.split(","))):
        whole = [name for name in features if fnmatchcase(name, pattern)]
        ends = [
            name
            for name in features
            if any(fnmatchcase(name[end.end() :], pattern) for end in _SEPARATOR.finditer(name))
        ]
        names = whole or ends
        if set(pattern) & set("*?["):
            names = [name for name in names if not _NO_TOUCH.search(name)]
        if not names:
            raise InputError.at(path, f"holds no feature {pattern!r}; {_held(features)}")
        chosen += [name for name in sorted(names, key=natural_key) if name not in chosen]
    return chosen


def _held(features: Mapping[str, Sizes]) -> str:
    if not features:
        return "it holds no feature of numbers"
    names = sorted(features, key=natural_key)
    found = ", ".join(_shown(name, features[name]) for name in names[:_SHOWN])
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return f"it holds {found}{more}"


def _shown(name: str, sizes: Sizes) -> str:
    return f"{name} {list(sizes)}" if sizes else name


def shown(sizes: Sizes) -> str:
    """Return the sizes of a frame as text: "3 x 4"."""
    return " x ".join(map(str, sizes or (1,)))


@dataclass(frozen=True)
class Pads:
    """Features as the pads of one array.

    Attributes:
        sizes: of a frame of each feature.
        steps: frames that one row of the data set holds: touch that is faster than the other
            features comes in windows.
        shape: ``(pads, rows, cols)``; None: one flat feature.
        is_guessed: whether flat features were taken as one row each.
    """

    sizes: tuple[Sizes, ...]
    steps: int
    shape: Shape | None
    is_guessed: bool = False

    @classmethod
    def of(cls, sizes: Sequence[Sizes], given: Shape | None = None) -> Pads:
        """Return the layout of features; ``given`` is ``(pads, rows, cols)``, where the user states
        it."""
        sizes = [size or (1,) for size in sizes]
        total = sum(map(math.prod, sizes))
        cells = math.prod(given) if given else total
        fitting = given if cells == total else None
        is_one = len(sizes) == 1 and len(sizes[0]) > 1
        is_windowed = is_one and cells < total == cells * sizes[0][0]
        if is_windowed:
            return cls((sizes[0][1:],), sizes[0][0], given)
        is_flat = all(len(size) == 1 for size in sizes) if len(sizes) == 1 else total == len(sizes)
        if fitting or is_flat:
            return cls(tuple(sizes), 1, fitting)
        grids = [_grid(size) for size in sizes]
        pads = sum(grid[0] for grid in grids)
        shape = (pads, max(grid[1] for grid in grids), max(grid[2] for grid in grids))
        return cls(tuple(sizes), 1, shape, all(len(size) == 1 for size in sizes))

    @property
    def present(self) -> NDArray[np.bool_] | None:
        """Bool ``[pads, rows, cols]``; None where all pads have all positions."""
        if self.shape is None or self._is_plain:
            return None
        present = np.zeros(self.shape, dtype=bool)
        present.ravel()[self._places] = True
        return present

    @property
    def places(self) -> NDArray[np.intp] | None:
        """Where in a frame ``[D]`` each reading belongs; None: one after the other."""
        return None if self._is_plain else self._places

    @property
    def _is_plain(self) -> bool:
        """Whether the readings of all features one after the other are the frame."""
        total = sum(map(math.prod, self.sizes))
        return self.shape is None or math.prod(self.shape) == total

    @property
    def _places(self) -> NDArray[np.intp]:
        """Where in a frame ``[D]`` each reading belongs."""
        assert self.shape is not None  # for the type checker
        index = np.arange(math.prod(self.shape)).reshape(self.shape)
        places = []
        first = 0
        for size in self.sizes:
            pads, rows, cols = _grid(size)
            places.append(index[first : first + pads, :rows, :cols].ravel())
            first += pads
        return np.concatenate(places)

    def frames(self, features: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Return frames ``[t, D]`` of rows ``[n, ...]`` of each feature; positions without a cell
        hold 0."""
        rows = len(features[0])
        joined = np.concatenate([feature.reshape(rows, -1) for feature in features], axis=1)
        if self._is_plain:
            return joined.reshape(rows * self.steps, -1)
        assert self.shape is not None  # for the type checker
        frames = np.zeros((rows, math.prod(self.shape)), joined.dtype)
        frames[:, self._places] = joined
        return frames


def _grid(size: Sizes) -> Shape:
    """Return the pads, rows and columns of a feature; a flat one is a row."""
    if len(size) > 3:
        size = (math.prod(size[:-2]), *size[-2:])
    pads, rows, cols = (1,) * (3 - len(size)) + size
    return pads, rows, cols
