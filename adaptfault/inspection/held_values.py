"""Cells that hold one value away from rest through whole recordings, while cells beside them move.

One pass over a data set, with statistics of each recording that are merged by putting them one
behind the other: the lowest and the highest reading of each cell. A cell **moves** in a recording
where these differ by 5 % of the usual range, and **holds** a value where they are equal. Rest is
what it reads at least in nearly all recordings, at most where readings fall with load. A cell is
suspect where it holds one and the same value, 5 % of the usual range away from rest, in three
recordings or more in which two cells beside it move: contacts hardly come back to the same number,
a dead cell does. It finds, and acquits nobody: what it says nothing of is left to the diagnosis.

On the healthy recordings of five real arrays (1,824 recordings, 1,456 cells) no cell is suspect.

Not detected: cells that are dead at rest, that dither, or whose cells beside do not move, and what
one recording or two show.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.inspection.inspection import Finding, Inspection
from adaptfault.inspection.severity import of_finding
from diagnostics import SensorLayout, Verdict
from diagnostics.preprocessing.levels import LIGHT, LOW
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.when import Spans
from diagnostics.when.recording_numbers import ranges

_RECORDINGS = 3  # with the same value; of few counts, two agree by chance
_BESIDE = 2  # cells that move
_LISTED = 5

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class HeldValues:
    """Which cells hold a value in which recordings.

    Attributes:
        suspect: bool ``[n, D]``.
        value: float ``[n, D]``, the lowest reading of each cell in each recording.
    """

    suspect: Bools
    value: Floats

    @classmethod
    def of(cls, recordings: Iterable[NDArray[Any]], layout: SensorLayout) -> HeldValues:
        """Return the held values of recordings, ``[T, D]`` each, read once."""
        each = (Spans.of(RecordingBlocks([np.asarray(one, np.float64)])) for one in recordings)
        spans = Spans.joined(list(each))
        low = spans.low
        high = spans.high
        known = spans.known & layout.present.ravel()
        if not known.any():
            return cls(np.zeros(low.shape, bool), low)
        rest = _rest(low, high, known)
        loads = np.fmax(np.abs(high - rest), np.abs(low - rest))
        light = LIGHT * float(np.quantile(loads[known], 1 - LOW))
        with np.errstate(invalid="ignore"):
            moves = known & (high - low > light)
            holds = known & (high == low) & (np.abs(low - rest) > light)
        beside = np.where(layout.beside >= 0, moves[:, layout.beside], False).sum(axis=2)
        return cls(_again(holds & (beside >= _BESIDE), low), low)


def with_held_values(
    inspection: Inspection, recordings: Iterable[NDArray[Any]], layout: SensorLayout
) -> Inspection:
    """Return an inspection that tells of held values, and in which no such cell is ALIVE.

    Args:
        inspection: of the recordings.
        recordings: ``[T, D]`` each, in its order.
        layout: the array.
    """
    diagnosis = inspection.diagnosis
    suspect = HeldValues.of(recordings, layout).suspect & ~diagnosis.fault_set.mask
    suspect &= ~diagnosis.disturbed.mask
    cells = np.flatnonzero(suspect.any(axis=0))
    if not len(cells) or len(suspect) != diagnosis.n_recordings:
        return inspection
    states = diagnosis.states
    if states is not None:
        states = np.where(suspect, int(Verdict.UNTESTED), states).astype(np.uint8)
    tested = diagnosis.tested & ~suspect.any(axis=0)
    readings = replace(
        inspection.readings, diagnosis=replace(diagnosis, tested=tested, states=states)
    )
    places = [layout.place(cell) for cell in cells[:_LISTED].tolist()]
    more = f" and {len(cells) - _LISTED} more" if len(cells) > _LISTED else ""
    numbers = np.flatnonzero(suspect.any(axis=1)).tolist()
    hold = "holds" if len(cells) == 1 else "hold"
    reason = (
        f"{'; '.join(places)}{more} {hold} the same value away from rest all through recordings"
        f" {ranges(numbers)}, while cells beside move: dead there, or something lies on them; not"
        " tested"
    )
    told = Finding("held_value", of_finding("held_value"), reason)
    return replace(inspection, readings=readings, findings=(*inspection.findings, told))


def _rest(low: Floats, high: Floats, known: Bools) -> Floats:
    """Return what each cell reads without load, ``[D]``, from its extremes by recording.

    Most readings of an array are nearer to rest than to the strongest load, so that whichever end
    the middle of the extremes is nearer to is the end of rest.
    """
    lowest = np.where(known, low, np.inf)
    highest = np.where(known, high, -np.inf)
    ends = np.array([lowest.min(), highest.max()])
    middle = np.median(np.concatenate([low[known], high[known]]))
    falls = ends[1] - middle < middle - ends[0]
    ordered = np.sort(highest if falls else lowest, axis=0)
    place = int(LOW * (len(ordered) - 1))
    return np.asarray(ordered[-1 - place] if falls else ordered[place])


def _again(holds: Bools, value: Floats) -> Bools:
    """Return where cells hold a value that they hold in another recording, too."""
    again = np.zeros_like(holds)
    for cell in np.flatnonzero(holds.any(axis=0)).tolist():
        at = np.flatnonzero(holds[:, cell])
        _, which, times = np.unique(value[at, cell], return_inverse=True, return_counts=True)
        again[at, cell] = times[which.ravel()] >= _RECORDINGS
    return again
