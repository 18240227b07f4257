"""Message types by name, their arrays of numbers, and DiagnosticArrays. Needs the packages of the
messages."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from importlib import import_module
from typing import Any

_NUMBERS = {
    "float",
    "double",
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
}
_SEQUENCE = re.compile(r"sequence<(.+?)(?:, \d+)?>|(.+)\[\d+\]")


def message_type(name: str) -> Any:
    """Return the class of messages of a type, as "std_msgs/msg/Float32MultiArray".

    Raises:
        ValueError: there is no such type in the packages that are installed.
    """
    package, _, kind = name.replace("/msg/", "/").partition("/")
    try:
        return getattr(import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError, ValueError, TypeError):
        raise ValueError(
            f"topic_type {name!r}: there is no such message; name one as sensor_msgs/msg/Image, of"
            " a sourced package"
        ) from None


def choose_field(kind: Any, field: str) -> str:
    """Return the field that holds the readings of messages of a type.

    Args:
        kind: class of the messages.
        field: dotted; "" = the only array of numbers.

    Raises:
        ValueError: there is no such array, or there are several to choose from.
    """
    arrays = list(_arrays(kind, ""))
    listed = ", ".join(arrays) or "no arrays of numbers"
    if field:
        if field not in arrays:
            raise ValueError(f"field {field!r}: {kind.__name__} has {listed}")
        return field
    if len(arrays) != 1:
        raise ValueError(f"{kind.__name__} has {listed}; name one with the parameter field")
    return arrays[0]


def _arrays(kind: Any, before: str) -> Iterable[str]:
    for name, text in kind.get_fields_and_field_types().items():
        match = _SEQUENCE.fullmatch(text)
        inner = text if match is None else match[1] or match[2]
        if "/" in inner:
            yield from _arrays(message_type(inner), f"{before}{name}.")
        elif match is not None and inner in _NUMBERS:
            yield before + name


def stamp_of(message: Any) -> float | None:
    """Return the time in the header of a message, seconds; None without one, or where it is 0."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None or not (stamp.sec or stamp.nanosec):
        return None
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def diagnostics_message(content: Mapping[str, Any]) -> Any:
    """Return a DiagnosticArray message with the content of :func:`adaptfault.diagnostic_array`."""
    from builtin_interfaces.msg import Time
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from std_msgs.msg import Header

    header = content["header"]
    statuses = []
    for one in content["status"]:
        pairs = [KeyValue(**pair) for pair in one["values"]]
        statuses.append(
            DiagnosticStatus(**{**one, "level": bytes([one["level"]]), "values": pairs})
        )
    return DiagnosticArray(
        header=Header(stamp=Time(**header["stamp"]), frame_id=header["frame_id"]),
        status=statuses,
    )
