"""The record of a log: lowest, highest and mean reading of each cell in short pieces.

This is the only code that a frame passes. A piece never crosses the edge of a recording, and a
unit, in which a healthy cell may be odd, is a few successive pieces of one recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from diagnostics.model.as_one import AsOne

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]
Cells = NDArray[np.intp]

LONGEST = 8  # frames of a piece
UNIT = 8  # pieces of a unit
_PIECES = 6  # of a short recording
_FEWEST = 3
_KEPT = 0.75  # of the pieces that there may be, once there are more
_CUT = 5.0  # times the tolerance: a load that vanishes, or appears
_CELLS = 0.05  # share of the cells that do, and as many that do the other; two at least
_SUDDEN = 3.0  # times what changed in the frames before


@dataclass(frozen=True)
class Record:
    """Pieces of a log, in order.

    Attributes:
        low, high, mean: readings of each piece, float32 ``[n, D]``; where nothing was received,
            those of the piece before.
        received: bool ``[n, D]``, whether anything was.
        recording: int ``[n]``, from 0.
        first: bool ``[n]``, whether a recording begins with a piece: stated, or by a cut.
        begins: int ``[n]``, number of the first frame of each.
        n_frames: of the log.
        as_one: ``[n, G]``, share of the frames in which each group reads as one.
    """

    low: Array
    high: Array
    mean: Array
    received: Mask
    recording: Cells
    first: Mask
    begins: Cells
    n_frames: int
    as_one: Array = field(default_factory=lambda: np.zeros((0, 0), np.float32))

    def __len__(self) -> int:
        return len(self.begins)

    @cached_property
    def of_unit(self) -> Cells:
        """Unit of each piece, int ``[n]``, from 0."""
        found: Cells = np.cumsum(since_begin(self.first) % UNIT == 0) - 1
        return found

    @cached_property
    def units(self) -> Cells:
        """First piece of each unit, int ``[units]``."""
        return np.flatnonzero(np.diff(self.of_unit, prepend=-1))

    def sum_of_units(self, values: Array) -> Array:
        """Return the sums over the pieces of each unit, ``[units, D]`` of ``[n, D]``."""
        found: Array = np.add.reduceat(values, self.units, axis=0)
        return found

    def ends(self) -> Cells:
        """Return the number of the frame behind each piece, int ``[n]``."""
        return np.append(self.begins[1:], self.n_frames)


def frames_of_piece(recordings: Sequence[NDArray[np.floating]]) -> int:
    """Return the frames of a piece: a recording has some pieces, however short it is."""
    typical = float(np.median([len(one) for one in recordings]))
    return int(np.clip(typical // _PIECES, 1, LONGEST))


@dataclass(frozen=True)
class _Pieces:
    """Successive pieces.

    Attributes:
        low, high: lowest and highest reading ``[n, D]``; NaN: none was received.
        total, count: sum and number of the readings that were received, ``[n, D]``.
        frames: int ``[n]``, frames of each piece.
        recording, first, begins: as of :class:`Record`.
    """

    low: Array
    high: Array
    total: NDArray[np.float64]
    count: NDArray[np.int32]
    frames: Cells
    recording: Cells
    first: Mask
    begins: Cells

    def __len__(self) -> int:
        return len(self.begins)

    def chosen(self, which: slice | Mask) -> _Pieces:
        """Return some of the pieces."""
        return _Pieces(*[values[which] for values in vars(self).values()])

    @staticmethod
    def joined(parts: Sequence[_Pieces]) -> _Pieces:
        """Return the pieces of all parts, in order."""
        every = [vars(part) for part in parts]
        return _Pieces(*[np.concatenate([part[name] for part in every]) for name in every[0]])

    def merged(self, into_last: Mask) -> _Pieces:
        """Return the pieces where some of them (bool ``[n]``) belong to the one before."""
        if not into_last.any():
            return self
        first = np.flatnonzero(~into_last)
        return _Pieces(
            np.fmin.reduceat(self.low, first, axis=0),
            np.fmax.reduceat(self.high, first, axis=0),
            np.add.reduceat(self.total, first, axis=0),
            np.add.reduceat(self.count, first, axis=0),
            np.add.reduceat(self.frames, first),
            self.recording[first],
            self.first[first],
            self.begins[first],
        )

    def unchanged(self, tolerance: float) -> Mask:
        """Return the pieces that no reading leaves that lie before and behind, bool ``[n]``."""
        same = np.zeros(len(self), bool)
        if len(self) < _FEWEST:
            return same
        high = np.fmax.reduce([self.high[:-2], self.high[1:-1], self.high[2:]])
        low = np.fmin.reduce([self.low[:-2], self.low[1:-1], self.low[2:]])
        same[1:-1] = ~(high - low > tolerance).any(axis=1)
        same[1:-1] &= self.recording[:-2] == self.recording[2:]
        return same

    def record(self, n_frames: int, groups: int) -> Record:
        """Return the record of a log of ``n_frames``; the last columns are of ``groups``."""
        if groups:
            share = (self.total / self.frames[:, None])[:, -groups:].astype(np.float32)
            found = self._of_cells(groups).record(n_frames, 0)
            return replace(found, as_one=share)
        received = self.count > 0
        mean = (self.total / np.maximum(self.count, 1)).astype(np.float32)
        low = self.low
        high = self.high
        if not received.all():
            last = _last_received(received, self.recording)
            low = np.take_along_axis(low, last, 0)
            high = np.take_along_axis(high, last, 0)
            mean = np.take_along_axis(mean, last, 0)
            mean[:, ~received.any(axis=0)] = np.nan
        return Record(low, high, mean, received, self.recording, self.first, self.begins, n_frames)

    def _of_cells(self, groups: int) -> _Pieces:
        """Return the pieces without the last columns."""
        cells = np.s_[:, :-groups]
        return replace(
            self,
            low=self.low[cells],
            high=self.high[cells],
            total=self.total[cells],
            count=self.count[cells],
        )


@dataclass(frozen=True)
class Recorder:
    """Builds the record of a log, frame by frame, in constant memory.

    A piece begins with each recording, and with every ``length``-th frame of it; an end of less
    than half a piece belongs to the piece before. A frame that repeats the one before tells
    nothing, and is left out: loggers are faster than sensors. With more than ``most`` pieces,
    those in which nothing changes are dropped, then the oldest.

    Recordings that were joined begin with a cut: in one frame loads vanish and others appear
    elsewhere, and much more changes than in the frames before, as noise and contacts do not. It is
    looked for once a recording is longer than those of the reference.

    Attributes:
        length: frames of a piece.
        tolerance: readings change by more.
        most: pieces that are kept, about.
        as_one: finds the frames in which groups read as one; None: there are no groups.
        complete: pieces that no frame changes any more.
        last: the last two, which may.
        recordings: number of those that began.
        given: ``[D]``, the last frame; None: there was none.
        changes: ``[length]``, how much changed in each of the last frames.
        longest: frames of a recording of the reference, at most.
        age: frames of the recording so far.
    """

    length: int
    tolerance: float = 0.0
    most: float = np.inf
    as_one: AsOne | None = None
    complete: tuple[_Pieces, ...] = ()
    last: _Pieces | None = None
    recordings: int = 0
    given: NDArray[np.floating] | None = None
    changes: Array = field(default_factory=lambda: np.zeros(0, np.float32))
    longest: float = np.inf
    age: int = 0

    def __len__(self) -> int:
        """Return the number of pieces."""
        return sum(map(len, self.complete)) + (0 if self.last is None else len(self.last))

    def extend(
        self, frames: NDArray[np.floating], numbers: Cells, *, begins: Mask | None = None
    ) -> Recorder:
        """Return the recorder after more frames.

        Args:
            frames: readings ``[t, D]``; NaN: missing.
            numbers: int ``[t]``, of the frames.
            begins: bool ``[t]``, frames with which a recording begins; None: the first one.
        """
        if not len(frames):
            return self
        if begins is None:
            begins = np.arange(len(frames)) == 0
        previous = self._before(frames)
        fresh = self._fresh(frames, previous) | begins
        cut, changes = self._cuts(frames, previous)
        age = since_begin(begins) + np.where(begins.cumsum() == 0, self.age, 0)
        cut &= (age >= self.longest) & ~begins
        after = replace(self, changes=changes, age=int(age[-1]) + 1)
        if not fresh.any():
            return after
        after = replace(after, given=frames[-1].copy())
        return after._joined(frames[fresh], numbers[fresh], begins[fresh], cut[fresh])

    def _joined(
        self, frames: NDArray[np.floating], numbers: Cells, begins: Mask, cut: Mask
    ) -> Recorder:
        """Return the recorder with the pieces of fresh frames; arguments as of :meth:`extend`, and
        ``cut``, bool ``[t]``: frames with which joined recordings begin."""
        if self.as_one is not None:
            frames = np.hstack([frames, self.as_one(frames)])
        open_frames = 0
        if self.last is None:
            begins = begins | (np.arange(len(frames)) == 0)
        else:
            open_frames = int(self.last.frames[-1])
        opens = begins | cut
        # frames of the recording so far, up to a multiple of the length
        since = since_begin(opens) + np.where(opens.cumsum() == 0, open_frames, 0)
        starts = since % self.length == 0
        first = np.flatnonzero(starts)
        continues = not starts[0]
        if continues:
            first = np.insert(first, 0, 0)
        recording = self.recordings - 1 + np.cumsum(begins[first])
        run = _pieces(frames, numbers, first, recording, opens[first])
        before = 0
        if self.last is not None:
            run = _Pieces.joined([self.last, run])
            before = len(self.last)
        joins = np.zeros(len(run), bool)
        joins[before] = continues
        run = run.merged(joins)
        ended = np.append(run.first[1:], False)
        run = run.merged(self._too_short(run) & ended)
        kept = (*self.complete, run.chosen(slice(0, -2)))
        return replace(
            self,
            complete=self._fewer(kept),
            last=run.chosen(slice(-2, None)),
            recordings=self.recordings + int(begins[first].sum()),
        )

    def _before(self, frames: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the frame before each one, ``[t, D]``; NaN: there was none."""
        before = np.full_like(frames, np.nan)
        before[1:] = frames[:-1]
        if self.given is not None:
            before[0] = self.given
        return before

    def _fresh(self, frames: NDArray[np.floating], before: NDArray[np.floating]) -> Mask:
        """Return the frames ``[t, D]`` that do not repeat the one before, bool ``[t]``."""
        missing = np.isnan(frames)
        same = (frames == before) | (missing & np.isnan(before))
        found: Mask = ~same.all(axis=1) | missing.all(axis=1)
        found[0] |= self.given is None
        return found

    def _cuts(
        self, frames: NDArray[np.floating], before: NDArray[np.floating]
    ) -> tuple[Mask, Array]:
        """Return the frames ``[t, D]`` with which joined recordings begin, bool ``[t]``, and how
        much changed in the last frames."""
        step = np.nan_to_num(frames - before)
        least = _CUT * self.tolerance
        appear = (step > least).sum(axis=1)
        vanish = (step < -least).sum(axis=1)
        both = np.minimum(appear, vanish) >= max(2, _CELLS * frames.shape[1])
        changes = self.changes if len(self.changes) else np.zeros(self.length, np.float32)
        change = np.concatenate([changes, np.abs(step).sum(axis=1).astype(np.float32)])
        usual = sliding_window_view(change, self.length)[:-1].max(axis=1)
        cuts: Mask = both & (change[self.length :] > _SUDDEN * usual)
        return cuts, change[-self.length :]

    def record(self, n_frames: int) -> Record:
        """Return the record of a log of ``n_frames`` that ends here.

        Raises:
            ValueError: no frame was received.
        """
        if self.last is None:
            raise ValueError("a record needs a frame")
        run = self.last
        at_end = np.arange(len(run)) == len(run) - 1
        run = run.merged(self._too_short(run) & at_end)
        groups = 0 if self.as_one is None else len(self.as_one.on)
        return _Pieces.joined([*self.complete, run]).record(n_frames, groups)

    def _too_short(self, run: _Pieces) -> Mask:
        """Return the pieces of less than half a length behind another of the same recording, bool
        ``[n]``."""
        found: Mask = ~run.first & (2 * run.frames < self.length)
        return found

    def _fewer(self, complete: tuple[_Pieces, ...]) -> tuple[_Pieces, ...]:
        if sum(map(len, complete)) <= self.most:
            return complete
        every = _Pieces.joined(complete)
        every = every.chosen(~every.unchanged(self.tolerance))
        return (every.chosen(slice(-int(self.most * _KEPT), None)),)


def since_begin(begins: Mask) -> Cells:
    """Return how far each step lies behind the last one that begins something, or behind the first
    one, int ``[n]`` of bool ``[n]``."""
    step = np.arange(len(begins))
    found: Cells = step - np.maximum.accumulate(np.where(begins, step, 0))
    return found


def record_of(
    recordings: Sequence[NDArray[np.floating]], length: int, as_one: AsOne | None = None
) -> Record:
    """Return the record of recordings ``[T, D]`` each, with ``length`` frames a piece; NaN:
    missing. ``as_one``: of :class:`Recorder`."""
    recorder = Recorder(length, as_one=as_one)
    frame = 0
    for one in recordings:
        recorder = recorder.extend(one, frame + np.arange(len(one)))
        frame += len(one)
    return recorder.record(frame)


def _pieces(
    frames: NDArray[np.floating], numbers: Cells, first: Cells, recording: Cells, opens: Mask
) -> _Pieces:
    """Return the pieces of frames ``[t, D]``.

    Args:
        frames: NaN: missing.
        numbers: int ``[t]``, of the frames.
        first: int ``[n]``, index of the first one of each piece.
        recording, opens: of each piece, and whether a recording begins with it, ``[n]``.
    """
    x = frames.astype(np.float32)
    missing = np.isnan(x)
    return _Pieces(
        low=np.fmin.reduceat(x, first, axis=0),
        high=np.fmax.reduceat(x, first, axis=0),
        total=np.add.reduceat(np.where(missing, 0, x), first, axis=0, dtype=np.float64),
        count=np.add.reduceat(~missing, first, axis=0, dtype=np.int32),
        frames=np.diff(np.append(first, len(x))),
        recording=recording,
        first=opens,
        begins=numbers[first],
    )


def _last_received(received: Mask, recording: Cells) -> Cells:
    """Return the last piece of the same recording in which each cell was received, or the piece
    itself, int ``[n, D]``."""
    piece = np.broadcast_to(np.arange(len(received))[:, None], received.shape)
    last = np.maximum.accumulate(np.where(received, piece, -1), axis=0)
    same = (last >= 0) & (recording[last] == recording[:, None])
    return np.where(same, last, piece)
