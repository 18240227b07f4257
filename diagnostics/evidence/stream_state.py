"""What is remembered of a log: fed frame by frame, of constant size, and the same however the frames come in.

Frames are looked at in segments of 32. Of each cell the still stretch that it is in is kept, of the log its last
touches. Older touches are weighed, and only their evidence stays.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from copy import copy
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.constant_runs import ConstantRuns
from diagnostics.events.contact_events import SEGMENT, EventLog
from diagnostics.evidence.conditional_test import SUDDEN_JUMP, CellState, Model
from diagnostics.evidence.duplicate_lines import DuplicateLines, informative
from diagnostics.evidence.intermittency import Intermittency
from diagnostics.evidence.spatial import Exclusion, Spatial, group_excluded_evidence, spatial_evidence
from diagnostics.healthy.nearest_neighbours import NearestNeighbours
from diagnostics.healthy.reference import Reference
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.offset import OffsetTracker
from diagnostics.preprocessing.readings import held
from diagnostics.preprocessing.scale import Array, Scale
from diagnostics.preprocessing.transport import TransportState

Result = TypeVar("Result")

MAX_EVENTS, KEPT_EVENTS = 40, 32  # when there are more, all but the last so many are weighed and let go
_SILENT, _NEVER_HEARD = 2 * SEGMENT, SEGMENT // 2  # frames on end without a reading: that is no chance any more
_PAUSE = SEGMENT // 2  # frames of a segment after which that begins, a little with each frame: it ends with the segment


class StreamState:
    """The state of a diagnosis after some frames.

    Attributes:
        layout, reference: as given.
        caution: what evidence is worth.
        stream: what is known of the transport.
        runs: the still stretch of each cell.
        touches: the last ones.
        settled: float ``[D]``, evidence from touches that are gone, of the stretches that still go on.
        unrest: blinks and noise.
        twins: lines that read alike.
        touched: bool ``[D]``, cells that read more than untouched ones do.
        scale: what a reading means, as offsets are now.
    """

    def __init__(self, layout: SensorLayout, reference: Reference, exclusion: Exclusion) -> None:
        self.layout, self.reference, self.exclusion = layout, reference, exclusion
        self.present = layout.present.ravel()
        self.transport = TransportState()
        self.runs = ConstantRuns.begin(layout.n_cells)
        self.events = EventLog()
        self.accumulated = np.zeros(layout.n_cells)
        self.intermittency = Intermittency.begin(layout)
        self.duplicates = DuplicateLines.begin(layout)
        self.touched = np.zeros(layout.n_cells, bool)
        self.scale: Scale = reference.scale
        self._offsets = OffsetTracker.begin(layout.n_cells)
        self._buffer = np.empty((SEGMENT, layout.n_cells))
        self._numbers = np.empty(SEGMENT, np.intp)
        self._filled = 0
        self._leaving: Iterator[None] = iter(())  # work at the touches that are let go

    def extend(self, frames: NDArray[np.float64]) -> bool:
        """Take in frames ``[t, D]``; return whether a segment was completed."""
        before = self.transport.seen
        self.transport, known_values = self.transport.receive(frames, self.present, self.reference.patience)
        completed = False
        taken = 0
        next(self._leaving, None)
        while taken < len(known_values):
            if self._filled == _PAUSE and self._crowded:
                self._leaving = self._let_go()
            n = min((_PAUSE if self._filled < _PAUSE else SEGMENT) - self._filled, len(known_values) - taken)
            chosen = known_values[taken : taken + n]
            self._buffer[self._filled : self._filled + n] = frames[chosen]
            self._numbers[self._filled : self._filled + n] = chosen + before
            self._filled += n
            taken += n
            if self._filled == SEGMENT:
                self._close()
                completed = True
        return completed

    @property
    def due(self) -> bool:
        """Whether the next frame brings more work than being kept."""
        return self._filled == SEGMENT - 1 or (self._filled >= _PAUSE and self._crowded)

    def miss(self, frames: int) -> None:
        """Count frames that never came, as the sender's clock tells."""
        if frames > 0:
            self.transport = self.transport.without(frames)

    def complete(self) -> StreamState:
        """Return a memory in which the frames that wait for their segment have been looked at; this one stays."""
        if not self._filled:
            return self
        self._gone()
        other = copy(self)
        other._close()  # reads the frames that wait, and changes none of them
        return other

    @property
    def received(self) -> NDArray[np.bool_]:
        """Which cells ever delivered a reading, bool ``[D]``."""
        return np.isfinite(self.runs.last)

    @property
    def silent(self) -> NDArray[np.bool_]:
        """Which cells deliver no reading, or none any more, bool ``[D]``."""
        return self.present & (self.runs.missed >= np.where(self.received, _SILENT, _NEVER_HEARD))

    def rests(self) -> NDArray[np.bool_]:
        """Where a cell reads now, or held still at, what an untouched one reads, bool ``[D]``."""
        return np.isfinite(self.runs.value) & (self.scale.root_load(self.runs.value) <= self.scale.root_near)

    def temporal(self) -> NDArray[np.float64]:
        """What each cell's still stretch says, and the jump into it, a log likelihood ratio ``[D]``."""
        reference = self.reference
        rests = self.rests()
        lower = reference.least.lower(self.runs, rests & self.present)
        low = reference.least.evidence(self.runs, rests, reference.tolerance, self.present, lower)
        noise = reference.noise_loss.evidence(self.runs, rests, self.present, lower < -reference.tolerance)
        untouched = np.where(np.abs(noise) > np.abs(low), noise, low)
        return reference.jumps_seen.evidence(self.runs, self.layout.full_scale) + untouched

    def model(self) -> Model:
        """What healthy cells would do; without a reference, as far as this log tells."""
        return self.reference.model or NearestNeighbours.of(self.events.kept, self.layout)

    def views(self, onset: int) -> Iterator[tuple[Array, NDArray[np.intp], NDArray[np.intp], Model]]:
        """Yield what happened from frame ``onset`` on: features ``[n, 4, k]``, the k cells, those judged, by a model.

        The cells that the model judges are given by their place among the k.
        """
        suffixes = [s.features() for event in self.events.kept for s in event.suffixes() if s.first >= onset]
        if suffixes:
            every = np.arange(self.layout.n_cells)
            yield np.stack(suffixes), every, every, self.model()

    def spatial(
        self, wrong: NDArray[np.bool_] | None = None, events: EventLog | None = None
    ) -> Generator[None, None, Spatial]:
        """What the other cells say of each cell that is still, over all touches or those given.

        Cells that are known to be ``wrong`` (bool ``[D]``) are not asked.
        """
        events = self.events if events is None else events
        return spatial_evidence(
            events.kept, self.cells(wrong), self.model(), self.scale, self.reference.tolerance,
            self.exclusion,
        )  # fmt: skip

    def group_excluded(
        self, spatial: Spatial, wrong: NDArray[np.bool_], groups: Sequence[NDArray[np.intp]]
    ) -> Generator[None, None, NDArray[np.float64]]:
        """What touches say of cells if nobody is asked who may have broken with them, ``[groups, D]``.

        Args:
            spatial: what was found with all asked that are not suspected.
            wrong: bool ``[D]``, known to be wrong.
            groups: cells each, that may have broken together.
        """
        if not self.events.kept:
            return np.tile(self.accumulated, (len(groups), 1))
        return (
            yield from group_excluded_evidence(
                self.events.kept, self.cells(wrong), self.model(), self.scale, self.reference.tolerance,
                ~self._suspected(spatial), groups,
            )
        )  # fmt: skip

    def _suspected(self, spatial: Spatial) -> NDArray[np.bool_]:
        return (spatial.scored & (spatial.evidence + self.temporal() >= self.exclusion.threshold)) | spatial.drifting

    def cells(self, wrong: NDArray[np.bool_] | None) -> CellState:
        """What is known of the cells before the others are asked, but those that are known to be ``wrong``."""
        wrong = self.intermittency.intermittent | self.intermittency.excess | (False if wrong is None else wrong)
        eligible = self.present & self.received & ~self.silent & ~wrong
        return CellState(self.runs, self.accumulated, self.temporal(), self._sudden(), eligible, np.zeros_like(wrong))

    def _sudden(self) -> NDArray[np.float64]:
        return self.reference.jumps_seen.size(self.runs, self.layout.full_scale)

    def _close(self) -> None:
        self._gone()
        frames, numbers = self._buffer[: self._filled], self._numbers[: self._filled]
        self._filled = 0
        self._offsets = self._offsets.extend(frames, self.reference.scale, self.present, self.reference.offset)
        self.scale = scale = self._offsets.on(self.reference.scale)
        start, known = self.runs.start, _known(frames, self.runs.last)
        self.runs = self.runs.extend(frames, numbers, self.reference.tolerance, scale.baseline)
        # Evidence belongs to a stretch, and ends with it.
        self.accumulated = np.where(self.runs.start == start, self.accumulated, 0.0)
        root, still = scale.root_load(self._offsets.off(known)), self.runs.start <= numbers[0]
        self.touched = self.touched | root.any(axis=0)
        self._remember(root, numbers, (self._sudden() >= SUDDEN_JUMP) & (self.runs.alone | still))
        self.intermittency = self.intermittency.extend(known, root, numbers, scale, self.reference.usual, still)
        self.duplicates = self.duplicates.extend(
            self._comparable(frames), numbers, informative(frames, still, scale), scale.near
        )

    @property
    def _crowded(self) -> bool:
        return len(self.events.kept) > MAX_EVENTS

    def _remember(self, root: Array, numbers: NDArray[np.intp], jumped: NDArray[np.bool_]) -> None:
        self.events = self.events.extend(root, numbers, self.scale.root_near, self.runs.start, jumped)

    def _comparable(self, frames: NDArray[np.float64]) -> NDArray[np.float64]:
        return frames

    def _gone(self) -> None:
        """Weigh the touches that are let go to the end."""
        for _ in self._leaving:
            pass

    def _let_go(self) -> Generator[None, None, None]:
        old, kept = self.events.split(KEPT_EVENTS)
        accumulated = (yield from self.spatial(events=old)).surprisal
        self.events, self.accumulated = kept, accumulated


def _known(frames: NDArray[np.float64], last: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``frames`` with the last reading of a cell, before them ``last``, for each that is missing.

    Not of a cell that delivers none in all of them: what was long ago is no load now.
    """
    missing = np.isnan(frames)
    return np.where(missing.all(axis=0), np.nan, held(frames, last)[1:]) if missing.any() else frames


def run_to_end(work: Generator[None, None, Result]) -> Result:
    """Run work that pauses to its end, and return what it returns."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            result: Result = end.value
            return result
