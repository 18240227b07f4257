"""Diagnosis frame by frame, in a control loop: constant memory, no long pauses, and the same answers as in one go."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import nullcontext
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diagnostics.layout import Line

if TYPE_CHECKING:
    from diagnostics.decision.result import Diagnosis
    from diagnostics.diagnosis import SelfDiagnosis
    from diagnostics.faults import Fault

Key = tuple[Line | None, int]


class Monitor:
    """Watches a running sensor and reports faults that are new, have changed, or are gone.

    Whenever a segment of 32 frames is complete, all is judged anew, a little of the work with each frame that follows:
    a fault is reported some 50 frames after it shows, at the latest. :meth:`diagnosis` judges at once.

    Args:
        fitted: a fitted :class:`SelfDiagnosis`; one that is not fitted judges each cell by those around it.
    """

    def __init__(self, fitted: SelfDiagnosis) -> None:
        import scipy.ndimage  # now, not in the loop
        import scipy.optimize  # noqa: F401
        from threadpoolctl import ThreadpoolController

        # Threads that wait for each other on a busy robot cost far more than they save on such small matrices.
        self._threads = ThreadpoolController()
        self._diagnoser = fitted
        self._stream = fitted.stream()
        self._work: Generator[None, None, Diagnosis] | None = None
        self._known: dict[Key, Fault] = {}
        self._time: float | None = None

    def update(self, frame: ArrayLike, time: float | None = None) -> tuple[Fault, ...]:
        """Take in one frame; return the faults that are newly found, changed, or gone.

        Args:
            frame: ``[D]`` or ``[pads, rows, cols]``, in the layout's unit; NaN = missing.
            time: when it was taken, in seconds; frames that the clock says are missing are counted as lost.

        Returns:
            A fault that is gone has probability 0, and its reason says so.

        Raises:
            ValueError: a frame of another shape.
        """
        layout = self._diagnoser.layout
        reading = np.asarray(frame, dtype=np.float64).reshape(-1)
        if reading.size != layout.n_cells:
            raise ValueError(f"expected a frame of {layout.n_cells} readings ({layout}), got {reading.size}")
        if time is not None:
            if self._time is not None:
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
                return self._news(end.value)
        return ()

    def diagnosis(self) -> Diagnosis:
        """Judge all frames so far, as :meth:`SelfDiagnosis.diagnose` does.

        Raises:
            ValueError: no frame with a reading has come yet.
        """
        return self._diagnoser.evaluate(self._stream)

    def _news(self, diagnosis: Diagnosis) -> tuple[Fault, ...]:
        now = {(fault.line, fault.cells[0] if fault.line is None else -1): fault for fault in diagnosis.faults}
        news = [fault for key, fault in now.items() if self._differs(self._known.get(key), fault)]
        faulty = diagnosis.fault_set
        for key, fault in self._known.items():
            # A cell whose wire was found to be the cause has not recovered.
            if key not in now and not set(fault.cells) & faulty:
                text = f"gone since about frame {diagnosis.n_frames}: {fault.reason}"
                news.append(replace(fault, probability=0.0, reason=text))
        self._known = now
        return tuple(news)

    @staticmethod
    def _differs(before: Fault | None, now: Fault) -> bool:
        return before is None or (before.kind, before.cells) != (now.kind, now.cells)
