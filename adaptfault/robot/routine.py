"""A self-test routine: which recordings to repeat, and what a log of them left untested."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.documents import members, rebuilt
from diagnostics import Diagnosis, SensorLayout, Verdict
from diagnostics.shown import shown

SCHEMA = "adaptfault.routine/1"

LOADS = 3
"""Loads of a cell that count as its test.

After so many a diagnosis finds 0.99 of the open cells, after two 0.88, after one 0.36 (simulated
grasps, ``python benchmarks/promises.py selftest simulated``)."""


@dataclass(frozen=True)
class Repertoire:
    """The recordings of which a routine was chosen.

    Attributes:
        names: of the recordings.
        gestures: recordings with one number repeat each other, as those of one class.
        loaded: the cells that each recording loaded, a bit a cell, hexadecimal.
        weights: what each cell matters, ``[D]``, of sum 1.

    Raises:
        ValueError: the recordings have another number of names, gestures or loads, or the loads
            are of another number of cells.
    """

    names: tuple[str, ...]
    gestures: tuple[int, ...]
    loaded: tuple[str, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.names) == len(self.gestures) == len(self.loaded) > 0:
            raise ValueError("names, gestures and loads of the repertoire differ in number")
        if {len(bytes.fromhex(row)) for row in self.loaded} != {-(-len(self.weights) // 8)}:
            raise ValueError("the loads of the repertoire do not fit its weights")

    @classmethod
    def from_loads(
        cls,
        loaded: NDArray[np.bool_],
        gestures: NDArray[np.int64],
        names: tuple[str, ...],
        weights: NDArray[np.float64],
    ) -> Repertoire:
        """Build from the cells that each recording loaded, bool ``[n, D]``."""
        bits = np.packbits(loaded, axis=1)
        return cls(
            names,
            tuple(gestures.tolist()),
            tuple(row.tobytes().hex() for row in bits),
            tuple(weights.tolist()),
        )

    @property
    def likely(self) -> NDArray[np.float64]:
        """Probability that a repetition of each recording loads each cell, ``[n, D]``: the mean of
        what it did, and of what the recordings that it repeats did."""
        bits = np.stack([np.frombuffer(bytes.fromhex(row), np.uint8) for row in self.loaded])
        loaded = np.unpackbits(bits, axis=1, count=len(self.weights)).astype(np.float64)
        gestures = np.array(self.gestures)
        share = np.empty_like(loaded)
        for gesture in np.unique(gestures):
            of_it = gestures == gesture
            share[of_it] = loaded[of_it].mean(axis=0)
        likely: NDArray[np.float64] = (loaded + share) / 2
        return likely


@shown
@dataclass(frozen=True)
class Routine:
    """Recordings to repeat.

    Attributes:
        recordings: their indices in the repertoire, in the order of choice.
        names: of these recordings.
        tested: share of what matters that is tested before, and expected to be after.
        reached: the share after each recording.
        seconds: how long all take.
        repertoire: of which they were chosen.
    """

    recordings: tuple[int, ...]
    names: tuple[str, ...]
    tested: tuple[float, float]
    reached: tuple[float, ...]
    seconds: float
    repertoire: Repertoire

    def __str__(self) -> str:
        before, after = self.tested
        head = (
            f"{len(self.recordings)} recordings, {self.seconds:.0f} s: test {after:.0%} of what"
            f" matters, {before:.0%} before"
        )
        lines = [
            f"{share:5.0%} after {name}"
            for share, name in zip(self.reached, self.names, strict=True)
        ]
        return "\n".join([head, *lines])

    def check(self, layout: SensorLayout) -> None:
        """Refuse a layout of another number of cells: raise ValueError."""
        n = len(self.repertoire.weights)
        if n != layout.n_cells:
            raise ValueError(f"the routine is for {n} cells, the sensor has {layout.n_cells}")

    def after(self, diagnosis: Diagnosis, n_recordings: int) -> RoutineResult:
        """Return what a log of this routine tested, and what would test more.

        Args:
            diagnosis: of the log.
            n_recordings: of the log.

        Raises:
            ValueError: the routine is for another number of cells.
        """
        self.check(diagnosis.layout)
        weights = np.array(self.repertoire.weights)
        untested = (diagnosis.verdicts == Verdict.UNTESTED) & (weights > 0)
        gains = self.repertoire.likely @ np.where(untested, weights, 0.0)
        best = int(gains.argmax())
        return RoutineResult(
            tested=float(weights[~untested].sum()),
            planned=self.tested[1],
            untested=tuple(np.flatnonzero(untested).tolist()),
            n_cells=int((weights > 0).sum()),
            next_best=self.repertoire.names[best] if gains[best] > 0 else None,
            gain=float(gains[best]),
            n_recordings=n_recordings,
            n_planned=len(self.recordings),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        return {"schema": SCHEMA, **members(self)}

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> Routine:
        """Rebuild a routine from :meth:`to_dict`.

        Raises:
            ValueError: it is none.
        """
        if not isinstance(d, Mapping) or d.get("schema") != SCHEMA:
            raise ValueError(f"expected a routine with schema {SCHEMA!r}")
        try:
            return rebuilt(d, cls, schema=SCHEMA)
        except ValueError as error:
            raise ValueError(f"the routine is damaged: {error}") from None

    @classmethod
    def read(cls, path: str | Path) -> Routine:
        """Read the file that ``adaptfault selftest --out`` wrote.

        Raises:
            OSError: it cannot be read.
            ValueError: it holds no routine.
        """
        try:
            return cls.from_dict(json.loads(Path(path).read_bytes()))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path}: {error}") from None


@shown
@dataclass(frozen=True)
class RoutineResult:
    """What a log of a routine tested.

    Attributes:
        tested: share of what matters that the log tested.
        planned: the share that the routine was expected to test.
        untested: cells that matter and were not tested.
        n_cells: number of cells that matter.
        next_best: the recording of the repertoire whose repetition loads most of what is untested;
            None: none loads any of it.
        gain: the share of what matters that it is expected to load and is untested.
        n_recordings: of the log.
        n_planned: of the routine.
    """

    tested: float
    planned: float
    untested: tuple[int, ...]
    n_cells: int
    next_best: str | None
    gain: float
    n_recordings: int
    n_planned: int

    def __str__(self) -> str:
        tested = (
            f"self-test: {self.tested:.0%} of what matters tested ({self.planned:.0%} expected)"
        )
        if self.n_recordings != self.n_planned:
            tested += f", from {self.n_recordings} recordings, where the routine has"
            tested += f" {self.n_planned}"
        if not self.untested:
            return tested
        left = f"{tested}; {len(self.untested)} of {self.n_cells} cells untested"
        if self.next_best is None:
            return f"{left}, and no recording of the repertoire loads them"
        return f"{left}; next best: {self.next_best}, which loads {self.gain:.1%} of what matters"

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        return members(self)
