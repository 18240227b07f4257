"""Receives the packets of several devices over UDP in bounded memory."""

from __future__ import annotations

import asyncio
import socket
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass, fields
from ipaddress import ip_address
from types import TracebackType

from adaptfault.acquisition.clock import ClockCheck
from adaptfault.acquisition.ordering import WINDOW, Arrivals, Frame, Ordering
from adaptfault.acquisition.packet import (
    TICKS,
    NotAuthentic,
    PacketError,
    longest_packet,
    parse_packet,
)
from diagnostics import SensorLayout

MOST_DEVICES = 16
QUEUE = 1024
# bytes requested, for datagrams that arrive while this process does not run
_KERNEL_BUFFER = 4 << 20
_TURNS = 8  # of the event loop for each frame fetched; each turn reads one datagram
_BOUND = 10.0  # seconds of silence after which a device may send from another address
_IDLE = 2.0  # seconds of silence after which a device may give its place to another one
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
        counts = {f.name: getattr(self, f.name) for f in fields(self)}
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
        return {f.name: getattr(self, f.name) for f in fields(self)}


class Receiver(asyncio.DatagramProtocol):
    """Frames of one kind of array from the network:
    ``async with Receiver(layout, port) as r: async for frame in r:``.

    No content of a datagram stops the receiver or grows its memory: invalid datagrams are counted
    and discarded; the numbers of devices and of waiting frames are limited. A full queue discards
    its oldest frame. At the limit of devices a new one takes the place of the one that has been
    silent longest, 2 s at least.

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
        self,
        layout: SensorLayout,
        port: int = 0,
        *,
        host: str = "127.0.0.1",
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
        self.port = port
        self.host = host
        self.ticks = ticks
        self.on_frame = on_frame
        self.on_trouble = on_trouble
        self.devices = None if devices is None else dict(map(_device, devices))
        self.most_devices = most_devices
        self.window = window
        self.key = key
        self._queue: deque[Frame] = deque(maxlen=queue)
        self._longest = longest_packet(layout.n_cells)
        self._streams: dict[str, Ordering] = {}
        self._clocks: dict[str, ClockCheck] = {}
        self._senders: dict[
            str, tuple[str, float]
        ] = {}  # address of each device, and when it sent last
        # counts of devices that are forgotten
        self._evicted = dict.fromkeys((f.name for f in fields(Arrivals)), 0)
        self._received = self._dropped = self._malformed = self._oversized = self._forged = (
            self._refused
        ) = 0
        self._told: float | None = None  # when a packet was told that is not taken
        self._untold = 0  # such packets since then
        self._last_problem = ""
        self._transport: asyncio.BaseTransport | None = None
        self._news = asyncio.Event()
        self._closed = False
        self._ticker: asyncio.Task[None] | None = None

    @property
    def counters(self) -> Counters:
        """Counts of all datagrams so far."""
        each = [stream.arrivals for stream in self._streams.values()]
        total = {
            f.name: self._evicted[f.name] + sum(getattr(one, f.name) for one in each)
            for f in fields(Arrivals)
            if f.name != "received"
        }
        total["kept"] -= self._dropped
        return Counters(
            received=self._received,
            dropped=self._dropped,
            malformed=self._malformed,
            oversized=self._oversized,
            forged=self._forged,
            refused=self._refused,
            devices=len(each),
            **total,
        )

    @property
    def arrivals(self) -> dict[str, Arrivals]:
        """Counts of the packets of each device."""
        return {name: stream.arrivals for name, stream in self._streams.items()}

    def take(self, data: bytes, now: float, sender: str = "") -> None:
        """Process one datagram that arrived at ``now``, seconds of a monotonic clock, from the
        address ``sender``.

        A device is bound to the address that it sends from first: packets with its name from other
        addresses are refused until it has been silent for 10 s.
        """
        self._received += 1
        if len(data) > self._longest:
            self._oversized += 1
            self._tell(f"{len(data)} bytes, expected {self._longest} at most", now, sender)
            return
        try:
            packet = parse_packet(data, self.layout.n_cells, ticks=self.ticks, key=self.key)
        except NotAuthentic as error:
            self._forged += 1
            self._tell(str(error), now, sender)
            return
        except PacketError as error:
            self._malformed += 1
            self._tell(str(error), now, sender)
            return
        if self.devices is not None and self.devices.get(packet.device, "none") not in (
            None,
            sender,
        ):
            self._refused += 1
            return
        stream = self._streams.get(packet.device)
        if stream is None:
            if len(self._streams) >= self.most_devices and not self._evict(now):
                self._refused += 1
                most = f"{self.most_devices} devices send, and no more are taken"
                self._tell(f"{most}; --device NAME takes the named ones alone", now, sender)
                return
            stream = self._streams[packet.device] = Ordering(
                packet.device, self.layout.rate, window=self.window, restarts=self.key is None
            )
            self._clocks[packet.device] = ClockCheck(self.ticks)
        bound, last = self._senders.get(packet.device, (sender, now))
        if sender != bound and now - last < _BOUND:
            self._refused += 1
            return
        self._senders[packet.device] = (sender, now)
        problem = self._clocks[packet.device].push(packet.time, now)
        if problem and self.on_trouble is not None:
            self.on_trouble(packet.device, problem)
        self._put(stream.push(packet, now))

    def _tell(self, problem: str, now: float, sender: str) -> None:
        """Tell the first datagram that is not taken; later ones are told together."""
        if self.on_trouble is None:
            return
        self._last_problem = f"{problem}{f' (from {sender})' if sender else ''}"
        if self._told is None:
            self._told = now
            self.on_trouble("", f"a packet is dropped: {self._last_problem}")
            return
        self._untold += 1
        self._tell_more(now)

    def _tell_more(self, now: float) -> None:
        if not self._untold or self._told is None or now - self._told < _TELL:
            return
        assert self.on_trouble is not None
        packets = "packet is" if self._untold == 1 else "packets are"
        self.on_trouble(
            "", f"{self._untold} more {packets} dropped, the last: {self._last_problem}"
        )
        self._told = now
        self._untold = 0

    def _evict(self, now: float) -> bool:
        """Forget the device that has been silent longest; return whether there was one."""
        name = min(self._senders, key=lambda one: self._senders[one][1])
        if now - self._senders[name][1] < _IDLE:
            return False
        stream = self._streams.pop(name)
        del self._senders[name], self._clocks[name]
        self._put(stream.flush())
        for count in self._evicted:
            self._evicted[count] += getattr(stream.arrivals, count)
        return True

    def discard(self) -> None:
        """Drop the frames that wait to be fetched."""
        self._dropped += len(self._queue)
        self._queue.clear()

    @property
    def closed(self) -> bool:
        """Whether it no longer listens."""
        return self._closed

    def poll(self, now: float) -> None:
        """Release packets whose waiting time for an earlier one is over."""
        for stream in self._streams.values():
            self._put(stream.overdue(now))
        self._tell_more(now)

    def close(self) -> None:
        """Stop listening. Received frames can still be fetched; then the iteration ends."""
        if self._closed:
            return
        self._closed = True
        if self._ticker is not None:
            self._ticker.cancel()
        if self._transport is not None:
            self._transport.close()
        for stream in self._streams.values():
            self._put(stream.flush())
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
        for frame in frames:
            if self.on_frame is not None:
                self.on_frame(frame)
            self._dropped += len(self._queue) == self._queue.maxlen
            self._queue.append(frame)
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
