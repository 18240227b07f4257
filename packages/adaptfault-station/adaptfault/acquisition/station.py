"""A station: receives and processes the frames of all devices until it is stopped."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from functools import partial
from operator import methodcaller
from typing import TYPE_CHECKING

from adaptfault.acquisition.newcomers import Newcomers
from adaptfault.acquisition.ordering import Frame
from adaptfault.acquisition.packet import TICKS
from adaptfault.acquisition.receiver import Receiver
from adaptfault.acquisition.relay import FrameRepair, Relay, parse_address
from adaptfault.acquisition.session import Event, Session
from adaptfault.acquisition.sessions import Sessions
from adaptfault.data.printable import printable
from adaptfault.inspection.converter_range import within_range
from adaptfault.robot.metrics import RobotMetrics, cells_by_pad, fault_counts, write_metrics
from diagnostics import SensorLayout

if TYPE_CHECKING:
    from adaptfault.acquisition.live import LiveView
    from adaptfault.data.calibration import Calibration

SCHEMA = "adaptfault.listen/1"

_COMMANDS = {"record": True, "stop": False, "auto": None}
_ANSWERS = {
    True: "recording from now on",
    False: "not recording",
    None: "recording as the rule says",
}
_DRAIN = 0.5  # seconds for the frames that still wait at the end
_CHECK = 0.5  # seconds between checks for silent devices
_WAITING = 16_000_000  # bytes of frames that may wait, for bursts
_LINE = 1000  # bytes; longest command


class Station:
    """Monitors, classifies (with a bundle) and records every device that sends.

    Events go to stdout, one line each; the counters of all datagrams are the last line. It ends
    after ``seconds`` or ``frames``, on SIGINT, SIGTERM or SIGHUP, and on "quit" from stdin
    ("record", "stop" and "auto" switch the recording).

    Args:
        layout: the array; None: the bundle's.
        port, host, devices, ticks, key: as for :class:`Receiver`.
        bundle: folder of a bundle; None: monitor only.
        keys, least_serial: whose signature the bundle needs, see :class:`Bundle`.
        record: folder for recordings; None: no recording.
        relay: ``HOST:PORT`` to which repaired packets are sent, see :class:`Relay`; needs a bundle.
        when: when to record, see :func:`parse_when`.
        metrics: file of metrics for Prometheus, written when faults change and at the end; the
            robots in it are devices.
        view: file or stream that shows all frames, see
            :class:`~adaptfault.acquisition.live.LiveView`; with a bundle, restored ones, too.
        seconds, frames: when to end; None: never.
        calibration: converts received values into the layout's unit.
        on_event: called with each event in the event loop, instead of printing it.
        accumulate: tell one class for a whole contact, see :class:`Session`; needs a bundle.
        lines_held: whether the read-out holds lines that it does not select, in scans of itself;
            None: not stated.
        sets: tell the set of classes of each window that holds the true one with probability
            1 - ``sets``, see :class:`Predictor`; needs a bundle.
        as_json: one JSON object per line.
        quiet: no output on stderr.

    Raises:
        ValueError: neither layout nor bundle, an unknown rule, a calibration of another layout, a
            relay that has no bundle or sends to the port it listens on, or ``accumulate`` or
            ``sets`` without a bundle, with a regression, or together.
    """

    def __init__(
        self,
        layout: SensorLayout | None,
        port: int = 0,
        *,
        bundle: str | None = None,
        keys: Sequence[str | os.PathLike[str]] | None = None,
        least_serial: int = 0,
        host: str = "127.0.0.1",
        devices: Collection[str] | None = None,
        ticks: float = TICKS,
        key: bytes | None = None,
        record: str | os.PathLike[str] | None = None,
        relay: str | None = None,
        when: str = "contact",
        metrics: str | os.PathLike[str] | None = None,
        view: str | None = None,
        seconds: float | None = None,
        frames: int | None = None,
        calibration: Calibration | None = None,
        on_event: Callable[[Event], None] | None = None,
        accumulate: bool = False,
        sets: float | None = None,
        lines_held: bool | None = None,
        as_json: bool = False,
        quiet: bool = False,
    ) -> None:
        self.calibration = calibration
        self.metrics = metrics
        self.seconds = seconds
        self.frames = frames
        self.quiet = quiet
        self.as_json = as_json
        self.on_event = self._print if on_event is None else on_event
        trust = {"keys": keys, "least_serial": least_serial}
        self._sessions = Sessions(
            layout, bundle, trust, record, when, accumulate, sets, lines_held, self._say
        )
        self.layout = self._sessions.layout
        if calibration is not None:
            calibration.check(self.layout)
        self._relay = None if relay is None else self._make_relay(relay, host, port, ticks)
        self._view = None if view is None else self._make_view(view)
        self.receiver = Receiver(
            self.layout,
            port,
            host=host,
            devices=devices,
            ticks=ticks,
            queue=max(64, _WAITING // (8 * self.layout.n_cells)),
            key=key,
            on_frame=None if self._relay is None else self._send,
            on_trouble=self._trouble,
        )
        self._newcomers = Newcomers(self.layout.rate, self.receiver.devices)
        self._outside = 0  # readings outside the layout's range

    async def listen(self) -> None:
        """Listen until stopped.

        Raises:
            OSError: the port is taken, or the address does not belong to this machine.
        """
        loop = asyncio.get_running_loop()
        try:
            async with self.receiver as receiver:
                self._say(f"listening on {receiver.host}, port {receiver.port}, for {self.layout}")
                # Windows has none
                ends = (
                    signal.SIGINT,
                    signal.SIGTERM,
                    getattr(signal, "SIGHUP", signal.SIGTERM),
                )
                for number in ends:
                    # not in the main thread; Windows
                    with suppress(NotImplementedError, RuntimeError, ValueError):
                        loop.add_signal_handler(number, receiver.close)
                if self.seconds is not None:
                    loop.call_later(self.seconds, receiver.close)
                _read_commands(loop, self._handle_command)
                looking = asyncio.create_task(self._check_silence())
                try:
                    await self._take_all()
                finally:
                    looking.cancel()
            self.receiver.discard()  # what the number of frames left over
        finally:
            for session in self._sessions.of.values():
                self._emit(session.finish())
            if self._relay is not None:
                self._relay.close()
            self._close_view()
            self._write_metrics()
        self._end()

    async def _take_all(self) -> None:
        taken = 0
        ending: float | None = None
        async for frame in self.receiver:
            self._take(frame)
            taken += 1
            if self.frames is not None and taken >= self.frames:
                break
            if self.receiver.closed:
                ending = time.monotonic() if ending is None else ending
                if time.monotonic() - ending > _DRAIN:
                    self.receiver.discard()
        self._watch(self._newcomers.rest())

    async def _check_silence(self) -> None:
        while True:
            await asyncio.sleep(_CHECK)
            now = time.monotonic()
            for name, session in self._sessions.of.items():
                events = session.idle(now)
                self._emit(events)
                if events:
                    self._show(name, methodcaller("tell", name, events))

    def _take(self, frame: Frame) -> None:
        session = self._sessions.of.get(frame.device)
        if session is not None:
            self._process(session, frame)
            return
        now = time.monotonic()
        sending = self.receiver.arrivals.keys()
        unwatched = self._newcomers.forget(sending, now)
        if unwatched is not None:
            self._trouble("", unwatched)
        proven = self._newcomers.take(frame, now)
        if proven:
            self._forget(self._sessions.of.keys() - sending)
            self._watch(proven)

    def _watch(self, frames: Sequence[Frame]) -> None:
        """Process frames of devices that may be new."""
        for frame in frames:
            self._process(self._sessions.begun(frame.device), frame)

    def _forget(self, devices: Collection[str]) -> None:
        """End the sessions of devices that the receiver has forgotten."""
        for gone in devices:
            self._emit(self._sessions.of.pop(gone).finish())
            self._show(gone, methodcaller("forget", gone))

    def _process(self, session: Session, frame: Frame) -> None:
        if frame.scan is not None:
            self._emit(session.take(frame, time.monotonic()))
            return
        frame, outside = self._in_unit(frame)
        self._outside += outside
        events = session.take(frame, time.monotonic())
        self._emit(events)
        self._show(frame.device, methodcaller("take", frame, session, events))
        if any(event.kind in ("fault", "gone") for event in events):
            if self._relay is not None:
                self._relay.found(frame.device, session.fault_set)
            self._write_metrics(frame.device, frame.time)

    def _show(self, device: str, show: Callable[[LiveView], None]) -> None:
        """Show something of a device; a view that cannot be written ends, and the station goes
        on."""
        if self._view is None:
            return
        try:
            show(self._view)
        except OSError as error:
            with suppress(OSError):
                self._view.close()
            self._view = None
            self._trouble(device, f"the view ends: {error}")

    def _close_view(self) -> None:
        if self._view is None:
            return
        try:
            self._view.close()
        except OSError as error:
            self._trouble("", f"the view is not complete: {error}")

    def _trouble(self, device: str, text: str) -> None:
        session = self._sessions.of.get(device)
        at = 0.0 if session is None else session.time
        self.on_event(Event("trouble", device or "station", at, text, clock=datetime.now()))

    def _write_metrics(self, device: str = "station", at: float = 0.0) -> None:
        """Write the metrics of all devices; a file that cannot be written does not end the
        station."""
        if self.metrics is None:
            return
        now = time.time()
        robots = [
            RobotMetrics(
                name,
                now,
                pads=cells_by_pad(self.layout, session.faults),
                faults=fault_counts(session.faults),
            )
            for name, session in self._sessions.of.items()
        ]
        try:
            write_metrics(self.metrics, robots)
        except OSError as error:
            text = f"metrics are not written: {error}"
            self.on_event(Event("trouble", device, at, text, clock=datetime.now()))

    def _send(self, frame: Frame) -> None:
        """Send a frame on, before it waits for monitoring and classification, which take longer."""
        assert self._relay is not None  # for the type checker
        if frame.scan is not None:
            return  # no readings
        session = self._sessions.of.get(frame.device)
        watcher = self._sessions.first if session is None else session.watcher
        whole, _ = self._in_unit(frame)
        self._relay.send(
            frame.device, frame.time, frame.values, whole.values, getattr(watcher, "running", None)
        )

    def _in_unit(self, frame: Frame) -> tuple[Frame, int]:
        """Return a frame in the unit of the layout, and how many of its readings are outside the
        range."""
        values = frame.values
        if self.calibration is not None:
            values = self.calibration.apply(values)[0].astype(float)
        values, outside = within_range(values, self.layout)
        return replace(frame, values=values), outside

    def _make_relay(self, address: str, host: str, port: int, ticks: float) -> Relay:
        if self._sessions.bundle is None:
            raise ValueError("--relay needs a bundle: cells are restored with its healthy windows")
        if parse_address(address) == (host, port):
            raise ValueError(
                f"--relay {address}: this address is listened on; give the consumer another port"
            )
        return Relay(address, *self._sessions.restoring, calibration=self.calibration, ticks=ticks)

    def _make_view(self, target: str) -> LiveView:
        from adaptfault.acquisition.live import LiveView

        repair = None
        if self._sessions.bundle is not None:
            repair = partial(FrameRepair, *self._sessions.restoring)
        view = LiveView(target, self.layout, repair)
        self._say(f"view: {view.places[0]}")
        return view

    def _handle_command(self, line: str) -> None:
        word = line.strip().lower()
        if word == "quit":
            self.receiver.close()
        elif word in _COMMANDS and self._sessions.record is not None:
            self._emit(self._sessions.obey(_COMMANDS[word]))
            self._say(f"{word}: {_ANSWERS[_COMMANDS[word]]}")
        elif word in _COMMANDS:
            self._say(f"{word}: no folder to record into; start with --record FOLDER")
        elif word:
            self._say(f"{word[:20]!r} is not a command; expected {', '.join(_COMMANDS)} or quit")

    def _emit(self, events: list[Event]) -> None:
        for event in events:
            self.on_event(event)

    def _print(self, event: Event) -> None:
        print(
            json.dumps(event.to_dict(), allow_nan=False) if self.as_json else printable(str(event)),
            flush=True,
        )

    def _say(self, text: str) -> None:
        if not self.quiet:
            print(printable(text), file=sys.stderr, flush=True)

    def _end(self) -> None:
        counters = self.receiver.counters
        result = {
            "schema": SCHEMA,
            "layout": self.layout.to_dict(),
            "counters": counters.to_dict(),
            "readings_outside_range": self._outside,
        }
        text = f"end: {counters}"
        if self._outside:
            text += f", {self._outside} readings outside the range"
        if self._relay is not None:
            result["relay"] = self._relay.to_dict()
            text += f", {self._relay}"
        if self._view is not None:
            result["view"] = list(self._view.places)
            text += f", view in {', '.join(self._view.places)}"
        print(json.dumps(result, allow_nan=False) if self.as_json else text, flush=True)


def _read_commands(loop: asyncio.AbstractEventLoop, handle: Callable[[str], None]) -> None:
    """Pass each line of stdin to ``handle`` from a thread that may block forever."""
    try:
        descriptor = sys.stdin.fileno()
        if os.isatty(descriptor) and os.tcgetpgrp(descriptor) != os.getpgrp():
            return  # in the background, reading from the terminal would stop the process
    except (AttributeError, OSError, ValueError):  # no stdin
        return

    def read() -> None:
        rest = b""
        # Not through sys.stdin: a thread that holds its lock would break the interpreter's end.
        with suppress(OSError, RuntimeError):  # closed, or the loop has ended
            while data := os.read(descriptor, 4096):
                *lines, rest = (rest + data).split(b"\n")
                rest = rest[-_LINE:]
                for line in lines:
                    loop.call_soon_threadsafe(handle, line.decode("utf-8", "replace"))

    threading.Thread(target=read, name="commands", daemon=True).start()
