"""A self-test from the robot's own repertoire: the fewest recordings that test what matters.

A repertoire is a set of recordings of movements that the robot can repeat. Recording i loads cell c
in a repetition with probability

    p_ic = (l_ic + r_gc) / 2

l_ic is 1 where it loaded the cell, r_gc the share of the recordings of its class that did (of all
recordings without classes). A cell counts as tested by two loads, so a routine R tests

    sum_c w_c min(1, sum_{i in R} p_ic / 2)

This is submodular: the greedy choice reaches 1 - 1/e of the best one at least (Nemhauser, Wolsey
and Fisher 1978). The weights w are the accuracy that is lost if the cell is dead and not in F,
plus one window, so that no cell is worth nothing.

Not considered: how hard a fault is to see where neighbours say little about a cell.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.bundle.bundle import Bundle
from adaptfault.data.recordings import Recordings
from adaptfault.evaluation.sensitivity import sensitivity
from diagnostics import Diagnosis, FaultSet, SensorLayout, Verdict
from diagnostics.preprocessing.levels import LIGHT, LOW

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter

SCHEMA = "adaptfault.routine/1"

Floats = NDArray[np.float64]

_LOADS = 2  # of a cell that tests it
_ENOUGH = 0.99  # of what the whole repertoire tests


@dataclass(frozen=True)
class Routine:
    """Recordings to repeat.

    Attributes:
        recordings: their indices in the repertoire, in the order of choice.
        names: of these recordings.
        tested: share of what matters that is tested before and after.
        reached: the share after each recording.
        seconds: how long all take.
    """

    recordings: tuple[int, ...]
    names: tuple[str, ...]
    tested: tuple[float, float]
    reached: tuple[float, ...]
    seconds: float

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

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict that :meth:`from_dict` reads."""
        return {
            "schema": SCHEMA,
            "recordings": list(self.recordings),
            "names": list(self.names),
            "tested": list(self.tested),
            "reached": list(self.reached),
            "seconds": self.seconds,
        }

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> Routine:
        """Rebuild a routine from :meth:`to_dict`.

        Raises:
            ValueError: it is none.
        """
        if not isinstance(d, Mapping) or d.get("schema") != SCHEMA:
            raise ValueError(f"expected a routine with schema {SCHEMA!r}")
        try:
            before, after = map(float, d["tested"])
            return cls(
                tuple(map(int, d["recordings"])),
                tuple(map(str, d["names"])),
                (before, after),
                tuple(map(float, d["reached"])),
                float(d["seconds"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"the routine is damaged: {error}") from None


def plan_selftest(
    bundle_or_adapter: Bundle | Adapter,
    repertoire: Recordings | Sequence[NDArray[Any]],
    *,
    seconds: float | None = None,
    n: int | None = None,
) -> Routine:
    """Return the recordings of a repertoire that test what matters.

    Args:
        bundle_or_adapter: the robot. Of a bundle, known faults need no test, and what its last log
            tested counts as tested before.
        repertoire: recordings ``[T, D]`` of a healthy sensor, at least two.
        seconds: the longest time of all chosen recordings.
        n: their largest number. Without either, as many as reach 99 % of what the repertoire can.

    Raises:
        ValueError: fewer than two recordings, or none that fits the budget; recordings that do not
            fit the layout, or load no cell.
    """
    adapter = bundle_or_adapter
    faulty = tested = None
    if isinstance(adapter, Bundle):
        faulty, tested = _known(adapter)
        adapter = adapter.parts.adapter()
    layout = adapter.layout
    if n is not None and n < 1:
        raise ValueError(f"n is the number of recordings, at least 1; got {n}")
    if seconds is not None and not seconds > 0:
        raise ValueError(f"seconds is the time of the routine, above 0; got {seconds}")
    frames = [
        layout.check_recording(recording, f"recording {i}")
        for i, recording in enumerate(layout.recordings(list(repertoire)))
    ]
    if len(frames) < 2:
        raise ValueError(
            f"a repertoire has at least 2 recordings to choose from, got {len(frames)}"
        )
    labels = repertoire.labels if isinstance(repertoire, Recordings) else None
    names = (
        repertoire.names
        if isinstance(repertoire, Recordings)
        else tuple(f"recording {i}" for i in range(len(frames)))
    )
    likely = load_probability(frames, layout, labels)
    if not likely.any():
        raise ValueError("no recording of the repertoire loads any cell: record contacts")
    durations = np.array([len(one) / layout.rate for one in frames])
    weights = cell_weights(adapter, faulty)
    begun = np.zeros(layout.n_cells) if tested is None else np.where(tested, float(_LOADS), 0.0)
    chosen, reached = _greedy(likely, weights, durations, begun, seconds, n)
    if not chosen:
        raise ValueError(
            f"no recording that tests anything new fits into {seconds:g} s; the shortest takes"
            f" {durations.min():.2g} s"
            if seconds is not None
            else "the last log tested all that the repertoire can test"
        )
    before = float(weights @ np.minimum(1, begun / _LOADS))
    return Routine(
        tuple(chosen),
        tuple(names[i] for i in chosen),
        (before, reached[-1]),
        tuple(reached),
        float(durations[chosen].sum()),
    )


def load_probability(
    frames: Sequence[Floats], layout: SensorLayout, labels: NDArray[np.int64] | None = None
) -> Floats:
    """Return the probability that a repetition of each recording loads each cell, ``[n, D]``.

    A cell is loaded where its reading leaves its rest by 5 % of the range that the array shows.

    Args:
        frames: recordings ``[T, D]``.
        layout: the array.
        labels: classes ``[n]``, whose recordings repeat each other; None: not known.
    """
    every = np.concatenate(frames)
    known = np.where(np.isfinite(every), every, np.nan)
    present = layout.present.ravel() & ~np.isnan(known).all(axis=0)
    rest = np.zeros(layout.n_cells)
    least = np.nanquantile(known[:, present], (LOW, 0.5, 1 - LOW), axis=0)
    falls = np.nanmean(known[:, present] - least[1]) < 0  # load lowers the readings
    rest[present] = least[2] if falls else least[0]
    span = np.nanmax(np.abs(known[:, present] - rest[present]), initial=0.0)
    loaded = np.zeros((len(frames), layout.n_cells))
    for i, recording in enumerate(frames):
        most = np.nanmax(np.abs(recording - rest), axis=0, initial=0.0, where=~np.isnan(recording))
        loaded[i] = present & (most > LIGHT * span)
    groups = np.zeros(len(frames), np.int64) if labels is None else np.asarray(labels)
    share = np.empty_like(loaded)
    for group in np.unique(groups):
        of_it = groups == group
        share[of_it] = loaded[of_it].mean(axis=0)
    return (loaded + share) / 2


def cell_weights(adapter: Adapter, faulty: FaultSet | None = None) -> Floats:
    """Return what each cell matters, ``[D]``, of sum 1: the accuracy that is lost if it reads 0 and
    is not in F."""
    windows = adapter.validation
    present = adapter.layout.present.ravel().copy()
    if faulty is not None:
        present &= ~faulty.mask
    lost = np.zeros(adapter.layout.n_cells)
    if adapter.task == "classification" and (windows.y >= 0).all():
        lost = np.maximum(sensitivity(adapter.model, windows, values=(0.0,))[0], 0.0)
    weights = np.where(present, lost + 1 / len(windows), 0.0)
    shares: Floats = weights / weights.sum()
    return shares


def _known(bundle: Bundle) -> tuple[FaultSet, NDArray[np.bool_] | None]:
    """Return the known faulty cells, and the cells that the last log tested; None without one."""
    cells = {cell for fault in bundle.known_faults().faults for cell in fault.cells}
    faulty = FaultSet(tuple(cells), bundle.layout.n_cells)
    runs = [run["diagnosis"] for run in bundle.journal.runs() if run.get("diagnosis")]
    if not runs:
        return faulty, None
    return faulty, Diagnosis.from_dict(runs[-1]).verdicts != Verdict.UNTESTED


def _greedy(
    likely: Floats,
    weights: Floats,
    durations: Floats,
    begun: Floats,
    seconds: float | None,
    n: int | None,
) -> tuple[list[int], list[float]]:
    """Return the chosen recordings, and the share that is tested after each."""
    limit = len(likely) if n is None else n
    most = _share(begun + likely.sum(axis=0), weights)
    loads = begun.copy()
    left = np.inf if seconds is None else seconds
    chosen: list[int] = []
    reached: list[float] = []
    while len(chosen) < limit:
        now = _share(loads, weights)
        gains = np.minimum(1, (loads + likely) / _LOADS) @ weights - now
        gains[chosen] = 0.0
        gains[durations > left] = 0.0
        rate = gains if seconds is None else gains / durations
        best = int(np.argmax(rate))
        if gains[best] <= 0:
            break
        chosen.append(best)
        loads = loads + likely[best]
        left -= float(durations[best])
        reached.append(_share(loads, weights))
        if n is None and seconds is None and reached[-1] >= _ENOUGH * most:
            break
    return chosen, reached


def _share(loads: Floats, weights: Floats) -> float:
    return float(np.minimum(1, loads / _LOADS) @ weights)
