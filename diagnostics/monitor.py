"""Monitor: diagnosis frame by frame in a control loop, with constant memory and the results of the batch diagnosis."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import nullcontext
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from diagnostics.layout import Line

if TYPE_CHECKING:
    from diagnostics.decision.result import Diagnosis
    from diagnostics.diagnosis import SelfDiagnosis
    from diagnostics.faults import Fault

Key = tuple[Line | None, int]

_LONGEST_GAP = 86400.0  # seconds; after a longer one the clock was set


class Monitor:
    """Monitors a running sensor and reports faults that are new, have changed, or are gone.

    After each segment of 32 frames the diagnosis is updated, in small steps over the frames that follow: a fault is
    reported at most about 50 frames after it becomes detectable. :meth:`diagnosis` evaluates at once.

    Args:
        fitted: a fitted :class:`SelfDiagnosis`; an unfitted one is a cold start.
    """

    def __init__(self, fitted: SelfDiagnosis) -> None:
        import scipy.ndimage  # imported here, not in the control loop
        import scipy.optimize  # noqa: F401
        from threadpoolctl import ThreadpoolController

        # On small matrices the synchronisation of threads costs more than it saves.
        self._threads = ThreadpoolController()
        self._diagnoser = fitted
        self._stream = fitted.stream()
        self._work: Generator[None, None, Diagnosis] | None = None
        self._known: dict[Key, Fault] = {}
        self._time: float | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or a pickle holds; an evaluation under way begins anew after the copy's next segment."""
        state = {**vars(self), "_work": None}
        del state["_threads"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        from threadpoolctl import ThreadpoolController

        vars(self).update(state)
        self._threads = ThreadpoolController()

    def update(self, frame: ArrayLike, time: float | None = None) -> tuple[Fault, ...]:
        """Process one frame; return the faults that are new, changed, or gone.

        Args:
            frame: ``[D]`` or ``[pads, rows, cols]``, in the layout's unit; NaN = missing.
            time: time of the frame in seconds; frames missing from the sequence of times are counted as lost. A step
                back, or forward by more than a day, is a clock that was set: no frame counts as lost.

        Returns:
            The faults; one that is gone has probability 0.

        Raises:
            ValueError: a frame of another shape, or a time that is not finite; the frame is not processed.
        """
        layout = self._diagnoser.layout
        reading = np.asarray(frame, dtype=np.float64).reshape(-1)
        if reading.size != layout.n_cells:
            raise ValueError(f"expected a frame of {layout.n_cells} readings ({layout}), got {reading.size}")
        if time is not None:
            if not np.isfinite(time):
                raise ValueError(f"time {time}: expected seconds, or None where it is unknown")
            if self._time is not None and 0 < time - self._time <= _LONGEST_GAP:
                self._stream.miss(round((time - self._time) * layout.rate) - 1)
            self._time = time
        due = self._stream.due
        with self._threads.limit(limits=1) if due else nullcontext():
            completed = self._stream.extend(reading[None])
        if self._work is None and completed:
            self._work = self._diagnoser.steps(copy(self._stream))
        elif self._work is not None and not due:
            try:
                with self._threads.limit(limits=1):
                    next(self._work)
            except StopIteration as end:
                self._work = None
                return self._changes(end.value)
        return ()

    def diagnosis(self) -> Diagnosis:
        """Return the diagnosis of all frames so far, as :meth:`SelfDiagnosis.diagnose` does.

        Raises:
            ValueError: no frame with a reading was received yet.
        """
        return self._diagnoser.evaluate(self._stream)

    def _changes(self, diagnosis: Diagnosis) -> tuple[Fault, ...]:
        now = {(fault.line, fault.cells[0] if fault.line is None else -1): fault for fault in diagnosis.faults}
        changes = []
        for key, fault in now.items():
            before = self._known.get(key)
            if before is None or (before.kind, before.cells) != (fault.kind, fault.cells):
                changes.append(fault)
        faulty = diagnosis.fault_set
        for key, fault in self._known.items():
            # A cell that is now part of the fault of a wire has not recovered.
            if key not in now and not set(fault.cells) & faulty:
                text = f"gone since about frame {diagnosis.n_frames}: {fault.reason}"
                changes.append(replace(fault, probability=0.0, reason=text))
        self._known = now
        return tuple(changes)
