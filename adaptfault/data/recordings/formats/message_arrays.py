"""The numbers in a message that a field path names. The message may be of rosbags, of rclpy or a
JSON object.

A path leads through messages and lists of messages to numbers, to a list of numbers, to a field
that a PointCloud2 or one of Foxglove's grids and clouds packs into bytes, or to a message, whose
numbers are taken together. Packed bytes themselves are no readings.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ENCODING = re.compile(r"(8|16|32|64)([USF])C(\d*)")
_NAMED = {"mono8": "8UC1", "mono16": "16UC1"}
_KINDS = {"U": "u", "S": "i", "F": "f"}

# numpy's types by the number that sensor_msgs/PointField and foxglove.PackedElementField give them
_ROS = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_FOXGLOVE = ("", "u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8")

Sizes = tuple[int, ...]


def fields_of(message: Any) -> dict[str, Sizes]:
    """Return the paths of all numbers in a message, and the sizes of what they lead to; ``()`` for
    one number, and the count of numbers where the path leads through a list of messages."""
    return {path: _sizes(arrays_at(message, path)) for path in dict.fromkeys(_paths(message, ""))}


def _paths(message: Any, before: str) -> Iterator[str]:
    for name in _names(message):
        value = _get(message, name)
        path = before + name
        if _is_message(value):
            yield from _paths(value, f"{path}.")
        elif isinstance(value, list) and value and all(map(_is_message, value)):
            for one in value:
                yield from _paths(one, f"{path}.")
        elif _is_number(value) or _is_numbers(value):
            yield path


def _sizes(arrays: Sequence[NDArray[Any]]) -> Sizes:
    if len(arrays) == 1:
        return arrays[0].shape
    return (sum(array.size for array in arrays),)


def arrays_at(message: Any, field: str) -> list[NDArray[Any]]:
    """Return the arrays that a field path leads to, in order, as views of the message where it
    holds arrays: writing changes it.

    Args:
        message: of any type.
        field: dotted, as "sensors.values". Where the path leads through a list of messages, each
            gives its array.

    Raises:
        ValueError: the sizes of an image or a cloud do not fit its data.
    """
    *before, last = field.split(".")
    owners = [message]
    for name in before:
        inner: list[Any] = []
        for owner in owners:
            value = _get(owner, name)
            inner.extend(value if isinstance(value, list) else [value])
        owners = inner
    return [array for owner in owners for array in _arrays(owner, last)]


def _arrays(owner: Any, name: str) -> Iterator[NDArray[Any]]:
    """Yield what a name leads to in a message."""
    if name in _packed_names(owner):
        yield _packed(owner, name)
        return
    value = _get(owner, name)
    many = value if isinstance(value, list) else [value]
    if many and all(map(_is_message, many)):
        for one in many:
            for path in dict.fromkeys(_paths(one, "")):
                yield from arrays_at(one, path)
    else:
        yield _shaped(owner, name, value)


def _is_message(value: Any) -> bool:
    """Return whether a value is a message: rosbags has dataclasses, rclpy classes with slots."""
    if isinstance(value, Mapping):
        return True
    return hasattr(value, "__dataclass_fields__") or hasattr(value, "get_fields_and_field_types")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool | np.bool_)


def _is_numbers(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "iuf"
    if not isinstance(value, Sequence) or isinstance(value, str | bytes) or not value:
        return False
    return all(one is None or _is_number(one) or _is_numbers(one) for one in value)


def _names(message: Any) -> list[str]:
    """Return the names in a message; what is packed stands in the place of its bytes."""
    if isinstance(message, Mapping):
        names = list(message)
    elif hasattr(message, "__dataclass_fields__"):
        names = [name for name in message.__dataclass_fields__ if not name.startswith("_")]
    else:
        names = list(message.get_fields_and_field_types())
    packed = _packed_names(message)
    if packed:
        return packed
    if "data" not in names:
        return names
    # of a compressed image the bytes are no readings, and of an array its layout is none
    aside = "data" if "format" in names else "layout"
    return [name for name in names if name != aside]


def _get(owner: Any, name: str) -> Any:
    if name in _packed_names(owner):
        return _packed(owner, name)
    return owner[name] if isinstance(owner, Mapping) else getattr(owner, name)


def _packed_names(owner: Any) -> list[str]:
    """Return the fields that a message packs into its bytes."""
    if isinstance(owner, Mapping):
        is_packed = isinstance(owner.get("data"), str) and isinstance(owner.get("fields"), list)
    else:
        is_packed = hasattr(owner, "point_step") and hasattr(owner, "fields")
    if not is_packed:
        return []
    return [str(_get_plain(field, "name")) for field in _get_plain(owner, "fields")]


def _get_plain(owner: Any, name: str) -> Any:
    if isinstance(owner, Mapping):
        return owner.get(name, ())
    return getattr(owner, name, ())


def _packed(owner: Any, name: str) -> NDArray[Any]:
    """Return one field of a cloud or a grid, ``[rows, columns]`` where it has rows, else
    ``[points]``.

    Foxglove draws the rows of a grid upwards: the first row that is returned is the highest.
    """
    if not isinstance(owner, Mapping):
        field = next(one for one in owner.fields if one.name == name)
        order = ">" if owner.is_bigendian else "<"
        kind = np.dtype(f"{order}{_ROS[field.datatype]}")
        data = np.asarray(owner.data).view(np.uint8)
        sizes = (owner.height, owner.width)
        strides = (owner.row_step, owner.point_step)
        values = _strided(data, kind, field.offset, sizes, strides, field.count)
        cloud: NDArray[Any] = values[0] if owner.height == 1 else values
        return cloud
    field = next(one for one in owner["fields"] if one["name"] == name)
    kind = np.dtype(f"<{_FOXGLOVE[field['type']]}")
    data = np.frombuffer(base64.b64decode(owner["data"]), np.uint8)
    if "cell_stride" in owner:
        rows = len(data) // owner["row_stride"]
        strides = (owner["row_stride"], owner["cell_stride"])
        sizes = (rows, owner["column_count"])
        grid: NDArray[Any] = _strided(data, kind, field["offset"], sizes, strides, 1)[::-1]
        return grid
    step = owner["point_stride"]
    points = len(data) // step
    row = _strided(data, kind, field["offset"], (1, points), (len(data), step), 1)
    return row.reshape(points)


def _strided(
    data: NDArray[np.uint8],
    kind: np.dtype[Any],
    offset: int,
    sizes: tuple[int, int],
    strides: tuple[int, int],
    count: int,
) -> NDArray[Any]:
    """Return the values of a field that lie some bytes apart, as a view of ``data``."""
    rows, columns = sizes
    inside = offset + kind.itemsize * max(count, 1) <= strides[1]
    last = (rows - 1) * strides[0] + columns * strides[1]
    if not inside or min(sizes) < 1 or last > len(data):
        what = f"{rows} x {columns} points of {strides[1]} bytes, {len(data)} bytes do not fit"
        raise ValueError(what)
    shape = (*sizes, count) if count > 1 else sizes
    steps = (*strides, kind.itemsize)[: len(shape)]
    values: NDArray[Any] = np.ndarray(shape, kind, data.data, offset, steps)
    return values


def _shaped(owner: Any, name: str, value: Any) -> NDArray[Any]:
    """Return numbers as an array with the axes that the message states."""
    array = np.asarray(value)
    if array.dtype.kind == "O":  # null in JSON is a missing reading
        array = np.asarray(value, dtype=np.float64)
    if name != "data":
        return array
    if hasattr(owner, "encoding"):
        return _pixels(owner, array)
    dims = _get_plain(_get_plain(owner, "layout"), "dim")
    sizes = tuple(int(_get_plain(dim, "size")) for dim in dims)
    fits = array.ndim == 1 and len(sizes) > 1 and math.prod(sizes) == array.size
    return array.reshape(sizes) if fits else array


def join(arrays: Sequence[NDArray[Any]], dtype: type[np.floating[Any]]) -> NDArray[Any]:
    """Return the numbers of all arrays one after another, ``[D]``."""
    with np.errstate(all="ignore"):  # what the type cannot hold becomes infinite, and is missing
        parts = [array.astype(dtype).ravel() for array in arrays]
    return np.concatenate(parts) if parts else np.empty(0, dtype)


def put(arrays: Sequence[NDArray[Any]], values: NDArray[np.float64]) -> None:
    """Write values ``[D]`` into the arrays; whole numbers are rounded, and clipped to what their
    type holds."""
    start = 0
    for array in arrays:
        given = values[start : start + array.size].reshape(array.shape)
        start += array.size
        if array.dtype.kind in "iu":
            limits = np.iinfo(array.dtype)
            given = np.clip(np.rint(given), limits.min, limits.max)
        array[...] = given


def _pixels(image: Any, data: NDArray[Any]) -> NDArray[Any]:
    """Return the readings of a ``sensor_msgs/Image``: rows without their padding, in the type of
    its encoding.

    Encodings: mono8, mono16, and those such as 16UC1 or 32FC1. Of others, as rgb8, the bytes are
    returned.
    """
    match = _ENCODING.fullmatch(_NAMED.get(image.encoding, image.encoding))
    if match is None:
        return data
    bits, kind, channels = match.groups()
    order = ">" if image.is_bigendian else "<"
    pixel = np.dtype(f"{order}{_KINDS[kind]}{int(bits) // 8}")
    width = image.width * int(channels or 1) * pixel.itemsize
    if image.step < width or len(data) != image.height * image.step:
        raise ValueError(
            f"image of {image.height} rows of {image.step} bytes, {image.width} wide,"
            f" {image.encoding}: {len(data)} bytes do not fit"
        )
    rows: NDArray[Any] = data.view(np.uint8).reshape(image.height, image.step)[:, :width]
    return rows.view(pixel)
