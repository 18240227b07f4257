"""Recordings of a file of named arrays with groups: HDF5, Zarr, MAT.

Three forms are read:

- arrays of all episodes one behind the other, with ``episode_ends`` (or ``lengths``) beside them;
- one group an episode: ``demo_0/obs/tactile``, ``demo_1/obs/tactile``;
- one array: a recording ``[T, ...]``, or recordings ``[n, T, ...]`` named ``frames``.

Arrays of one episode whose names differ are the pads of one array.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.facts.labels import natural_key
from adaptfault.data.recordings.formats.datasets.features import Pads, choose
from adaptfault.data.recordings.formats.datasets.table import unit_of
from adaptfault.data.recordings.recording import BLOCK, Block, Facts, Recording, Shape

_EPISODE = re.compile(
    r"(?:demo|ep|episode|traj|trajectory|trial|rec|recording|sample|run|grasp|seq|sequence|rollout"
    r"|log|)[_-]?\d+",
    re.IGNORECASE,
)
_ENDS = ("episode_ends", "lengths", "episode_lengths")
_CLOCKS = ("timestamp", "timestamps", "time", "times", "stamp", "t")
_SHOWN = 12  # arrays in a message
LABELS = ("label", "labels", "class", "object", "task")
RATES = ("rate", "fps", "hz", "sampling_rate", "sampling_hz", "frequency")
FULL_SCALES = ("full_scale", "max_value")
UNITS = ("unit", "units")


class Array(Protocol):
    """An array in a file; a slice of it is read."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the axes."""
        ...

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the numbers."""
        ...

    def __getitem__(self, part: slice, /) -> Any: ...


@dataclass(frozen=True)
class Contents:
    """An open file.

    Attributes:
        arrays: those of numbers, by their names with groups, as "data/tactile".
        attributes: of each group and array that has some; "" is the file itself.
        texts: arrays of text.
    """

    arrays: Mapping[str, Array]
    attributes: Mapping[str, Mapping[str, Any]]
    texts: Mapping[str, Sequence[str]]


Opened = Callable[[Sequence[str] | None], AbstractContextManager[Contents]]
"""Opens a file, and returns all that it holds, or the arrays of some names alone."""


@dataclass(frozen=True)
class Stated:
    """Names of the arrays of times and of classes, or of an attribute with the class, whole or the
    last part; None: found by their names."""

    clock: str | None = None
    label: str | None = None


@dataclass(frozen=True)
class _Part:
    """Where the frames of one recording are."""

    names: tuple[str, ...]
    first: int
    last: int
    clock: str | None = None
    outer: int | None = None
    label: str | None = None
    name: str | None = None


def recordings_of(
    path: Path,
    opened: Opened,
    *,
    shape: Shape | None,
    key: str | None,
    stated: Stated,
) -> list[Recording]:
    """Return the recordings of a file.

    Args:
        path: of the file, for messages.
        opened: opens it; raises InputError where it cannot be read.
        shape: ``(pads, rows, cols)`` where the user states it.
        key: which arrays hold the readings; None: found by their names.
        stated: where times and classes are.

    Raises:
        InputError: no array of touch, or several that could be meant; times or classes are not
            where they are stated.
    """
    with opened(None) as contents:
        arrays = contents.arrays
        ends = next((name for name in arrays if _last(name) in _ENDS), None)
        listed = {name: tuple(array.shape[1:]) for name, array in arrays.items() if name != ends}
        episodes = _episodes(path, listed, key)
        names = episodes[0][1]
        outer = _holds_recordings(arrays[names[0]], names, shape) and ends is None
        skipped = 2 if outer else 1
        sizes = [tuple(map(int, arrays[name].shape[skipped:])) for name in names]
        pads = Pads.of(sizes, shape)
        facts = _facts(path, contents, names, pads)
        parts = list(_parts(path, contents, episodes, ends, stated, outer=outer))
        if not any(part.last > part.first for part in parts):
            raise InputError.at(path, "holds no frames; record it again or remove it")

    def blocks(part: _Part) -> Callable[[], Iterator[Block]]:
        tick = None if stated.clock is None else unit_of(stated.clock)
        return lambda: _blocks(path, opened, part, pads, tick)

    return [Recording(facts, blocks(part), part.name, part.label) for part in parts]


def _last(name: str) -> str:
    return name.rpartition("/")[2].lower()


def _episodes(
    path: Path, listed: Mapping[str, tuple[int, ...]], key: str | None
) -> list[tuple[str, list[str]]]:
    """Return the names of the arrays of each episode, and how the episode is called."""
    grouped: dict[tuple[str, ...], dict[str, str]] = {}
    for name in sorted(listed, key=natural_key):
        *groups, last = name.split("/")
        episode = tuple(group for group in groups if _EPISODE.fullmatch(group))
        common = "/".join([*(group for group in groups if group not in episode), last])
        grouped.setdefault(episode, {})[common] = name
    features: dict[str, tuple[int, ...]] = {}
    for names in grouped.values():
        features |= {common: listed[name] for common, name in names.items()}
    chosen = choose(path, features, key)
    found = []
    for episode, names in grouped.items():
        if all(common in names for common in chosen):
            found.append(("/".join(episode), [names[common] for common in chosen]))
    if not found:
        raise InputError.at(path, f"no episode holds all of {', '.join(chosen)}")
    return found


def _holds_recordings(array: Array, names: Sequence[str], given: Shape | None) -> bool:
    """Return whether the first axis counts recordings, not frames."""
    sizes = tuple(map(int, array.shape))
    if len(names) > 1 or len(sizes) < 3:
        return False
    if given is not None:
        cells = math.prod(given)
        return math.prod(sizes[1:]) != cells and math.prod(sizes[2:]) == cells
    return len(sizes) == 5 or _last(names[0]) in ("frames", "recordings")


def _parts(
    path: Path,
    contents: Contents,
    episodes: Sequence[tuple[str, list[str]]],
    ends: str | None,
    stated: Stated,
    *,
    outer: bool,
) -> Iterator[_Part]:
    labels = _labels(contents) if stated.label is None else []
    for episode, names in episodes:
        length = min(int(contents.arrays[name].shape[0]) for name in names)
        clocks = _CLOCKS if stated.clock is None else (stated.clock,)
        beside = _beside(contents.arrays, names[0], clocks, length)
        if stated.clock is not None and beside is None and not outer:
            raise _absent(path, "time-column", stated.clock, "of one number a frame", contents)
        own_labels = _own_labels(path, contents, names[0], stated.label)
        if outer:
            frames = int(contents.arrays[names[0]].shape[1])
            for i in range(length):
                label = labels[i] if len(labels) == length else own_labels(0, frames, i, length)
                yield _Part(tuple(names), 0, frames, outer=i, label=label)
            continue
        if ends is None:
            own = _attribute(contents, names[0], LABELS)
            label = str(own) if own is not None else (labels[0] if len(labels) == 1 else None)
            label = own_labels(0, length, 0, 1) or label
            name = _called(path, episode)
            yield _Part(tuple(names), 0, length, beside, label=label, name=name)
            continue
        bounds = _bounds(path, contents, ends, length)
        for i, (first, last) in enumerate(bounds):
            label = labels[i] if len(labels) == len(bounds) else None
            label = own_labels(first, last, i, len(bounds)) or label
            name = _called(path, f"episode {i}")
            yield _Part(tuple(names), first, last, beside, label=label, name=name)


def _called(path: Path, episode: str) -> str | None:
    return f"{path.name}, {episode}" if episode else None


def _bounds(path: Path, contents: Contents, name: str, length: int) -> list[tuple[int, int]]:
    """Return the first frame of each episode and the one behind its last."""
    stored = np.asarray(contents.arrays[name][:]).ravel().astype(np.int64)
    ends = stored if _last(name) == _ENDS[0] else np.cumsum(stored)
    if not len(ends) or (np.diff(ends, prepend=0) < 0).any():
        raise InputError.at(path, f"{name} does not rise; it holds where each episode ends")
    if ends[-1] > length:
        what = f"{name} ends at frame {ends[-1]}, but the readings hold {length}: cut off?"
        raise InputError.at(path, what)
    return [bounds for bounds in pairwise([0, *ends.tolist()]) if bounds[1] > bounds[0]]


def _beside(
    arrays: Mapping[str, Array], name: str, wanted: Sequence[str], length: int
) -> str | None:
    """Return an array of one number a frame in a group of ``name``, or above it."""
    groups = name.split("/")[:-1]
    for depth in range(len(groups), -1, -1):
        above = "/".join(groups[:depth])
        for other, array in arrays.items():
            within = other.rpartition("/")[0] == above or (
                depth == 0 and other.startswith(("data/", "meta/"))
            )
            if within and _named(other, wanted) and tuple(array.shape) in ((length,), (length, 1)):
                return other
    return None


def _named(name: str, wanted: Sequence[str]) -> bool:
    """Return whether a wanted name is this one, or its last part."""
    return any(f"/{name.lower()}".endswith(f"/{one.lower()}") for one in wanted)


def _absent(path: Path, option: str, name: str, what: str, contents: Contents) -> InputError:
    held = ", ".join(sorted([*contents.arrays, *contents.texts], key=natural_key)[:_SHOWN])
    return InputError.at(path, f"--{option} {name}: holds no such array {what}; it holds {held}")


def _own_labels(
    path: Path, contents: Contents, name: str, stated: str | None
) -> Callable[[int, int, int, int], str | None]:
    """Return what tells the class of the recording with some first and last frame, its number and
    how many there are, from the array or the attribute that the user states."""
    if stated is None:
        return lambda *_: None
    value = _attribute(contents, name, (stated.lower(),))
    if value is not None:
        return lambda *_: str(value)
    groups = name.split("/")[:-1]
    above = ["/".join(groups[:depth]) for depth in range(len(groups), -1, -1)]
    near = [
        other
        for group in above
        for other in (*contents.texts, *contents.arrays)
        if _named(other, (stated,)) and (not group or other.startswith(f"{group}/"))
    ]
    if not near:
        raise _absent(path, "label-column", stated, "or attribute", contents)
    held = contents.texts.get(near[0])
    values = np.asarray(contents.arrays[near[0]][:]).ravel().tolist() if held is None else held

    def label(first: int, last: int, number: int, count: int) -> str:
        if len(values) == count:
            return str(values[number])
        if len(values) < last:
            what = (
                f"{near[0]} holds {len(values)} classes; expected one a recording, or one a frame"
            )
            raise InputError.at(path, f"--label-column {stated}: {what}")
        return Counter(map(str, values[first:last])).most_common(1)[0][0]

    return label


def _labels(contents: Contents) -> list[str]:
    """Return the labels of recordings that an array of the file holds."""
    for other, texts in contents.texts.items():
        if _last(other) in LABELS:
            return list(texts)
    for other, array in contents.arrays.items():
        if _last(other) in LABELS and array.dtype.kind in "iu" and len(array.shape) == 1:
            return [str(label) for label in np.asarray(array[:]).tolist()]
    return []


def _attribute(contents: Contents, name: str, wanted: Sequence[str]) -> Any:
    """Return an attribute of an array, of a group that holds it, or of the file."""
    parts = name.split("/")
    for depth in range(len(parts), -1, -1):
        attributes = contents.attributes.get("/".join(parts[:depth]), {})
        for known, value in attributes.items():
            if known.lower() in wanted and np.size(value) == 1:
                plain = np.asarray(value).item()
                return plain.decode() if isinstance(plain, bytes) else plain
    return None


def _facts(path: Path, contents: Contents, names: Sequence[str], pads: Pads) -> Facts:
    array = contents.arrays[names[0]]
    rate = _positive(_attribute(contents, names[0], RATES))
    unit = _attribute(contents, names[0], UNITS)
    return Facts(
        path,
        counts=all(contents.arrays[name].dtype.kind in "iu" for name in names),
        shape=pads.shape,
        present=pads.present,
        full_scale=_positive(_attribute(contents, names[0], FULL_SCALES)),
        unit=unit if isinstance(unit, str) and 0 < len(unit) <= 16 else None,
        rate=None if rate is None else rate * pads.steps,
        stored=tuple(map(int, array.shape)),
    )


def _positive(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) and value > 0 else None


def _blocks(
    path: Path, opened: Opened, part: _Part, pads: Pads, tick: str | None
) -> Iterator[Block]:
    wanted = [*part.names, *([] if part.clock is None else [part.clock])]
    with opened(wanted) as contents:
        arrays: list[Any] = [contents.arrays[name] for name in part.names]
        if part.outer is not None:
            arrays = [arrays[0][part.outer : part.outer + 1][0]]
        # times of rows are none of frames
        has_times = part.clock is not None and pads.steps == 1
        clock = contents.arrays[str(part.clock)] if has_times else None
        for first in range(part.first, part.last, BLOCK):
            last = min(first + BLOCK, part.last)
            called = (part.name or part.names[0]).removeprefix(f"{path.name}, ")
            where = f"{called}, frames {first} to {last - 1}"
            try:
                values = [np.asarray(array[first:last]) for array in arrays]
                times = None if clock is None else np.asarray(clock[first:last], dtype=np.float64)
            # a damaged chunk raises any of a dozen kinds: the codec's, the store's, Python's
            except Exception as error:
                what = (
                    f"cannot be read ({type(error).__name__}): damaged, or cut off; copy it again"
                )
                raise InputError.at(path, what, where) from None
            if any(len(value) != last - first for value in values):
                raise InputError.at(path, "is cut off; copy it again", where)
            times = None if times is None else times.ravel()
            yield Block(_numbers(pads.frames(values)), None, times, tick)


def _numbers(values: NDArray[Any]) -> NDArray[Any]:
    if values.dtype.kind in "iu":
        return values
    with np.errstate(all="ignore"):  # what float32 cannot hold becomes infinite, and is missing
        return values.astype(np.float32)
