"""Recordings of any size, whose frames are read when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.check import (
    OutOfRange,
    clamped_readings,
    out_of_range,
    without_infinite,
)
from adaptfault.data.recordings.errors import Problem
from adaptfault.data.recordings.facts.classes import class_indices
from adaptfault.data.recordings.facts.rates import Clock, Elapsed
from adaptfault.data.recordings.facts.targets import TargetTable
from adaptfault.data.recordings.recording import BLOCK, Recording
from adaptfault.data.recordings.survey import Content
from diagnostics import SensorLayout

if TYPE_CHECKING:
    from adaptfault.data.calibration import Calibration
    from diagnostics import Scan

PART = 5_000_000
"""Readings of a log that are in memory at once."""


class Opened:
    """Recordings whose frames are read when they are asked for; may be iterated more than once.

    Iterating yields float32 ``[T, D]`` in the layout's unit, one recording after the other; NaN =
    missing.

    Attributes:
        layout: the array.
        lengths: frames of each recording.
        labels, class_names, names, targets, value_names: as in
            :class:`~adaptfault.data.recordings.dataset.Recordings`.
        inferred: as in :class:`Loaded`.
        problems: errors and warnings.
        n_found: number of all recordings, of which these were selected.
        late_problems: warnings about the range of readings, after a whole iteration.
        scan: of the read-out, of all files; None: there is none.
    """

    def __init__(
        self,
        contents: Sequence[Content],
        layout: SensorLayout,
        inferred: tuple[str, ...],
        tables: Calibration | None,
        problems: list[Problem],
        values: TargetTable | None,
        n_found: int | None = None,
        scan: Scan | None = None,
    ) -> None:
        self.scan = scan
        self._tables = tables
        self.layout = layout
        self.inferred = inferred
        self._each = [(content, i) for content in contents for i in content.kept]
        self.names = tuple(content.name(i) for content, i in self._each)
        self._surveys = [content.surveys[i] for content, i in self._each]
        self.lengths = tuple(survey.length for survey in self._surveys)
        labels = [content.labels[i] if content.labels else None for content, i in self._each]
        orders = [content.facts.class_names for content in contents]
        self.labels, self.class_names = class_indices(labels, orders, problems)
        self.value_names: tuple[str, ...] = ()
        self.targets: tuple[NDArray[np.float32], ...] | None = None
        if values is not None:
            self.value_names = values.names
            self.targets = tuple(one.targets for one, _ in self._each if one.targets is not None)
        self.problems = tuple(problems)
        self.late_problems: tuple[Problem, ...] = ()
        self.n_found = len(self) if n_found is None else n_found

    @property
    def origins(self) -> tuple[Recording, ...]:
        """The recordings as their readers give them: which arrays of a data set hold them."""
        return tuple(content.recordings[i] for content, i in self._each)

    @property
    def clock(self) -> Clock:
        """How regular the times of the frames are."""
        elapsed = Elapsed.of_all(survey.elapsed for survey in self._surveys)
        return Clock() if elapsed is None else elapsed.clock()

    @property
    def seconds(self) -> float:
        """How long the recordings took: by their times where there are some, else by their
        rate."""
        timed = Elapsed.of_all(survey.elapsed for survey in self._surveys)
        usual = None if timed is None else timed.unit()
        total = 0.0
        for survey in self._surveys:
            unit = survey.tick or usual
            if survey.elapsed is None or unit is None:
                total += survey.length / self.layout.rate
            else:
                total += survey.elapsed.seconds(unit)
        return total

    def __len__(self) -> int:
        return len(self.lengths)

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        for pieces in self._recordings():
            yield np.concatenate(list(pieces))

    def pieces(self, frames: int = BLOCK) -> Iterator[NDArray[np.float32]]:
        """Yield all recordings in pieces ``[t, D]`` of about so many frames, in constant memory.

        A piece holds frames of one recording.
        """
        for blocks in self._recordings():
            held: list[NDArray[np.float32]] = []
            for block in blocks:
                held.append(block)
                if sum(map(len, held)) >= frames:
                    yield np.concatenate(held)
                    held = []
            if held:
                yield np.concatenate(held)

    def parts(self, readings: int = PART) -> Iterator[list[NDArray[np.float32]]]:
        """Yield all recordings in lists of at most about so many readings; long recordings are cut.

        A log that is not larger is one list of whole recordings.
        """
        frames = max(1, readings // self.layout.n_cells)
        if sum(self.lengths) <= frames:
            yield list(self)
            return
        part: list[NDArray[np.float32]] = []
        for piece in self.pieces(frames):
            if part and sum(map(len, part)) + len(piece) > frames:
                yield part
                part = []
            part.append(piece)
        yield part

    def _recordings(self) -> Iterator[Iterator[NDArray[np.float32]]]:
        """Yield the blocks of each recording, calibrated."""
        clamped = np.zeros((2, self.layout.n_cells), dtype=np.int64)
        outside: list[Problem] = []
        files = 0
        for content, each in groupby(self._each, key=itemgetter(0)):
            files += 1
            range_ = OutOfRange(content, self.layout)
            for _, i in each:
                yield self._blocks(content, i, clamped, range_)
            problem = range_.problem()
            if problem is not None:
                outside.append(problem)
        late = out_of_range(outside, files, self.layout)
        if clamped.any():
            late.append(clamped_readings(clamped))
        self.late_problems = tuple(late)

    def _blocks(
        self, content: Content, i: int, clamped: NDArray[np.int64], range_: OutOfRange
    ) -> Iterator[NDArray[np.float32]]:
        for block in content.recordings[i].blocks():
            if not len(block.values):
                continue
            readings = without_infinite(block.values)
            if self._tables is not None:
                readings, out = self._tables.apply(readings)
                clamped += np.stack([out.below, out.above])
            with np.errstate(all="ignore"):
                readings = readings.astype(np.float32, copy=False)
            range_.add(i, readings, block.lines)
            yield readings
