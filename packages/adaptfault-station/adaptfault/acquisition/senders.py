"""For how long names have sent: where more send than there are places, who lasts gets one.

Anybody on the network can invent names; to hold places with them, each must send as steadily as a
device, and must have begun before it.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

_MOST = 4096  # names: a size
_PERIODS = 3  # without a packet, after which a device is overdue
_PATIENCE = 0.25  # seconds until then at least, because networks delay packets


@dataclass
class _Sender:
    last: float
    lasted: float = 0.0


class Senders:
    """How long names have sent, each from one address; of many names, the last heard.

    Args:
        rate: packets of a device a second.
    """

    def __init__(self, rate: float) -> None:
        self._due = max(_PATIENCE, _PERIODS / rate)
        self._of: OrderedDict[tuple[str, str], _Sender] = OrderedDict()

    def heard(self, name: str, address: str, now: float) -> float:
        """Count a packet at ``now``, seconds of a monotonic clock; return for how long the name
        has sent, seconds: pauses count little."""
        sender = self._of.setdefault((name, address), _Sender(now))
        self._of.move_to_end((name, address))
        if len(self._of) > _MOST:
            self._of.popitem(last=False)
        sender.lasted += min(now - sender.last, self._due)
        sender.last = now
        return sender.lasted

    def lasted(self, name: str, address: str) -> float:
        """Return for how long a name has sent from an address, seconds; 0: unknown."""
        sender = self._of.get((name, address))
        return 0.0 if sender is None else sender.lasted

    def overdue(self, silent: float) -> bool:
        """Return whether a device that has been silent for so many seconds should have sent."""
        return silent > self._due
