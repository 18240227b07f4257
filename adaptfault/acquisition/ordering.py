"""Puts the packets of one device in order: late, doubled, lost and stray ones, and a device that started anew."""

from __future__ import annotations

from bisect import insort
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from adaptfault.acquisition.packet import Packet

WINDOW = 3
"""So many packets are held back at most while one before them is missing."""

_LATE = 1.0  # seconds by which a packet may come behind its successors; one that is older began a new count
_FAR = 10.0  # seconds; a time stamp that leaps further has to be confirmed by the next one
_PATIENCE = 0.25  # seconds; a packet is held so long at least: the network has its own hiccups
_REMEMBERED = 64  # time stamps that are known again as doubles


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame in its place.

    Attributes:
        device: who sent it.
        time: seconds; rises from frame to frame, also where the device started anew.
        values: float64 ``[D]``, NaN = missing reading.
        lost: how many frames before it never came.
        restarted: the device's clock started anew with it.
    """

    device: str
    time: float
    values: NDArray[np.float64]
    lost: int = 0
    restarted: bool = False


@dataclass(frozen=True)
class Arrivals:
    """What became of one device's packets: ``received`` = all the others but ``lost``, ``restarts``, + ``held``.

    Attributes:
        received: packets that could be read.
        kept: given on as frames.
        duplicates: came twice.
        late: came when later ones had been given on already.
        strays: time stamps far from all others.
        held: wait for one before them.
        lost: frames that never came, as the time stamps tell.
        restarts: the device's clock began anew.
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
    """The packets of one device in the order of their time stamps, in constant memory.

    A packet that follows the last one is given on at once. One that leaves a gap is held back until the gap is filled,
    or ``window`` packets are held, or as long as they take. A time stamp that leaps is taken seriously once a second
    one agrees with it: back, the device has started anew; forth, it was silent.

    Args:
        device: its name.
        rate: packets per second.
        window: most packets held back.
    """

    def __init__(self, device: str, rate: float, *, window: int = WINDOW) -> None:
        self.device, self.rate, self.window = device, rate, window
        self._last: float | None = None  # time stamp of the last frame given on
        self._arrived = 0.0  # when that one came, by the receiver's clock
        self._offset = 0.0  # from the device's clock to one that never jumps back
        self._held: list[_Waiting] = []
        self._stray: _Waiting | None = None
        self._seen: deque[float] = deque(maxlen=_REMEMBERED)
        self._received = self._kept = self._duplicates = self._late = self._strays = self._lost = self._restarts = 0

    @property
    def arrivals(self) -> Arrivals:
        """What became of the packets so far."""
        held = len(self._held) + (self._stray is not None)
        return Arrivals(
            self._received, self._kept, self._duplicates, self._late, self._strays, held, self._lost, self._restarts
        )

    def push(self, packet: Packet, now: float) -> list[Frame]:
        """Take in a packet that arrived at ``now`` (seconds); return the frames that are next."""
        self._received += 1
        return self._place(_Waiting(packet.time, packet, now))

    def overdue(self, now: float) -> list[Frame]:
        """Return the frames that have waited long enough at ``now``, seconds of the receiver's clock."""
        if self._held and now - min(one.arrived for one in self._held) > max(_PATIENCE, (self.window + 1) / self.rate):
            return self._release_held()
        return []

    def flush(self) -> list[Frame]:
        """Return the frames that still wait: no more will come."""
        if self._stray is not None:
            self._stray = None
            self._strays += 1
        return self._release_held()

    def _place(self, one: _Waiting) -> list[Frame]:
        if self._last is None:
            return [self._release(one)]
        waiting = self._held if self._stray is None else [*self._held, self._stray]
        if one.time in self._seen or any(one.time == other.time for other in waiting):
            self._duplicates += 1
            return []
        step = one.time - self._last
        if not -_LATE <= step <= _FAR:
            return self._leap(one)
        if step <= 0:
            self._late += 1
            return []
        insort(self._held, one)
        frames = self._release_following()
        if len(self._held) > self.window:
            frames.append(self._release(self._held.pop(0)))
            frames += self._release_following()
        return frames

    def _leap(self, one: _Waiting) -> list[Frame]:
        """Deal with a time stamp far from the last: wait for a second one that agrees."""
        other, self._stray = self._stray, one
        if other is None:
            return []
        if abs(one.time - other.time) > _FAR:
            self._strays += 1
            return []
        self._stray = None
        frames = self._release_held()
        first, second = sorted((other, one))
        frames.append(self._release(first, anew=first.time < (self._last or 0.0)))
        return frames + self._place(second)

    def _release_following(self) -> list[Frame]:
        frames = []
        while self._held and self._missing(self._held[0].time) == 0:
            frames.append(self._release(self._held.pop(0)))
        return frames

    def _release_held(self) -> list[Frame]:
        held, self._held = self._held, []
        return [self._release(one) for one in held]

    def _missing(self, time: float) -> int:
        """Return how many frames there should be between the last one and this time."""
        return 0 if self._last is None else max(0, round((time - self._last) * self.rate) - 1)

    def _release(self, one: _Waiting, *, anew: bool = False) -> Frame:
        lost = 0
        if anew and self._last is not None:
            self._restarts += 1
            self._seen.clear()
            # How long it was away only the receiver's clock can tell.
            away = max(one.arrived - self._arrived, 1 / self.rate)
            self._offset += self._last + away - one.time
        else:
            lost = self._missing(one.time)
        self._last, self._arrived = one.time, one.arrived
        self._seen.append(one.time)
        self._lost += lost
        self._kept += 1
        return Frame(self.device, one.time + self._offset, one.packet.values, lost, anew)
