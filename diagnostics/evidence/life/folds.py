"""The reference in folds of whole recordings, as pieces of load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.life.healthy_table import Floats, Mask
from diagnostics.evidence.life.record import KEPT, PIECE, LifeRecord
from diagnostics.healthy.cross_fitting import FOLDS
from diagnostics.preprocessing.levels import FEWEST, MAJORITY
from diagnostics.preprocessing.offset import OffsetTracker
from diagnostics.preprocessing.readings import SEGMENT, RecordingBlocks
from diagnostics.preprocessing.scale import Array

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout
    from diagnostics.preprocessing.offset import ReferenceOffset
    from diagnostics.preprocessing.scale import Scale

_MOST_PIECES = 6000  # of the reference: a size


@dataclass(frozen=True)
class Fold:
    """Pieces of some reference recordings: loads, readings, and which of these were constant,
    ``[n, D]``; piece numbers int ``[n]``."""

    loads: Array
    readings: Array
    constant: Mask
    piece: NDArray[np.intp]

    def copy(self) -> Fold:
        """Return a copy whose loads and readings can be changed."""
        return Fold(self.loads.copy(), self.readings.copy(), self.constant.copy(), self.piece)

    def kill(self, cell: int, source: int, rng: np.random.Generator) -> None:
        """Let a cell read, equally often, what another one (``source``) read at other times, or
        nothing."""
        if rng.random() < MAJORITY:
            self.loads[:, cell] = 0.0
            # NaN without any reading
            self.readings[:, cell] = np.fmin.reduce(self.readings[:, cell])
            self.constant[:, cell] = True
            return
        order = rng.permutation(len(self.loads))
        self.loads[:, cell] = self.loads[order, source]
        self.readings[:, cell] = self.readings[order, source]
        self.constant[:, cell] = self.constant[order, source]


def folds_of(
    recordings: Sequence[Floats], layout: SensorLayout, scale: Scale, offset: ReferenceOffset
) -> list[Fold] | None:
    """Return the pieces of the reference in folds of whole recordings, with offsets tracked as in a
    log."""
    blocks = RecordingBlocks.of(recordings)
    order = np.random.default_rng(0).permutation(len(blocks))
    frames = np.cumsum([len(blocks.given[i]) for i in order])
    order = order[: max(FEWEST, int(np.searchsorted(frames, _MOST_PIECES * SEGMENT // 4)))]
    if len(order) < FEWEST:
        return None
    present = layout.present.ravel()
    folds = []
    for k in range(FOLDS):
        mine = order[k::FOLDS]
        parts = []
        begin = 0
        for some in np.array_split(mine, max(1, len(mine) // FEWEST)):
            log = np.concatenate([blocks[i] for i in some])
            record, begin = _recorded(log, begin, present, scale, offset)
            if record.number:
                parts.append(Fold(record.loads, record.means, record.constant, record.piece))
        if not parts:
            return None
        folds.append(joined(parts))
    return folds if min(len(fold.loads) for fold in folds) >= FEWEST else None


def joined(parts: Sequence[Fold]) -> Fold:
    """Return the pieces of all parts as one."""
    return Fold(
        np.concatenate([part.loads for part in parts]),
        np.concatenate([part.readings for part in parts]),
        np.concatenate([part.constant for part in parts]),
        np.concatenate([part.piece for part in parts]),
    )


def _recorded(
    log: Floats, begin: int, present: Mask, scale: Scale, offset: ReferenceOffset
) -> tuple[LifeRecord, int]:
    """Return the record of a log, of any length, and the number of the segment after it."""
    tracked = OffsetTracker.begin(log.shape[1])
    root: list[Array] = []
    readings: list[Array] = []
    flat: list[Mask] = []
    number: list[int] = []
    for first in range(0, len(log), SEGMENT):
        frames = log[first : first + SEGMENT]
        tracked = tracked.extend(frames, scale, present, offset)
        loads = tracked.on(scale).root_load(tracked.off(frames))
        one = LifeRecord().extend(
            np.where(present, loads, np.float32(0)), frames, begin + first // SEGMENT
        )
        root += one.root
        readings += one.readings
        flat += one.flat
        number += one.number
    record = LifeRecord(tuple(root), tuple(readings), tuple(flat), (), tuple(number))
    return record, begin + len(log) // SEGMENT + 1


def logs_of(fold: Fold) -> list[LifeRecord]:
    """Return the pieces as records of logs, each of as many segments as are kept of a log."""
    numbers, begins = np.unique(fold.piece // (SEGMENT // PIECE), return_index=True)
    loads = np.split(fold.loads, begins[1:])
    readings = np.split(fold.readings, begins[1:])
    flat = np.split(fold.constant, begins[1:])
    return [
        LifeRecord(
            tuple(loads[first : first + KEPT]),
            tuple(readings[first : first + KEPT]),
            tuple(flat[first : first + KEPT]),
            (),
            tuple(numbers[first : first + KEPT].tolist()),
        )
        for first in range(0, len(numbers), KEPT)
    ]
