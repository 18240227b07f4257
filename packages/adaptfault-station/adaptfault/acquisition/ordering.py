"""Ordering of one device's packets: late, duplicate, lost and stray packets, and restarts of the
device."""

from __future__ import annotations

from bisect import insort
from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from adaptfault.acquisition.packet import Packet

WINDOW = 3
"""Most packets that are held back while an earlier one is missing."""

# seconds by which a packet may be older than the last frame; an older time stamp is a restart
_LATE = 1.0
_FAR = 10.0  # seconds; a larger jump of the time stamp needs a second packet that agrees
_PATIENCE = 0.25  # seconds for which a packet is held at least, because networks delay packets
_QUIET = 0.5  # seconds; a device that sent within that has not restarted: no boot is so short
_REMEMBERED = 64  # time stamps in which duplicates are recognised


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame in the order of time stamps.

    Attributes:
        device: name of the sender.
        time: seconds; increases from frame to frame, also across a restart of the device.
        values: float64 ``[D]``, NaN = missing reading.
        lost: number of frames missing before this one.
        restarted: the device's clock restarted with this frame.
        scan: share of the drive in a frame of a scan; None: an ordinary frame.
    """

    device: str
    time: float
    values: NDArray[np.float64]
    lost: int = 0
    restarted: bool = False
    scan: float | None = None


@dataclass(frozen=True)
class Arrivals:
    """Counts of one device's packets.

    ``received`` = ``kept`` + ``duplicates`` + ``late`` + ``strays`` + ``held``.

    Attributes:
        received: valid packets.
        kept: passed on as frames.
        duplicates: repeated time stamps.
        late: older than a frame that was passed on.
        strays: time stamps far from all others.
        held: waiting for an earlier packet.
        lost: frames missing according to the time stamps.
        restarts: restarts of the device's clock.
    """

    received: int = 0
    kept: int = 0
    duplicates: int = 0
    late: int = 0
    strays: int = 0
    held: int = 0
    lost: int = 0
    restarts: int = 0


@dataclass(order=True)
class _Waiting:
    time: float
    packet: Packet = field(compare=False)
    arrived: float = field(compare=False)


class Ordering:
    """Orders the packets of one device by time stamp, in constant memory.

    A packet that follows the last frame is passed on at once. A packet after a gap is held back
    until the gap is filled, ``window`` packets are held, or the time of so many packets has passed.
    A jump of the time stamp needs a second packet that agrees: backwards the device restarted,
    forwards it was silent. A device whose packets still arrive has not restarted, so older time
    stamps are then replays, which are dropped as strays.

    Args:
        device: name of the device.
        rate: packets per second.
        window: most packets held back.
        restarts: the device's clock may restart; False: older time stamps are always dropped.
    """

    def __init__(
        self, device: str, rate: float, *, window: int = WINDOW, restarts: bool = True
    ) -> None:
        self.device = device
        self.rate = rate
        self.window = window
        self.restarts = restarts
        self._last: float | None = None  # time stamp of the last frame passed on
        self._arrived = 0.0  # its arrival by the receiver's clock
        self._offset = 0.0  # from the device's clock to a clock that never goes back
        self._held: list[_Waiting] = []
        self._stray: _Waiting | None = None
        self._seen: deque[float] = deque(maxlen=_REMEMBERED)
        self._counts: Counter[str] = Counter()

    @property
    def arrivals(self) -> Arrivals:
        """Counts so far."""
        return Arrivals(held=len(self._held) + (self._stray is not None), **self._counts)

    def push(self, packet: Packet, now: float) -> list[Frame]:
        """Add a packet that arrived at ``now`` (seconds); return the frames that are ready."""
        self._counts["received"] += 1
        return self._place(_Waiting(packet.time, packet, now))

    def overdue(self, now: float) -> list[Frame]:
        """Return the frames whose waiting time is over at ``now``, seconds of the receiver's
        clock."""
        if self._held and now - min(one.arrived for one in self._held) > max(
            _PATIENCE, (self.window + 1) / self.rate
        ):
            return self._release_held()
        return []

    def flush(self) -> list[Frame]:
        """Return all held frames; call at the end."""
        if self._stray is not None:
            self._stray = None
            self._counts["strays"] += 1
        return self._release_held()

    def _place(self, one: _Waiting) -> list[Frame]:
        if self._last is None:
            return [self._release(one)]
        waiting = self._held if self._stray is None else [*self._held, self._stray]
        if one.time in self._seen or any(one.time == other.time for other in waiting):
            self._counts["duplicates"] += 1
            return []
        step = one.time - self._last
        if not -_LATE <= step <= _FAR:
            return self._handle_jump(one)
        if step <= 0:
            self._counts["late"] += 1
            return []
        insort(self._held, one)
        frames = self._release_following()
        if len(self._held) > self.window:
            frames.append(self._release(self._held.pop(0)))
            frames += self._release_following()
        return frames

    def _handle_jump(self, one: _Waiting) -> list[Frame]:
        """Handle a time stamp far from the last: wait for a second packet that agrees."""
        quiet = max(_QUIET, 3 / self.rate)
        if one.time < (self._last or 0.0) and (
            not self.restarts or one.arrived - self._arrived < quiet
        ):
            self._counts["strays"] += 1
            return []
        other = self._stray
        self._stray = one
        if other is None:
            return []
        if abs(one.time - other.time) > _FAR:
            self._counts["strays"] += 1
            return []
        self._stray = None
        frames = self._release_held()
        first, second = sorted((other, one))
        frames.append(self._release(first, restarted=first.time < (self._last or 0.0)))
        return frames + self._place(second)

    def _release_following(self) -> list[Frame]:
        frames = []
        while self._held and self._missing(self._held[0].time) == 0:
            frames.append(self._release(self._held.pop(0)))
        return frames

    def _release_held(self) -> list[Frame]:
        held = self._held
        self._held = []
        return [self._release(one) for one in held]

    def _missing(self, time: float) -> int:
        """Return the number of frames missing between the last one and this time."""
        return 0 if self._last is None else max(0, round((time - self._last) * self.rate) - 1)

    def _release(self, one: _Waiting, *, restarted: bool = False) -> Frame:
        lost = 0
        if restarted and self._last is not None:
            self._counts["restarts"] += 1
            self._seen.clear()
            # Only the receiver's clock measures the duration of the restart.
            away = max(one.arrived - self._arrived, 1 / self.rate)
            self._offset += self._last + away - one.time
        else:
            lost = self._missing(one.time)
        self._last = one.time
        self._arrived = one.arrived
        self._seen.append(one.time)
        self._counts["lost"] += lost
        self._counts["kept"] += 1
        packet = one.packet
        at = one.time + self._offset
        return Frame(self.device, at, packet.values, lost, restarted, packet.scan)
