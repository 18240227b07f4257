"""Self-diagnosis: gathers the evidence, weighs it, finds the root causes, and says what was not tested."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.faults import Fault, FaultKind
from diagnostics.layout import Line, SensorLayout
from diagnostics.reference import Expectation, NearestFrames, PooledNeighbourhood
from diagnostics.spatial import stuck_evidence
from diagnostics.temporal import LastRuns, last_runs
from diagnostics.verdicts import Diagnosis
from diagnostics.weighing import Weights, faulty_at
from diagnostics.wiring import Cause, explain

Recording = NDArray[np.float64]

_TOLERANCE = 0.005  # of full scale: how far a stuck cell's reading may wander, a converter's dither
_STEPS = 1.5  # and at least so many converter steps
_SAME_VALUE = 0.02  # of full scale: stuck cells this near to each other may share a cause


class SelfDiagnosis:
    """Finds the cells that hold one value whatever touches them, and the wires behind them.

    Not detected yet: cells that move but wrongly (aliased addresses, intermittent contacts, excess noise, drift).

    Args:
        layout: the array.
        false_discovery_rate: expected share of healthy cells in F; at most this is accepted.

    Attributes:
        expectation_: what healthy looks like, after :meth:`fit`.
        weights_: what evidence is worth, after :meth:`fit`.
        tolerance_: how near to a value counts as that value, in the layout's unit.
    """

    expectation_: NearestFrames | None = None
    weights_: Weights = Weights()
    tolerance_: float | None = None

    def __init__(self, layout: SensorLayout, *, false_discovery_rate: float = 0.01) -> None:
        self.layout = layout
        self.false_discovery_rate = false_discovery_rate

    def fit(self, recordings: ArrayLike | Sequence[ArrayLike]) -> SelfDiagnosis:
        """Learn from fault-free recordings, ``[T, D]`` or a list of them, what healthy looks like.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame.
        """
        healthy = _recordings(recordings, self.layout)
        self.tolerance_ = _tolerance(healthy, self.layout)
        self.expectation_ = NearestFrames.fit(healthy, self.layout.full_scale)
        self.weights_ = Weights.fit(healthy, self.layout, self.tolerance_)
        return self

    def diagnose(self, recordings: ArrayLike | Sequence[ArrayLike]) -> Diagnosis:
        """Judge every cell from a log: recordings ``[T, D]`` or a list of them, in time order.

        Without :meth:`fit`, cells are judged by the cells around them in the same log.

        Raises:
            ValueError: recordings that do not fit the layout, or hold no frame.
        """
        log = _recordings(recordings, self.layout)
        tolerance = self.tolerance_ or _tolerance(log, self.layout)
        present = self.layout.present.ravel()
        frames = np.concatenate(log)
        silent = present & np.isnan(frames).all(axis=0)  # never delivered a reading
        arrived = ~np.isnan(frames[:, present & ~silent]).all(axis=1)  # a lost frame is evidence of nothing
        kept = np.flatnonzero(arrived)
        lengths = [int(n.sum()) for n in np.split(arrived, np.cumsum([len(r) for r in log])[:-1])]
        frames = frames[arrived]
        if not len(frames):
            raise ValueError("the recordings hold no frame with a reading: nothing to diagnose")
        runs = last_runs(frames, tolerance)
        expectation: Expectation = self.expectation_ or PooledNeighbourhood(self.layout, frames)
        ratio = stuck_evidence(frames, lengths, runs, expectation, present & ~silent, self.layout.full_scale, tolerance)
        probability = np.where(silent, 1.0, self.weights_.probability(ratio, present & ~silent))
        faulty = faulty_at(probability, self.false_discovery_rate) | silent
        alive = present & ~faulty & runs.moved
        faults = self._faults(faulty, alive, silent, probability, runs, kept, tolerance)
        for fault in faults:
            cells = list(fault.cells)
            probability[cells] = np.maximum(probability[cells], fault.probability or 0.0)
        return Diagnosis(
            layout=self.layout,
            faults=faults,
            probability=probability,
            tested=alive | faulty,
            n_frames=sum(len(r) for r in log),
            n_recordings=len(log),
        )

    def _faults(
        self,
        faulty: NDArray[np.bool_],
        alive: NDArray[np.bool_],
        silent: NDArray[np.bool_],
        probability: NDArray[np.float64],
        runs: LastRuns,
        kept: NDArray[np.intp],
        tolerance: float,
    ) -> tuple[Fault, ...]:
        """Name the root causes of the faulty cells, one fault each."""
        full_scale = self.layout.full_scale
        faults: list[Fault] = []
        for kind, cells, value in _alike(faulty, silent, runs.value, full_scale, tolerance):
            # A live cell contradicts a broken wire; so does one that is faulty in another way.
            others = alive.copy()
            others[np.setdiff1d(np.flatnonzero(faulty), cells)] = True
            for cause in explain(cells, others, self.layout):
                starts = runs.start[list(cause.seen)]
                onset = int(np.median(starts)) if np.median(starts) > 0 else None
                faults.append(
                    Fault(
                        kind,
                        cause.cells,
                        line=cause.line,
                        value=value if cause.line else _value(kind, float(runs.value[cause.cells[0]]), full_scale),
                        onset=None if onset is None else int(kept[min(onset, len(kept) - 1)]),
                        probability=cause.probability if cause.line else float(probability[cause.cells[0]]),
                    )
                )
                faults[-1] = _with_reason(faults[-1], cause, self.layout, bool(silent[cause.cells[0]]))
        # The biggest cause first: that is what a technician starts with.
        return tuple(sorted(faults, key=lambda f: (-len(f.cells), f.cells)))


def _recordings(recordings: ArrayLike | Sequence[ArrayLike], layout: SensorLayout) -> list[Recording]:
    """Return recordings as a list of ``[T, D]``, T >= 1."""
    given: Any = recordings
    single = isinstance(given, np.ndarray) and (given.shape[1:] == layout.shape or given.ndim <= 2)
    checked = [layout.check_recording(r, f"recording {i}") for i, r in enumerate([given] if single else given)]
    checked = [r for r in checked if len(r)]
    if not checked:
        raise ValueError("no frames: expected recordings [T, D] with T >= 1")
    return checked


def _tolerance(recordings: Sequence[Recording], layout: SensorLayout) -> float:
    """Return how near to a value counts as that value: what a converter's dither needs, whatever its step."""
    sample = np.concatenate([r[:: max(1, len(r) // 20)].ravel() for r in recordings])
    steps = np.diff(np.unique(sample[np.isfinite(sample)]))
    steps = steps[steps > 1e-6 * layout.full_scale]  # what is finer is rounding
    step = float(steps.min()) if len(steps) else 0.0
    return max(_TOLERANCE * layout.full_scale, min(_STEPS * step, 2 * _TOLERANCE * layout.full_scale))


def _alike(
    faulty: NDArray[np.bool_],
    silent: NDArray[np.bool_],
    value: NDArray[np.float64],
    full_scale: float,
    tolerance: float,
) -> list[tuple[FaultKind, NDArray[np.intp], float | None]]:
    """Group faulty cells that could share a cause: the same kind and nearly the same value."""
    groups: list[tuple[FaultKind, NDArray[np.intp], float | None]] = []
    if silent.any():
        groups.append((FaultKind.OPEN, np.flatnonzero(silent), None))
    heard = faulty & ~silent
    low, high = heard & (value <= tolerance), heard & (value >= full_scale - tolerance)
    for kind, members, at in ((FaultKind.OPEN, low, 0.0), (FaultKind.SHORT, high, full_scale)):
        if members.any():
            groups.append((kind, np.flatnonzero(members), at))
    between = np.flatnonzero(heard & ~low & ~high)
    between = between[np.argsort(value[between])]
    for cells in np.split(between, np.flatnonzero(np.diff(value[between]) > _SAME_VALUE * full_scale) + 1):
        if len(cells):
            groups.append((FaultKind.STUCK, np.sort(cells), float(np.median(value[cells]))))
    return groups


def _value(kind: FaultKind, value: float, full_scale: float) -> float | None:
    if not np.isfinite(value):
        return None
    return {FaultKind.OPEN: 0.0, FaultKind.SHORT: full_scale}.get(kind, value)


def _with_reason(fault: Fault, cause: Cause, layout: SensorLayout, silent: bool) -> Fault:
    """Say in one plain sentence what was seen and what to check."""
    reads = "delivers no reading" if silent else f"reads {fault.value:.4g} {layout.unit}"
    since = "" if fault.onset is None else f" from frame {fault.onset} on ({fault.onset / layout.rate:.1f} s)"
    if fault.line is None:
        pad, row, column = layout.position(fault.cells[0])
        reason = f"pad {pad}, row {row}, column {column} is {fault.kind}: it {reads}{since}, whatever touches it"
    else:
        inferred = len(cause.cells) - len(cause.seen)
        also = f"; {inferred} more, not touched, are inferred" if inferred else ""
        reason = (
            f"{fault.line} is {fault.kind}: each of {len(cause.seen)} cells on it {reads}{since}{also};"
            f" check {_wire(fault.line)}"
        )
    return Fault(**{**fault.__dict__, "reason": reason})


def _wire(line: Line) -> str:
    return (
        "the converter channel and its cable" if line.kind == "converter" else f"the {line.kind} wire and its address"
    )
