"""Receives the packets of several devices over UDP in bounded memory."""

from __future__ import annotations

import asyncio
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from ipaddress import ip_address
from types import TracebackType
from typing import Any

from adaptfault.acquisition.clock import ClockCheck
from adaptfault.acquisition.ordering import WINDOW, Arrivals, Frame, Ordering
from adaptfault.acquisition.packet import (
    TICKS,
    NotAuthentic,
    PacketError,
    longest_packet,
    parse_packet,
)
from adaptfault.acquisition.senders import Senders
from diagnostics import SensorLayout

MOST_DEVICES = 16
QUEUE = 1024
# bytes requested, for datagrams that arrive while this process does not run
_KERNEL_BUFFER = 4 << 20
_TURNS = 8  # of the event loop for each frame fetched; each turn reads one datagram
_BOUND = 10.0  # seconds of silence after which a device may send from another address
_IDLE = 2.0  # seconds of silence after which a device may give its place to any other one
_TICK = 0.05  # seconds between checks for held packets
_TELL = 10.0  # seconds between two lines about packets that are not taken

_OUTSIDE = ("devices", "lost", "restarts")  # counts of something else than datagrams


@dataclass(frozen=True)
class Counters:
    """Counts of all datagrams.

    ``received`` is the sum of ``kept``, ``dropped``, ``malformed``, ``oversized``, ``forged``,
    ``refused``, ``duplicates``, ``late``, ``strays`` and ``held``.

    Attributes:
        received: datagrams.
        kept: frames, in order, that were fetched or still wait for it.
        dropped: frames that were not fetched in time.
        malformed, oversized: not packets of this array.
        forged: without the right authentication code, where a key is given.
        refused: from devices that are not listed, beyond the limit of devices, or from another
            address.
        devices: number of devices.
        duplicates, late, strays, held, lost, restarts: as in :class:`Arrivals`, all devices
        together.
    """

    received: int = 0
    kept: int = 0
    dropped: int = 0
    malformed: int = 0
    oversized: int = 0
    forged: int = 0
    refused: int = 0
    devices: int = 0
    duplicates: int = 0
    late: int = 0
    strays: int = 0
    held: int = 0
    lost: int = 0
    restarts: int = 0

    def __str__(self) -> str:
        counts = asdict(self)
        received = counts.pop("received")
        outside = {name: counts.pop(name) for name in _OUTSIDE}
        kept = f"{counts.pop('kept')} kept"
        parts = [
            kept,
            *(f"{count} {_noun(name, count)}" for name, count in counts.items() if count),
        ]
        others = [f"{count} {_noun(name, count)}" for name, count in outside.items() if count]
        text = f"{received} received = {' + '.join(parts)}"
        return f"{text}; {', '.join(others)}" if others else text

    def to_dict(self) -> dict[str, int]:
        """Return a JSON-safe dict."""
        return asdict(self)


class _Oversized(PacketError):
    """A datagram that is longer than any packet of the array."""


_REFUSED: dict[type[PacketError], str] = {_Oversized: "oversized", NotAuthentic: "forged"}


class _Dropping:
    """Tells the first datagram that is not taken; later ones are told together."""

    def __init__(self, on_trouble: Callable[[str, str], None] | None) -> None:
        self._on_trouble = on_trouble
        self._told: float | None = None  # when the last line was told
        self._untold = 0  # such packets since then
        self._last = ""

    def tell(self, problem: str, now: float, sender: str) -> None:
        """Tell a datagram at ``now``, seconds, from an address."""
        if self._on_trouble is None:
            return
        self._last = f"{problem}{f' (from {sender})' if sender else ''}"
        if self._told is None:
            self._told = now
            self._on_trouble("", f"a packet is dropped: {self._last}")
            return
        self._untold += 1
        self.tell_more(now)

    def tell_more(self, now: float) -> None:
        """Tell how many came since the last line, if that was long ago."""
        if not self._untold or self._told is None or now - self._told < _TELL:
            return
        assert self._on_trouble is not None
        packets = "packet is" if self._untold == 1 else "packets are"
        self._on_trouble("", f"{self._untold} more {packets} dropped, the last: {self._last}")
        self._told = now
        self._untold = 0


@dataclass
class _Device:
    """A device that sends: its packets in their order, its clock, its address, and when it sent
    last."""

    stream: Ordering
    clock: ClockCheck
    address: str
    last: float


class Intake:
    """Makes datagrams of one kind of array frames that wait to be fetched; see :class:`Receiver`
    for the arguments."""

    def __init__(
        self,
        layout: SensorLayout,
        *,
        ticks: float = TICKS,
        devices: Collection[str] | None = None,
        most_devices: int = MOST_DEVICES,
        queue: int = QUEUE,
        window: int = WINDOW,
        key: bytes | None = None,
        on_frame: Callable[[Frame], None] | None = None,
        on_trouble: Callable[[str, str], None] | None = None,
    ) -> None:
        self.layout = layout
        self.ticks = ticks
        self.on_frame = on_frame
        self.on_trouble = on_trouble
        self.devices = None if devices is None else dict(map(_device, devices))
        self.most_devices = most_devices
        self.window = window
        self.key = key
        self._queue: deque[Frame] = deque(maxlen=queue)
        self._devices: dict[str, _Device] = {}
        self._senders = Senders(layout.rate)
        self._counts: Counter[str] = Counter()  # those of devices that are forgotten among them
        self._dropping = _Dropping(on_trouble)

    @property
    def counters(self) -> Counters:
        """Counts of all datagrams so far."""
        total = self._counts.copy()
        for device in self._devices.values():
            total.update(_beside_received(device))
        total["kept"] -= total["dropped"]
        return Counters(devices=len(self._devices), **total)

    @property
    def arrivals(self) -> dict[str, Arrivals]:
        """Counts of the packets of each device."""
        return {name: device.stream.arrivals for name, device in self._devices.items()}

    def take(self, data: bytes, now: float, sender: str = "") -> None:
        """Process one datagram that arrived at ``now``, seconds of a monotonic clock, from the
        address ``sender``.

        A device is bound to the address that it sends from first: packets with its name from other
        addresses are refused until it has been silent for 10 s, or is overdue and another address
        has sent for a longer time.
        """
        self._counts["received"] += 1
        longest = longest_packet(self.layout.n_cells)
        try:
            if len(data) > longest:
                raise _Oversized(f"{len(data)} bytes, expected {longest} at most")
            packet = parse_packet(data, self.layout.n_cells, ticks=self.ticks, key=self.key)
        except PacketError as error:
            self._counts[_REFUSED.get(type(error), "malformed")] += 1
            self._dropping.tell(str(error), now, sender)
            return
        device = self._device_of(packet.device, now, sender)
        if device is None:
            self._counts["refused"] += 1
            return
        device.address = sender
        device.last = now
        problem = device.clock.push(packet.time, now)
        if problem and self.on_trouble is not None:
            self.on_trouble(packet.device, problem)
        self._put(device.stream.push(packet, now))

    def _device_of(self, name: str, now: float, sender: str) -> _Device | None:
        """Return the device that sends from an address; None: its packets are refused."""
        if self.devices is not None and self.devices.get(name, "none") not in (None, sender):
            return None
        lasted = self._senders.heard(name, sender, now)
        device = self._devices.get(name)
        if device is not None:
            silent = now - device.last
            free = silent >= _BOUND or self._gives_way(name, lasted, silent)
            return device if sender == device.address or free else None
        if len(self._devices) >= self.most_devices and not self._evict(lasted, now):
            most = f"{self.most_devices} devices send, and no more are taken"
            self._dropping.tell(f"{most}; --device NAME takes the named ones alone", now, sender)
            return None
        rate = self.layout.rate
        stream = Ordering(name, rate, window=self.window, restarts=self.key is None)
        self._devices[name] = _Device(stream, ClockCheck(self.ticks), sender, now)
        return self._devices[name]

    def _evict(self, lasted: float, now: float) -> bool:
        """Forget a device in whose place one can be taken that has sent for ``lasted`` seconds;
        return whether there is one.

        One packet gives no place. Of the devices that are overdue, the one goes that has sent for
        the shortest time, if that is shorter, or if it is silent for 2 s.
        """
        for name in sorted(self._devices, key=self._lasted):
            silent = now - self._devices[name].last
            if lasted and (silent >= _IDLE or self._gives_way(name, lasted, silent)):
                break
        else:
            return False
        device = self._devices.pop(name)
        self._put(device.stream.flush())
        self._counts.update(_beside_received(device))
        return True

    def _gives_way(self, name: str, lasted: float, silent: float) -> bool:
        """Return whether a device that has been ``silent`` for so many seconds gives way to who has
        sent for ``lasted`` seconds: it is overdue, and has sent for a shorter time."""
        return lasted > self._lasted(name) and self._senders.overdue(silent)

    def _lasted(self, name: str) -> float:
        """Return for how long a device has sent, seconds."""
        return self._senders.lasted(name, self._devices[name].address)

    def discard(self) -> None:
        """Drop the frames that wait to be fetched."""
        self._counts["dropped"] += len(self._queue)
        self._queue.clear()

    def poll(self, now: float) -> None:
        """Release packets whose waiting time for an earlier one is over."""
        for device in self._devices.values():
            self._put(device.stream.overdue(now))
        self._dropping.tell_more(now)

    def _put(self, frames: Iterable[Frame]) -> None:
        for frame in frames:
            if self.on_frame is not None:
                self.on_frame(frame)
            self._counts["dropped"] += len(self._queue) == self._queue.maxlen
            self._queue.append(frame)


def _beside_received(device: _Device) -> dict[str, int]:
    """Return the counts of the packets of a device; all datagrams are counted as they come."""
    counts = asdict(device.stream.arrivals)
    del counts["received"]
    return counts


class Receiver(Intake, asyncio.DatagramProtocol):
    """Frames of one kind of array from the network:
    ``async with Receiver(layout, port) as r: async for frame in r:``.

    No content of a datagram stops the receiver or grows its memory: invalid datagrams are counted
    and discarded; the numbers of devices and of waiting frames are limited. A full queue discards
    its oldest frame. At the limit of devices a new one takes the place of one that is overdue and
    has sent for a shorter time, or has been silent for 2 s.

    Args:
        layout: the array; its rate determines which packets are missing.
        port: to listen on; 0 chooses a free one.
        host: address to listen on; the default receives from this machine only, "0.0.0.0" from the
            whole network.
        ticks: ticks of the time stamps in a second.
        devices: names of the accepted devices, each with its address where it has a fixed one, as
            "hand@10.0.0.7"; None: any.
        most_devices: limit of devices; packets of further ones are refused.
        queue: frames that may wait to be fetched.
        window: packets of a device held back for a late one.
        key: packets without the right authentication code are refused (see :func:`parse_packet`).
            Time stamps must then never go back, not even when the device restarts: that excludes
            replays.
        on_frame: called with each frame before it waits to be fetched, also where the queue
            discards it.
        on_trouble: called with a device ("": none) and one line about packets that are malformed,
            oversized, not authentic or from a device beyond the limit (the first one, then a count
            every 10 s), and about a clock that runs in another unit than ``ticks`` states (once a
            device).

    Raises:
        ValueError: an address in ``devices`` is none.
    """

    def __init__(
        self, layout: SensorLayout, port: int = 0, *, host: str = "127.0.0.1", **options: Any
    ) -> None:
        super().__init__(layout, **options)
        self.port = port
        self.host = host
        self._transport: asyncio.BaseTransport | None = None
        self._news = asyncio.Event()
        self._closed = False
        self._ticker: asyncio.Task[None] | None = None

    @property
    def closed(self) -> bool:
        """Whether it no longer listens."""
        return self._closed

    def close(self) -> None:
        """Stop listening. Received frames can still be fetched; then the iteration ends."""
        if self._closed:
            return
        self._closed = True
        if self._ticker is not None:
            self._ticker.cancel()
        if self._transport is not None:
            self._transport.close()
        for device in self._devices.values():
            self._put(device.stream.flush())
        self._news.set()

    async def __aenter__(self) -> Receiver:
        loop = asyncio.get_running_loop()
        family, kind, protocol, _, address = socket.getaddrinfo(
            self.host, self.port, type=socket.SOCK_DGRAM
        )[0]
        listening = socket.socket(family, kind, protocol)
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _KERNEL_BUFFER)
            listening.bind(address)
            listening.setblocking(False)
            self._transport, _ = await loop.create_datagram_endpoint(lambda: self, sock=listening)
        except BaseException:
            listening.close()
            raise
        self.port = listening.getsockname()[1]
        self._ticker = asyncio.create_task(self._tick())
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
        await asyncio.sleep(0)  # the transport closes its socket in the next turn

    def __aiter__(self) -> Receiver:
        return self

    async def __anext__(self) -> Frame:
        for _ in range(_TURNS):  # lets the loop read the socket, however many frames wait
            await asyncio.sleep(0)
        while not self._queue:
            if self._closed:
                raise StopAsyncIteration
            self._news.clear()
            await self._news.wait()
        return self._queue.popleft()

    def datagram_received(self, data: bytes, addr: object) -> None:
        """Called by asyncio."""
        self.take(data, time.monotonic(), str(addr[0]) if isinstance(addr, tuple) else "")

    def error_received(self, exc: Exception) -> None:
        """Called by asyncio for ICMP errors, which do not affect a receiver."""

    async def _tick(self) -> None:
        while True:
            await asyncio.sleep(_TICK)
            self.poll(time.monotonic())

    def _put(self, frames: Iterable[Frame]) -> None:
        super()._put(frames)
        if self._queue:
            self._news.set()


def _noun(name: str, count: int) -> str:
    return name.removesuffix("s") if count == 1 else name


def _device(text: str) -> tuple[str, str | None]:
    """Return the name and the address, if any, of a device "name" or "name@address"."""
    name, _, address = text.partition("@")
    if not address:
        return name, None
    with suppress(ValueError):
        return name, str(ip_address(address))
    raise ValueError(
        f"device {text!r}: {address!r} is no IP address; expected NAME or NAME@ADDRESS"
    )
