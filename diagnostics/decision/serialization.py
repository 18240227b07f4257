"""Writes any dataclass of numbers and arrays as JSON and named arrays, and reads it back bit for
bit. No pickle.

The types of the fields say how each value is read: numbers, booleans, arrays, other dataclasses,
tuples of these, and ``| None``. A :class:`~diagnostics.layout.SensorLayout` is written by its own
``to_dict``.
"""

from __future__ import annotations

import json
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from io import BytesIO
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diagnostics.layout import SensorLayout

Arrays = dict[str, NDArray[Any]]
T = TypeVar("T")

_ABOUT = "about.json"
# what numpy and zipfile raise for a file that was cut off, changed, or is another one
_DAMAGED = (
    AttributeError,
    EOFError,
    KeyError,
    NotImplementedError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)


def to_state(value: object) -> tuple[Any, Arrays]:
    """Return a JSON-safe description of ``value``, and its arrays by dotted name, as
    :func:`from_state` reads them."""
    arrays: Arrays = {}
    return _packed(value, "", arrays), arrays


def from_state(cls: type[T], about: Any, arrays: Mapping[str, ArrayLike]) -> T:
    """Rebuild what :func:`to_state` wrote.

    Raises:
        KeyError: a field or an array is missing.
        TypeError, ValueError: one is of a wrong kind, shape or dtype, or no longer finite.
    """
    value: T = _read(cls, about, arrays, cls.__name__)
    return value


def _packed(value: Any, name: str, arrays: Arrays) -> Any:
    if isinstance(value, SensorLayout):
        return value.to_dict()
    if isinstance(value, np.ndarray):
        arrays[name] = np.array(value, order="C")
        finite = bool(np.isfinite(value).all())
        return {
            "array": name,
            "dtype": str(value.dtype),
            "shape": list(value.shape),
            "finite": finite,
        }
    if is_dataclass(value):
        prefix = f"{name}." if name else ""
        return {
            f.name: _packed(getattr(value, f.name), f"{prefix}{f.name}", arrays)
            for f in fields(value)
        }
    if isinstance(value, tuple):
        return [_packed(item, f"{name}.{i}", arrays) for i, item in enumerate(value)]
    if isinstance(value, np.generic):
        value = value.item()
    # JSON has no infinity
    return value if not isinstance(value, float) or np.isfinite(value) else str(value)


def _read(kind: Any, about: Any, arrays: Mapping[str, ArrayLike], name: str) -> Any:
    origin = get_origin(kind)
    if origin in (Union, UnionType):
        (some,) = (option for option in get_args(kind) if option is not NoneType)
        return None if about is None else _read(some, about, arrays, name)
    if kind is SensorLayout:
        return SensorLayout.from_dict(about)
    if origin in (np.ndarray, NDArray):  # from NumPy 2.5 on the alias is its own origin
        return _array(about, arrays)
    if origin is tuple:
        item = get_args(kind)[0]
        return tuple(_read(item, each, arrays, f"{name}.{i}") for i, each in enumerate(about))
    if isinstance(kind, type) and is_dataclass(kind):
        if not isinstance(about, Mapping):
            raise TypeError(f"expected the fields of {name}, got {about!r}")
        hints = get_type_hints(kind)
        return kind(
            **{f.name: _read(hints[f.name], about[f.name], arrays, f.name) for f in fields(kind)}
        )
    if isinstance(about, bool) != (kind is bool) or not isinstance(about, int | float | str):
        raise TypeError(f"expected {kind.__name__} for {name}, got {about!r}")
    return kind(about)


def _array(about: Any, arrays: Mapping[str, ArrayLike]) -> NDArray[Any]:
    """Return a copy of its own, as the fitted arrays are."""
    name = about["array"]
    array = np.asarray(arrays[about["array"]])
    if str(array.dtype) != about["dtype"] or list(array.shape) != about["shape"]:
        raise ValueError(
            f"expected {about['dtype']} {about['shape']} for {name}, got {array.dtype}"
            f" {list(array.shape)}"
        )
    if about["finite"] and not np.isfinite(array).all():
        raise ValueError(f"{name} holds numbers that are not finite")
    return np.array(array, order="C")


def write_state(
    path: str | Path, about: Mapping[str, Any], arrays: Mapping[str, ArrayLike]
) -> None:
    """Write a description and arrays into one file: an NPZ archive, the description as the bytes of
    its JSON.

    The file is written beside ``path`` and renamed, so that a power cut leaves the old one or the
    new one.
    """
    path = Path(path)
    text = json.dumps(about, allow_nan=False).encode()
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with beside.open("wb") as file:
            np.savez(file, **{_ABOUT: np.frombuffer(text, np.uint8)}, **arrays)  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def read_state(path: str | Path) -> tuple[dict[str, Any], Arrays]:
    """Read what :func:`write_state` wrote.

    Raises:
        OSError: the file is missing, or cannot be read.
        ValueError: it is damaged, or of another kind.
    """
    data = Path(path).read_bytes()
    try:
        with np.load(BytesIO(data), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        about = json.loads(arrays.pop(_ABOUT).tobytes())
        if not isinstance(about, dict):
            raise TypeError("its description is no object")
    except _DAMAGED as error:
        raise ValueError(f"{path} is damaged, or holds no fitted diagnosis: {error}") from None
    return about, arrays
