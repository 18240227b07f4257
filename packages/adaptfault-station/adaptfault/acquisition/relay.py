"""Sends whole frames on: faulty cells are restored, so that software that only reads packets needs
no change."""

from __future__ import annotations

import socket
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.acquisition.packet import TICKS, format_packet
from diagnostics import FaultSet

if TYPE_CHECKING:
    from adaptfault.bundle.versions import Version
    from adaptfault.data.calibration import Calibration
    from adaptfault.imputation.restorer import Restorer

_DIGITS = 15  # every decimal number of so many digits is sent on as it came


@dataclass
class Relayed:
    """Counts of the packets that were sent on.

    Attributes:
        sent: packets that the system took.
        failed: packets that it did not take, as those to an unreachable network.
        restored: packets with at least one restored cell.
    """

    sent: int = 0
    failed: int = 0
    restored: int = 0

    def to_dict(self) -> dict[str, int]:
        """Return a JSON-safe dict."""
        return asdict(self)


class FrameRepair:
    """Restores frames of one device in constant time: cells in F from the healthy ones, other gaps
    by the last reading.

    Args:
        restorer: fitted on healthy recordings.
        known: cells that are faulty whatever a monitor finds.

    Attributes:
        fault_set: F, the cells that are restored in every frame.
    """

    def __init__(self, restorer: Restorer, known: FaultSet) -> None:
        self.restorer = restorer
        self.known = known
        self.fault_set = known
        self._last = restorer.mean_.copy()  # of a cell that has not sent yet

    def found(self, faulty: FaultSet) -> None:
        """Restore these cells too, besides the known ones, from the next frame on."""
        fault_set = self.known | faulty
        if fault_set != self.fault_set:
            # solves the linear system now, after the frame was sent
            self.restorer.deviation(fault_set)
            self.fault_set = fault_set

    def __call__(self, values: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the whole frame ``[D]`` and which of its cells are restored, bool ``[D]``.

        Args:
            values: ``[D]`` in the layout's unit; NaN = missing.
        """
        frame = np.array(values, dtype=np.float64)
        restored = np.isnan(frame) | self.fault_set.mask
        frame = np.where(np.isnan(frame), self._last, frame)
        self._last = np.where(restored, self._last, frame)
        # + 0.0: no minus sign before a zero
        return (
            self.restorer.update(frame, self.fault_set) + 0.0,
            restored,
        )

    def alone(self, values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the same of a frame that follows no other: all its gaps are restored from the
        healthy cells. That takes the time of a linear solve where gaps are new."""
        restored = np.isnan(values) | self.fault_set.mask
        return self.restorer.update(values, self.fault_set) + 0.0, restored


def in_place(
    repair: Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.bool_]]],
    received: NDArray[np.float64],
    values: NDArray[np.float64],
    version: Version | None = None,
    calibration: Calibration | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the whole frame as the sensor would have sent it, each cell at its place.

    Args:
        repair: returns the whole frame and its restored cells, as :class:`FrameRepair`.
        received: ``[D]`` as they came.
        values: ``[D]`` in the layout's unit; NaN = missing.
        version: undoes exchanged wires and replaced pads; None: readings stay where they came from.
        calibration: from received values to the layout's unit; None: they are in that unit.

    Returns:
        The frame ``[D]`` in the unit in which it came, which cells are restored, and which values
        are others than those received: restored ones and those of a replaced pad, both bool
        ``[D]``.
    """
    source = np.arange(len(values)) if version is None else version.source
    given = values[source]
    readings = given if version is None else version.undo(values)
    whole, restored = repair(readings)
    other = restored | (np.isfinite(readings) & (readings != given))
    if calibration is not None and other.any():
        as_received = np.zeros(len(whole))
        as_received[source] = whole
        whole = calibration.invert(as_received)[source]
    return np.where(other, whole, received[source]), restored, other


class Relay:
    """Sends repaired packets to one address over UDP, in the format in which they came.

    A restored value is written with a plus sign, ``+1.25``, which readers of numbers ignore. All
    other values are those that came. Where a device sends whole numbers only, restored ones are
    rounded. Sending never waits: a consumer that is not there, or does not read, has no effect.

    Args:
        address: of the consumer, as ``HOST:PORT``.
        restorer: fitted on healthy recordings.
        known: cells that are faulty from the start.
        calibration: from received values to the layout's unit; restored values are converted back.
        ticks: ticks of the time stamps in a second.

    Raises:
        ValueError: the address has another form, or its host is not known.
    """

    def __init__(
        self,
        address: str,
        restorer: Restorer,
        known: FaultSet,
        *,
        calibration: Calibration | None = None,
        ticks: float = TICKS,
    ) -> None:
        self.host, self.port = parse_address(address)
        self.restorer = restorer
        self.known = known
        self.calibration = calibration
        self.ticks = ticks
        self._to: Any  # host and port, of IPv6 with two numbers more
        try:
            family, kind, protocol, _, self._to = socket.getaddrinfo(
                self.host, self.port, type=socket.SOCK_DGRAM
            )[0]
        except OSError as error:
            raise ValueError(
                f"{address}: {error.strerror or error}; give a host that this machine knows"
            ) from None
        # Not connected: a connected socket reports that nobody listens, at the next packet.
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)
        self.relayed = Relayed()
        self._repairs: dict[str, FrameRepair] = {}
        self._whole: dict[str, bool] = {}  # devices that have sent whole numbers only
        restorer.deviation(known)  # before the first frame

    def send(
        self,
        device: str,
        time: float,
        received: NDArray[np.float64],
        values: NDArray[np.float64],
        version: Version | None = None,
    ) -> None:
        """Send one frame on, as the model of ``version`` reads it: wires put back, replaced pads
        recalibrated.

        Args:
            device: name of the sender.
            time: seconds.
            received: ``[D]`` as they came.
            values: ``[D]`` in the layout's unit; NaN = missing.
            version: of the model that runs; None: readings are sent where they came from.
        """
        repair = self._repairs.setdefault(device, FrameRepair(self.restorer, self.known))
        frame, restored, other = in_place(repair, received, values, version, self.calibration)
        whole = self._whole.get(device, True) and not np.any(frame[~other] % 1)
        self._whole[device] = whole
        self.relayed.restored += bool(restored.any())
        if whole:
            frame = np.where(other, np.rint(frame), frame)
        data = format_packet(
            device, time, frame, ticks=self.ticks, restored=restored, digits=_DIGITS
        )
        try:
            self._socket.sendto(data, self._to)
            self.relayed.sent += 1
        except OSError:
            self.relayed.failed += 1

    def found(self, device: str, faulty: FaultSet) -> None:
        """Restore these cells of a device too, from its next frame on."""
        self._repairs[device].found(faulty)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def __str__(self) -> str:
        counts = self.relayed
        failed = f", {counts.failed} failed" if counts.failed else ""
        return (
            f"{counts.sent} relayed to {self.host}:{self.port} ({counts.restored} with restored"
            f" cells{failed})"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return address and counts as a JSON-safe dict."""
        return {"to": f"{self.host}:{self.port}", **self.relayed.to_dict()}


def parse_address(text: str) -> tuple[str, int]:
    """Return host and port of ``HOST:PORT`` or ``[IPv6]:PORT``.

    Raises:
        ValueError: another form.
    """
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"--relay {text}: expected HOST:PORT, as 127.0.0.1:5006")
    return host, int(port)
