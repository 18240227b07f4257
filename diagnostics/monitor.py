"""Monitor: diagnosis frame by frame in a control loop, with constant memory and the results of the
batch diagnosis."""

from __future__ import annotations

import logging
from concurrent.futures import Future
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.evidence.read_out import judge_scan, with_scan
from diagnostics.preprocessing.array_likes import plain_array
from diagnostics.preprocessing.readings import SEGMENT
from diagnostics.threads import Worker, one_thread
from diagnostics.wiring import Line

if TYPE_CHECKING:
    from diagnostics.decision.result import Diagnosis
    from diagnostics.diagnosis import SelfDiagnosis
    from diagnostics.evidence.read_out import ReadOut, Scan
    from diagnostics.evidence.stream_state import StreamState
    from diagnostics.faults import Fault

_log = logging.getLogger(__name__)

Key = tuple[Line | None, int]
Frames = list[tuple[int, NDArray[np.float64]]]  # lost before it, frame [D]

# seconds that an evaluation takes on a busy machine: for a cell, and for a reading of its record
_A_CELL = 1e-3
_A_READING = 2e-5
_LATE = 10  # times the frames that an evaluation is given
_LONGEST_GAP = 86400.0  # seconds; after a longer one the clock was set


class Monitor:
    """Monitors a running sensor and reports faults that are new, have changed, or are gone.

    After each segment of 32 frames a thread of the monitor's own evaluates them, and the 16th frame
    after it tells what changed. A large array, and a long log, are given more frames: those of 1 ms
    a cell and of 20 us a reading of the record that is judged, at the rate of the array.

    A control loop must not stall: where the evaluation is not complete by then, the first frame by
    which it is tells. A replay feeds frames faster than the sensor does, and would be told late, or
    only by :meth:`flush`: it waits (``wait``), and which frame tells which fault does not depend on
    the speed of the machine.

    While a wire breaks, healthy cells beside it look faulty for an evaluation, so a change is
    reported once the next evaluation confirms it, at most about 80 frames after it becomes
    detectable in a short log. :meth:`diagnosis` evaluates at once.

    Args:
        fitted: a fitted :class:`SelfDiagnosis`; an unfitted one is a cold start.
        wait: for replays: the frame that is to tell waits until the evaluation is complete.
    """

    def __init__(self, fitted: SelfDiagnosis, *, wait: bool = False) -> None:
        import scipy.ndimage  # imported here, not in the control loop
        import scipy.optimize  # noqa: F401

        self._diagnoser = fitted
        self._waits = wait
        self._record = _Record(fitted.stream())
        self._work: Future[_Record] | _Record | None = None  # with those given
        self._given: Frames = []
        self._new: Frames = []
        self._told_after, self._every = self._pace(0)
        self._worker = Worker()
        self._known: dict[Key, Fault] = {}
        self._evaluated: Diagnosis | None = None  # without the scan, as the next one
        self._settled: Diagnosis | None = None
        self._read_out: ReadOut | None = None
        self._time: float | None = None
        self._warned = False

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or a pickle holds; it waits for an evaluation under way."""
        work = None if self._work is None else _result(self._work)
        return {**vars(self), "_new": list(self._new), "_work": work, "_worker": Worker()}

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
            Exception: what an evaluation raised; the frames that it took in count as lost.
        """
        layout = self._diagnoser.layout
        reading = np.array(plain_array(frame), dtype=np.float64).reshape(-1)
        if reading.size != layout.n_cells:
            raise ValueError(
                f"expected a frame of {layout.n_cells} readings ({layout}), got {reading.size}"
            )
        lost = 0
        if time is not None:
            if not np.isfinite(time):
                raise ValueError(f"time {time}: expected seconds, or None where it is unknown")
            if self._time is not None and 0 < time - self._time <= _LONGEST_GAP:
                lost = max(round((time - self._time) * layout.rate) - 1, 0)
            self._time = time
        self._new.append((lost, reading))
        changes: tuple[Fault, ...] = ()
        if self._work is not None and len(self._new) >= self._told_after:
            if not self._waits and not _is_complete(self._work):
                self._warn()
                return ()
            changes = self._collect(self._work)
        if len(self._new) >= self._every:
            self._begin()
        return changes

    def _warn(self) -> None:
        """Say once that evaluations come far too late."""
        if self._warned or len(self._new) < _LATE * self._told_after:
            return
        self._warned = True
        _log.warning(
            "frames come faster than they can be evaluated: %d since the last evaluation began;"
            " call flush() for what they show, or replay with Monitor(fitted, wait=True)",
            len(self._new),
        )

    def scan(self, scan: Scan) -> tuple[Fault, ...]:
        """Take a scan of the read-out for evidence, in place of the one before; return the faults
        that are new or changed by it, at once.

        Its frames are none of :meth:`update`, and may come before the first of them. A scan that
        was interrupted tells nothing, and the one before stays. What an earlier scan found and this
        one does not is told as gone with the next evaluation.

        Raises:
            ValueError: a scan of another array; it is not taken.
        """
        found = judge_scan(scan, self._diagnoser.layout)
        if not (found.alive | found.broken).any():
            return ()
        self._read_out = found
        changes = []
        for fault in found.faults:
            known = self._known.get(_key(fault))
            self._known[_key(fault)] = fault
            if known is None or (known.kind, known.cells) != (fault.kind, fault.cells):
                changes.append(fault)
        return tuple(changes)

    def _pace(self, pieces: int) -> tuple[int, int]:
        """Return after how many frames an evaluation of so many pieces tells what changed, and the
        next one begins."""
        layout = self._diagnoser.layout
        takes = layout.n_cells * (_A_CELL + _A_READING * pieces) * layout.rate
        told_after = max(SEGMENT // 2, ceil(takes))
        return told_after, SEGMENT * ceil(told_after / SEGMENT)

    def _begin(self) -> None:
        """Begin to evaluate the new frames."""
        self._told_after, self._every = self._pace(self._record.stream.pieces)
        self._given = self._new
        self._new = []
        self._work = self._worker.begin(
            partial(_evaluated, self._diagnoser, self._record, self._given)
        )

    def _collect(self, work: Future[_Record] | _Record) -> tuple[Fault, ...]:
        """Return the changes of an evaluation; wait for it."""
        try:
            self._record = _result(work)
        except Exception:
            stream = copy(self._record.stream)
            stream.miss(sum(lost + 1 for lost, _ in self._given))
            self._record = replace(self._record, stream=stream, diagnosis=None)
            self._work = None
            raise
        self._work = None
        diagnosis = self._record.diagnosis
        return () if diagnosis is None else self._changes(diagnosis)

    def _so_far(self) -> _Record:
        """Return the record with all frames so far."""
        record = self._record if self._work is None else _result(self._work)
        stream = copy(record.stream)
        _extend(stream, self._new)
        return replace(record, stream=stream)

    def flush(self) -> tuple[Fault, ...]:
        """Evaluate all frames so far at once; return the faults that are new, changed, or gone.

        After it, what was told is what :meth:`diagnosis` tells. It takes as long as that one, some
        hundred milliseconds: it belongs to the end of a log, or to a pause of the control loop.
        """
        record = self._so_far()
        if not record.stream.complete().received.any():
            return ()
        diagnosis = self._diagnoser.evaluate(record.stream)
        self._record = replace(record, diagnosis=diagnosis)
        self._work = None
        self._new = []
        return self._changes(diagnosis, final=True)

    def diagnosis(self) -> Diagnosis:
        """Return the diagnosis of all frames so far, with the scan, as
        :meth:`SelfDiagnosis.diagnose` does.

        Raises:
            ValueError: no frame with a reading was received yet.
        """
        return self._with_scan(self._diagnoser.evaluate(self._so_far().stream))

    @property
    def faults(self) -> tuple[Fault, ...]:
        """The faults that were told and are not gone, without a new evaluation."""
        return tuple(self._known.values())

    @property
    def evaluated(self) -> Diagnosis | None:
        """The diagnosis of the last evaluation that is complete, without a new one; of the one
        before it where the last one says what was not told yet. None before the first."""
        return None if self._settled is None else self._with_scan(self._settled)

    def _with_scan(self, diagnosis: Diagnosis) -> Diagnosis:
        return diagnosis if self._read_out is None else with_scan(diagnosis, self._read_out)

    def _changes(self, evaluated: Diagnosis, *, final: bool = False) -> tuple[Fault, ...]:
        """Take in a complete evaluation; return what it says as the one before it did, and was not
        told yet. ``final``: no further one is needed."""
        last = evaluated if final else self._evaluated
        self._evaluated = evaluated
        if last is None:
            self._settled = None if evaluated.faults else evaluated
            return ()
        diagnosis = self._with_scan(evaluated)
        before = self._with_scan(last)
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
        if found == told.keys() or self._settled is not last:
            self._settled = evaluated
        return tuple(changes)


def _key(fault: Fault) -> Key:
    return fault.line, fault.cells[0] if fault.line is None else -1


def _is_in(fault: Fault, diagnosis: Diagnosis) -> bool:
    """Return whether a diagnosis says so, too: it names the wire, or holds all cells faulty."""
    if fault.line is not None and any(other.line == fault.line for other in diagnosis.faults):
        return True
    return diagnosis.fault_set.mask[list(fault.cells)].all().item()


@dataclass(frozen=True)
class _Record:
    """What the frames leave.

    Attributes:
        stream: the state after them; it does not change any more.
        diagnosis: None: the last frames completed no segment, and were not evaluated.
    """

    stream: StreamState
    diagnosis: Diagnosis | None = None


def _is_complete(work: Future[_Record] | _Record) -> bool:
    """Return whether an evaluation is."""
    return isinstance(work, _Record) or work.done()


def _result(work: Future[_Record] | _Record) -> _Record:
    """Wait for an evaluation."""
    return work if isinstance(work, _Record) else work.result()


def _extend(stream: StreamState, given: Frames) -> bool:
    """Take in frames; return whether a segment was completed."""
    frames = np.array([frame for _, frame in given])
    lost = np.array([before for before, _ in given], np.intp)
    gaps = np.flatnonzero(lost)
    completed = False
    with one_thread():
        for before, part in zip((0, *lost[gaps].tolist()), np.split(frames, gaps), strict=True):
            stream.miss(before)
            if len(part):
                completed |= stream.extend(part)
    return completed


def _evaluated(diagnoser: SelfDiagnosis, record: _Record, given: Frames) -> _Record:
    """Return the record after more frames."""
    stream = copy(record.stream)
    completed = _extend(stream, given)
    record = replace(record, stream=stream, diagnosis=None)
    if not completed or not stream.received.any():
        return record
    return replace(record, diagnosis=diagnoser.evaluate(stream))
