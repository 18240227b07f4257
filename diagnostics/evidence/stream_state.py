"""The state of a log: fed frame by frame, of constant size, and independent of how the frames are
split into blocks.

Frames are processed in segments of 32. With a model of the array the state builds the record that
it judges; without one :mod:`diagnostics.evidence.cold_start` keeps more.
"""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.constant_runs import ConstantRuns
from diagnostics.events.tiles import MOST_CELLS
from diagnostics.evidence.duplicate_lines import DuplicateLines, informative
from diagnostics.evidence.intermittency import Intermittency
from diagnostics.preprocessing.levels import MAJORITY
from diagnostics.preprocessing.noise import NoiseNow
from diagnostics.preprocessing.offset import OffsetTracker
from diagnostics.preprocessing.readings import SEGMENT, held
from diagnostics.preprocessing.transport import TransportState, invalid

if TYPE_CHECKING:
    from diagnostics.evidence.reference import Reference
    from diagnostics.layout import SensorLayout
    from diagnostics.model.record import Record, Recorder
    from diagnostics.preprocessing.load import LoadDirection
    from diagnostics.preprocessing.scale import Array, Scale
    from diagnostics.sensor.crosstalk import Crosstalk

# consecutive frames without a reading: not chance any more
_SILENT = 2 * SEGMENT
_NEVER_RECEIVED = SEGMENT // 2
_WHOLE = 1e-6  # by which a whole number may be missed after a conversion to loads and back

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Cells = NDArray[np.intp]


class StreamState:
    """The state of a log after some frames.

    Args:
        layout: the array.
        reference: the healthy reference.
        recorder: builds the record that the model judges; None: there is no model.
        load: how readings become loads; None: they are.
        order: int ``[D]``, which reading of a frame each cell is; None: they are in order.

    Attributes:
        transport: lost and repeated frames.
        runs, before: the constant run of each cell, and of a segment ago.
        intermittency: blinks and excess noise.
        duplicates: pairs of lines that read the same.
        touched: bool ``[D]``, cells that were loaded at least once.
        scale: baseline with the present offsets, and full scale.
        below: bool ``[D]``, cells that last read less than at rest.
        crosstalk: of lines, that the reference does not have; None: not known.
    """

    def __init__(
        self,
        layout: SensorLayout,
        reference: Reference,
        recorder: Recorder | None,
        load: LoadDirection | None = None,
        order: Cells | None = None,
    ) -> None:
        self.layout = layout
        self.reference = reference
        self.present = layout.is_cell
        self.order = order
        self.load = load
        self.below = np.zeros(layout.n_cells, bool)
        self.transport = TransportState()
        self._patience = reference.repeats(layout)
        self.runs = ConstantRuns.begin(layout.n_cells)
        self.before = self.runs
        self.intermittency = Intermittency.begin(layout)
        self.duplicates = DuplicateLines.begin(layout, reference.duplicates.shares)
        self.touched = np.zeros(layout.n_cells, bool)
        self.scale: Scale = reference.scale
        self._offsets = OffsetTracker.begin(layout.n_cells)
        self._noise = NoiseNow()
        self._highest = np.full(layout.n_cells, np.nan)
        self.crosstalk: Crosstalk | None = None
        self._recorder = recorder
        self._buffer = np.empty((SEGMENT, layout.n_cells))
        self._numbers = np.empty(SEGMENT, np.intp)
        self._begins = np.zeros(SEGMENT, bool)  # frames that begin a recording
        self._begins_next = False
        self._filled = 0

    def begin_recording(self) -> None:
        """Take the next frame as the first one of a recording: it does not follow the last one."""
        self._begins_next = True

    def extend(self, frames: Floats) -> bool:
        """Take in frames ``[t, D]`` of readings; return whether a segment was completed."""
        if self.order is not None:
            frames = frames[:, self.order]
        if self.load is not None:
            side = np.where(np.isnan(frames), self.below, frames < self.load.rest)
            self.below = side[-1].astype(bool) if len(side) else self.below
            frames = self.load.loads(frames)
        if not self.present.all():  # such a position may read anything
            frames = np.where(self.present, frames, self.reference.scale.baseline)
        wrong = invalid(frames, self.layout.full_scale)
        if wrong is not None:
            frames = np.where(wrong, np.nan, frames)
            self.transport = self.transport.dropped(wrong)
        before = self.transport.seen
        self.transport, new = self.transport.receive(frames, self.present, self._patience)
        if self._begins_next:
            # it tells something though it repeats the last one of another recording
            arrived = np.flatnonzero(~np.isnan(frames[:, self.present]).all(axis=1))
            new = np.union1d(arrived[:1], new)
        completed = False
        taken = 0
        while taken < len(new):
            n = min(SEGMENT - self._filled, len(new) - taken)
            chosen = new[taken : taken + n]
            self._buffer[self._filled : self._filled + n] = frames[chosen]
            self._numbers[self._filled : self._filled + n] = chosen + before
            self._begins[self._filled : self._filled + n] = False
            self._begins[self._filled] = self._begins_next
            self._begins_next = False
            self._filled += n
            taken += n
            if self._filled == SEGMENT:
                self._close()
                completed = True
        return completed

    def miss(self, frames: int) -> None:
        """Count frames that were never received, according to the sender's clock."""
        if frames > 0:
            self.transport = self.transport.without(frames)

    def complete(self) -> StreamState:
        """Return a state in which the frames of the unfinished segment are processed; this state
        stays as it is."""
        if not self._filled:
            return self
        other = copy(self)
        other._close()
        return other

    def __copy__(self) -> StreamState:
        """Return a state that takes in frames of its own."""
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        other._buffer = self._buffer.copy()
        other._numbers = self._numbers.copy()
        other._begins = self._begins.copy()
        return other

    def reading(self, load: Floats) -> Floats:
        """Return the readings of loads ``[D]``, where they are not the same."""
        return load if self.load is None else self.load.readings(load, self.below)

    def typical_reading(self) -> Floats:
        """Return the reading of each cell's constant run, ``[D]``: in whole counts where it has
        such readings.

        A value that fills more than half of the run is its median. Otherwise the median is between
        the ends of the run: then it is the whole number beside their middle that is closer to the
        last reading.
        """
        runs = self.runs
        middle = self.reading(runs.value)
        ends = np.stack([self.reading(one) for one in (runs.low, runs.high, runs.last)])
        ends = np.where(np.isfinite(ends), ends, 0.5)  # no reading: not whole
        whole = (np.abs(ends - np.rint(ends)) < _WHOLE).all(axis=0)
        last = np.rint(ends[2])
        beside = np.where(last > middle, np.ceil(middle - _WHOLE), np.floor(middle + _WHOLE))
        counts = np.where(2 * runs.same > runs.length, last, beside)
        return np.where(whole, counts, middle)

    def blinks_to(self, full_scale: float) -> Floats:
        """Return the reading to which each cell blinks, ``[D]``: full scale where most blinks go
        there."""
        frames = self.intermittency
        load = np.where(2 * frames.high > frames.blinks, full_scale, np.maximum(self.lowest, 0.0))
        return self.reading(load)

    @property
    def received(self) -> Mask:
        """Cells that delivered a reading at least once, bool ``[D]``."""
        return self.present & np.isfinite(self.runs.last)

    @property
    def silent(self) -> Mask:
        """Cells that deliver no reading, or no longer do, bool ``[D]``."""
        return self.present & (
            self.runs.missed >= np.where(self.received, _SILENT, _NEVER_RECEIVED)
        )

    def rests(self) -> Mask:
        """Cells whose constant run lies at their baseline, bool ``[D]``."""
        return np.isfinite(self.runs.value) & (
            self.scale.root_load(self.runs.value) <= self.scale.root_near
        )

    def unused(self, alive: Mask) -> Mask:
        """Return the cells at rest of pads that nothing shows to be in use, bool ``[D]``.

        Such a pad has no loaded cell that is ``alive``, and most of its cells were never loaded,
        nor hold full scale or a reading below their rest, while another pad is in use. Nothing
        touched it, or it is cut off where it rests: the readings are the same.
        """
        below = self.runs.value < self.scale.baseline - self.scale.near
        below &= ~self.runs.moved
        full = ~self.runs.moved & (self.runs.value >= self.scale.full_scale - self.scale.near)
        still = self.present & ~below & ~full & ~self.touched & np.isfinite(self.lowest)
        of_pad = self.layout.pad_of
        pads = self.layout.pads
        share = np.bincount(of_pad[still], minlength=pads)
        cells = np.bincount(of_pad[self.present], minlength=pads)
        used = np.bincount(of_pad[alive & self.touched], minlength=pads) > 0
        idle = ~used & (share > MAJORITY * cells)
        return np.asarray(still & idle[of_pad] & bool(used.any()))

    @property
    def ranges(self) -> Floats:
        """Highest minus lowest reading of each cell, ``[D]``; 0: none."""
        found: Floats = np.nan_to_num(self._highest - self.lowest)
        return found

    @property
    def lowest(self) -> Floats:
        """The lowest reading of each cell so far, ``[D]``; inf: none."""
        return self.reference.scale.baseline + self._offsets.lowest

    def record(self) -> Record:
        """Return the record of the log so far, which the model judges.

        Raises:
            ValueError: there is no model, or no frame was received.
        """
        if self._recorder is None:
            raise ValueError("the diagnosis has no model")
        return self._recorder.record(self.transport.seen)

    @property
    def pieces(self) -> int:
        """Number of the pieces of the record; 0: there is none."""
        return 0 if self._recorder is None else len(self._recorder)

    def _close(self) -> None:
        """Process a segment."""
        frames = self._buffer[: self._filled]
        numbers = self._numbers[: self._filled]
        begins = self._begins[: self._filled]
        self._filled = 0
        reference = self.reference
        if self._recorder is not None:
            self._recorder = self._recorder.extend(frames, numbers, begins=begins)
        self._highest = np.fmax(self._highest, np.fmax.reduce(frames))
        self._offsets = self._offsets.extend(
            frames, reference.scale, self.present, reference.offset
        )
        self._noise = self._noise.extend(frames, self.present)
        plain = self._offsets.on(reference.scale)
        noise = 0.0 if reference.noise is None else reference.noise.raises(self._noise)
        noisy = plain.above(noise)
        self.scale = self._scale_after(frames, plain, noisy)
        known = _known(frames, self.runs.last)
        moved = self.runs.moved & self.received
        self.before = self.runs
        self.runs = self.runs.extend(frames, numbers, reference.tolerance)
        still = self.runs.start <= numbers[0]
        steady = self._offsets.off(known)
        root = self.scale.root_load(steady)
        self.touched = self.touched | self._touched_in(steady, root, numbers, moved)
        usual = reference.usual.with_noise(noise / plain.full_scale)
        self.intermittency = self.intermittency.extend(
            known, root, numbers, noisy, usual, still, begins=begins
        )
        if self.present.sum() > MOST_CELLS:
            # On long lines some cell is always dead: cells that never moved are no difference
            # between two lines.
            frames = np.where(self.runs.moved, frames, np.nan)
        # Lines that only have noise where they rest agree by chance.
        telling = informative(frames, still, self._clear(plain, noisy)) & self.touched
        self.duplicates = self.duplicates.extend(frames, numbers, telling, plain.near)

    def _scale_after(self, frames: Floats, plain: Scale, noisy: Scale) -> Scale:
        """Return the scale of the log after the frames ``[t, D]`` of a segment.

        Args:
            frames: NaN = missing.
            plain: the scale without knowledge of the log; noisy: with its noise.
        """
        return noisy

    def _touched_in(self, steady: Floats, root: Array, numbers: Cells, moved: Mask) -> Mask:
        """Return the cells that are loaded in a segment, bool ``[D]``.

        Args:
            steady, root: readings and root loads ``[t, D]``, without changes of the offset.
            numbers: int ``[t]``, of the frames.
            moved: bool ``[D]``, cells that moved before.
        """
        return np.asarray(root.any(axis=0))

    def _clear(self, plain: Scale, noisy: Scale) -> Scale:
        """Return the scale of loads that tell whether two lines read the same."""
        return noisy


def _known(frames: Floats, last: Floats) -> Floats:
    """Return ``frames`` with each missing reading replaced by the one before it; ``last`` holds
    those before all.

    A cell without any reading in these frames stays missing: an old reading is no load now.
    """
    missing = np.isnan(frames)
    return (
        np.where(missing.all(axis=0), np.nan, held(frames, last)[1:]) if missing.any() else frames
    )
