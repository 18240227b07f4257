"""Writes MCAP files for Foxglove: JSON messages with its public schemas.

- ``/tactile/<pad>/readings``: one ``foxglove.Grid`` a frame, field ``reading``
- ``/tactile/<pad>/restored``: the same, with faulty and missing cells restored, where something
  restores them
- ``/tactile/<pad>/states``: one ``foxglove.Grid`` a second, field ``state`` (numbered as in
  :class:`~adaptfault.viewers.timed_log.State`) and its colour
- ``/diagnostics``: one ``diagnostic_msgs/DiagnosticArray`` a second

Foxglove draws the rows of a grid upwards, so the last row of a pad comes first. The states lie
below the readings, the restored ones below the states.

With mcap, where there is foxglove-sdk: that one writes protobuf, and the recordings of such a file
are read back as JSON; its channels of JSON need the same schemas.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping
from os import PathLike
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.atomic import atomic_file
from adaptfault.data.recordings.formats.datasets.extra import imported
from adaptfault.viewers.ros_diagnostics import TOPIC, diagnostic_array
from adaptfault.viewers.timed_log import COLOURS, ROOT, Piece, TimedLog
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
    check_mcap(path)
    status = diagnostic_array(log.diagnosis)
    names = {str(i): name for i, name in enumerate(log.names)}
    with atomic_file(path) as name, open(name, "wb") as file:
        messages = McapMessages(file)
        messages.writer.add_metadata("recordings", names)
        array = messages.array(log.layout)
        for piece in log:
            array.write(piece, log.states, status)
        messages.finish()


def check_mcap(path: str | PathLike[str]) -> None:
    """Raise InputError where the package mcap is not installed; ``path``: of the file to write."""
    what = "MCAP files are written with mcap; install it: pip install 'adaptfault-viewers[view]'"
    imported("mcap.writer", path, what)


class McapMessages:
    """The messages of one file.

    Args:
        file: is written to, and stays open.
    """

    def __init__(self, file: BinaryIO) -> None:
        from mcap.writer import Writer

        self.writer = Writer(file)
        self.writer.start(profile="", library="adaptfault")
        self._grid = self._schema("foxglove.Grid", GRID)
        kind = "diagnostic_msgs/DiagnosticArray"
        self._diagnostics = self._channel(self._schema(kind, DIAGNOSTIC_ARRAY), TOPIC)
        self._right = 0.0  # where the next array is drawn

    def array(self, layout: SensorLayout, root: str = ROOT, *, restored: bool = False) -> McapArray:
        """Return the channels of one more array, which is drawn to the right of those before.

        Args:
            layout: of the array.
            root: what the names of its topics begin with.
            restored: whether its pieces hold restored frames.
        """
        array = McapArray(self, layout, root, restored=restored, right=self._right)
        self._right += CELL * (layout.pads * (layout.shape[2] + 1) + 1)
        return array

    def grid_channel(self, topic: str) -> int:
        """Return a new channel of grids."""
        return self._channel(self._grid, topic)

    def status(self, time: float, status: Mapping[str, Any]) -> None:
        """Add a DiagnosticArray, as :func:`adaptfault.diagnostic_array` makes it, at ``time``
        (seconds)."""
        stamp = _stamp(time)
        header = {"stamp": stamp, "frame_id": FRAME}
        self.add(self._diagnostics, stamp, {**status, "header": header})

    def add(self, channel: int, stamp: Mapping[str, int], message: Mapping[str, Any]) -> None:
        """Add a message to a channel."""
        at = stamp["sec"] * 10**9 + stamp["nsec"]
        data = json.dumps(message, allow_nan=False).encode()
        self.writer.add_message(channel, log_time=at, publish_time=at, data=data)

    def finish(self) -> None:
        """Write the index of the file, its last part."""
        self.writer.finish()

    def _schema(self, name: str, schema: Mapping[str, Any]) -> int:
        data = json.dumps(schema).encode()
        return int(self.writer.register_schema(name=name, encoding="jsonschema", data=data))

    def _channel(self, schema: int, topic: str) -> int:
        channel = self.writer.register_channel(
            topic=topic, message_encoding="json", schema_id=schema
        )
        return int(channel)


class McapArray:
    """The messages of one array in a file; see :meth:`McapMessages.array`."""

    def __init__(
        self,
        messages: McapMessages,
        layout: SensorLayout,
        root: str,
        *,
        restored: bool,
        right: float,
    ) -> None:
        self._messages = messages
        self._due = -np.inf
        self._readings = self._grids(layout, root, "readings", right, 0)
        self._states = self._grids(layout, root, "states", right, 1)
        self._restored = self._grids(layout, root, "restored", right, 2) if restored else []

    def write(self, piece: Piece, states: NDArray[np.uint8], status: Mapping[str, Any]) -> None:
        """Write frames in the order of their times, with the states of all positions once a second.

        Args:
            piece: the frames.
            states: uint8 ``[pads, rows, cols]``, the :class:`State` of each position.
            status: a DiagnosticArray, see :meth:`McapMessages.status`.
        """
        for frame, time in enumerate(piece.times.tolist()):
            stamp = _stamp(time)
            if time >= self._due:
                self._due = time + _REPEAT
                self._add(self._states, stamp, [_coloured(pad) for pad in states])
                self._messages.status(time, status)
            self._add(self._readings, stamp, piece.readings[frame].astype("<f4"))
            if piece.restored is not None:
                self._add(self._restored, stamp, piece.restored[frame].astype("<f4"))

    def _grids(
        self, layout: SensorLayout, root: str, what: str, right: float, row: int
    ) -> list[tuple[int, dict[str, Any]]]:
        """Return the channel of each pad, and what all its messages share."""
        packed = _STATE if what == "states" else _READING
        return [
            (
                self._messages.grid_channel(f"{root}/{pad}/{what}"),
                _grid(layout, pad, packed, right, row),
            )
            for pad in range(layout.pads)
        ]

    def _add(
        self,
        grids: list[tuple[int, dict[str, Any]]],
        stamp: Mapping[str, int],
        pads: Iterable[NDArray[Any]],
    ) -> None:
        for (channel, grid), pad in zip(grids, pads, strict=True):
            message = {"timestamp": stamp, **grid, "data": _packed(pad)}
            self._messages.add(channel, stamp, message)


def _grid(
    layout: SensorLayout, pad: int, packed: np.dtype[Any], right: float, row: int
) -> dict[str, Any]:
    """Return what all grids of a pad share; ``row``: how many grids lie above it."""
    _, rows, cols = layout.shape
    x = right + CELL * (cols + 1) * pad
    y = -CELL * (rows + 1) * row
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
