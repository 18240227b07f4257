"""What a file of named arrays holds, whatever its format: arrays by name, attributes, and what had
to be left out.

HDF5, Zarr, MAT, netCDF and Parquet are opened as these contents; :mod:`.chooser` finds readings,
times, episodes and classes in them, the same way for all.
"""

from __future__ import annotations

import base64
import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.facts.roles import LABELS
from adaptfault.data.recordings.formats.datasets.features import VALID, is_touch

NUMBERS = "iuf"
TIMES = "mM"
TEXTS = "OSUT"
"""Kinds of numpy's types."""

RATES = ("rate", "fps", "hz", "sampling_rate", "sampling_hz", "frequency")
FULL_SCALES = ("full_scale", "max_value")
UNITS = ("unit", "units")
DEVICES = ("device", "device_id", "robot", "robot_id", "serial", "serial_number")
"""Names of attributes, and of arrays that hold one value."""

_SCALARS = (*RATES, *FULL_SCALES, *UNITS, *DEVICES, *LABELS)


class Array(Protocol):
    """An array in a file; a slice of it is read."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the axes."""
        ...

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the numbers."""
        ...

    def __getitem__(self, part: slice, /) -> Any: ...


@dataclass
class Contents:
    """An open file.

    Attributes:
        arrays: of numbers, times and texts, by their names with groups, as "data/tactile".
        valid: which readings of an array are valid, by its name: what ``check --write-copy`` wrote,
            or those that were written at all.
        written: sizes of the part of an array that was written, where that is not all of it.
        attributes: of each group and array that has some; "" is the file itself.
        left_out: arrays that cannot be read, and why.
        told: other warnings.
        is_table: its first axis counts rows, so it is the time.
    """

    arrays: dict[str, Array] = field(default_factory=dict)
    valid: dict[str, Array] = field(default_factory=dict)
    written: dict[str, tuple[int, ...]] = field(default_factory=dict)
    attributes: dict[str, dict[str, Any]] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    told: list[str] = field(default_factory=list)
    is_table: bool = False

    def add(self, name: str, array: Array, attributes: Mapping[str, Any] | None = None) -> None:
        """Take in an array: one value under a name of :data:`RATES` and the like is an attribute of
        its group, a mask belongs to its array, and what holds neither numbers, times nor texts is
        left out."""
        group, _, last = name.rpartition("/")
        size = math.prod(array.shape)
        kind = array.dtype.kind
        if kind == "b" and name.endswith(VALID):
            self.valid[name.removesuffix(VALID)] = array
        elif kind == "c":
            self.left_out[name] = "holds complex numbers; save their real part or their amplitude"
        elif size == 1 and last.lower() in _SCALARS:
            value = np.asarray(array[:] if array.shape else array).ravel()[0]
            self.attributes.setdefault(group, {})[last] = value
        elif kind == "V":
            self.left_out[name] = "holds records of several fields; save each field as an array"
        elif kind in NUMBERS and 0 in array.shape[1:] and array.shape[0]:
            self.left_out[name] = "holds frames without a number"
        elif array.shape and kind in NUMBERS + TIMES + TEXTS:
            self.arrays[name] = array
        if is_touch(name) and name not in self.arrays:
            self.left_out.setdefault(name, f"is {array.dtype}, no array of numbers")
        self.note(name, attributes)

    def note(self, name: str, attributes: Mapping[str, Any] | None) -> None:
        """Take in the attributes of a group or an array."""
        if attributes:
            self.attributes.setdefault(name, {}).update(attributes)

    def attribute(self, name: str, wanted: Sequence[str]) -> Any:
        """Return an attribute of an array, of a group that holds it, or of the file; None where
        there is none of one value."""
        parts = name.split("/")
        for depth in range(len(parts), -1, -1):
            held = self.attributes.get("/".join(parts[:depth]), {})
            for known, value in held.items():
                if known.lower() in wanted and np.size(value) == 1:
                    return plain(np.asarray(value).item())
        return None

    def declared(self, name: str) -> dict[str, Any]:
        """Return what attributes declare of the layout: the device."""
        device = self.attribute(name, DEVICES)
        return {} if device is None else {"device": device}

    def positive(self, name: str, wanted: Sequence[str]) -> float | None:
        """Return an attribute that is a number above 0; None where there is none."""
        value = self.attribute(name, wanted)
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        return float(value) if math.isfinite(value) and value > 0 else None


Opened = Callable[[Sequence[str] | None], AbstractContextManager[Contents]]
"""Opens a file, and returns all that it holds, or the arrays of some names alone."""

Opener = Callable[[Path, Sequence[str] | None], AbstractContextManager[Contents]]
"""Opens a file of a format, as :data:`Opened` does."""


def kept(read: Callable[[Path], Contents]) -> Opener:
    """Return what opens files whose contents can be read later, too: those of the last file stay
    in memory, and are read anew where all are asked for."""
    held = lru_cache(maxsize=1)(read)

    @contextmanager
    def opened(path: Path, names: Sequence[str] | None = None) -> Iterator[Contents]:
        if names is None:  # the file may have changed since
            held.cache_clear()
        yield held(path)

    return opened


def element(name: str, place: int) -> str:
    """Return the name of an element of an array of arrays: a group that counts, as of episodes."""
    group, _, last = name.rpartition("/")
    return f"{group or last}/{place}/{last}"


def plain(value: Any) -> Any:
    """Return bytes as text, anything else as it is."""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


def texts(values: Any) -> list[str]:
    """Return the values of an array as text; one that is missing is empty."""
    held = np.asarray(values).ravel().tolist()
    return ["" if value is None else str(plain(value)) for value in held]


@dataclass(frozen=True)
class Packing:
    """How CF conventions, and xarray with them, store readings: ``stored * scale + offset``.

    Attributes:
        missing: stored values that stand for a missing reading.
        scale, offset: of the others.
        limits: what lies outside is a missing reading; of stored values, and where they are no
            whole numbers but the stored values are, of readings.
        is_unsigned: whether whole numbers are meant without a sign, whatever their type is: netCDF
            3 has none without; None: as their type is.
    """

    missing: tuple[float, ...] = ()
    scale: float = 1.0
    offset: float = 0.0
    limits: tuple[float | None, float | None] = (None, None)
    is_unsigned: bool | None = None

    @classmethod
    def of(cls, attributes: Mapping[str, Any]) -> Packing:
        """Return what the attributes of an array say.

        Raises:
            ValueError: a scale of 0, or one that is no number.
        """
        missing = [
            _number(value)
            for name in ("_FillValue", "missing_value")
            if name in attributes
            for value in np.asarray(attributes[name]).ravel().tolist()
        ]
        known = tuple(value for value in missing if not math.isnan(value))
        scale = _stated(attributes, "scale_factor", 1.0)
        offset = _stated(attributes, "add_offset", 0.0)
        if scale == 0:
            raise ValueError("scale_factor 0")
        unsigned = {"true": True, "false": False}
        sign = str(plain(attributes.get("_Unsigned", ""))).lower()
        return cls(known, scale, offset, _limits(attributes), unsigned.get(sign))

    @property
    def is_scaled(self) -> bool:
        """Whether readings are other numbers than what is stored."""
        return (self.scale, self.offset) != (1.0, 0.0)

    def unpacked(self, stored: NDArray[Any]) -> NDArray[Any]:
        """Return readings; whole numbers keep their type where none is missing."""
        meant = self._with_sign(stored)
        is_missing = self._is_outside(meant)
        if self.missing:
            is_missing |= np.isin(stored, self.missing) | np.isin(meant, self.missing)
        if not self.is_scaled and not is_missing.any():
            return as_readings(meant)
        values = self._scaled(meant)
        values[is_missing] = np.nan
        return as_readings(values)

    def _with_sign(self, stored: NDArray[Any]) -> NDArray[Any]:
        """Return whole numbers with or without the sign that is meant."""
        if self.is_unsigned is None or stored.dtype.kind not in "iu":
            return stored
        kind = "u" if self.is_unsigned else "i"
        order = stored.dtype.byteorder
        return stored.view(np.dtype(f"{kind}{stored.dtype.itemsize}").newbyteorder(order))

    def _is_outside(self, meant: NDArray[Any]) -> NDArray[np.bool_]:
        outside = np.zeros(meant.shape, bool)
        is_whole = meant.dtype.kind in "iu"
        of_readings = is_whole and any(isinstance(limit, float) for limit in self.limits)
        compared = self._scaled(meant) if of_readings and self.is_scaled else meant
        for limit, is_beyond in zip(self.limits, (np.less, np.greater), strict=True):
            if limit is not None:
                wraps = limit < 0 and self.is_unsigned and is_whole and not of_readings
                end = limit + 2 ** (8 * meant.dtype.itemsize) if wraps else limit
                outside |= is_beyond(compared, end)
        return outside

    def _scaled(self, meant: NDArray[Any]) -> NDArray[np.float64]:
        # float64 before the scale: a 32-bit count does not fit float32
        return meant.astype(np.float64) * self.scale + self.offset


def as_readings(values: NDArray[Any]) -> NDArray[Any]:
    """Return whole numbers as they are, others as float32."""
    if values.dtype.kind in "iu":
        return values
    with np.errstate(all="ignore"):  # what float32 cannot hold becomes infinite, and is missing
        return values.astype(np.float32)


def _stated(attributes: Mapping[str, Any], name: str, usual: float) -> float:
    """Return a number among attributes; the usual one where none is stated."""
    values = np.asarray(attributes.get(name, usual)).ravel().tolist()
    number = _number(values[0]) if values else usual
    if not math.isfinite(number):
        raise ValueError(f"{name} {values[0]!r}")
    return number


def _limits(attributes: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """Return the least and the greatest valid value among attributes; None where none is stated."""
    both = np.asarray(attributes.get("valid_range", ())).ravel().tolist()
    if len(both) != 2:
        ends = [attributes.get("valid_min"), attributes.get("valid_max")]
        both = [next(iter(np.asarray(end).ravel().tolist()), None) for end in ends]
    least, most = (None if math.isnan(_number(one)) else one for one in both)
    return least, most


def _number(value: Any) -> float:
    """Return an attribute as a number; xarray writes decimals in Zarr 3 as the text of their
    bytes. NaN: it is none."""
    try:
        if isinstance(value, str) and len(value) == 12:
            return float(struct.unpack("<d", base64.b64decode(value, validate=True))[0])
        return float(value)
    except (TypeError, ValueError):
        return math.nan
