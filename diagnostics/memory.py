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

from diagnostics.layout import SensorLayout
from diagnostics.question import SUDDEN, Cells, Model
from diagnostics.readings import held
from diagnostics.reference import Reference
from diagnostics.scale import Array, Scale
from diagnostics.spatial import Caution, Spatial, apart_evidence, stuck_evidence
from diagnostics.surroundings import Surroundings
from diagnostics.tare import Tare
from diagnostics.temporal import StillRuns
from diagnostics.touches import SEGMENT, Touches
from diagnostics.transport import Stream
from diagnostics.twins import Twins, telling
from diagnostics.unrest import Unrest

Result = TypeVar("Result")

MOST_TOUCHES, KEPT_TOUCHES = 40, 32  # when there are more, all but the last so many are weighed and let go
_SILENT, _NEVER_HEARD = 2 * SEGMENT, SEGMENT // 2  # frames on end without a reading: that is no chance any more
_PAUSE = SEGMENT // 2  # frames of a segment after which that begins, a little with each frame: it ends with the segment


class Memory:
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

    def __init__(self, layout: SensorLayout, reference: Reference, caution: Caution) -> None:
        self.layout, self.reference, self.caution = layout, reference, caution
        self.present = layout.present.ravel()
        self.stream = Stream()
        self.runs = StillRuns.begin(layout.n_cells)
        self.touches = Touches()
        self.settled = np.zeros(layout.n_cells)
        self.unrest = Unrest.begin(layout)
        self.twins = Twins.begin(layout)
        self.touched = np.zeros(layout.n_cells, bool)
        self.scale: Scale = reference.scale
        self._tare = Tare.begin(layout.n_cells)
        self._buffer = np.empty((SEGMENT, layout.n_cells))
        self._numbers = np.empty(SEGMENT, np.intp)
        self._filled = 0
        self._leaving: Iterator[None] = iter(())  # work at the touches that are let go

    def extend(self, frames: NDArray[np.float64]) -> bool:
        """Take in frames ``[t, D]``; return whether a segment was completed."""
        before = self.stream.seen
        self.stream, told = self.stream.receive(frames, self.present, self.reference.patience)
        completed = False
        taken = 0
        next(self._leaving, None)
        while taken < len(told):
            if self._filled == _PAUSE and self._crowded:
                self._leaving = self._let_go()
            n = min((_PAUSE if self._filled < _PAUSE else SEGMENT) - self._filled, len(told) - taken)
            chosen = told[taken : taken + n]
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
            self.stream = self.stream.without(frames)

    def complete(self) -> Memory:
        """Return a memory in which the frames that wait for their segment have been looked at; this one stays."""
        if not self._filled:
            return self
        self._gone()
        other = copy(self)
        other._close()  # reads the frames that wait, and changes none of them
        return other

    @property
    def heard(self) -> NDArray[np.bool_]:
        """Which cells ever delivered a reading, bool ``[D]``."""
        return np.isfinite(self.runs.last)

    @property
    def silent(self) -> NDArray[np.bool_]:
        """Which cells deliver no reading, or none any more, bool ``[D]``."""
        return self.present & (self.runs.missed >= np.where(self.heard, _SILENT, _NEVER_HEARD))

    def rests(self) -> NDArray[np.bool_]:
        """Where a cell reads now, or held still at, what an untouched one reads, bool ``[D]``."""
        return np.isfinite(self.runs.value) & (self.scale.root_load(self.runs.value) <= self.scale.root_near)

    def temporal(self) -> NDArray[np.float64]:
        """What each cell's still stretch says, and the jump into it, a log likelihood ratio ``[D]``."""
        reference = self.reference
        rests = self.rests()
        lower = reference.least.lower(self.runs, rests & self.present)
        low = reference.least.evidence(self.runs, rests, reference.tolerance, self.present, lower)
        noise = reference.flicker.evidence(self.runs, rests, self.present, lower < -reference.tolerance)
        untouched = np.where(np.abs(noise) > np.abs(low), noise, low)
        return reference.onsets.evidence(self.runs, self.layout.full_scale) + untouched

    def model(self) -> Model:
        """What healthy cells would do; without a reference, as far as this log tells."""
        return self.reference.model or Surroundings.of(self.touches.kept, self.layout)

    def views(self, onset: int) -> Iterator[tuple[Array, NDArray[np.intp], NDArray[np.intp], Model]]:
        """Yield what happened from frame ``onset`` on: features ``[n, 4, k]``, the k cells, those judged, by a model.

        The cells that the model judges are given by their place among the k.
        """
        suffixes = [s.features() for touch in self.touches.kept for s in touch.suffixes() if s.first >= onset]
        if suffixes:
            every = np.arange(self.layout.n_cells)
            yield np.stack(suffixes), every, every, self.model()

    def spatial(
        self, wrong: NDArray[np.bool_] | None = None, touches: Touches | None = None
    ) -> Generator[None, None, Spatial]:
        """What the other cells say of each cell that is still, over all touches or those given.

        Cells that are known to be ``wrong`` (bool ``[D]``) are not asked.
        """
        touches = self.touches if touches is None else touches
        return stuck_evidence(
            touches.kept, self.cells(wrong), self.model(), self.scale, self.reference.tolerance,
            self.caution,
        )  # fmt: skip

    def apart(
        self, spatial: Spatial, wrong: NDArray[np.bool_], groups: Sequence[NDArray[np.intp]]
    ) -> Generator[None, None, NDArray[np.float64]]:
        """What touches say of cells if nobody is asked who may have broken with them, ``[groups, D]``.

        Args:
            spatial: what was found with all asked that are not suspected.
            wrong: bool ``[D]``, known to be wrong.
            groups: cells each, that may have broken together.
        """
        if not self.touches.kept:
            return np.tile(self.settled, (len(groups), 1))
        return (
            yield from apart_evidence(
                self.touches.kept, self.cells(wrong), self.model(), self.scale, self.reference.tolerance,
                ~self._suspected(spatial), groups,
            )
        )  # fmt: skip

    def _suspected(self, spatial: Spatial) -> NDArray[np.bool_]:
        return (spatial.asked & (spatial.evidence + self.temporal() >= self.caution.suspicious)) | spatial.drifting

    def cells(self, wrong: NDArray[np.bool_] | None) -> Cells:
        """What is known of the cells before the others are asked, but those that are known to be ``wrong``."""
        wrong = self.unrest.intermittent | self.unrest.excess | (False if wrong is None else wrong)
        askable = self.present & self.heard & ~self.silent & ~wrong
        return Cells(self.runs, self.settled, self.temporal(), self._sudden(), askable, np.zeros_like(wrong))

    def _sudden(self) -> NDArray[np.float64]:
        return self.reference.onsets.size(self.runs, self.layout.full_scale)

    def _close(self) -> None:
        self._gone()
        frames, numbers = self._buffer[: self._filled], self._numbers[: self._filled]
        self._filled = 0
        self._tare = self._tare.extend(frames, self.reference.scale, self.present, self.reference.offset)
        self.scale = scale = self._tare.on(self.reference.scale)
        start, known = self.runs.start, _known(frames, self.runs.last)
        self.runs = self.runs.extend(frames, numbers, self.reference.tolerance, scale.resting)
        # Evidence belongs to a stretch, and ends with it.
        self.settled = np.where(self.runs.start == start, self.settled, 0.0)
        root, still = scale.root_load(self._tare.off(known)), self.runs.start <= numbers[0]
        self.touched = self.touched | root.any(axis=0)
        self._remember(root, numbers, (self._sudden() >= SUDDEN) & (self.runs.alone | still))
        self.unrest = self.unrest.extend(known, root, numbers, scale, self.reference.usual, still)
        self.twins = self.twins.extend(self._comparable(frames), numbers, telling(frames, still, scale), scale.near)

    @property
    def _crowded(self) -> bool:
        return len(self.touches.kept) > MOST_TOUCHES

    def _remember(self, root: Array, numbers: NDArray[np.intp], jumped: NDArray[np.bool_]) -> None:
        self.touches = self.touches.extend(root, numbers, self.scale.root_near, self.runs.start, jumped)

    def _comparable(self, frames: NDArray[np.float64]) -> NDArray[np.float64]:
        return frames

    def _gone(self) -> None:
        """Weigh the touches that are let go to the end."""
        for _ in self._leaving:
            pass

    def _let_go(self) -> Generator[None, None, None]:
        old, kept = self.touches.split(KEPT_TOUCHES)
        settled = (yield from self.spatial(touches=old)).surprise
        self.touches, self.settled = kept, settled


def _known(frames: NDArray[np.float64], last: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``frames`` with the last reading of a cell, before them ``last``, for each that is missing.

    Not of a cell that delivers none in all of them: what was long ago is no load now.
    """
    missing = np.isnan(frames)
    return np.where(missing.all(axis=0), np.nan, held(frames, last)[1:]) if missing.any() else frames


def finished(work: Generator[None, None, Result]) -> Result:
    """Run work that pauses to its end, and return what it returns."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            result: Result = end.value
            return result
