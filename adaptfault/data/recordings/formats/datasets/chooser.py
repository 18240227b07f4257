"""Finds the recordings in a file of named arrays, the same way for HDF5, Zarr, MAT, netCDF,
Parquet and JSON lines: which arrays are readings, where times, episodes and classes are.

Episodes are

- groups: ``demo_0/obs/tactile``, ``demo_1/obs/tactile``;
- parts of arrays that hold all of them one behind the other, with ``episode_ends`` or ``lengths``
  beside, or a column ``episode_index`` that numbers the rows;
- the first axis of an array ``[n, T, ...]`` named ``frames``;
- otherwise the whole array is one recording ``[T, ...]``.

Arrays of one episode whose names differ are the pads of one array.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError, Problem
from adaptfault.data.recordings.facts.episodes import Division, Episode, refuse_a_row_each
from adaptfault.data.recordings.facts.labels import natural_key
from adaptfault.data.recordings.facts.roles import (
    COUNTERS,
    EPISODES,
    in_order,
    left_out,
    reordered,
    shape_of,
    unit_of,
)
from adaptfault.data.recordings.facts.sizes import MOST_CELLS
from adaptfault.data.recordings.formats.datasets.axes import (
    DOUBTED,
    TURNED,
    is_smoothest_along_last,
    is_time_last,
)
from adaptfault.data.recordings.formats.datasets.beside import (
    Beside,
    Stated,
    last_part,
    plain_number,
)
from adaptfault.data.recordings.formats.datasets.contents import (
    DEVICES,
    FULL_SCALES,
    NUMBERS,
    RATES,
    TEXTS,
    UNITS,
    Contents,
    Packing,
    texts,
)
from adaptfault.data.recordings.formats.datasets.features import (
    GUESSED,
    Pads,
    Sizes,
    by_episode,
    choose,
    is_touch,
)
from adaptfault.data.recordings.formats.datasets.parts import Part, Readings
from adaptfault.data.recordings.recording import Facts, Shape, device_name

_OUTER = ("frames", "recordings")  # names of arrays [n, T, ...]
_ENDS = ("episode_ends", "lengths", "episode_lengths")
_INDEX = "index"
_SHOWN = 12  # arrays in a message
_MOST_AXES = 4  # of a frame: hands, pads, rows, columns
_LONGEST_UNIT = 16


class Chooser:
    """What the arrays of one open file are."""

    def __init__(
        self,
        path: Path,
        contents: Contents,
        shape: Shape | None,
        stated: Stated,
        known: Mapping[str, Sizes] | None,
    ) -> None:
        self.path = path
        self.contents = contents
        self.shape = shape
        self.known = known
        arrays = contents.arrays
        self.ends = next((name for name in arrays if last_part(name) in _ENDS), None)
        self.outer = False
        self.is_turned = False
        self.is_doubted = False
        self.beside = Beside(path, contents, stated)
        self.divisions: list[Division] = []
        self.by_names: list[str] = []
        self.lost: list[str] = []

    def episodes(self, key: str | None) -> list[tuple[str, list[str]]]:
        """Return the group of each episode, and the names of its arrays of readings."""
        arrays = self.contents.arrays
        listed = {name: self._sizes(name) for name in arrays if self._may_be_readings(name)}
        if self.known is not None:
            listed = {name: size for name, size in self.known.items() if name in arrays}
        grouped = by_episode(sorted(listed, key=natural_key))
        features: dict[str, Sizes] = {}
        for names in grouped.values():
            features |= {common: listed[name] for common, name in names.items()}
        try:
            chosen = choose(self.path, features if self.known is None else self.known, key)
        except InputError:
            self._refuse_left_out(key)
            raise
        if key is None and chosen and not any(features.get(name) for name in chosen):
            others = [name for name in features if name not in chosen and not features[name]]
            in_file = by_episode(list(listed)).values()
            every = dict.fromkeys(name for names in in_file for name in names)
            stand = [name for name in every if name in chosen]
            chosen = [stand[i] for i in in_order(stand, self.shape)]
            self.by_names = [left_out(others, chosen, "key"), reordered(stand, chosen, "key")]
        found = [
            (episode, [names[common] for common in chosen])
            for episode, names in grouped.items()
            if all(common in names for common in chosen)
        ]
        if not found:
            self._refuse_left_out(key)
            missing = next((name for name in chosen if name not in arrays), None)
            what = f"no episode holds all of {', '.join(chosen)}"
            raise InputError.at(
                self.path, what if missing is None else f"holds no column {missing!r}"
            )
        first = found[0][1]
        if self._is_divided(first[0]):
            self.is_doubted = is_smoothest_along_last(arrays[first[0]])
        elif not self.contents.is_table and self.known is None:
            chosen_arrays = {name: arrays[name] for name in first}
            times = self.beside.times(first[0])
            self.is_turned = is_time_last(self.path, chosen_arrays, self.shape, times)
        self.outer = not self.is_turned and self._holds_recordings(first)
        return found

    def _is_divided(self, name: str) -> bool:
        """Return whether the name and the axes of an array show that its first one is no cell."""
        if last_part(name) not in _OUTER:
            return False
        axes = len(self.contents.arrays[name].shape)
        return self.ends is not None or (self.shape is None and axes > 3)

    def _may_be_readings(self, name: str) -> bool:
        array = self.contents.arrays[name]
        last = last_part(name)
        if array.dtype.kind not in NUMBERS or name == self.ends:
            return False
        if len(array.shape) == 1:
            return last not in (*COUNTERS, _INDEX) and not self.beside.tells(last)
        return last not in self.beside.given

    def _refuse_left_out(self, key: str | None) -> None:
        """Raise the reason why an array that is meant was left out."""
        for name, why in self.contents.left_out.items():
            asked = key is not None and last_part(name) in map(last_part, key.split(","))
            is_all = not self.contents.arrays
            if asked or (key is None and (is_all or is_touch(name))):
                raise InputError.at(self.path, f"{name} {why}")

    def _sizes(self, name: str) -> Sizes:
        if self.known is not None and name in self.known:
            return self.known[name]
        sizes = tuple(map(int, self.contents.arrays[name].shape))
        if self.is_turned:
            return sizes[:-1]
        return sizes[2:] if self.outer else sizes[1:]

    def sizes(self, part: Part) -> tuple[Sizes, ...]:
        """Return the sizes of a frame of each array of a recording.

        Raises:
            InputError: a frame is larger than any sensor.
        """
        sizes = tuple(self._sizes(name) for name in part.names)
        for name, size in zip(part.names, sizes, strict=True):
            if len(size) > _MOST_AXES:
                what = f"{name} has {len(self.contents.arrays[name].shape)} axes; expected at most"
                raise InputError.at(self.path, f"{what} those of [n, T, pads, rows, columns]")
        cells = sum(map(math.prod, sizes))
        if cells > MOST_CELLS:
            what = f"{part.names[0]} declares {cells:,} numbers a frame"
            raise InputError.at(self.path, f"{what}; expected at most {MOST_CELLS:,}")
        return sizes

    def _holds_recordings(self, names: Sequence[str]) -> bool:
        """Return whether the first axis counts recordings, not frames."""
        sizes = tuple(map(int, self.contents.arrays[names[0]].shape))
        if len(names) > 1 or len(sizes) < 3 or self.contents.is_table:
            return False
        if self.ends is not None:
            has_lengths = last_part(self.ends) != _ENDS[0]
            return has_lengths and self.contents.arrays[self.ends].shape == sizes[:1]
        if self.shape is not None:
            cells = math.prod(self.shape)
            fits = [cells == math.prod(sizes[axes:]) for axes in (1, 2)]
            if fits[0] != fits[1]:
                return fits[1]
        is_one = len(sizes) == 4 and sizes[1] == 1  # [T, 1, rows, columns]
        return len(sizes) == 5 or (last_part(names[0]) in _OUTER and not is_one)

    def device(self, part: Part) -> str | None:
        """Return which specimen recorded a recording: what an attribute of its arrays or groups
        says, or a column in its first row; None where nothing does."""
        name = part.names[0]
        stated = self.contents.declared(name).get("device")
        column = self.beside.near(name, DEVICES, self._length(name))
        if stated is None and column is not None and part.last > part.first:
            first = np.asarray(self.contents.arrays[column][part.first : part.first + 1])
            (stated,) = texts(first)
        return device_name(stated)

    def row(self, part: Part) -> int | None:
        """Return what a table calls the first row of a recording: its column ``index``, or its
        place; None where the file is no table."""
        if not self.contents.is_table:
            return None
        column = self.contents.arrays.get(_INDEX)
        if column is None or column.dtype.kind not in "iu" or part.first == part.last:
            return part.first
        return int(np.asarray(column[part.first : part.first + 1]).ravel()[0])

    def _length(self, name: str) -> int:
        shape = self.contents.arrays[name].shape
        return int(shape[-1] if self.is_turned else shape[0])

    def readings(self, part: Part) -> Readings:
        """Return what is read of a recording."""
        packings = [self._packing(name) for name in part.names]
        tick = None
        if part.clock is not None:
            units = self.contents.attributes.get(part.clock, {}).get("units")
            tick = unit_of(part.clock, units)
        masks = tuple(name for name in part.names if self._has_mask(name))
        return Readings(part, tuple(packings), masks, self.is_turned, tick)

    def _has_mask(self, name: str) -> bool:
        """Return whether the file says which readings of an array are valid; a mask of another
        shape is none."""
        mask = self.contents.valid.get(name)
        return mask is not None and tuple(mask.shape) == tuple(self.contents.arrays[name].shape)

    def _packing(self, name: str) -> Packing:
        try:
            return Packing.of(self.contents.attributes.get(name, {}))
        except ValueError as error:
            what = f"{name} has the attribute {error}; expected a number other than 0"
            raise InputError.at(self.path, what) from None

    def facts(self, part: Part, pads: Pads) -> Facts:
        """Return what the file states of its array, from one of its recordings."""
        contents = self.contents
        name = part.names[0]
        rate = contents.positive(name, RATES)
        unit = contents.attribute(name, UNITS)
        packings = self.readings(part).packings
        whole = all(contents.arrays[one].dtype.kind in "iu" for one in part.names)
        are_cells = len(part.names) > 1 and not any(map(self._sizes, part.names))
        by_name = shape_of(part.names) if are_cells and self.shape is None else None
        told = [*self.by_names, *(division.inferred for division in self.divisions)]
        return Facts(
            self.path,
            counts=whole and not any(one.is_scaled for one in packings),
            shape=pads.shape if by_name is None else by_name[0],
            shape_reason="" if by_name is None else by_name[1],
            names=part.names if are_cells else (),
            present=pads.present,
            full_scale=contents.positive(name, FULL_SCALES),
            unit=unit if isinstance(unit, str) and 0 < len(unit) <= _LONGEST_UNIT else None,
            rate=None if rate is None else rate * pads.steps,
            declared=contents.declared(name),
            stored=tuple(map(int, contents.arrays[name].shape)),
            problems=tuple(self._told(part, pads)),
            inferred=tuple(dict.fromkeys(filter(None, told))),
            sizes=pads.sizes,
            places=pads.places,
        )

    def _told(self, part: Part, pads: Pads) -> Iterator[Problem]:
        """Yield warnings of what was left out, and of what was decided without being stated."""
        told = []
        if self.is_turned:
            told.append(TURNED.format(part.names[0]))
        if self.is_doubted:
            told.append(DOUBTED.format(list(self.contents.arrays[part.names[0]].shape)))
        if pads.is_guessed:
            told.append(f"{', '.join(part.names)}: {GUESSED}")
        told += [division.lost for division in self.divisions if division.lost]
        told += dict.fromkeys(self.lost)
        told += self.contents.told
        left_out = list(self.contents.left_out.items())
        told += [f"{name} is left out: it {why}" for name, why in left_out[:_SHOWN]]
        if len(left_out) > _SHOWN:
            told.append(f"{len(left_out) - _SHOWN} more arrays are left out for such reasons")
        for what in told:
            yield Problem.warning(self.path, what)

    def parts(self, episodes: Sequence[tuple[str, list[str]]]) -> Iterator[Part]:
        """Yield the recordings in the arrays of each episode."""
        for place, (group, names) in enumerate(episodes):
            length = self._common_length(names)
            written = self._written(names, length)
            clock = None if self.outer else self.beside.clock(names[0], length, self.lost)
            classes = self.beside.classes(names[0])
            start = partial(Part, tuple(names), clock=clock, group=group)
            if self.outer:
                for i, frames in enumerate(self._lengths(names[0])):
                    label = classes.of_recording(i, length)
                    yield start(0, frames if i < written else 0, outer=i, label=label)
                continue
            column = self._episode_column(names[0], length)
            if self.ends is not None:
                found = self._bounds(self.ends, length)
                behind = length - found[-1].last
                if behind:
                    what = f"{names[0]}: {behind} frames behind the last end in {self.ends}"
                    self.lost.append(f"{what} are left out")
            elif column is not None and not group:
                found = self._runs(column, written)
                if self.contents.is_table:
                    refuse_a_row_each(self.path, found)
            else:
                found = [Episode(0, written)]
            is_group = len(found) == 1 and found[0].number is None
            first = place if is_group else 0
            count = len(episodes) if is_group else len(found)
            division = classes.divided(found, first, count)
            self.divisions.append(division)
            for episode in division.episodes:
                number = episode.number
                if episode.part is not None and number is not None:
                    number = f"{number}, part {episode.part}"
                first = min(episode.first, written)
                last = min(episode.last, written)
                yield start(first, last, label=episode.label, number=number)

    def _common_length(self, names: Sequence[str]) -> int:
        """Return how many frames all of some arrays hold."""
        lengths = {name: self._length(name) for name in names}
        shortest = min(names, key=lambda name: lengths[name])
        longest = max(names, key=lambda name: lengths[name])
        more = lengths[longest] - lengths[shortest]
        if more:
            what = f"{longest} holds {lengths[longest]} frames where {shortest} has"
            self.lost.append(f"{what} {lengths[shortest]}: the last {more} are left out")
        return lengths[shortest]

    def _written(self, names: Sequence[str], length: int) -> int:
        """Return how many of the frames that all of some arrays hold there are up to the last that
        was written; of recordings where the first axis counts these."""
        ends = [self.contents.written[name] for name in names if name in self.contents.written]
        if not ends:
            return length
        written = min(length, *(end[-1] if self.is_turned else end[0] for end in ends))
        if written < length:
            what = "recordings" if self.outer else "frames"
            never = f"the last {length - written} {what} were never written"
            self.lost.append(f"{names[0]}: {never}, and are left out")
        return written

    def _episode_column(self, name: str, length: int) -> str | None:
        """Return the array that numbers the episode of each row of a table; None without one.

        Raises:
            InputError: there is one of another shape.
        """
        column = self.beside.near(name, EPISODES, length)
        other = self.beside.near(name, EPISODES)
        if column is None and other is not None and self.contents.is_table:
            what = f"{other} holds lists; expected one number a row, that of its episode"
            raise InputError.at(self.path, what)
        return column

    def _lengths(self, name: str) -> list[int]:
        """Return the frames of each recording in an array ``[n, T, ...]``."""
        count, longest = map(int, self.contents.arrays[name].shape[:2])
        if self.ends is None:
            return [longest] * count
        lengths: list[int] = self._whole(self.ends).tolist()
        for i, length in enumerate(lengths):
            if not 0 <= length <= longest:
                what = f"length {length}, but {name!r} has room for {longest}; correct"
                raise InputError.at(self.path, f"{what} {self.ends!r}", f"recording {i}")
        return lengths

    def _whole(self, name: str) -> NDArray[np.int64]:
        """Return an array of whole numbers that tells where episodes end."""
        stored = np.asarray(self.contents.arrays[name][:]).ravel()
        if stored.dtype.kind not in "iu":
            what = f"{name} holds no whole numbers; it holds where each episode ends"
            raise InputError.at(self.path, what)
        return stored.astype(np.int64)

    def _bounds(self, name: str, length: int) -> list[Episode]:
        """Return the episodes whose ends an array tells."""
        stored = self._whole(name)
        ends = stored if last_part(name) == _ENDS[0] else np.cumsum(stored)
        if not len(ends) or (np.diff(ends, prepend=0) < 0).any():
            what = f"{name} does not rise; it holds where each episode ends"
            raise InputError.at(self.path, what)
        if ends[-1] > length:
            what = f"{name} ends at frame {ends[-1]}, but the readings hold {length}: cut off?"
            if last_part(name) != _ENDS[0]:
                came = f"array {name!r} is {stored.dtype} {list(stored.shape)}; expected"
                what = f"{came} whole numbers [{length}], one a recording, or any number of them"
                what += " whose sum is that of all frames"
            raise InputError.at(self.path, what)
        bounds = enumerate(pairwise([0, *ends.tolist()]))
        return [Episode(first, last, number) for number, (first, last) in bounds]

    def _runs(self, name: str, length: int) -> list[Episode]:
        """Return the episodes that a column numbers up to some frame."""
        array = self.contents.arrays[name]
        stored = np.asarray(array[:]).ravel()[:length]
        if array.dtype.kind in TEXTS:
            stored = np.array(texts(stored))
        if stored.dtype.kind == "f" and not np.isfinite(stored).all():
            raise InputError.at(self.path, f"rows without {name}; leave them out")
        changes = np.flatnonzero(stored[1:] != stored[:-1]) + 1
        ends = [0, *changes.tolist(), len(stored)] if len(stored) else []
        return [Episode(first, last, plain_number(stored[first])) for first, last in pairwise(ends)]
