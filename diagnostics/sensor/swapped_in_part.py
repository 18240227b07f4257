"""Wiring that was exchanged in some of the recordings: pads or lines that answer in each other's
place there, and in their own place in the others.

Each recording is scored by the log likelihood of a few contact events that load each pad most, as
they came and under each permutation that :mod:`diagnostics.sensor.rewiring` tries. A recording
counts as exchanged where a permutation gains 24 in it. The permutation with the largest gain over
these recordings, 192 at least, is told, of all recordings in which it gains, if they then are as
likely as the others are as they came, by their medians and the range of the others, and if no other
permutation of the same cells gains nearly as much. At least one recording must contradict it by 24:
otherwise the whole log may be so. Lines are exchanged in two recordings at least: one may be of an
odd contact.

Not detected: different exchanges in different recordings, and recordings that load both places
alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import CERTAIN_RATIO
from diagnostics.preprocessing.offset import levelled, levels_above
from diagnostics.sensor.rewiring import LIMIT, Rewiring, Test, candidates_of, events_of

if TYPE_CHECKING:
    from diagnostics.evidence.reference import Reference
    from diagnostics.layout import SensorLayout

# contact events, of a recording at most and of all: sizes
_EVENTS = 4
_ALL_EVENTS = 160
_FEWEST = 4  # recordings
# log likelihood gained, all recordings together: of many permutations and recordings, one is odd
_PROVEN = 8 * LIMIT
_LISTED = 5

Floats = NDArray[np.float64]
Cells = NDArray[np.intp]


@dataclass(frozen=True)
class SwappedInPart:
    """A permutation of the wiring in some recordings of a log.

    Attributes:
        source: int ``[D]``; cell i of the array answers at index ``source[i]`` in them.
        text: what was exchanged.
        recordings: in which, from 0.
        of: number of recordings in the log.
    """

    source: Cells
    text: str
    recordings: tuple[int, ...]
    of: int

    @property
    def reason(self) -> str:
        """One sentence."""
        first = self.recordings[0]
        if self.recordings == tuple(range(first, self.of)):
            when = f"from recording {first} on"
        else:
            some = ", ".join(map(str, self.recordings[:_LISTED]))
            more = len(self.recordings) - _LISTED
            plural = "s" if len(self.recordings) > 1 else ""
            when = f"in recording{plural} {some}" + (f" and {more} more" if more > 0 else "")
        return f"{self.text} {when}: check which connector was where, and put these back"

    def undo(self, recordings: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
        """Return recordings ``[T, D]`` with each reading at the index of the cell that gave it."""
        return [
            frames[..., self.source] if i in self.recordings else frames
            for i, frames in enumerate(recordings)
        ]


def find_swapped_in_part(
    recordings: Sequence[Floats], reference: Reference, layout: SensorLayout
) -> SwappedInPart | None:
    """Return the permutation of the wiring that explains some recordings of a log; None where there
    is none.

    Args:
        recordings: ``[T, D]`` each; NaN = missing.
        reference: of the array, fitted.
        layout: the array.
    """
    scored = _ByRecording.of(recordings, reference, layout)
    if scored is None:
        return None
    as_they_came = np.arange(layout.n_cells)
    usual = scored.likely(as_they_came)
    if np.nanmedian(usual) - np.nanmin(usual) < LIMIT:
        return None
    surplus = scored.test.score(as_they_came, ~scored.test.used).surplus
    candidates = list(candidates_of(layout, surplus, as_they_came))
    if not candidates:
        return None
    gains = np.stack([scored.likely(one.source) - usual for one in candidates])
    exchanged = gains >= LIMIT
    totals = np.where(exchanged, gains, 0.0).sum(axis=1)
    best = int(totals.argmax())
    of_pads = (layout.pad_of[candidates[best].source] != layout.pad_of).any()
    # A connector may be wrong for one recording; the lines of a pad are not.
    if totals[best] < _PROVEN or (exchanged[best].sum() < 2 and not of_pads):
        return None
    which = _exchanged(gains[best])
    others = ~which & np.isfinite(usual)
    if not (gains[best] <= -LIMIT).any():  # it may be so throughout
        return None
    moves = candidates[best].source != as_they_came
    rivals = [
        total
        for i, total in enumerate(totals)
        if i != best and (moves & (candidates[i].source != as_they_came)).any()
    ]
    if totals[best] - max(rivals, default=0.0) < LIMIT / 2:
        return None
    if np.median((usual + gains[best])[which]) < np.min(usual[others]):
        return None
    recordings_of = tuple(np.flatnonzero(which).tolist())
    return SwappedInPart(
        candidates[best].source, candidates[best].text, recordings_of, len(recordings)
    )


def newest_contradict(
    rewiring: Rewiring, recordings: Sequence[Floats], reference: Reference, layout: SensorLayout
) -> bool:
    """Return whether the newest recordings, however many, are clearly less likely with the wiring
    put back. Arguments as of :func:`find_swapped_in_part`; the recordings as they came."""
    scored = _ByRecording.of(recordings, reference, layout)
    if scored is None:
        return True
    gained = scored.likely(rewiring.source) - scored.likely(np.arange(layout.n_cells))
    of_newest = np.nancumsum(gained[::-1])
    return bool(of_newest.min() < -CERTAIN_RATIO)


@dataclass(frozen=True)
class _ByRecording:
    """Scores each recording of a log under a permutation.

    Attributes:
        test: of a few events of each recording.
        recording_of: the recording of each event.
        n: number of recordings.
    """

    test: Test
    recording_of: list[int]
    n: int

    @classmethod
    def of(
        cls, recordings: Sequence[Floats], reference: Reference, layout: SensorLayout
    ) -> _ByRecording | None:
        """Return the scores of a log; None where it has too few recordings with events."""
        if reference.model is None or len(recordings) < _FEWEST:
            return None
        present = layout.present.ravel()
        levels = levels_above(recordings, reference.scale, present, reference.offset)
        events: list[Floats] = []
        of: list[int] = []
        most = max(2, min(_EVENTS, _ALL_EVENTS // len(recordings)))
        for i, frames in enumerate(levelled(recordings, levels)):
            found = _of_each_pad(events_of([frames], reference.scale)[0], most, reference, layout)
            events += found
            of += [i] * len(found)
        if len(set(of)) < _FEWEST:
            return None
        moved = np.ptp(np.concatenate(events), axis=0) > reference.scale.near
        weight = np.ones(len(events))
        test = Test(events, weight, reference.model, reference.scale, present, moved)
        return cls(test, of, len(recordings))

    def likely(self, source: Cells) -> Floats:
        """Return the log likelihood of each recording, ``[n]``; NaN: it has no event."""
        by_recording = np.full(self.n, np.nan)
        of_events = self.test.of_working(source, np.zeros(len(source), bool))
        for i in set(self.recording_of):
            by_recording[i] = of_events[np.equal(self.recording_of, i)].sum()
        return by_recording


def _of_each_pad(
    events: Sequence[Floats], most: int, reference: Reference, layout: SensorLayout
) -> list[Floats]:
    """Return up to ``most`` of the events ``[t, D]`` of a recording: in turn those that load each
    pad most."""
    if not events:
        return []
    loads = np.stack([(frames - reference.scale.baseline).max(axis=0) for frames in events])
    by_pad = [
        np.argsort(-loads[:, layout.pad_of == pad].sum(axis=1), kind="stable")
        for pad in range(layout.pads)
    ]
    in_turn = np.stack(by_pad, axis=1).ravel().tolist()
    return [events[i] for i in list(dict.fromkeys(in_turn))[:most]]


def _exchanged(gains: Floats) -> NDArray[np.bool_]:
    """Return in which recordings a permutation that gains so much, ``[n]``, is in force.

    Those that hardly tell count with the others where it is in force from one recording on.
    """
    gains = np.nan_to_num(gains)
    first = int((gains >= LIMIT).argmax())
    while first > 0 and gains[first - 1] > 0:
        first -= 1
    from_then_on = np.arange(len(gains)) >= first
    if (gains[from_then_on] > -LIMIT).all():
        return from_then_on
    return np.asarray(gains > 0)
