"""The paper's UDP packets, ``device_id,timestamp,220 values`` as CSV text (Section II): parsing and
formatting.

Version 2 has one field more where the frame is one of a scan, ``device_id,timestamp,scan=LEVEL,
values``: the share of the drive, 0 to 1, 0 where the lines are let go. Its values are shares of the
converter's range, 0 to 1. All other packets are those of version 1.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptfault.data.recordings.facts.sizes import check_file

TICKS = 1000.0
"""Time stamps count milliseconds, as the ESP32's ``millis()`` does."""

DEVICE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:-]{0,63}")
"""Valid device names; a name becomes part of file names, so path separators are excluded."""

_LARGEST = float(np.finfo(np.float32).max)
_LATEST = 1e19  # ticks; nanoseconds since 1970 fit
_VALUE_BYTES = 32  # a double written in full, and its comma


_SCAN = "scan="
_TAG = 16  # bytes of the HMAC, written as twice as many hexadecimal digits
_SHORTEST_KEY = 16  # bytes


class PacketError(ValueError):
    """A datagram that is not a packet of this array. One line: what came, what was expected."""


class NotAuthentic(PacketError):
    """A packet without an authentication code, or with a wrong one."""


@dataclass(frozen=True, eq=False)
class Packet:
    """One scan of the array.

    Attributes:
        device: name of the sender.
        time: seconds of the sender's clock.
        values: float64 ``[D]`` in the sender's unit; NaN = missing reading.
        restored: cells whose value was written with a plus sign: ``adaptfault listen --relay``
            restored them.
        scan: share of the drive in a frame of a scan, whose values are shares of the converter's
            range; None: an ordinary frame.
    """

    device: str
    time: float
    values: NDArray[np.float64]
    restored: tuple[int, ...] = ()
    scan: float | None = None


def longest_packet(n_cells: int) -> int:
    """Return the largest size of a packet of ``n_cells`` values, in bytes."""
    return 128 + _VALUE_BYTES * n_cells + 1 + 2 * _TAG


def read_key(path: str | os.PathLike[str]) -> bytes:
    """Return the key in a file, without white space at its ends.

    Raises:
        ValueError: it is shorter than 16 bytes, or no regular file (a pipe or a device may have no
            end).
        OSError: the file cannot be read.
    """
    check_file(Path(path))
    key = Path(path).read_bytes().strip()
    if len(key) < _SHORTEST_KEY:
        raise ValueError(
            f"{path}: a key of {len(key)} bytes, expected {_SHORTEST_KEY} or more; openssl rand"
            " -hex 32"
        )
    return key


def parse_packet(
    data: bytes, n_cells: int, *, ticks: float = TICKS, key: bytes | None = None
) -> Packet:
    """Parse a packet. An empty value and ``nan`` are missing readings; a line end or a trailing
    comma is ignored.

    Args:
        data: the datagram.
        n_cells: D, number of values.
        ticks: ticks of the time stamp in a second.
        key: the packet must end with ``*`` and the HMAC-SHA256 of all before, its first 16 bytes as
            32 hexadecimal digits. None: packets have no such code.

    Raises:
        PacketError: the datagram is not such a packet.
        NotAuthentic: the code is missing or wrong.
    """
    if len(data) > longest_packet(n_cells):
        raise PacketError(
            f"{len(data)} bytes; {n_cells} values take {longest_packet(n_cells)} at most"
        )
    if key is not None:
        data, _, code = data.rstrip(b"\r\n\0 ").rpartition(b"*")
        if not hmac.compare_digest(code.lower(), _code(data, key)):
            raise NotAuthentic(
                "no authentication code, or a wrong one; the sender needs the same key"
            )
    try:
        text = data.decode("ascii").rstrip("\r\n\0 ")
    except UnicodeDecodeError:
        raise PacketError("not ASCII text; expected device_id,timestamp,values") from None
    device, stamp, *values = [*text.split(","), ""] if "," not in text else text.split(",")
    scan = None
    if values and values[0].startswith(_SCAN):
        scan = _level(values.pop(0))
    if len(values) == n_cells + 1 and not values[-1]:
        values.pop()
    if len(values) != n_cells:
        raise PacketError(f"{len(values)} values after device and time stamp, expected {n_cells}")
    if DEVICE.fullmatch(device) is None:
        raise PacketError(
            f"device {device[:20]!r}; expected letters, digits and . _ : - (64 at most)"
        )
    time = _number(stamp)
    if not 0 <= time < _LATEST:
        raise PacketError(f"time stamp {stamp[:20]!r}; expected a number of ticks, 0 or more")
    frame = np.array([_number(value) if value else math.nan for value in values])
    if (np.abs(frame) > _LARGEST).any():
        raise PacketError("a value is infinite or too large")
    restored = (
        tuple(i for i, value in enumerate(values) if value.startswith("+")) if "+" in text else ()
    )
    return Packet(device, time / ticks, frame, restored, scan)


def format_packet(
    device: str,
    time: float,
    values: ArrayLike,
    *,
    ticks: float = TICKS,
    restored: ArrayLike | None = None,
    digits: int = 6,
    key: bytes | None = None,
    scan: float | None = None,
) -> bytes:
    """Write the packet that :func:`parse_packet` reads; the time stamp is a whole number of ticks.

    Args:
        device: name of the sender.
        time: seconds.
        values: ``[D]``; NaN = missing reading.
        ticks: ticks of the time stamp in a second.
        restored: bool ``[D]``, values that are written with a plus sign, which readers of numbers
            ignore.
        digits: significant digits of a value that is not restored; restored ones have 6.
        key: of the authentication code that the packet ends with; None: no code.
        scan: share of the drive in a frame of a scan; None: an ordinary frame.

    Raises:
        ValueError: :func:`parse_packet` would reject the device name, or the share.
    """
    if scan is not None and not 0 <= scan <= 1:
        raise ValueError(f"scan={scan}: expected the share of the drive, 0 to 1")
    if DEVICE.fullmatch(device) is None:
        raise ValueError(f"device {device!r}; expected letters, digits and . _ : - (64 at most)")
    numbers = np.asarray(values, dtype=np.float64).ravel().tolist()
    written = ["" if value != value else f"{value:.{digits}g}" for value in numbers]
    for i in () if restored is None else np.flatnonzero(restored).tolist():
        written[i] = f"{numbers[i]:+.6g}"
    level = "" if scan is None else f"{_SCAN}{scan:.9g},"
    data = f"{device},{round(time * ticks)},{level}{','.join(written)}".encode()
    return data if key is None else data + b"*" + _code(data, key)


def _code(data: bytes, key: bytes) -> bytes:
    return hmac.new(key, data, hashlib.sha256).digest()[:_TAG].hex().encode()


def _level(text: str) -> float:
    """Return the share of the drive that a field states; raise PacketError for another one."""
    level = _number(text.removeprefix(_SCAN))
    if not 0 <= level <= 1:
        raise PacketError(f"{text[:20]!r}; expected the share of the drive, scan=0 to scan=1")
    return level


def _number(text: str) -> float:
    """Return the number; raise PacketError also for forms that only Python's float accepts
    ("1_000")."""
    try:
        number = float(text)
    except ValueError:
        raise PacketError(f"{text[:20]!r} is not a number") from None
    if "_" in text:
        raise PacketError(f"{text[:20]!r} is not a number")
    return number
