"""Processes the frames of one device: monitoring, classification, recording, events."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from adaptfault.acquisition.ordering import Frame
from adaptfault.acquisition.recorder import Recorded, Recorder
from adaptfault.acquisition.scanning import Scans
from adaptfault.acquisition.switch import Contact, Rule, Switch
from diagnostics import Diagnosis, Fault, FaultSet, Monitor, ReadOut, Scan, SensorLayout

CONFIRMED_AFTER = 100
"""Number of predicted windows after which a version on probation is confirmed."""

SILENCE = 2.0
"""Seconds without a frame after which a device is reported silent and its recording is closed."""

_BEFORE = 0.5  # seconds recorded before a contact


class StreamResult(Protocol):
    """Result of one frame, as :class:`adaptfault.Reading`; ``label`` is None until a window is
    full, and of a regression, which has ``values``."""

    @property
    def label(self) -> Any: ...  # noqa: D102
    @property
    def probabilities(self) -> Any: ...  # noqa: D102
    @property
    def fault_set(self) -> FaultSet: ...  # noqa: D102
    @property
    def events(self) -> tuple[Fault, ...]: ...  # noqa: D102
    @property
    def faults(self) -> tuple[Fault, ...]: ...  # noqa: D102


class StreamingPredictor(Protocol):
    """The methods of :class:`adaptfault.Predictor` that a session uses."""

    @property
    def layout(self) -> SensorLayout: ...  # noqa: D102
    @property
    def evaluated(self) -> Diagnosis | None: ...  # noqa: D102
    def stream(self, frame: NDArray[np.float64], time: float | None = None) -> StreamResult: ...  # noqa: D102
    def scan(self, scan: Scan) -> tuple[Fault, ...]: ...  # noqa: D102
    @property
    def faults(self) -> tuple[Fault, ...]: ...  # noqa: D102
    def confirm(self) -> bool | None: ...  # noqa: D102
    def sibling(self) -> StreamingPredictor: ...  # noqa: D102


@dataclass(frozen=True)
class Event:
    """An event of one device.

    Attributes:
        kind: "fault" (new or changed), "gone", "class", "recording", "recorded", "restart",
            "scan", "silent", "confirmed" or "trouble".
        device: name of the device.
        time: seconds, as in :class:`Frame`.
        text: one sentence.
        data: the content as JSON-safe values.
        clock: local time of the receiver; None: unknown. It is printed in place of ``time``, which
            counts from the start of the device.
    """

    kind: str
    device: str
    time: float
    text: str
    data: dict[str, Any] = field(default_factory=dict)
    clock: datetime | None = None

    def __str__(self) -> str:
        if self.clock is None:
            at = f"{self.time:.1f}"
        else:
            at = self.clock.strftime("%H:%M:%S")
            at += f".{self.clock.microsecond // 100_000}"
        return f"{at} {self.device} {self.kind}: {self.text}"

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-safe dict."""
        head: dict[str, Any] = {
            "schema": "adaptfault.event/1",
            "kind": self.kind,
            "device": self.device,
            "time": self.time,
        }
        if self.clock is not None:
            head["clock"] = self.clock.astimezone().isoformat(timespec="milliseconds")
        return {**head, "text": self.text, **self.data}


class Session:
    """Monitors, classifies and records one device.

    Args:
        device: name of the device.
        watcher: a predictor, or a monitor.
        recorder: writes its frames; None: no recording.
        rule: when to record, see :func:`parse_when`.
        clock: returns the local time.
        accumulate: tell the class of the whole contact so far, which the watcher accumulates, and
            not that of the last window. Every contact is decided anew.
        scans: collects the frames of scans; None: they are left out.

    Where the watcher gives the set of classes of a window, the event of a class tells it, and comes
    whenever the class or the set changes.
    """

    def __init__(
        self,
        device: str,
        watcher: StreamingPredictor | Monitor,
        *,
        recorder: Recorder | None = None,
        rule: Rule | None = None,
        clock: Callable[[], datetime] = datetime.now,
        accumulate: bool = False,
        scans: Scans | None = None,
    ) -> None:
        self.device = device
        self.scans = scans
        self.watcher = watcher
        self.recorder = recorder
        self.clock = clock
        self.accumulate = accumulate
        self.switch = None if rule is None else Switch(rule)
        self.told: tuple[Any, Any] = (None, None)  # class and set of classes
        self.faults: tuple[Fault, ...] = ()
        self._classified = 0
        self._confirmed: bool | None = None  # None: not tried yet
        self._faulty: NDArray[np.bool_] | None = None
        self.time = 0.0  # of the last frame
        self._arrived: float | None = None
        before = (
            round(_BEFORE * recorder.layout.rate) if recorder and isinstance(rule, Contact) else 0
        )
        self._before: deque[Frame] = deque(maxlen=before)

    @property
    def fault_set(self) -> FaultSet:
        """The cells that the monitor finds faulty now."""
        assert self._faulty is not None  # after the first frame
        return FaultSet.of(self._faulty, self._faulty.size)

    def take(self, frame: Frame, now: float) -> list[Event]:
        """Process a frame that arrived at ``now`` (seconds of the receiver's clock); return its
        events."""
        self.time = frame.time
        self._arrived = now
        events = [self._event("restart", "the device restarted")] if frame.restarted else []
        if frame.scan is not None:
            if self.scans is not None:
                self.scans.add(frame)
            return events
        if self.scans is not None:
            events += self._scanned(self.scans, self.scans.pass_by(frame))
        at = frame.time - (0.0 if self.scans is None else self.scans.time)
        if isinstance(self.watcher, Monitor):
            news = self.watcher.update(frame.values, at)
            self.faults = self.watcher.faults
        else:
            reading = self.watcher.stream(frame.values, at)
            news = tuple(reading.events)
            self.faults = reading.faults
            events += self._classify(reading)
        events += [self._fault_event(fault) for fault in news]
        faulty = np.zeros(frame.values.size, bool) if self._faulty is None else self._faulty
        for fault in news:
            faulty[list(fault.cells)] = fault.probability != 0
        self._faulty = faulty
        return events + self._record(frame)

    def idle(self, now: float) -> list[Event]:
        """Check for silence at ``now``; a silent device's recording is closed."""
        if self._arrived is None or now - self._arrived < SILENCE:
            return []
        self._arrived = None
        silent = self._event("silent", f"no frame for {SILENCE:g} s")
        return [silent, *self._end_scan(), *self.close()]

    def command(self, record: bool | None) -> list[Event]:
        """Record from now on (True), do not record (False), or follow the rule (None)."""
        if self.switch is not None:
            self.switch.command = record
        return [] if record else self.close()

    def finish(self) -> list[Event]:
        """End: no frame comes any more."""
        return [*self._end_scan(), *self.close()]

    def close(self) -> list[Event]:
        """End the recording, if one is open."""
        if self.recorder is None:
            return []
        try:
            recorded = self.recorder.close()
        except OSError as error:
            return [self._trouble(error)]
        return [] if recorded is None else [self._recorded(recorded)]

    def _end_scan(self) -> list[Event]:
        """End a scan, if there is one."""
        return [] if self.scans is None else self._scanned(self.scans, self.scans.end())

    def _scanned(self, scans: Scans, found: ReadOut | None) -> list[Event]:
        """Return what a scan says that has ended; None: none has."""
        if found is None or scans.last is None:
            return []
        news = self.watcher.scan(scans.last)
        self.faults = self.watcher.faults
        tested = int((found.alive | found.broken).sum())
        data = {
            "faults": [fault.to_dict() for fault in found.faults],
            "tested": tested,
            "under_load": found.under_load,
            "incomplete": found.incomplete,
        }
        events = [self._event("scan", found.summary, **data)]
        if self._faulty is None:
            self._faulty = np.zeros(found.alive.size, bool)
        for fault in news:
            events.append(self._fault_event(fault))
            self._faulty[list(fault.cells)] = True
        if self.recorder is not None:
            try:
                path = self.recorder.write_scan(scans.last)
            except OSError as error:
                return [*events, self._trouble(error)]
            events.append(self._event("recorded", f"{path}: a scan", path=str(path)))
        return events

    def _classify(self, reading: StreamResult) -> list[Event]:
        values = getattr(reading, "values", None)  # of a regression: no label, and no event
        if reading.label is None and values is None:
            return []
        events = []
        self._classified += 1
        if self._classified % CONFIRMED_AFTER == 0 and not self._confirmed:
            events += self._confirm()
        decided = reading.label
        probabilities = reading.probabilities
        if self.accumulate:
            probabilities = getattr(reading, "contact", None)
            decided = None if probabilities is None else int(np.argmax(probabilities))
        classes = getattr(reading, "classes", None)
        if (decided, classes) == self.told:
            return events
        self.told = decided, classes
        if decided is None:  # the contact has ended
            return events
        share = float(np.max(probabilities))
        label = decided.item() if isinstance(decided, np.generic) else decided
        names = getattr(self.watcher, "class_names", ())
        text = f"{names[label] if names else label} ({share:.0%})"
        data = {"label": label, "probability": share, "dropped": len(reading.fault_set)}
        if classes is not None:
            inside = [str(names[one] if names else one) for one in classes]
            text += f", one of {{{', '.join(inside)}}}"
            data["classes"] = list(classes)
        return [*events, self._event("class", text, **data)]

    def _confirm(self) -> list[Event]:
        """Confirm the running version; a failure is reported once and repeated after as many
        windows."""
        assert not isinstance(self.watcher, Monitor)
        first = self._confirmed is None
        self._confirmed = False
        try:
            self._confirmed = self.watcher.confirm() is not False
            problem = "another version is active, or the bundle cannot be written"
        except OSError as error:
            problem = str(error)
        if self._confirmed:
            return [self._event("confirmed", f"{self._classified} windows classified")]
        return [self._event("trouble", f"the version is not confirmed: {problem}")] if first else []

    def _record(self, frame: Frame) -> list[Event]:
        recorder = self.recorder
        if recorder is None or self.switch is None or self._faulty is None:
            return []
        if not self.switch(frame.values, self._faulty, frame.time, self.clock()):
            self._before.append(frame)
            return self.close()
        events: list[Event] = []
        for one in (*self._before, frame):
            before = recorder.path
            try:
                ended = recorder.write(one.values, one.time)
            except OSError as error:
                # until the next command: retrying on a full disk is pointless
                self.switch.command = False
                return [*events, self._trouble(error)]
            events += [] if ended is None else [self._recorded(ended)]
            if recorder.path != before:
                events.append(self._event("recording", str(recorder.path), path=str(recorder.path)))
        self._before.clear()
        return events

    def _fault_event(self, fault: Fault) -> Event:
        return self._event(
            "gone" if fault.probability == 0 else "fault", fault.reason, fault=fault.to_dict()
        )

    def _recorded(self, recorded: Recorded) -> Event:
        data = {"path": str(recorded.path), "frames": recorded.frames, "seconds": recorded.seconds}
        return self._event("recorded", str(recorded), **data)

    def _trouble(self, error: OSError) -> Event:
        return self._event("trouble", f"recording stopped: {error}")

    def _event(self, kind: str, text: str, **data: Any) -> Event:
        return Event(kind, self.device, self.time, text, data, self.clock())
