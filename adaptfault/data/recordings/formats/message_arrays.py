"""The arrays of numbers in a ROS message that a field path names. The message may be of rosbags or
of rclpy."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ENCODING = re.compile(r"(8|16|32|64)([USF])C(\d*)")
_NAMED = {"mono8": "8UC1", "mono16": "16UC1"}
_KINDS = {"U": "u", "S": "i", "F": "f"}


def arrays_at(message: Any, field: str) -> list[NDArray[Any]]:
    """Return the arrays that a field path leads to, in order, as views of the message: writing
    changes it.

    Args:
        message: of any type.
        field: dotted, as "sensors.values". Where the path leads through a list of messages, each
            gives its array.

    Raises:
        ValueError: an image whose sizes do not fit its data.
    """
    *before, last = field.split(".")
    owners = [message]
    for name in before:
        inner: list[Any] = []
        for owner in owners:
            value = getattr(owner, name)
            inner.extend(value if isinstance(value, list) else [value])
        owners = inner
    return [_array(owner, last) for owner in owners]


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


def _array(owner: Any, name: str) -> NDArray[Any]:
    array = np.asarray(getattr(owner, name))
    return _pixels(owner, array) if name == "data" and hasattr(owner, "encoding") else array


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
