"""A self-test from the robot's own repertoire: the fewest recordings that test what matters.

A repertoire is a set of recordings of movements that the robot can repeat. Recording i loads cell c
in a repetition with probability

    p_ic = (l_ic + r_gc) / 2

l_ic is 1 where it loaded the cell, r_gc the share of the recordings of its class that did (of all
recordings without classes). Repetitions are independent, so a routine R loads cell c in N_c of
them, a Poisson binomial number. A cell counts as tested by M = 3 loads
(:data:`~adaptfault.robot.routine.LOADS`), and R tests

    sum_c w_c E[min(M, N_c)] / M

The next recording adds sum_c w_c p_ic P(N_c < M) / M. This is submodular: the greedy choice reaches
1 - 1/e of the best one at least (Nemhauser, Wolsey and Fisher 1978). The weights w are the accuracy
that is lost if the cell is dead and not in F, plus one window, so that no cell is worth nothing.

Not considered: how hard a fault is to see where neighbours say little about a cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.bundle.bundle import Bundle
from adaptfault.data.recordings import Recordings
from adaptfault.evaluation.sensitivity import sensitivity
from adaptfault.robot.routine import LOADS, Repertoire, Routine
from diagnostics import Diagnosis, FaultSet, SensorLayout, Verdict
from diagnostics.preprocessing.levels import LIGHT, LOW

if TYPE_CHECKING:
    from adaptfault.adaptation.adapter import Adapter

Floats = NDArray[np.float64]

_ENOUGH = 0.99  # of what the whole repertoire tests


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
    durations = np.array([len(one) / layout.rate for one in frames])
    weights = cell_weights(adapter, faulty)
    every = _every(repertoire, frames, layout, weights)
    begun = np.zeros(layout.n_cells, bool) if tested is None else tested
    chosen, reached = greedy(every.likely, weights, durations, begun, seconds, n)
    if not chosen:
        raise ValueError(
            f"no recording that tests anything new fits into {seconds:g} s; the shortest takes"
            f" {durations.min():.2g} s"
            if seconds is not None
            else "the last log tested all that the repertoire can test"
        )
    before = float(weights[begun].sum())
    return Routine(
        tuple(chosen),
        tuple(every.names[i] for i in chosen),
        (before, reached[-1]),
        tuple(reached),
        float(durations[chosen].sum()),
        every,
    )


def _every(
    repertoire: Recordings | Sequence[NDArray[Any]],
    frames: Sequence[Floats],
    layout: SensorLayout,
    weights: Floats,
) -> Repertoire:
    """Return what there is to choose from; ``frames``: of the repertoire, as they are checked."""
    if len(frames) < 2:
        raise ValueError(
            f"a repertoire has at least 2 recordings to choose from, got {len(frames)}"
        )
    loaded = loads(frames, layout)
    if not loaded.any():
        raise ValueError("no recording of the repertoire loads any cell: record contacts")
    names = tuple(f"recording {i}" for i in range(len(frames)))
    gestures = np.zeros(len(frames), np.int64)
    if isinstance(repertoire, Recordings):
        names = tuple(repertoire.names)
        if repertoire.labels is not None:
            gestures = np.asarray(repertoire.labels)
    return Repertoire.from_loads(loaded, gestures, names, weights)


def loads(frames: Sequence[Floats], layout: SensorLayout) -> NDArray[np.bool_]:
    """Return which cells each recording loads, bool ``[n, D]``.

    A cell is loaded where its reading leaves its rest by 5 % of the range that the array shows.

    Args:
        frames: recordings ``[T, D]``.
        layout: the array.
    """
    every = np.concatenate(frames)
    known = np.where(np.isfinite(every), every, np.nan)
    present = layout.is_cell & ~np.isnan(known).all(axis=0)
    rest = np.zeros(layout.n_cells)
    least = np.nanquantile(known[:, present], (LOW, 0.5, 1 - LOW), axis=0)
    falls = np.nanmean(known[:, present] - least[1]) < 0  # load lowers the readings
    rest[present] = least[2] if falls else least[0]
    span = np.nanmax(np.abs(known[:, present] - rest[present]), initial=0.0)
    loaded = np.zeros((len(frames), layout.n_cells), bool)
    for i, recording in enumerate(frames):
        most = np.nanmax(np.abs(recording - rest), axis=0, initial=0.0, where=~np.isnan(recording))
        loaded[i] = present & (most > LIGHT * span)
    return loaded


def cell_weights(adapter: Adapter, faulty: FaultSet | None = None) -> Floats:
    """Return what each cell matters, ``[D]``, of sum 1: the accuracy that is lost if it reads 0 and
    is not in F."""
    windows = adapter.validation
    present = adapter.layout.is_cell.copy()
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


def greedy(
    likely: Floats,
    weights: Floats,
    durations: Floats,
    tested: NDArray[np.bool_],
    seconds: float | None,
    n: int | None,
) -> tuple[list[int], list[float]]:
    """Return the chosen recordings, and the share that is tested after each.

    Args:
        likely: probability that a repetition loads a cell, ``[n, D]``.
        weights: of the cells, ``[D]``.
        durations: of the recordings, seconds ``[n]``.
        tested: cells that need no test, bool ``[D]``.
        seconds, n: the budget; None: as many as test 99 % of what all recordings test.
    """
    limit = len(likely) if n is None else n
    begun = np.zeros((LOADS, likely.shape[1]))
    begun[0] = ~tested
    most = share_tested(likely, weights, begun)
    left = np.inf if seconds is None else seconds
    fewer = begun
    chosen: list[int] = []
    reached: list[float] = []
    while len(chosen) < limit:
        gains = likely @ (weights * fewer.sum(axis=0)) / LOADS
        gains[chosen] = 0.0
        gains[durations > left] = 0.0
        rate = gains if seconds is None else gains / durations
        best = int(np.argmax(rate))
        if gains[best] <= 0:
            break
        chosen.append(best)
        fewer = _repeated(fewer, likely[best])
        left -= float(durations[best])
        reached.append(_share(fewer, weights))
        if n is None and seconds is None and reached[-1] >= _ENOUGH * most:
            break
    return chosen, reached


def share_tested(likely: Floats, weights: Floats, begun: Floats) -> float:
    """Return the share of the weights ``[D]`` that repetitions of all given recordings are expected
    to test.

    Args:
        likely: probability that a repetition loads a cell, ``[n, D]``.
        weights: of the cells, ``[D]``.
        begun: P(N = 0, 1, 2 loads) of each cell before, ``[3, D]``.
    """
    fewer = begun
    for one in likely:
        fewer = _repeated(fewer, one)
    return _share(fewer, weights)


def _repeated(fewer: Floats, likely: Floats) -> Floats:
    """Return P(N = 0, 1, 2 loads) ``[3, D]`` after one more repetition."""
    after = fewer * (1 - likely)
    after[1:] += fewer[:-1] * likely
    return after


def _share(fewer: Floats, weights: Floats) -> float:
    missing = np.arange(LOADS, 0, -1) @ fewer / LOADS
    return float((1 - missing) @ weights)
