"""Writes an MCAP file for Foxglove: JSON messages with its public schemas.

- ``/tactile/<pad>/readings``: one ``foxglove.Grid`` a frame, field ``reading``
- ``/tactile/<pad>/states``: one ``foxglove.Grid`` a second, field ``state`` (numbered as in
  :class:`~adaptfault.viewers.timed_log.State`) and its colour
- ``/diagnostics``: one ``diagnostic_msgs/DiagnosticArray`` a second

Foxglove draws the rows of a grid upwards, so the last row of a pad comes first. The states lie
below the readings.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.acquisition.ros import TOPIC, diagnostic_array
from adaptfault.data.atomic import atomic_file
from adaptfault.data.recordings.errors import InputError
from adaptfault.viewers.timed_log import COLOURS, TimedLog
from diagnostics import SensorLayout

FRAME = "tactile"
"""The frame of reference that all grids share."""

CELL = 0.01
"""Metres that a cell is drawn wide."""

_REPEAT = 1.0  # seconds; ROS and Foxglove call a status stale that is not repeated for some
_TYPES = ("UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64")

_READING = np.dtype([("reading", "<f4")])
_STATE = np.dtype([(name, "u1") for name in ("state", "red", "green", "blue", "alpha")])
_NUMERIC = {"u1": _TYPES.index("UINT8"), "f4": _TYPES.index("FLOAT32")}


def write_mcap(path: str | PathLike[str], log: TimedLog) -> None:
    """Write a log; the memory that it takes does not grow with the log.

    Raises:
        InputError: the package mcap is not installed.
        OSError: the file cannot be written.
    """
    try:
        from mcap.writer import Writer
    except ImportError:
        what = "MCAP files are written with mcap; install it: pip install 'adaptfault[view]'"
        raise InputError.at(path, what) from None
    with atomic_file(path) as name, open(name, "wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="adaptfault")
        _Messages(writer, log).write()
        writer.finish()


class _Messages:
    """The messages of one file."""

    def __init__(self, writer: Any, log: TimedLog) -> None:
        self.writer = writer
        self.log = log
        grid = self._schema("foxglove.Grid", GRID)
        pads = range(log.layout.pads)
        self.readings = [self._channel(grid, f"/tactile/{pad}/readings") for pad in pads]
        self.states = [self._channel(grid, f"/tactile/{pad}/states") for pad in pads]
        kind = "diagnostic_msgs/DiagnosticArray"
        self.diagnostics = self._channel(self._schema(kind, DIAGNOSTIC_ARRAY), TOPIC)

    def write(self) -> None:
        """Write all messages in the order of their times."""
        layout = self.log.layout
        names = {str(i): name for i, name in enumerate(self.log.names)}
        self.writer.add_metadata("recordings", names)
        reading = [_grid(layout, pad, _READING, below=False) for pad in range(layout.pads)]
        shown = [
            {**_grid(layout, pad, _STATE, below=True), "data": _packed(_coloured(states))}
            for pad, states in enumerate(self.log.states)
        ]
        status = diagnostic_array(self.log.diagnosis)
        due = -1.0
        for piece in self.log:
            for time, frame in zip(piece.times.tolist(), piece.readings, strict=True):
                stamp = _stamp(time)
                if time >= due:
                    due = time + _REPEAT
                    for channel, grid in zip(self.states, shown, strict=True):
                        self._add(channel, stamp, {"timestamp": stamp, **grid})
                    header = {"stamp": stamp, "frame_id": FRAME}
                    self._add(self.diagnostics, stamp, {**status, "header": header})
                for channel, grid, pad in zip(self.readings, reading, frame, strict=True):
                    data = _packed(pad.astype("<f4"))
                    self._add(channel, stamp, {"timestamp": stamp, **grid, "data": data})

    def _schema(self, name: str, schema: Mapping[str, Any]) -> int:
        data = json.dumps(schema).encode()
        return int(self.writer.register_schema(name=name, encoding="jsonschema", data=data))

    def _channel(self, schema: int, topic: str) -> int:
        channel = self.writer.register_channel(
            topic=topic, message_encoding="json", schema_id=schema
        )
        return int(channel)

    def _add(self, channel: int, stamp: Mapping[str, int], message: Mapping[str, Any]) -> None:
        at = stamp["sec"] * 10**9 + stamp["nsec"]
        data = json.dumps(message, allow_nan=False).encode()
        self.writer.add_message(channel, log_time=at, publish_time=at, data=data)


def _grid(layout: SensorLayout, pad: int, packed: np.dtype[Any], *, below: bool) -> dict[str, Any]:
    """Return what all grids of a pad share."""
    _, rows, cols = layout.shape
    x = CELL * (cols + 1) * pad
    y = -CELL * (rows + 1) if below else 0.0
    fields = [
        {"name": name, "offset": offset, "type": _NUMERIC[kind.str[1:]]}
        for name, (kind, offset) in _fields(packed)
    ]
    return {
        "frame_id": FRAME,
        "pose": {
            "position": {"x": x, "y": y, "z": 0.0},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        },
        "column_count": cols,
        "cell_size": {"x": CELL, "y": CELL},
        "row_stride": cols * packed.itemsize,
        "cell_stride": packed.itemsize,
        "fields": fields,
    }


def _fields(packed: np.dtype[Any]) -> list[tuple[str, tuple[np.dtype[Any], int]]]:
    assert packed.fields is not None  # for the type checker
    return [(name, packed.fields[name][:2]) for name in packed.names or ()]


def _coloured(states: NDArray[np.uint8]) -> NDArray[Any]:
    """Return each state with its colour."""
    colours = np.array(list(COLOURS.values()), dtype=np.uint8)[states]
    return np.dstack([states, colours])


def _packed(rows: NDArray[Any]) -> str:
    """Return ``[rows, cols, ...]`` as a grid holds it: the lowest row first."""
    return base64.b64encode(rows[::-1].tobytes()).decode()


def _stamp(time: float) -> dict[str, int]:
    sec, nsec = divmod(round(time * 1e9), 10**9)
    return {"sec": sec, "nsec": nsec}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


def _titled(title: str, schema: dict[str, Any]) -> dict[str, Any]:
    return {"title": title, **schema}


_NUMBER = {"type": "number"}
_COUNT = {"type": "integer", "minimum": 0}
_TEXT = {"type": "string"}
_TIME = _titled("time", _object(sec=_COUNT, nsec={**_COUNT, "maximum": 10**9 - 1}))
_NUMERIC_TYPE = {
    "title": "foxglove.NumericType",
    "oneOf": [{"title": name, "const": i} for i, name in enumerate(_TYPES)],
}
_POSE = _object(
    position=_titled("foxglove.Vector3", _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)),
    orientation=_titled("foxglove.Quaternion", _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)),
)
_FIELD = _object(name=_TEXT, offset=_COUNT, type=_NUMERIC_TYPE)

GRID = _titled(
    "foxglove.Grid",
    _object(
        timestamp=_TIME,
        frame_id=_TEXT,
        pose=_titled("foxglove.Pose", _POSE),
        column_count=_COUNT,
        cell_size=_titled("foxglove.Vector2", _object(x=_NUMBER, y=_NUMBER)),
        row_stride=_COUNT,
        cell_stride=_COUNT,
        fields=_list(_titled("foxglove.PackedElementField", _FIELD)),
        data={"type": "string", "contentEncoding": "base64"},
    ),
)
"""JSON schema of ``foxglove.Grid``."""

_STATUS = _object(
    level=_COUNT,
    name=_TEXT,
    message=_TEXT,
    hardware_id=_TEXT,
    values=_list(_titled("diagnostic_msgs/KeyValue", _object(key=_TEXT, value=_TEXT))),
)

DIAGNOSTIC_ARRAY = _titled(
    "diagnostic_msgs/DiagnosticArray",
    _object(
        header=_titled("std_msgs/Header", _object(stamp=_TIME, frame_id=_TEXT)),
        status=_list(_titled("diagnostic_msgs/DiagnosticStatus", _STATUS)),
    ),
)
"""JSON schema of ``diagnostic_msgs/DiagnosticArray``, with the time as Foxglove writes it."""
