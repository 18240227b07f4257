"""Converts a diagnosis into ``diagnostic_msgs/DiagnosticArray``, as plain dicts, and writes it into
a bag.

No ROS is needed. Publish the dicts with rclpy (:mod:`adaptfault.ros2` does) once a second; ROS
marks a status as stale when it is not repeated for some seconds.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from diagnostics import Diagnosis, Fault, Line, SensorLayout
from diagnostics.decision.coverage import percent
from diagnostics.wiring import DECLARED

TOPIC = "/diagnostics"

# share of faulty cells of a pad that is an ERROR even without a faulty wire, as for exit codes
_SHARE = 0.1
# of the declared rate; below it the stream is a WARN, the tolerance of diagnostic_updater
_SLOW = 0.9
_LISTED = 20  # most cells named in one value
_GROUPS = {
    "rows": ("row",),
    "columns": ("column",),
    "addresses": ("row_address", "column_address"),
    "converter": ("converter",),
}


class Level(IntEnum):
    """``diagnostic_msgs/DiagnosticStatus``'s levels."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


def diagnostic_array(
    diagnosis: Diagnosis,
    *,
    stamp: float = 0.0,
    name: str = "tactile",
    hardware_id: str = "tactile",
    rate: float | None = None,
) -> dict[str, Any]:
    """Return a DiagnosticArray: one status for each pad, each group of its wires, and the stream of
    frames.

    The names depend on the layout only: "tactile: pad 0", "tactile: pad 0 rows" (``columns``,
    ``addresses``, ``converter``; with declared wiring ``groups``), ..., "tactile: stream". Single
    faulty cells of a pad are a WARN; a tenth of its cells, or a wire, is an ERROR, also of the
    wire's group. Lost or frozen frames are a WARN of the stream, and so is a rate below 90 % of the
    layout's. Untested cells are counted in the values and do not change the level.

    Args:
        diagnosis: to convert.
        stamp: seconds since 1970.
        name: prefix of all names.
        hardware_id: of the sensor.
        rate: at which frames come, per second; None: unknown.
    """
    layout = diagnosis.layout
    statuses = []
    for pad in range(layout.pads):
        on_pad = [f for f in diagnosis.faults if layout.position(f.cells[0])[0] == pad]
        statuses.append(_pad(diagnosis, pad, on_pad))
        for group, kinds in _groups(layout).items():
            faults = [f for f in on_pad if f.line is not None and f.line.kind in kinds]
            statuses.append(_wires(layout, pad, group, kinds, faults))
    statuses.append(_stream(diagnosis, rate))
    return _array(statuses, stamp, name, hardware_id)


def stale_array(
    layout: SensorLayout,
    message: str = "no frames",
    *,
    stamp: float = 0.0,
    name: str = "tactile",
    hardware_id: str = "tactile",
    level: Level = Level.STALE,
) -> dict[str, Any]:
    """Return the same statuses, all STALE (or of another level) with this message, for a sensor
    without frames."""
    names = [
        one
        for pad in range(layout.pads)
        for one in (f"pad {pad}", *(f"pad {pad} {group}" for group in _groups(layout)))
    ]
    statuses = [_status(one, level, message, {}) for one in (*names, "stream")]
    return _array(statuses, stamp, name, hardware_id)


def write_diagnostics(
    path: str | os.PathLike[str], arrays: Iterable[Mapping[str, Any]], *, topic: str = TOPIC
) -> None:
    """Write DiagnosticArrays into a new bag (MCAP, metadata version 8, which ROS 2 Humble reads),
    at their stamps.

    Raises:
        ValueError: rosbags is not installed, or the path exists.
        OSError: the bag cannot be written.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise ValueError(
            f"{path}: bags are written with rosbags; install it:"
            " pip install 'adaptfault-viewers[ros]'"
        ) from None
    if Path(path).exists():
        raise ValueError(f"{path} exists already; give the bag another name")
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    with Writer(Path(path), version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(topic, kind, typestore=store)
        for array in arrays:
            stamp = array["header"]["stamp"]
            data = store.serialize_cdr(_message(store.types, array), kind)
            writer.write(connection, stamp["sec"] * 10**9 + stamp["nanosec"], data)


def _groups(layout: SensorLayout) -> dict[str, tuple[str, ...]]:
    return _GROUPS if layout.is_matrix else {"groups": DECLARED}


def _pad(diagnosis: Diagnosis, pad: int, faults: list[Fault]) -> dict[str, Any]:
    layout = diagnosis.layout
    cells = np.flatnonzero(
        layout.is_cell & (np.arange(layout.n_cells) // (layout.rows * layout.shape[2]) == pad)
    )
    faulty = [cell for cell in diagnosis.fault_set if cell in set(cells.tolist())]
    untested = np.intersect1d(diagnosis.coverage.untested, cells).size
    tested = 1 - untested / max(1, cells.size)
    if faulty:
        grave = any(f.line is not None for f in faults) or len(faulty) >= _SHARE * cells.size
        level = Level.ERROR if grave else Level.WARN
        message = f"{len(faulty)} of {cells.size} cells faulty"
    else:
        level = Level.OK
        message = f"no fault found, {percent(tested)}% of the cells tested"
    values: dict[str, Any] = {"cells": cells.size, "faulty": len(faulty), "untested": untested}
    values |= {"test coverage": f"{tested:.3f}", "faulty cells": _places(layout, faulty)}
    values |= {f"cause {i}": fault.reason for i, fault in enumerate(faults, 1)}
    advice = next((touch for touch in diagnosis.coverage.advice if f"pad {pad}," in touch), None)
    return _status(
        f"pad {pad}", level, message, values if advice is None else values | {"advice": advice}
    )


def _wires(
    layout: SensorLayout, pad: int, group: str, kinds: tuple[str, ...], faults: list[Fault]
) -> dict[str, Any]:
    wires = sum(line.pad == pad and line.kind in kinds for line in layout.lines)
    values: dict[str, Any] = {"wires": wires, "faulty": len(faults)}
    for fault in faults:
        values[_short(fault.line)] = fault.reason
    if faults:
        return _status(
            f"pad {pad} {group}", Level.ERROR, "; ".join(_short(f.line) for f in faults), values
        )
    return _status(f"pad {pad} {group}", Level.OK, "no fault found", values)


def _stream(diagnosis: Diagnosis, rate: float | None) -> dict[str, Any]:
    counts = {
        kind: sum(t.frames for t in diagnosis.transport if t.kind == kind)
        for kind in ("lost", "frozen")
    }
    values: dict[str, Any] = {
        "frames": diagnosis.n_frames,
        "recordings": diagnosis.n_recordings,
        **counts,
    }
    messages = [f"{count} frames {kind}" for kind, count in counts.items() if count]
    declared = diagnosis.layout.rate
    if rate is not None:
        values |= {"rate": f"{rate:.3g}", "declared rate": f"{declared:g}"}
        if rate < _SLOW * declared:
            messages.append(f"{rate:.3g} frames a second, {declared:g} are declared")
    message = "; ".join(messages)
    return _status(
        "stream",
        Level.WARN if message else Level.OK,
        message or "frames come as they should",
        values,
    )


def _places(layout: SensorLayout, cells: list[int]) -> str:
    """Return at most 20 cells as "row.column", or by index with declared wiring, and the number of
    the others."""
    pattern = "{1}.{2}" if layout.is_matrix else "{3}"
    places = [pattern.format(*layout.position(cell), cell) for cell in cells[:_LISTED]]
    more = [f"and {len(cells) - _LISTED} more"] if len(cells) > _LISTED else []
    return " ".join([*places, *more])


def _short(line: Line | None) -> str:
    return str(line).partition(", ")[2] or str(line)


def _status(name: str, level: Level, message: str, values: Mapping[str, Any]) -> dict[str, Any]:
    pairs = [{"key": key, "value": str(value)} for key, value in values.items()]
    return {"level": int(level), "name": name, "message": message, "values": pairs}


def _array(
    statuses: list[dict[str, Any]], stamp: float, name: str, hardware_id: str
) -> dict[str, Any]:
    whole = [
        {**one, "name": f"{name}: {one['name']}", "hardware_id": hardware_id} for one in statuses
    ]
    seconds, rest = divmod(round(stamp * 1e9), 10**9)
    return {"header": {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": ""}, "status": whole}


def _message(types: Mapping[str, Any], array: Mapping[str, Any]) -> Any:
    """Return a DiagnosticArray of rosbags' types."""
    status = types["diagnostic_msgs/msg/DiagnosticStatus"]
    pair = types["diagnostic_msgs/msg/KeyValue"]
    stamp = types["builtin_interfaces/msg/Time"](**array["header"]["stamp"])
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=array["header"]["frame_id"])
    statuses = [
        status(**{**one, "values": [pair(**p) for p in one["values"]]}) for one in array["status"]
    ]
    return types["diagnostic_msgs/msg/DiagnosticArray"](header=header, status=statuses)
