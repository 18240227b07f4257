"""The sessions of all devices of a station: what watches each of them, and how it is recorded."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

from adaptfault.acquisition.recorder import Recorder
from adaptfault.acquisition.scanning import Scans
from adaptfault.acquisition.session import Event, Session, StreamingPredictor
from adaptfault.acquisition.switch import parse_when
from diagnostics import FaultSet, Monitor, SelfDiagnosis, SensorLayout

if TYPE_CHECKING:
    from adaptfault.imputation.restorer import Restorer


class Sessions:
    """The sessions of a station; see :class:`~adaptfault.acquisition.station.Station` for the
    arguments and errors.

    Attributes:
        of: the session of each device.
        first: what watches the first device.
    """

    def __init__(
        self,
        layout: SensorLayout | None,
        bundle: str | None,
        trust: dict[str, Any],
        record: str | os.PathLike[str] | None,
        when: str,
        accumulate: bool,
        sets: float | None,
        lines_held: bool | None,
        say: Callable[[str], None],
    ) -> None:
        self.of: dict[str, Session] = {}
        self.bundle = bundle
        self.record = record
        self.accumulate = accumulate
        self.sets = sets
        self.lines_held = lines_held
        self._trust = trust
        self._command: bool | None = None  # the last command, also for devices that come later
        self._say = say
        if accumulate and bundle is None:
            raise ValueError("--accumulate needs BUNDLE: classes are accumulated over a contact")
        if sets is not None and bundle is None:
            raise ValueError("--sets needs BUNDLE: its model classifies the windows")
        if sets is not None and accumulate:
            raise ValueError("--sets are of windows, --accumulate is of contacts: give one of them")
        predictor = None if bundle is None else self._predictor()
        layout = layout if predictor is None else predictor.layout
        if layout is None:
            raise ValueError("the array is unknown: give a layout or a bundle")
        self.layout = layout
        self._rule = None if record is None else parse_when(when, layout)
        if record is not None:
            with Recorder(record, layout):  # a folder that cannot be used raises now
                pass
        # a monitor takes a second, so before the first frame
        self.first = self._monitor() if predictor is None else predictor
        self._ready = [self.first]

    def begun(self, device: str) -> Session:
        """Return the session of a device, a new one where it sends for the first time."""
        if device in self.of:
            return self.of[device]
        recorder = None if self.record is None else Recorder(self.record, self.layout, device)
        session = Session(
            device,
            self._watcher(),
            recorder=recorder,
            rule=self._rule,
            accumulate=self.accumulate,
            scans=Scans(self.layout, self.lines_held),
        )
        session.command(self._command)
        self.of[device] = session
        return session

    def obey(self, command: bool | None) -> list[Event]:
        """Give a command to all devices, those that come later too; see
        :meth:`~adaptfault.acquisition.session.Session.command`."""
        self._command = command
        return [event for one in self.of.values() for event in one.command(command)]

    def _watcher(self) -> StreamingPredictor | Monitor:
        """Return what watches one more device; nothing is read for it in the loop."""
        if self._ready:
            return self._ready.pop()
        if isinstance(self.first, Monitor):
            return self._monitor()
        return self.first.sibling()

    def _monitor(self) -> Monitor:
        return Monitor(SelfDiagnosis(self.layout))

    def _predictor(self) -> StreamingPredictor:
        # imported here, because monitoring alone needs no model
        from adaptfault.prediction.predictor import Predictor

        assert self.bundle is not None
        try:
            return Predictor.load(
                self.bundle, **self._trust, accumulate=self.accumulate, sets=self.sets
            )
        except ImportError as error:
            raise ValueError(
                f"{self.bundle}: classifying needs {error.name}; install it, or give no bundle"
            ) from None

    @cached_property
    def restoring(self) -> tuple[Restorer, FaultSet]:
        """What restores frames, fitted once, and the cells that are faulty from the start."""
        from adaptfault.bundle.bundle import Bundle

        assert self.bundle is not None
        bundle = Bundle.open(self.bundle, **self._trust)
        known = bundle.known_faults().fault_set
        self._say(
            f"restoring: fitting on the healthy windows of {self.bundle}; {len(known)} faulty cells"
            " known"
        )
        return bundle.restorer(), known
