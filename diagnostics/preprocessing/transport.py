"""Transport faults: lost frames, frozen streams and invalid readings between sensor and log; no
faults of cells.

Detects frames without any reading, one frame repeated too often while at least 3 working cells are
loaded, and readings that no converter gives. In a frozen stream every cell looks stuck, so repeated
frames are not used as evidence. Arrays that send exact zeros repeat frames without contact: a
repetition without load is no fault. How often healthy frames repeat is learnt from the reference,
apart for frames with load and for all frames. Where nothing tells whether readings fall with load,
a frame in which most cells read what is their highest in most of the log is one without load.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import MAJORITY

_LOADED_CELLS = 3  # working cells that must be loaded in a repeated frame: fewer may be idle
_KEPT = 16  # most recent repetitions: a size


@dataclass(frozen=True)
class TransportFault:
    """Frames or readings that did not arrive as they were measured.

    Attributes:
        kind: ``"lost"`` (frames without any reading), ``"frozen"`` (one frame repeated),
            ``"invalid"`` (readings that no converter gives), ``"corrupt_frame"``,
            ``"common_spike"``, ``"one_signal"``, ``"repeated_frames"`` or ``"crosstalk"``
            (:mod:`diagnostics.sensor.shared`).
        onset: number of the first such frame.
        frames: how many frames; of ``"invalid"``: how many readings.
        reason: one plain sentence.
    """

    kind: str
    onset: int
    frames: int
    reason: str

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        return asdict(self)

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> TransportFault:
        """Rebuild from :meth:`to_dict`."""
        return cls(**d)


@dataclass(frozen=True)
class Patience:
    """How many times in a row a healthy frame comes again, at most.

    Attributes:
        idle: of a frame in which fewer than 3 cells are loaded.
        loaded: of any other; not more than ``idle``.
        loaded_from: float ``[D]``, the reading from which on each cell is loaded; infinite where
            there is no cell.
    """

    idle: int
    loaded: int
    loaded_from: NDArray[np.float64]

    @classmethod
    def fit(
        cls, recordings: Sequence[NDArray[np.float64]], loaded_from: NDArray[np.float64], least: int
    ) -> Patience:
        """Return twice the longest repetition in healthy recordings ``[T, D]``, and no less than
        ``least``."""
        found = cls(least, least, loaded_from)
        for frames in recordings:
            times = 2 * repetitions(frames)
            longer = np.flatnonzero(times > least)
            loaded = times[longer[found.is_loaded(frames[longer])]]
            idle = int(times.max(initial=found.idle))
            held = int(loaded.max(initial=found.loaded))
            found = cls(idle, held, loaded_from)
        return found

    def of(self, frames: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return the patience with each frame of ``[t, D]``, int ``[t]``."""
        return np.where(self.is_loaded(frames), self.loaded, self.idle)

    def is_loaded(self, frames: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return in which frames of ``[t, D]`` at least 3 cells are loaded, bool ``[t]``."""
        loaded: NDArray[np.bool_] = (frames > self.loaded_from).sum(axis=1) >= _LOADED_CELLS
        return loaded


@dataclass(frozen=True)
class Repetition:
    """One frame that was received several times in a row.

    Attributes:
        onset: number of its first occurrence.
        frames: number of occurrences.
        frame: float ``[D]``, its readings.
    """

    onset: int
    frames: int
    frame: NDArray[np.float64]


@dataclass(frozen=True)
class TransportState:
    """Counts of lost, repeated and invalid frames so far.

    Attributes:
        seen: frames so far, lost ones included.
        lost: number of lost frames.
        first_lost: number of the first of them; -1: none.
        last: float ``[D]``, the last frame received.
        repeats: number of times in a row that it was repeated.
        since: number of its first occurrence.
        repetitions: the repetitions beyond patience; the last may continue.
        invalid: number of readings that no converter gives.
        first_invalid: number of the frame of the first of them; -1: none.
        highest: float ``[D]``, of each cell.
        at_highest: int ``[D]``, in how many frames it read that.
    """

    seen: int = 0
    lost: int = 0
    first_lost: int = -1
    last: NDArray[np.float64] | None = None
    repeats: int = 0
    since: int = 0
    repetitions: tuple[Repetition, ...] = ()
    invalid: int = 0
    first_invalid: int = -1
    highest: NDArray[np.float64] | None = None
    at_highest: NDArray[np.intp] | None = None

    def receive(
        self, frames: NDArray[np.float64], present: NDArray[np.bool_], patience: Patience
    ) -> tuple[TransportState, NDArray[np.intp]]:
        """Return the state after more frames, and the indices of those that carry information, int
        ``[k]``.

        Args:
            frames: ``[t, D]``, t >= 1.
            present: bool ``[D]``, where there is a cell.
            patience: a frame that was repeated more often than this carries none.
        """
        missing = np.isnan(frames)
        arrived = (
            ~missing.all(axis=1, where=present) if missing.any() else np.ones(len(frames), bool)
        )
        arrived_at = np.flatnonzero(arrived)
        missed = len(frames) - len(arrived_at)
        state = self.without(missed, int((~arrived).argmax())) if missed else self
        if not len(arrived_at):
            return replace(state, seen=self.seen + len(frames)), arrived_at
        received = frames[arrived_at] if missed else frames
        highest, at_highest = self._with_highest(received)
        before = np.full_like(received[:1], np.nan) if self.last is None else self.last[None]
        again = repetitions(np.concatenate([before, received]))[1:]
        index = np.arange(len(received))
        numbers = self.seen + arrived_at
        ongoing = again > index  # a repetition that began before these frames
        repeats = again + np.where(ongoing, self.repeats, 0)
        since = np.where(ongoing, self.since, numbers[index - again])
        state = replace(
            state,
            seen=self.seen + len(frames),
            last=received[-1].copy(),
            repeats=int(repeats[-1]),
            since=int(since[-1]),
            highest=highest,
            at_highest=at_highest,
        )
        if repeats.max() <= patience.loaded:
            return state, arrived_at
        limit = np.full(len(received), patience.loaded)
        some = np.flatnonzero(repeats > patience.loaded)
        limit[some] = patience.of(received[some])
        beyond = repeats > limit
        # A repetition is recorded once it exceeds patience, and extended while it continues.
        recorded = list(self.repetitions)
        for i in np.flatnonzero(np.append(again[1:] == 0, True) & beyond).tolist():
            if recorded and ongoing[i] and self.repeats > limit[i]:
                recorded[-1] = replace(recorded[-1], frames=int(repeats[i]) + 1)
            else:
                recorded.append(Repetition(int(since[i]), int(repeats[i]) + 1, received[i].copy()))
        return replace(state, repetitions=tuple(recorded[-_KEPT:])), arrived_at[~beyond]

    def _with_highest(
        self, received: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Return the highest reading of each cell with more frames, and how often it was read."""
        highest = np.fmax.reduce(received)
        count = np.count_nonzero(received == highest, axis=0)
        if self.highest is None or self.at_highest is None:
            return highest, count
        highest = np.fmax(highest, self.highest)
        counts = np.where(self.highest == highest, self.at_highest, 0)
        return highest, counts + np.count_nonzero(received == highest, axis=0)

    def _rests_high(self, frame: NDArray[np.float64], working: NDArray[np.bool_]) -> bool:
        """Return whether a frame shows what a sensor whose readings fall with load reads
        without."""
        if self.highest is None or self.at_highest is None or not working.any():
            return False
        usual = self.at_highest > MAJORITY * (self.seen - self.lost)
        return bool((usual & (frame == self.highest))[working].mean() > MAJORITY)

    def dropped(self, invalid: NDArray[np.bool_]) -> TransportState:
        """Return the state with the ``invalid`` readings of the next frames, bool ``[t, D]``,
        counted."""
        first = (
            self.seen + int(invalid.any(axis=1).argmax())
            if self.first_invalid < 0
            else self.first_invalid
        )
        return replace(self, invalid=self.invalid + int(invalid.sum()), first_invalid=first)

    def without(self, frames: int, first: int = 0) -> TransportState:
        """Return the state with ``frames`` more frames lost, the ``first`` of them that many frames
        from now."""
        first_lost = self.seen + first if self.first_lost < 0 else self.first_lost
        return replace(self, lost=self.lost + frames, first_lost=first_lost)

    def faults(
        self,
        loaded_from: NDArray[np.float64],
        working: NDArray[np.bool_],
        rate: float,
        moved: bool = True,
        *,
        falls: bool | None = False,
    ) -> tuple[TransportFault, ...]:
        """Return the transport faults.

        Args:
            loaded_from: float ``[D]``, the reading from which on each cell is loaded.
            working: bool ``[D]``, cells that are known to work.
            rate: frames per second.
            moved: whether any cell moved in the log; if none did, ``working`` are the cells not
                known to be faulty.
            falls: whether readings fall with load; None: unknown.
        """
        found = []
        if self.lost:
            text = (
                f"{_count(self.lost, 'frame')} lost (no reading, or never received), the first is"
                f" {self.first_lost}"
            )
            found.append(
                TransportFault(
                    "lost", self.first_lost, self.lost, f"{text}: check the link to the sensor"
                )
            )
        if self.invalid:
            text = (
                f"{_count(self.invalid, 'reading')} outside what a converter gives, the first in"
                " frame"
            )
            text += (
                f" {self.first_invalid}: counted as missing; check the converter and the link to"
                " the sensor"
            )
            found.append(TransportFault("invalid", self.first_invalid, self.invalid, text))
        cells, why = (
            ("working cells", "not the cells") if moved else ("cells", "or these cells are stuck")
        )
        for r in self.repetitions:
            loaded = int((r.frame > loaded_from)[working].sum())
            is_rest = falls is None and moved and self._rests_high(r.frame, working)
            if loaded >= _LOADED_CELLS and not is_rest:
                text = (
                    f"frame {r.onset}, in which {loaded} {cells} are loaded, was received"
                    f" {r.frames} times"
                )
                text += f" in a row ({r.frames / rate:.1f} s): the stream was frozen, {why}"
                found.append(
                    TransportFault(
                        "frozen", r.onset, r.frames, f"{text}; check the link to the sensor"
                    )
                )
        return tuple(found)


def _count(number: int, name: str) -> str:
    return f"{number} {name}" if number == 1 else f"{number} {name}s"


def invalid(frames: NDArray[Any], full_scale: float) -> NDArray[np.bool_] | None:
    """Return which readings ``[T, D]`` are infinite or over one full scale outside of 0 to full
    scale; None: none is.

    Missing readings (NaN) are not.
    """
    low = np.fmin.reduce(frames, axis=None)
    high = np.fmax.reduce(frames, axis=None)
    if np.isnan(low) or (low >= -full_scale and high <= 2 * full_scale):
        return None
    return np.asarray((frames < -full_scale) | (frames > 2 * full_scale))


def repetitions(frames: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return how many times in a row each frame of ``[T, D]`` was received before, int ``[T]``; NaN
    equals NaN."""
    equal = frames[1:] == frames[:-1]
    missing = np.isnan(frames)
    if missing.any():
        equal |= missing[1:] & missing[:-1]
    same = np.zeros(len(frames), bool)
    counts = np.arange(len(frames))
    same[1:] = equal.all(axis=1)
    return counts - np.maximum.accumulate(np.where(same, 0, counts))
