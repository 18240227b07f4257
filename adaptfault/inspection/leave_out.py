"""What to leave out of a training, so that no fault that was found is left in it.

A recording is free of faults where no cell is faulty in it. Cells that are faulty in every
recording leave none that is, so these cells are left out; of the others, the smallest set of
recordings without which no fault is left is all those in which one shows. Leaving out the readings
of the faulty cells in these recordings does the same at less cost, where the training can do
without.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics import Diagnosis, Verdict
from diagnostics.when.recording_numbers import ranges


@dataclass(frozen=True)
class LeaveOut:
    """What to leave out.

    Attributes:
        cells: faulty in every recording.
        recordings: numbers of those in which others are.
        partly: these other cells.
        n_recordings: of the data set.
    """

    cells: tuple[int, ...] = ()
    recordings: tuple[int, ...] = ()
    partly: tuple[int, ...] = ()
    n_recordings: int = 0

    @classmethod
    def of(cls, diagnosis: Diagnosis) -> LeaveOut:
        """Return what to leave out, from the verdicts by recording."""
        faulty = _faulty(diagnosis)
        always = faulty.all(axis=0)
        shows = faulty & ~always
        return cls(
            tuple(np.flatnonzero(always).tolist()),
            tuple(np.flatnonzero(shows.any(axis=1)).tolist()),
            tuple(np.flatnonzero(shows.any(axis=0)).tolist()),
            len(faulty),
        )

    @property
    def sentences(self) -> list[str]:
        """What to do, recordings by their numbers; empty where nothing is faulty."""
        told = []
        if self.cells:
            n = len(self.cells)
            what = "1 cell is" if n == 1 else f"{n} cells are"
            whose = "its readings" if n == 1 else "their readings"
            told.append(f"{what} faulty in every recording: train without {whose}")
        if self.recordings:
            n = len(self.recordings)
            what = "recording" if n == 1 else "recordings"
            other = "other " if self.cells else ""
            cells = "1 cell" if len(self.partly) == 1 else f"{len(self.partly)} cells"
            told.append(
                f"without {what} {ranges(self.recordings)} ({n} of {self.n_recordings}) no"
                f" {other}fault that was found is left; or leave out the readings of {cells} there,"
                " which --write-valid marks"
            )
        return told

    def to_dict(self, names: Sequence[str]) -> dict[str, Any]:
        """Return a JSON-safe dict; ``names``: of the recordings."""
        return {
            "cells": list(self.cells),
            "recordings": [names[number] for number in self.recordings],
            "partly": list(self.partly),
        }


def _faulty(diagnosis: Diagnosis) -> NDArray[np.bool_]:
    """Return which cells are faulty in which recordings, bool ``[n, D]``."""
    if diagnosis.states is not None:
        return np.asarray(diagnosis.states == int(Verdict.FAULTY))
    return np.tile(diagnosis.fault_set.mask, (max(diagnosis.n_recordings, 1), 1))
