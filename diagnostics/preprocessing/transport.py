"""Faults on the way of the frames: lost ones, and a stream that is frozen. They say nothing about cells.

A frozen stream repeats one frame again and again. Cell by cell that looks as if every cell were stuck, and so repeated
frames must not count as evidence. Pads that send exact zeros repeat frames when nothing touches them, so a repetition
is a fault only while something is loaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LOADED_CELLS = 3  # so many working cells must be loaded in a repeated frame: else it may be idle
_KEPT = 16  # repetitions remembered; the most recent ones


@dataclass(frozen=True)
class TransportFault:
    """Frames that did not arrive as they were taken.

    Attributes:
        kind: ``"lost"`` (frames without any reading), ``"frozen"`` (one frame repeated) or ``"invalid"`` (readings that
            no converter gives).
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
class Repetition:
    """A frame that came ``frames`` times in a row, first as number ``onset``."""

    onset: int
    frames: int
    frame: NDArray[np.float64]


@dataclass(frozen=True)
class TransportState:
    """What is known of the transport so far.

    Attributes:
        seen: frames so far, lost ones included.
        lost: how many were lost; ``first_lost``: number of the first, -1: none.
        last: the last frame that arrived, ``[D]``.
        repeats: how often in a row it has come again; ``since``: number of its first coming.
        repetitions: those beyond patience, the last one perhaps still going on.
        invalid: readings that no converter gives; ``first_invalid``: number of the frame of the first, -1: none.
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

    def receive(
        self, frames: NDArray[np.float64], present: NDArray[np.bool_], patience: int
    ) -> tuple[TransportState, NDArray[np.intp]]:
        """Return the stream after more frames, and which of them say something, int ``[k]``, indices into ``frames``.

        Args:
            frames: ``[t, D]``, t >= 1.
            present: bool ``[D]``, where there is a cell.
            patience: a frame that has come again more often than this says nothing new.
        """
        missing = np.isnan(frames)
        arrived = ~missing.all(axis=1, where=present) if missing.any() else np.ones(len(frames), bool)
        there = np.flatnonzero(arrived)
        gone = len(frames) - len(there)
        lost, first_lost = self.lost + gone, self.first_lost
        if gone and first_lost < 0:
            first_lost = self.seen + int((~arrived).argmax())
        if not len(there):
            return replace(self, seen=self.seen + len(frames), lost=lost, first_lost=first_lost), there
        came = frames[there] if gone else frames
        same = np.zeros(len(came), bool)
        if self.last is not None:
            same[0] = np.array_equal(came[0], self.last, equal_nan=True)
        same[1:] = _as_before(came)
        counts = np.arange(1, len(came) + 1)
        fresh = np.maximum.accumulate(np.where(same, 0, counts))
        repeats = np.where(fresh > 0, counts - fresh, self.repeats + counts)
        repetitions = list(self.repetitions)
        # Each repetition is noted once it is beyond patience, and lengthened when it goes on.
        numbers = self.seen + there
        since = np.where(fresh > 0, numbers[fresh - 1], self.since)
        last_of_run = np.flatnonzero(np.append(~same[1:], True) & (repeats > patience))
        for i in last_of_run.tolist():
            known = repetitions[-1] if repetitions and fresh[i] == 0 and self.repeats > patience else None
            if known is not None:
                repetitions[-1] = replace(known, frames=int(repeats[i]) + 1)
            else:
                repetitions.append(Repetition(int(since[i]), int(repeats[i]) + 1, came[i].copy()))
        state = TransportState(
            seen=self.seen + len(frames),
            lost=lost,
            first_lost=first_lost,
            last=came[-1].copy(),
            repeats=int(repeats[-1]),
            since=int(since[-1]),
            repetitions=tuple(repetitions[-_KEPT:]),
            invalid=self.invalid,
            first_invalid=self.first_invalid,
        )
        return state, there[repeats <= patience]

    def dropped(self, invalid: NDArray[np.bool_]) -> TransportState:
        """Return the state with the ``invalid`` readings of the next frames, bool ``[t, D]``, counted."""
        first = self.seen + int(invalid.any(axis=1).argmax()) if self.first_invalid < 0 else self.first_invalid
        return replace(self, invalid=self.invalid + int(invalid.sum()), first_invalid=first)

    def without(self, frames: int) -> TransportState:
        """Return the stream after frames that never came."""
        first = self.seen if self.first_lost < 0 else self.first_lost
        return replace(self, lost=self.lost + frames, first_lost=first)

    def faults(
        self, loaded_from: NDArray[np.float64], working: NDArray[np.bool_], rate: float
    ) -> tuple[TransportFault, ...]:
        """Name what went wrong.

        Args:
            loaded_from: float ``[D]``, the reading from which on each cell is loaded.
            working: bool ``[D]``, the cells that are not themselves stuck.
            rate: frames per second.
        """
        found = []
        if self.lost:
            text = f"{self.lost} frames came without a reading or not at all, the first is number {self.first_lost}"
            found.append(TransportFault("lost", self.first_lost, self.lost, f"{text}: check the link to the sensor"))
        if self.invalid:
            text = f"{_count(self.invalid, 'reading')} outside what a converter gives, the first in frame"
            text += f" {self.first_invalid}: counted as missing; check the converter and the link to the sensor"
            found.append(TransportFault("invalid", self.first_invalid, self.invalid, text))
        for r in self.repetitions:
            loaded = int((r.frame > loaded_from)[working].sum())
            if loaded >= _LOADED_CELLS:
                text = (
                    f"the frame {r.onset}, in which {loaded} working cells are loaded, came {r.frames} times in a row"
                )
                text += f" ({r.frames / rate:.1f} s)"
                found.append(
                    TransportFault("frozen", r.onset, r.frames, f"{text}: the stream was frozen, not the cells")
                )
        return tuple(found)


def _count(number: int, name: str) -> str:
    return f"{number} {name}" if number == 1 else f"{number} {name}s"


def invalid(frames: NDArray[Any], full_scale: float) -> NDArray[np.bool_] | None:
    """Return which readings ``[T, D]`` are infinite or over one full scale outside of 0 to full scale; None: none is.

    Missing readings (NaN) are not.
    """
    low, high = np.fmin.reduce(frames, axis=None), np.fmax.reduce(frames, axis=None)
    if np.isnan(low) or (low >= -full_scale and high <= 2 * full_scale):
        return None
    return np.asarray((frames < -full_scale) | (frames > 2 * full_scale))


def longest_repetition(frames: NDArray[np.float64]) -> int:
    """Return how often in a row a frame of ``[T, D]`` came again at most."""
    same = _as_before(frames)
    counts = np.arange(1, len(same) + 1)
    return int((counts - np.maximum.accumulate(np.where(same, 0, counts))).max(initial=0))


def _as_before(frames: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return for each frame but the first, ``[T - 1]``, whether it equals the one before, missing readings included."""
    matching, missing = frames[1:] == frames[:-1], np.isnan(frames)
    if missing.any():
        matching |= missing[1:] & missing[:-1]
    same: NDArray[np.bool_] = matching.all(axis=1)
    return same
