"""Prediction and monitoring in the robot's loop; newly deployed versions take over between two
frames."""

from __future__ import annotations

import copy
import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.bundle.checksummed_json import Damaged
from adaptfault.bundle.pointer import file_stamp
from adaptfault.bundle.reload import Reload
from adaptfault.data.windows import finite_windows, scale
from adaptfault.inspection.converter_range import within_range
from adaptfault.models.accumulation import ContactDecision
from adaptfault.prediction.loaded import Loader, start_any
from adaptfault.prediction.reading import Reading
from diagnostics import Diagnosis, Fault, FaultSet, Monitor, Scan, SelfDiagnosis

if TYPE_CHECKING:
    from adaptfault.bundle.bundle import Bundle
    from adaptfault.bundle.versions import Version

_POLL = 1.0  # seconds between two checks of the bundle's pointer

_log = logging.getLogger(__name__)


class Predictor:
    """Predicts, monitors, and switches to newly deployed versions; needs no torch where ONNX
    Runtime is installed.

    A new version is loaded in a thread and takes over between two frames. A version that cannot be
    loaded is logged, and the running one continues. Not thread-safe: one thread may use a predictor
    at a time.

    Args:
        open_bundle: opens the bundle as it is now on disk; see :meth:`load`.
        accumulate: :meth:`stream` also accumulates the probabilities of the windows of one contact,
            calibrated on validation recordings, and begins anew at its release
            (:mod:`adaptfault.models.accumulation`).
        sets: :meth:`stream` also gives the set of classes of each window that holds the true one
            with probability 1 - ``sets``; None: no sets.
        wait: for replays, see :class:`diagnostics.Monitor`.

    Raises:
        FileNotFoundError, ValueError: no version of the bundle can be loaded; ``accumulate`` or
            ``sets`` with a regression, ``sets`` that is no share.
    """

    def __init__(
        self,
        open_bundle: Callable[[], Bundle],
        *,
        accumulate: bool = False,
        sets: float | None = None,
        wait: bool = False,
    ) -> None:
        self._wait = wait
        self._sets = sets
        self._accumulate = accumulate
        self._loader = Loader(open_bundle)
        bundle = open_bundle()
        self._reload = Reload(self._loader, partial(file_stamp, bundle.pointer), _POLL)
        self._running = start_any(bundle)
        self._diagnoser = _reference(bundle)
        self._monitor = Monitor(self._diagnoser, wait=self._wait)
        self.layout = bundle.layout
        self.class_names = tuple(bundle.class_names)
        self.outside = 0  # readings outside the range so far
        self._last: NDArray[np.float32]  # last reading of each cell that is not missing
        self._frames: NDArray[np.float32]  # last frames, scaled
        if accumulate and self.task == "regression":
            raise ValueError(
                "a regression has no class probabilities to accumulate: leave accumulate out"
            )
        if sets is not None:
            none = np.zeros((0, self._running.model.length, self.layout.n_cells), np.float32)
            self._running.model.prediction_sets(none, sets)
        self._decision = self._new_decision()
        self.reset()

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        keys: Sequence[str | os.PathLike[str]] | None = None,
        least_serial: int = 0,
        accumulate: bool = False,
        sets: float | None = None,
        wait: bool = False,
    ) -> Predictor:
        """Open the bundle in a folder and start its active version; ``accumulate``, ``sets`` and
        ``wait`` as in the class.

        Args:
            path: of the bundle.
            keys, least_serial: whose signature is needed, see :class:`Bundle`.

        Raises:
            FileNotFoundError: the folder holds no bundle, or a file is missing.
            ValueError: the active version and all earlier ones are damaged, or not signed by one of
                the keys.
        """
        from adaptfault.bundle.bundle import Bundle

        return cls(
            lambda: Bundle.open(path, keys=keys, least_serial=least_serial),
            accumulate=accumulate,
            sets=sets,
            wait=wait,
        )

    def sibling(self) -> Predictor:
        """Return a predictor of the running version for another device; nothing is read for it."""
        other = copy.copy(self)
        other._monitor = Monitor(self._diagnoser, wait=self._wait)
        other._loader = copy.copy(self._loader)
        other._loader.told = set()
        other._reload = self._reload.sibling(other._loader)
        other.outside = 0
        other._decision = other._new_decision()
        other.reset()
        return other

    @property
    def fault_set(self) -> FaultSet:
        """F, the cells that the running version does not use."""
        return self._running.model.fault_set

    @property
    def running(self) -> Version:
        """The running version: its model, and how readings reach it (``Version.undo``)."""
        return self._running.version

    @property
    def evaluated(self) -> Diagnosis | None:
        """What the monitor found last, as :attr:`diagnostics.Monitor.evaluated`."""
        return self._monitor.evaluated

    @property
    def version(self) -> int:
        """Number of the running version."""
        return self._running.version.number

    @property
    def task(self) -> str:
        """ "classification" or "regression"."""
        return self._running.model.task

    @property
    def runtime(self) -> str:
        """The runtime, "onnx" or "torch"."""
        return self._running.model.runtime

    def predict(self, x: NDArray[Any]) -> NDArray[Any]:
        """Return the class of each window ``[N, T, D]`` on the 0..1 scale, int64 ``[N]``, or its
        values, float32 ``[N, k]``."""
        self._keep_up()
        return self._running.model.predict(self._rewired(finite_windows(x)))

    def predict_proba(self, x: NDArray[Any]) -> NDArray[np.float32]:
        """Return class probabilities ``[N, n_classes]`` of windows ``[N, T, D]``; F's cells may
        hold anything.

        Raises:
            ValueError: the model is a regression.
        """
        self._keep_up()
        return self._running.model.predict_proba(self._rewired(finite_windows(x)))

    def prediction_sets(
        self, x: NDArray[Any], alpha: float = 0.1, *, by_class: bool = False
    ) -> NDArray[np.bool_]:
        """Return the sets of classes of windows ``[N, T, D]``, as
        :meth:`~adaptfault.prediction.inference.Inference.prediction_sets`."""
        self._keep_up()
        x = self._rewired(finite_windows(x))
        return self._running.model.prediction_sets(x, alpha, by_class=by_class)

    def stream(self, frame: ArrayLike, time: float | None = None) -> Reading:
        """Process one frame and predict from the window that ends with it.

        A missing reading (NaN, infinite, or more than one full scale outside the range) is replaced
        by the last reading of its cell, 0 before the first, as in ``make_windows``.

        Args:
            frame: ``[D]`` or ``[pads, rows, cols]`` in the layout's unit.
            time: of the frame, seconds; frames missing between two times are reported as lost.
                None: unknown.

        Raises:
            ValueError: the frame has another shape, or the time is not finite.
        """
        given = self.layout.check_frame(frame)
        if time is not None and not np.isfinite(time):
            raise ValueError(f"time {time}: expected seconds, or None where it is unknown")
        given = self._running.version.undo(given)
        reading, outside = within_range(given, self.layout)
        if outside and not self.outside:
            _log.warning(
                "%d readings outside the range of %s count as missing", outside, self.layout
            )
        self.outside += outside
        events = self._monitor.update(given, time)
        self._keep_up()
        model = self._running.model
        scaled = scale(reading, self.layout)
        self._last = np.where(np.isnan(scaled), self._last, scaled)
        # All cells are kept, the dropped ones too: the next version may use them.
        self._frames = np.concatenate([self._frames, self._last[None]])[-model.length :]
        label = probabilities = name = values = classes = None
        full = len(self._frames) == model.length
        if full and model.task == "regression":
            values = model.predict(self._frames[None])[0]
        elif full:
            probabilities = model.predict_proba(self._frames[None])[0]
            label = int(probabilities.argmax())
            name = self.class_names[label] if self.class_names else None
            if self._sets is not None and model.sets is not None:
                (inside,) = model.sets_of(probabilities[None], self._sets)
                classes = tuple(np.flatnonzero(inside).tolist())
        contact = (
            None if self._decision is None else self._decision.update(self._last, probabilities)
        )
        return Reading(
            label,
            probabilities,
            model.fault_set,
            events,
            self.version,
            contact,
            name,
            self._monitor.faults,
            values,
            classes,
        )

    def scan(self, scan: Scan) -> tuple[Fault, ...]:
        """Take a scan of the read-out for evidence of the monitor, as
        :meth:`diagnostics.Monitor.scan`.

        Raises:
            ValueError: a scan of another array; it is not taken.
        """
        source = self._running.version.source
        if scan.readings.shape[1] == len(source):
            scan = replace(scan, readings=scan.readings[:, source])
        return self._monitor.scan(scan)

    @property
    def faults(self) -> tuple[Fault, ...]:
        """The faults that the monitor told and are not gone, as in :class:`Reading`."""
        return self._monitor.faults

    def _new_decision(self) -> ContactDecision | None:
        """Return a decision for the running version, without contact; None where the predictor does
        not accumulate."""
        if not self._accumulate:
            return None
        model = self._running.model
        healthy = self.layout.is_cell & ~model.fault_set.mask
        return ContactDecision(model.contact, healthy, model.length)

    def reset(self) -> None:
        """Begin a new recording: no window spans it. The monitor keeps its state."""
        self._frames = np.zeros((0, self.layout.n_cells), np.float32)
        self._last = np.zeros(self.layout.n_cells, np.float32)
        if self._decision is not None:
            self._decision.reset()

    def confirm(self) -> bool:
        """End the probation of the running version.

        Returns:
            False, without a confirmation, where another version is active that does not run here
            yet, or the bundle cannot be written (logged).
        """
        bundle = self._running.bundle
        try:
            if bundle.active().number != self.version:
                return False
            bundle.confirm()
        except (OSError, Damaged) as error:
            self._loader.tell(f"version {self.version} stays on probation: {error}")
            return False
        return True

    def __str__(self) -> str:
        return f"version {self.version}: {self._running.model}"

    def _rewired(self, x: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return windows as the model reads them; see ``Version.undo``."""
        version = self._running.version
        # the model refuses another shape
        return version.undo(x, 1.0) if x.shape[-1:] == version.source.shape else x

    def _keep_up(self) -> None:
        """Switch to a new version once it is loaded; check for one every second."""
        before = self._running
        self._running = self._reload.poll(before) or before
        if self._running is before:
            return
        # the frames so far read otherwise
        if before.version.readings != self._running.version.readings:
            self._diagnoser = _reference(self._running.bundle)
            self._monitor = Monitor(self._diagnoser, wait=self._wait)
            self.reset()
        self._decision = self._new_decision()
        _log.info("version %d runs now", self.version)


def _reference(bundle: Bundle) -> SelfDiagnosis:
    """Return the bundle's diagnoser; where it cannot be read, one without a reference, so that
    prediction goes on."""
    try:
        return bundle.diagnoser()
    except (OSError, Damaged) as error:
        _log.warning("monitoring without the healthy reference: %s", error)
        return SelfDiagnosis(bundle.layout)
