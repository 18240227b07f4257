"""Wiring that was exchanged in some of the recordings: pads or lines that answer in each other's
place there, and in their own place in the others.

Each recording is scored by the log likelihood of the few pieces that load each pad most, as they
came and under each permutation that :mod:`diagnostics.sensor.rewiring` tries. A recording counts as
exchanged where a permutation gains 24 in it. The permutation with the largest gain over these
recordings, 192 at least, is told, of all recordings in which it gains, if they then are as likely
as most of the others are as they came: their median is among three quarters of these, or 24 below
theirs at most. No other permutation of the same cells may gain nearly as much. At least one
recording must contradict it by 24: otherwise the whole log may be so. Lines are exchanged in two
recordings at least: one may be of an odd contact.

Not detected: different exchanges in different recordings, and recordings that load both places
alike; nor any behind a coarser converter, or one that loads drive to its top.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import CERTAIN_RATIO, LEAST_LOADED, MAJORITY
from diagnostics.sensor.permutations import best_of, candidates_of
from diagnostics.sensor.rewiring import LIMIT, Rewiring, Test, strongest

if TYPE_CHECKING:
    from diagnostics.evidence.reference import Reference
    from diagnostics.layout import SensorLayout

# pieces with a load, of a recording at most and of all: sizes
_PIECES = 4
_ALL_PIECES = 160
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
    best, lead = best_of(candidates, totals, as_they_came, 0.0)
    of_pads = (layout.pad_of[candidates[best].source] != layout.pad_of).any()
    # A connector may be wrong for one recording; the lines of a pad are not.
    if totals[best] < _PROVEN or (exchanged[best].sum() < 2 and not of_pads):
        return None
    which = _exchanged(gains[best])
    others = ~which & np.isfinite(usual)
    if not (gains[best] <= -LIMIT).any():  # it may be so throughout
        return None
    if lead < LIMIT / 2:
        return None
    low, middle = np.quantile(usual[others], [LEAST_LOADED, MAJORITY])
    if np.median((usual + gains[best])[which]) < min(low, middle - LIMIT):
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
        test: of a few pieces of each recording.
        recording_of: int ``[pieces]``, the recording of each.
        n: number of recordings.
    """

    test: Test
    recording_of: Cells
    n: int

    @classmethod
    def of(
        cls, recordings: Sequence[Floats], reference: Reference, layout: SensorLayout
    ) -> _ByRecording | None:
        """Return the scores of a log; None where it has too few recordings with loads."""
        model = reference.model
        if model is None or len(recordings) < _FEWEST:
            return None
        log = model.log_of_record(model.record_of(recordings))
        if log.is_coarse:
            return None
        most = max(2, min(_PIECES, _ALL_PIECES // len(recordings)))
        pieces = []
        weights = []
        for number in range(len(recordings)):
            some = np.flatnonzero(log.record.recording == number)
            chosen, weight = strongest(log, some, most, layout.pad_of)
            pieces.append(chosen)
            weights.append(weight)
        test = Test(model, log, np.concatenate(pieces), np.concatenate(weights))
        of = log.record.recording[test.pieces]
        if len(np.unique(of)) < _FEWEST:
            return None
        return cls(test, of, len(recordings))

    def likely(self, source: Cells) -> Floats:
        """Return the log likelihood of each recording, ``[n]``; NaN: it has no piece with a
        load."""
        of_pieces = self.test.of_working(source, np.zeros(len(source), bool))
        total = np.bincount(self.recording_of, of_pieces, self.n)
        return np.where(np.bincount(self.recording_of, minlength=self.n) > 0, total, np.nan)


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
