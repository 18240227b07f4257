"""Monitor: diagnosis frame by frame in a control loop, with constant memory and the results of the
batch diagnosis."""

from __future__ import annotations

from collections.abc import Generator
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from diagnostics.evidence.life import Life
from diagnostics.evidence.stepping import finished
from diagnostics.preprocessing.array_likes import plain_array
from diagnostics.threads import one_thread
from diagnostics.wiring import Line

if TYPE_CHECKING:
    from diagnostics.decision.result import Diagnosis
    from diagnostics.diagnosis import SelfDiagnosis
    from diagnostics.faults import Fault

Key = tuple[Line | None, int]

_PROVEN_EVERY = 4  # segments, life is proven: a size
_LONGEST_GAP = 86400.0  # seconds; after a longer one the clock was set


class Monitor:
    """Monitors a running sensor and reports faults that are new, have changed, or are gone.

    After each segment of 32 frames the diagnosis is updated, in small steps over the frames that
    follow. While a wire breaks, healthy cells beside it look faulty for an evaluation, so a change
    is reported once the next evaluation confirms it, at most about 80 frames after it becomes
    detectable. The proof of life of all cells takes the frames in between, so that a dead cell that
    moves is reported up to some 200 frames later. :meth:`diagnosis` evaluates at once.

    Args:
        fitted: a fitted :class:`SelfDiagnosis`; an unfitted one is a cold start.

    Raises:
        ValueError: its engine judges whole logs.
    """

    def __init__(self, fitted: SelfDiagnosis) -> None:
        if fitted.engine == "model":
            raise ValueError("engine='model' judges whole logs: monitor with engine='events'")
        import scipy.ndimage  # imported here, not in the control loop
        import scipy.optimize  # noqa: F401

        with one_thread():  # looks for the libraries once
            pass
        self._diagnoser = fitted
        self._stream = fitted.stream()
        self._work: Generator[None, None, Diagnosis] | None = None
        self._proof: Generator[None, None, Life] | None = None
        proves = self._stream.reference.life is not None
        self._life = Life.unknown(fitted.layout.n_cells) if proves else None
        self._segments = 0  # since the last proof of life began
        self._known: dict[Key, Fault] = {}
        self._evaluated: Diagnosis | None = None
        self._settled: Diagnosis | None = None
        self._time: float | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or a pickle holds; an evaluation under way begins anew after the
        copy's next segment."""
        return {**vars(self), "_work": None, "_proof": None}

    def update(self, frame: ArrayLike, time: float | None = None) -> tuple[Fault, ...]:
        """Process one frame; return the faults that are new, changed, or gone.

        Args:
            frame: ``[D]`` or ``[pads, rows, cols]``, in the layout's unit; NaN = missing.
            time: time of the frame in seconds; frames missing from the sequence of times are
                counted as lost. A step back, or forward by more than a day, is a clock that was
                set: no frame counts as lost.

        Returns:
            The faults; one that is gone has probability 0.

        Raises:
            ValueError: a frame of another shape, or a time that is not finite; the frame is not
                processed.
        """
        layout = self._diagnoser.layout
        reading = np.asarray(plain_array(frame), dtype=np.float64).reshape(-1)
        if reading.size != layout.n_cells:
            raise ValueError(
                f"expected a frame of {layout.n_cells} readings ({layout}), got {reading.size}"
            )
        if time is not None:
            if not np.isfinite(time):
                raise ValueError(f"time {time}: expected seconds, or None where it is unknown")
            if self._time is not None and 0 < time - self._time <= _LONGEST_GAP:
                self._stream.miss(round((time - self._time) * layout.rate) - 1)
            self._time = time
        due = self._stream.due
        with one_thread():
            if self._stream.extend(reading[None]):
                self._begin()
            elif not due:
                return self._step()
        return ()

    def _begin(self) -> None:
        """Begin to evaluate the frames so far, unless an evaluation is under way."""
        if self._work is None:
            self._work = self._diagnoser.steps(copy(self._stream), life=self._life)
        self._segments += 1
        if self._proof is None and self._life is not None and self._segments >= _PROVEN_EVERY:
            self._proof = self._diagnoser.proof(copy(self._stream))
            self._segments = 0

    def _step(self) -> tuple[Fault, ...]:
        """Do a step of the evaluation, or else of the proof of life; return the changes when it is
        complete."""
        if self._work is not None:
            try:
                next(self._work)
            except StopIteration as end:
                self._work = None
                return self._changes(end.value)
        elif self._proof is not None:
            try:
                next(self._proof)
            except StopIteration as end:
                self._proof = None
                self._life = end.value
        return ()

    def flush(self) -> tuple[Fault, ...]:
        """Evaluate all frames so far at once; return the faults that are new, changed, or gone.

        After it, what was told is what :meth:`diagnosis` tells. It takes as long as that one, some
        hundred milliseconds: it belongs to the end of a log, or to a pause of the control loop.
        """
        if not self._stream.received.any():
            return ()
        self._work = None
        self._proof = None
        self._segments = 0
        with one_thread():
            if self._life is not None:
                self._life = finished(self._diagnoser.proof(copy(self._stream)))
            steps = self._diagnoser.steps(copy(self._stream), life=self._life)
            return self._changes(finished(steps), final=True)

    def diagnosis(self) -> Diagnosis:
        """Return the diagnosis of all frames so far, as :meth:`SelfDiagnosis.diagnose` does.

        Raises:
            ValueError: no frame with a reading was received yet.
        """
        return self._diagnoser.evaluate(self._stream)

    @property
    def faults(self) -> tuple[Fault, ...]:
        """The faults that were told and are not gone, without a new evaluation."""
        return tuple(self._known.values())

    @property
    def evaluated(self) -> Diagnosis | None:
        """The diagnosis of the last evaluation that is complete, without a new one; of the one
        before it where the last one says what was not told yet. None before the first."""
        return self._settled

    def _changes(self, diagnosis: Diagnosis, *, final: bool = False) -> tuple[Fault, ...]:
        """Take in a complete evaluation; return what it says as the one before it did, and was not
        told yet. ``final``: no further one is needed."""
        before = diagnosis if final else self._evaluated
        self._evaluated = diagnosis
        if before is None:
            self._settled = None if diagnosis.faults else diagnosis
            return ()
        told = dict(self._known)
        changes = []
        for fault in diagnosis.faults:
            key = _key(fault)
            known = told.get(key)
            if known is not None and (known.kind, known.cells) == (fault.kind, fault.cells):
                told[key] = fault
            elif _is_in(fault, before):
                told[key] = fault
                changes.append(fault)
        found = {_key(fault) for fault in diagnosis.faults}
        current = {cell for key in found & told.keys() for cell in told[key].cells}
        faulty = set(diagnosis.fault_set | before.fault_set)
        for key, fault in self._known.items():
            if key in found:
                continue
            if faulty.isdisjoint(fault.cells):
                del told[key]
                text = f"gone since about frame {diagnosis.n_frames}: {fault.reason}"
                changes.append(replace(fault, probability=0.0, reason=text))
            elif current.issuperset(fault.cells):  # told with their wire: none has recovered
                del told[key]
        self._known = told
        if found == told.keys() or self._settled is not before:
            self._settled = diagnosis
        return tuple(changes)


def _key(fault: Fault) -> Key:
    return fault.line, fault.cells[0] if fault.line is None else -1


def _is_in(fault: Fault, diagnosis: Diagnosis) -> bool:
    """Return whether a diagnosis says so, too: it names the wire, or holds all cells faulty."""
    if fault.line is not None and any(other.line == fault.line for other in diagnosis.faults):
        return True
    return diagnosis.fault_set.mask[list(fault.cells)].all().item()
