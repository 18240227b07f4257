"""Restores the frames of a running sensor, monitors them, and states their diagnosis.

The thread that receives frames calls all methods but :meth:`Watch.work`, which belongs to a thread
of its own: to monitor a frame of a large array may take longer than the time between two frames,
and no frame waits for it to be restored.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.acquisition.followed import Sensor
from adaptfault.acquisition.ordering import Frame
from adaptfault.acquisition.relay import FrameRepair, in_place
from adaptfault.acquisition.scanning import Scans
from adaptfault.inspection.converter_range import within_range
from adaptfault.viewers.ros_diagnostics import Level, diagnostic_array, stale_array
from diagnostics import Fault, FaultSet, Monitor, ReadOut, with_scan

GRACE = 5.0  # seconds after the start in which no frame is a WARN, and STALE afterwards
SILENCE = 2.0  # seconds without a frame, after which everything is STALE; at least so many periods:
_PERIODS = 5
WAITING = 1000  # most frames that wait to be monitored; fewer of large arrays:
_BYTES = 16_000_000
_RATED = 5.0  # seconds over which the rate is counted, at least so many frames:
_FEWEST = 10


class Waiting:
    """Frames that wait to be monitored, ``most`` of them; the oldest are left out.

    Attributes:
        left_out: how many were.
        ended: whether no frame is to be monitored any more.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self._comes = threading.Event()  # set where frames wait, or the work ends
        self.begin()

    def begin(self) -> None:
        """Begin without a frame."""
        self.ended = False
        self.left_out = 0
        self._frames: deque[tuple[NDArray[np.float64], float | None]] = deque()

    def __bool__(self) -> bool:
        return bool(self._frames)

    def put(self, received: NDArray[np.float64], time: float | None) -> None:
        """Add a frame."""
        self._frames.append((received, time))
        while len(self._frames) > self.most:
            with suppress(IndexError):  # it was taken just now
                self._frames.popleft()
                self.left_out += 1
        self._comes.set()

    def take(self) -> tuple[NDArray[np.float64], float | None] | None:
        """Return the frame that waits longest; None without one."""
        with suppress(IndexError):
            return self._frames.popleft()
        return None

    def wait(self) -> None:
        """Wait for a frame, or the end."""
        if not self._frames:
            self._comes.wait()
            self._comes.clear()

    def end(self) -> None:
        """Wake who waits, for the last time."""
        self.ended = True
        self._comes.set()


class Watch:
    """Takes frames in, and states the diagnosis to publish.

    Args:
        sensor: as the bundle or the layout states it.
        name, hardware_id: of :func:`~adaptfault.viewers.ros_diagnostics.diagnostic_array`.
        lines_held: of the scans of the read-out, as in :class:`diagnostics.Scan`.
        clock: seconds, never set back.
    """

    def __init__(
        self,
        sensor: Sensor,
        *,
        name: str = "tactile",
        hardware_id: str = "tactile",
        lines_held: bool | None = None,
        clock: Callable[[], float] = monotonic,
    ) -> None:
        self.about: dict[str, Any] = {"name": name, "hardware_id": hardware_id}
        self.clock = clock
        self.sensor = sensor
        self.layout = sensor.layout
        self.faulty = np.zeros(self.layout.n_cells, bool)  # as the monitor finds
        self.monitor = Monitor(sensor.diagnoser, wait=True)
        self.read_out: ReadOut | None = None  # what the last scan says
        self._scans = Scans(self.layout, lines_held)
        self._changing = threading.Lock()  # held for moments, never while a frame is monitored
        self.repair = self._repair_of(sensor)
        self.queue = Waiting(min(WAITING, max(1, _BYTES // (8 * self.layout.n_cells))))
        self.begin()

    def begin(self) -> None:
        """Wait for the first frame from now on, as after a pause in which none was asked for."""
        self.started = self.clock()
        self.last: float | None = None  # frame of this sensor
        self.refused = ""  # why the last frame was not taken, where none was taken after it
        self.queue.begin()
        self._times: deque[float] = deque(maxlen=max(_FEWEST, round(_RATED * self.layout.rate)) + 1)

    def switch(self, sensor: Sensor) -> None:
        """Go on with what a maintenance run wrote: known faults, and how readings reach their
        cells."""
        before = self.sensor
        repair = self._repair_of(sensor)
        # the frames so far read otherwise
        other = before.parts != sensor.parts or before.readings != sensor.readings
        monitor = Monitor(sensor.diagnoser, wait=True) if other else self.monitor
        with self._changing:
            if other:
                self.faulty[:] = False
                self.read_out = None
            self.sensor = sensor
            self.monitor = monitor
            self.repair = repair
            found = self._found()
        if repair is not None:
            repair.found(found)

    def remember(self, faulty: FaultSet) -> None:
        """Take cells for faulty that an earlier watch of this sensor found, for as long as frames
        read as they do now: this monitor never saw them work."""
        with self._changing:
            self.faulty |= faulty.mask
            found = self._found()
        if self.repair is not None:
            self.repair.found(found)

    def restore(self, received: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the whole frame in the unit in which it came; None where nothing restores it.

        Args:
            received: ``[D]``; a frame of another length is not restored.
        """
        if self.repair is None or received.size != self.layout.n_cells:
            return None
        whole, _, _ = self.restored(self.repair, received)
        return whole

    def restored(
        self, repair: Callable[..., Any], received: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Return the whole frame ``[D]``, which cells are restored, and which values are others
        than those received, as :func:`~adaptfault.acquisition.relay.in_place`."""
        readings = within_range(_readings(received, self.sensor), self.layout)[0]
        sensor = self.sensor
        return in_place(repair, received, readings, sensor.version, sensor.calibration)

    def put(self, received: NDArray[np.float64], time: float | None = None) -> None:
        """Take in one frame ``[D]``, to be monitored later: that takes longer than to restore it.

        Args:
            received: as it came.
            time: of the frame, seconds; None: unknown.

        Raises:
            ValueError: another number of values than cells.
        """
        if received.size != self.layout.n_cells:
            self.refused = f"frames of {received.size} values come, expected {self.layout.n_cells}"
            raise ValueError(self.refused)
        self.refused = ""
        self.last = self.clock()
        self._times.append(self.last)
        self.queue.put(received, time)

    def scan(self, level: float, values: NDArray[np.float64]) -> None:
        """Take in one frame ``[D]`` of a scan of the read-out; the scan ends two seconds after its
        last frame.

        Args:
            level: share of the drive, 0 to 1.
            values: shares of the converter's range, 0 to 1, each where its cell answers.

        Raises:
            ValueError: another number of values than cells, or another level.
        """
        if values.size != self.layout.n_cells or not 0 <= level <= 1:
            raise ValueError(
                f"a frame of a scan has level {level:g} and {values.size} values, expected 0 to 1"
                f" and {self.layout.n_cells}"
            )
        self.last = self.clock()
        version = self.sensor.version
        placed = values if version is None else values[version.source]
        self._scans.add(Frame(self.about["name"], self.last, placed, scan=float(level)))

    def _end_scan(self, now: float) -> None:
        """Take a scan that has ended for evidence: its broken cells are restored, too."""
        found = self._scans.ended(now)
        if found is not None:
            self.read_out = found
            self.remember(FaultSet.of(found.broken, found.broken.size))

    def work(self) -> tuple[Fault, ...]:
        """Monitor the frame that waits longest, if one waits; return the faults that are new,
        changed or gone."""
        frame = self.queue.take()
        if frame is None:
            return ()
        received, time = frame
        with self._changing:
            sensor = self.sensor
            monitor = self.monitor
        readings = _readings(received, sensor)
        version = sensor.version
        faults = monitor.update(readings if version is None else version.undo(readings), time)
        if not faults:
            return ()
        with self._changing:
            if monitor is not self.monitor:  # its frames read otherwise than those of today
                return ()
            for fault in faults:
                self.faulty[list(fault.cells)] = fault.probability != 0
            repair = self.repair
            found = self._found()
        if repair is not None:
            repair.found(found)
        return faults

    def work_on(self, tell: Callable[[Fault], object]) -> None:
        """Monitor frames as they come, until :meth:`end`; ``tell`` gets each fault that is new,
        changed or gone."""
        while not self.queue.ended:
            for fault in self.work():
                tell(fault)
            self.queue.wait()

    def end(self) -> None:
        """End :meth:`work_on` after the frame that is monitored now."""
        self.queue.end()

    def diagnostics(self, stamp: float) -> dict[str, Any]:
        """Return the content of the DiagnosticArray to publish now.

        Before the first frame everything is WARN in a time of grace, then STALE. Later everything
        is STALE after 2 s without a frame.

        Args:
            stamp: seconds since 1970.
        """
        now = self.clock()
        self._end_scan(now)
        about = {"stamp": stamp, **self.about}
        silence = max(SILENCE, _PERIODS / self.layout.rate)
        if self.last is None:
            waited = now - self.started
            level = Level.WARN if waited < max(GRACE, silence) else Level.STALE
            return stale_array(self.layout, self.refused or "no frame yet", level=level, **about)
        if now - self.last > silence:
            self._times.clear()
            message = self.refused or f"no frame for {now - self.last:.0f} s"
            return stale_array(self.layout, message, **about)
        evaluated = self.monitor.evaluated
        if evaluated is None:
            what = "the first frames are being evaluated"
            return stale_array(self.layout, what, level=Level.WARN, **about)
        if self.read_out is not None:
            evaluated = with_scan(evaluated, self.read_out)
        return diagnostic_array(evaluated, rate=self._rate(now), **about)

    def _rate(self, now: float) -> float | None:
        """Return the frames a second of late; None until enough of them came."""
        times = self._times
        if len(times) < _FEWEST or (len(times) < (times.maxlen or 0) and now - times[0] < _RATED):
            return None
        return (len(times) - 1) / max(times[-1] - times[0], 1e-9)

    def _found(self) -> FaultSet:
        return FaultSet.of(self.faulty, self.faulty.size)

    @staticmethod
    def _repair_of(sensor: Sensor) -> FrameRepair | None:
        if sensor.restorer is None:
            return None
        sensor.restorer.deviation(sensor.known)  # before the first frame
        return FrameRepair(sensor.restorer, sensor.known)


def _readings(received: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
    """Return received values in the layout's unit."""
    if sensor.calibration is None:
        return received
    return sensor.calibration.apply(received)[0].astype(np.float64)
