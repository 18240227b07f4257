"""Shows what devices send while they send it: in files that grow, or in Rerun's viewers.

A file that exists is kept; its successor has a number in its name. So has the file that follows
after an hour, which bounds memory. What was received up to the last second is in the file after
``kill -9``, too: an MCAP file then lacks its index, which ``mcap recover`` writes, and an RRD file
is read as it is.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from adaptfault.acquisition.ordering import Frame
from adaptfault.acquisition.relay import FrameRepair, in_place
from adaptfault.acquisition.session import Event, Session
from adaptfault.viewers.mcap_file import McapArray, McapMessages, check_mcap
from adaptfault.viewers.rerun_file import RerunArray, blueprint, check_rerun
from adaptfault.viewers.ros_diagnostics import Level, diagnostic_array, stale_array
from adaptfault.viewers.timed_log import ROOT, Piece, State, on_grid, states_of
from diagnostics import Diagnosis, FaultSet, SensorLayout

LONGEST = 3600.0
"""Seconds after which a file ends and the next one begins."""

PORT = 9876
"""Where viewers of Rerun look for a stream."""

_MEMORY = "128MiB"  # of frames that wait for viewers which come later
_FLUSHED = 1.0  # seconds between two writes to the disk


class LiveView:
    """Shows readings, restored frames, states and faults of all devices.

    Times are those of the devices, moved so that the first frame of each has the time at which it
    was taken.

    Args:
        target: ``FILE.mcap``, ``FILE.rrd``, or ``rerun`` (``rerun:PORT``), which serves viewers.
        layout: of all devices.
        repair: makes what restores the frames of one device; None: none are restored.
        longest: seconds after which a file ends.
        clock: seconds since 1970.

    Raises:
        InputError: the package that writes the format is not installed.
        ValueError: another target.
        OSError: the file cannot be written.
    """

    def __init__(
        self,
        target: str,
        layout: SensorLayout,
        repair: Callable[[], FrameRepair] | None = None,
        *,
        longest: float = LONGEST,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.layout = layout
        self.clock = clock
        self._repair = repair
        self._longest = longest
        self._began: float | None = None  # the first frame of the file
        self._sink = _sink(target, layout, restored=repair is not None)
        self._devices: dict[str, _Device] = {}

    @property
    def places(self) -> tuple[str, ...]:
        """The files so far, or the address of the stream."""
        return tuple(self._sink.places)

    def take(self, frame: Frame, session: Session, events: Sequence[Event] = ()) -> None:
        """Show one frame of a device, and what was found with it.

        Args:
            frame: in the unit of the layout.
            session: of the device, after it took the frame.
            events: that the frame caused.

        Raises:
            OSError: the file cannot be written.
        """
        device = self._devices.get(frame.device)
        if device is None:
            repair = None if self._repair is None else self._repair()
            device = _Device(frame.device, self.clock() - frame.time, repair)
            self._devices[frame.device] = device
        self._keep_short(frame.time + device.offset)
        device.take(frame, session, self.layout)
        self._sink.tell(device, events)
        if device.times[-1] - device.times[0] >= self._sink.span:
            self._sink.write(device)

    def tell(self, name: str, events: Sequence[Event]) -> None:
        """Show that a device is silent, where ``events`` say so."""
        device = self._devices.get(name)
        if device is not None and any(event.kind == "silent" for event in events):
            if device.times:
                self._sink.write(device)
            device.last = self.clock()
            self._sink.tell(device, events)

    def forget(self, name: str) -> None:
        """Keep nothing of a device that is gone.

        Raises:
            OSError: the file cannot be written.
        """
        device = self._devices.pop(name, None)
        if device is not None and device.times:
            self._sink.write(device)

    def close(self) -> None:
        """End the file or the stream.

        Raises:
            OSError: the file cannot be written.
        """
        try:
            self._write()
        finally:
            self._sink.close()

    def _keep_short(self, now: float) -> None:
        """Begin the next file where the present one is long enough."""
        if self._began is None:
            self._began = now
        if now - self._began >= self._longest:
            self._write()
            self._sink.renew()
            self._began = now

    def _write(self) -> None:
        """Write the frames that wait."""
        for device in self._devices.values():
            if device.times:
                self._sink.write(device)


@dataclass(eq=False)
class _Device:
    """What is shown of one device, and the frames that wait to be shown.

    Attributes:
        name: of the device.
        offset: from its clock to seconds since 1970.
        repair: restores its frames.
        last: when its last frame was taken.
        times, readings, restored: of the frames that wait.
        states: uint8 ``[pads, rows, cols]``.
        status: a DiagnosticArray.
    """

    name: str
    offset: float
    repair: FrameRepair | None
    last: float = 0.0
    times: list[float] = field(default_factory=list)
    readings: list[NDArray[np.float64]] = field(default_factory=list)
    restored: list[NDArray[np.float64]] = field(default_factory=list)
    states: NDArray[np.uint8] | None = None
    status: Mapping[str, Any] = field(default_factory=dict)
    _shown: tuple[Diagnosis | None, FaultSet] | None = None

    @property
    def root(self) -> str:
        """What the names of its topics and entities begin with."""
        return f"{ROOT}/{self.name}"

    def take(self, frame: Frame, session: Session, layout: SensorLayout) -> None:
        """Add a frame to those that wait."""
        version = getattr(session.watcher, "running", None)
        self.last = frame.time + self.offset
        self.times.append(self.last)
        self.readings.append(frame.values if version is None else version.undo(frame.values))
        if self.repair is not None:
            self.repair.found(session.fault_set)
            whole, _, _ = in_place(self.repair, frame.values, frame.values, version)
            self.restored.append(whole)
        faulty = session.fault_set if self.repair is None else self.repair.fault_set
        found = (session.watcher.evaluated, faulty)
        if self._shown is None or found[0] is not self._shown[0] or found[1] != self._shown[1]:
            self._shown = found
            self._state(*found, layout)

    def _state(self, diagnosis: Diagnosis | None, faulty: FaultSet, layout: SensorLayout) -> None:
        """State what an evaluation found, and all cells that are taken for faulty now."""
        if diagnosis is None:
            states = np.full(layout.n_cells, State.UNTESTED, dtype=np.uint8)
            states[~layout.is_cell] = State.NO_CELL
            self.status = stale_array(
                layout, "not evaluated yet", level=Level.WARN, hardware_id=self.name
            )
        else:
            states = states_of(diagnosis).ravel()
            self.status = diagnostic_array(diagnosis, hardware_id=self.name)
        states[faulty.mask] = State.FAULTY
        self.states = layout.grid(states)

    def piece(self, layout: SensorLayout) -> Piece:
        """Return the frames that wait; none wait after it."""
        restored = on_grid(np.array(self.restored), layout) if self.restored else None
        piece = Piece(0, np.array(self.times), on_grid(np.array(self.readings), layout), restored)
        self.times.clear()
        self.readings.clear()
        self.restored.clear()
        return piece


class _Sink(Protocol):
    """Where pieces go."""

    span: float  # seconds of frames that are written at once
    places: list[str]

    def renew(self) -> None: ...
    def write(self, device: _Device) -> None: ...
    def tell(self, device: _Device, events: Sequence[Event]) -> None: ...
    def close(self) -> None: ...


def _sink(target: str, layout: SensorLayout, *, restored: bool) -> _Sink:
    ending = Path(target).suffix.lower()
    if ending == ".mcap":
        check_mcap(target)
        return _McapFiles(Path(target), layout, restored)
    if ending == ".rrd":
        check_rerun(target)
        return _RerunFiles(Path(target), layout, restored)
    name, _, port = target.partition(":")
    if name == "rerun" and (not port or port.isdecimal()):
        check_rerun(target)
        return _RerunServer(layout, restored, int(port or PORT))
    raise ValueError(f"--view {target}: expected FILE.mcap, FILE.rrd or rerun")


def _free(path: Path) -> Path:
    """Return the path, or one with a number where a file is there already."""
    number = 1
    free = path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.stem}_{number}{path.suffix}")
    return free


class _McapFiles:
    """MCAP files, one after the other."""

    span = 0.0

    def __init__(self, path: Path, layout: SensorLayout, restored: bool) -> None:
        self.places: list[str] = []
        self._path = path
        self._layout = layout
        self._restored = restored
        self._open()

    def _open(self) -> None:
        path = _free(self._path)
        self._file: BinaryIO = path.open("xb")
        self.places.append(str(path))
        self._messages = McapMessages(self._file)
        self._arrays: dict[str, McapArray] = {}
        self._flushed = -np.inf

    def renew(self) -> None:
        """End the file, and begin the next one."""
        self.close()
        self._open()

    def write(self, device: _Device) -> None:
        """Write the frames that wait; each second all goes to the disk."""
        if device.last - self._flushed >= _FLUSHED:
            self._messages.writer.flush()
            self._flushed = device.last
        array = self._arrays.get(device.name)
        if array is None:
            array = self._messages.array(self._layout, device.root, restored=self._restored)
            self._arrays[device.name] = array
        assert device.states is not None  # after the first frame
        array.write(device.piece(self._layout), device.states, device.status)

    def tell(self, device: _Device, events: Sequence[Event]) -> None:
        """Write that a device is silent."""
        for event in events:
            if event.kind == "silent":
                status = stale_array(self._layout, event.text, hardware_id=device.name)
                self._messages.status(device.last, status)
                self._messages.writer.flush()

    def close(self) -> None:
        """End the file with its index."""
        with self._file:
            self._messages.finish()


class _Rerun:
    """A stream of Rerun."""

    span = 0.1

    def __init__(self, layout: SensorLayout, restored: bool) -> None:
        self.places: list[str] = []
        self._layout = layout
        self._restored = restored

    def _open(self) -> None:
        import rerun

        self._stream = rerun.RecordingStream("adaptfault")
        self._arrays: dict[str, RerunArray] = {}
        self._states: dict[str, NDArray[np.uint8] | None] = {}  # as written last
        rerun.TimeColumn("time", duration=[0.0])  # imports much: now, not at the first frame
        blueprint([])
        self._connect(self._stream)

    def _connect(self, stream: Any) -> None:
        raise NotImplementedError

    def renew(self) -> None:
        """End the stream, and begin the next one."""
        self.close()
        self._open()

    def write(self, device: _Device) -> None:
        """Write the frames that wait, and the states where they changed."""
        array = self._array(device)
        if self._states.get(device.name) is not device.states:
            self._states[device.name] = device.states
            assert device.states is not None  # after the first frame
            array.states(device.states, (0, device.times[-1]))
        array.write(device.piece(self._layout))

    def tell(self, device: _Device, events: Sequence[Event]) -> None:
        """Write a line an event."""
        for event in events:
            level = _LEVELS.get(event.kind)
            if level is not None:
                if event.data.get("fault", {}).get("line") is not None and level == "WARN":
                    level = "ERROR"
                self._array(device).texts("faults", [event.text], [(0, device.last)], [level])

    def _array(self, device: _Device) -> RerunArray:
        array = self._arrays.get(device.name)
        if array is None:
            array = RerunArray(
                self._stream, self._layout, device.root, restored=self._restored, clock=True
            )
            self._arrays[device.name] = array
            array.begin()
            self._stream.send_blueprint(blueprint(list(self._arrays.values())))
        return array

    def close(self) -> None:
        """End the stream."""
        self._stream.disconnect()


_LEVELS = {"fault": "WARN", "gone": "INFO", "restart": "INFO", "silent": "WARN"}


class _RerunFiles(_Rerun):
    """RRD files, one after the other."""

    span = _FLUSHED

    def __init__(self, path: Path, layout: SensorLayout, restored: bool) -> None:
        super().__init__(layout, restored)
        self._path = path
        self._open()

    def _connect(self, stream: Any) -> None:
        path = _free(self._path)
        path.touch()  # raises OSError; Rerun's own thread would only log it
        stream.save(path)
        self.places.append(str(path))


class _RerunServer(_Rerun):
    """A stream that viewers connect to; those that come later get the last 128 MiB."""

    def __init__(self, layout: SensorLayout, restored: bool, port: int) -> None:
        super().__init__(layout, restored)
        self._port = port
        self._open()

    def _connect(self, stream: Any) -> None:
        address = stream.serve_grpc(grpc_port=self._port, server_memory_limit=_MEMORY)
        self.places.append(address)

    def renew(self) -> None:
        """The stream goes on: its memory is bounded."""
