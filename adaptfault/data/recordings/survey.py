"""Goes through the frames of each recording once, before the array is decided: lengths, the largest
readings, what is missing, the times. What fits into memory is kept, so that it is read once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import NO_FRAMES, InputError, Problem, foreseeing
from adaptfault.data.recordings.facts.rates import Elapsed
from adaptfault.data.recordings.files import Found
from adaptfault.data.recordings.recording import Block, Facts, Recording, Shape
from adaptfault.data.recordings.scans import Scans, doubt_of, readings_of, scan_of, without_scan
from diagnostics import SensorLayout
from diagnostics.preprocessing.levels import LOW
from diagnostics.preprocessing.quantiles import known_quantile
from diagnostics.sensor.odd_frames import find_odd_frames

_FEW = 8  # frames, that tell no corrupt one from the others
_FAR = 1.5  # times what most frames read at most
_HEAD = 100  # first frames of a recording, for messages
_COUNTS = 16  # whole numbers that reach it are counts, in an array of decimals, too
_SAMPLE = 2000  # readings of a recording, in which the step of a converter is looked for


class Gaps:
    """Readings of some kind, as missing ones.

    Args:
        cells: D, how many cells there are.

    Attributes:
        count: int ``[D]``, how many there are of each cell.
        first: int ``[D]``, frame of the first one, or line in a text.
    """

    def __init__(self, cells: int) -> None:
        self.count = np.zeros(cells, np.int64)
        self.first = np.zeros(cells, np.int64)

    def add(self, gaps: NDArray[np.bool_], block: Block, before: int) -> None:
        """Take in which readings ``[t, D]`` of the next frames are such; ``before``: frames of
        those before."""
        cells = np.flatnonzero(gaps.any(axis=0))
        frames = gaps[:, cells].argmax(axis=0)
        places = frames + before if block.lines is None else block.lines[frames]
        new = self.count[cells] == 0
        self.first[cells[new]] = places[new]
        self.count[cells] += gaps[:, cells].sum(axis=0)


@dataclass(eq=False)
class Survey:
    """What one recording holds.

    Attributes:
        length: T, the number of frames.
        head: its first frames, ``[t, D]``.
        first_line: of the file, where it is text; 0 otherwise.
        whole: whether all readings are whole numbers.
        largest: finite reading.
        sample: finite readings above 0, evenly spaced in each block.
        missing, infinite: such readings.
        loaded, beyond: number of readings above 0, and above ``limit``.
        elapsed: of its clock; None without one.
        tick: unit of its clock.
    """

    limit: float
    length: int = 0
    head: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))
    first_line: int = 0
    whole: bool = True
    largest: float = 0.0
    sample: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    missing: Gaps = field(default_factory=lambda: Gaps(0))
    infinite: Gaps = field(default_factory=lambda: Gaps(0))
    loaded: int = 0
    beyond: int = 0
    elapsed: Elapsed | None = None
    tick: str | None = None

    @property
    def width(self) -> int:
        """Readings in a frame."""
        return int(self.head.shape[1])

    def add(self, block: Block) -> None:
        """Take in the next frames."""
        values = block.values
        if not len(values):
            return
        if not self.length:
            self.head = np.asarray(values[:_HEAD], dtype=np.float64)
            self.first_line = 0 if block.lines is None else int(block.lines[0])
            self.missing = Gaps(values.shape[1])
            self.infinite = Gaps(values.shape[1])
        whole_type = values.dtype.kind in "iu"
        measured = _measured(values)
        finite = measured if whole_type else measured[np.isfinite(measured)]
        positive = finite[finite > 0]
        self.largest = max(self.largest, float(positive.max(initial=0)))
        self.loaded += positive.size
        self.beyond += int(np.count_nonzero(positive > self.limit))
        if not whole_type:
            self.whole = self.whole and bool(np.array_equal(finite, np.rint(finite)))
            self.missing.add(np.isnan(values), block, self.length)
            self.infinite.add(np.isinf(values), block, self.length)
        room = _SAMPLE - len(self.sample)
        if room > 0:
            step = max(1, len(positive) // room)
            picked = np.asarray(positive[::step], dtype=np.float64)
            self.sample = np.concatenate([self.sample, picked[:room]])
        if block.times is not None:
            self.elapsed = Elapsed() if self.elapsed is None else self.elapsed
            self.elapsed.add(block.times, block.lines)
            self.tick = block.tick
        self.length += len(values)


def _measured(values: NDArray[Any]) -> NDArray[Any]:
    """Return frames ``[t, D]`` without corrupt ones, where some read far more than most do: they
    say nothing of the range."""
    if len(values) < _FEW or not values.shape[1]:
        return values
    highest = np.nan_to_num(np.fmax.reduce(values, axis=1), posinf=0.0)
    if not highest.max() > _FAR * known_quantile(highest, 1 - 2 * LOW, axis=0):
        return values
    odd = find_odd_frames([values], SensorLayout(1, 1, values.shape[1]))
    return np.delete(values, [one.frame for one in odd if one.kind == "corrupt"], axis=0)


@dataclass(frozen=True, eq=False)
class Content:
    """The recordings of one file, and what it states about the array.

    Attributes:
        file: where it was found.
        facts: of the file.
        recordings: at least one.
        surveys: of each.
        labels: the class of each recording; None without.
        targets: the values of its one recording; None without.
        kept: which recordings can be used.
    """

    file: Found
    facts: Facts
    recordings: tuple[Recording, ...]
    surveys: tuple[Survey, ...]
    labels: tuple[str, ...] | None = None
    targets: NDArray[np.float32] | None = None
    kept: tuple[int, ...] = ()

    @property
    def path(self) -> Path:
        """The file."""
        return self.facts.path

    @property
    def text(self) -> bool:
        """Whether it is a text file."""
        return self.facts.text

    @property
    def shape(self) -> Shape | None:
        """``(pads, rows, cols)``, where the file states it."""
        return self.facts.shape

    @property
    def width(self) -> int:
        """D, the number of readings in a frame of most recordings that hold frames."""
        widths = Counter(survey.width for survey in self.surveys if survey.length)
        return widths.most_common(1)[0][0]

    @property
    def head(self) -> NDArray[np.float64]:
        """The first frames of the first recording of this width, ``[t, D]``."""
        return next(survey.head for survey in self.surveys if survey.width == self.width)

    @property
    def tick(self) -> str | None:
        """Unit of its clock."""
        return next((survey.tick for survey in self.surveys if survey.elapsed is not None), None)

    @property
    def counts(self) -> bool:
        """Whether the readings are counts of a converter: by their type, or by their values, which
        are whole and in a file of decimals not all small."""
        if self.facts.counts:
            return True
        is_whole = all(survey.whole for survey in self.surveys)
        return is_whole and (self.text or self.largest >= _COUNTS)

    @property
    def largest(self) -> float:
        """The largest finite reading, 0 where there is none."""
        return max(survey.largest for survey in self.surveys)

    @property
    def elapsed(self) -> Elapsed | None:
        """Of the clocks of its recordings; None without one."""
        return Elapsed.of_all(survey.elapsed for survey in self.surveys)

    @property
    def rate(self) -> float | None:
        """Frames a second that the file states, else those of its clock."""
        if self.facts.rate is not None:
            return self.facts.rate
        elapsed = self.elapsed
        return None if elapsed is None else elapsed.rate(self.tick)

    def name(self, recording: int) -> str:
        """Return the name of a recording: as the file calls it, else that of the file."""
        name = self.recordings[recording].name
        if name is not None:
            return name
        several = f", recording {recording}" if len(self.recordings) > 1 else ""
        return f"{self.file.name}{several}"

    def where(self, recording: int, frame: int | None = None) -> str:
        """Return the place of a recording or a frame in this file as text.

        Args:
            recording: its index.
            frame: its index, or in a text its line; None: the whole recording.
        """
        if self.text:
            return "" if frame is None else f"line {frame}"
        held = self.recordings[recording]
        called = f"recording {recording}"
        if held.arrays and held.name is not None:  # as a data set calls it
            called = held.name.removeprefix(f"{self.path.name}, ")
        parts = [called] if len(self.recordings) > 1 else []
        return ", ".join(parts if frame is None else [*parts, f"frame {frame}"])

    def error(self, what: str, recording: int = 0, frame: int | None = None) -> InputError:
        """Return the error for something wrong at a place in this file."""
        return InputError.at(self.path, what, self.where(recording, frame))


class Surveyor:
    """Surveys one file after the other, and keeps their frames while there is room.

    Args:
        limit: readings above it are counted.
        room: bytes of frames that are kept in memory.
        step: receives the number of frames of each block.

    Attributes:
        scans: of the read-out, in all files.
    """

    def __init__(self, limit: float, room: int, step: Callable[[int], None]) -> None:
        self.limit = limit
        self.room = room
        self.step = step
        self.scans = Scans()

    def __call__(
        self, file: Found, recordings: Sequence[Recording], problems: list[Problem]
    ) -> Content | None:
        """Return the content of a file; None: a scan alone. Warnings are added to ``problems``.

        Args:
            file: where it was found.
            recordings: in it.
            problems: of all files.

        Raises:
            InputError: all recordings are damaged. Single damaged ones are left out, with an
                error.
        """
        surveyed = []
        kept = []
        scanned = len(self.scans.frames)
        failed: list[InputError] = []
        for recording in recordings:
            try:
                with foreseeing(recording.facts.path):
                    survey, recording = self._survey(recording, problems)
            except InputError as error:  # the other recordings are read
                failed.append(error)
                continue
            surveyed.append(survey)
            kept.append(recording)
        if not kept:
            raise failed[0] if failed else InputError("holds no recordings")
        if not any(survey.length for survey in surveyed):
            if len(self.scans.frames) > scanned:
                return None
            raise InputError.at(kept[0].facts.path, NO_FRAMES)
        problems += [Problem("error", str(error)) for error in failed]
        facts = kept[0].facts
        problems += facts.problems
        held = [recording.label for recording in kept]
        labels = tuple(label for label in held if label is not None)
        every = labels if len(labels) == len(held) else None
        return Content(file, facts, tuple(kept), tuple(surveyed), every)

    def _survey(self, recording: Recording, problems: list[Problem]) -> tuple[Survey, Recording]:
        """Return what a recording holds, and the recording, with its frames where there is room."""
        survey = Survey(self.limit)
        blocks: list[Block] | None = []
        size = 0
        for given in recording.blocks():
            problems += (*given.problems, *doubt_of(given, recording.facts.path))
            self.scans.frames += scan_of(given)
            block = without_scan(given)
            survey.add(block)
            size += block.values.nbytes
            self.step(len(block.values))
            if size > self.room:
                blocks = None
            if blocks is not None:
                blocks.append(replace(block, problems=()))
        if blocks is not None:
            self.room -= size
            return survey, replace(recording, blocks=partial(iter, blocks))
        return survey, readings_of(recording)
