"""Data classes as JSON: their fields as JSON holds them, and rebuilt from it, each by its declared
type."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

T = TypeVar("T")


def members(value: Any, *names: str) -> dict[str, Any]:
    """Return attributes of a value as JSON holds them; without names, all fields of a data
    class."""
    wanted = names or tuple(one.name for one in fields(value))
    return {name: plain(getattr(value, name)) for name in wanted}


def plain(value: Any) -> Any:
    """Return a value as JSON holds it: a number that is not finite as None, arrays and sets of
    cells as lists, what has a document of its own as that."""
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {name: plain(held) for name, held in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Iterable) and not isinstance(value, str):
        return [plain(held) for held in value]
    return members(value) if is_dataclass(value) else value


def rebuilt(
    value: Any, kind: type[T], names: Mapping[str, Any] | None = None, schema: str | None = None
) -> T:
    """Return the data class that a document of JSON was written of.

    Args:
        value: the document.
        kind: the data class; its fields are such, tuples, unions, literals and plain types.
        names: what names stand for that only a type checker imports.
        schema: that the document states beside the fields; None: it states none.

    Raises:
        ValueError: another schema; a field without a default is missing, or one is unknown or of
            another type.
    """
    if schema is not None:
        check_schema(value, schema)
        value = {name: held for name, held in value.items() if name != "schema"}
    made: T = _rebuilt(value, kind, names)
    return made


def check_schema(document: Any, schema: str) -> None:
    """Raise ValueError unless a document states a schema."""
    found = document.get("schema") if isinstance(document, Mapping) else None
    if found != schema:
        raise ValueError(f"expected schema {schema!r}, got {found!r}")


def _rebuilt(value: Any, kind: Any, names: Mapping[str, Any] | None) -> Any:
    """Return a value of JSON as a type."""
    origin = get_origin(kind)
    kinds = get_args(kind)
    if origin in (Union, UnionType):
        return _of_union(value, kinds, names)
    if origin is tuple:
        return _of_tuple(value, kinds, names)
    if is_dataclass(kind):
        return _of_dataclass(value, kind, names)
    if origin is Literal:
        fits = value in kinds
    else:
        fits = type(value) in ((int, float) if kind is float else (kind,))
    if not fits:
        raise ValueError(f"expected {getattr(kind, '__name__', kinds)}, got {str(value)[:60]!r}")
    return value


def _of_union(value: Any, kinds: tuple[Any, ...], names: Mapping[str, Any] | None) -> Any:
    problem = ValueError()
    for kind in kinds:
        try:
            return _rebuilt(value, kind, names)
        except ValueError as error:
            problem = error
    raise problem


def _of_tuple(value: Any, kinds: tuple[Any, ...], names: Mapping[str, Any] | None) -> Any:
    if not isinstance(value, list | tuple):
        raise ValueError(f"expected a list, got {str(value)[:60]!r}")
    if kinds[-1] is ...:
        kinds = kinds[:1] * len(value)
    if len(value) != len(kinds):
        raise ValueError(f"expected {len(kinds)} values, got {len(value)}")
    return tuple(_rebuilt(one, kind, names) for one, kind in zip(value, kinds, strict=True))


def _of_dataclass(value: Any, kind: Any, names: Mapping[str, Any] | None) -> Any:
    types = get_type_hints(kind, localns=dict(names or {}))
    needed = {one.name for one in fields(kind) if _is_needed(one)}
    if not isinstance(value, Mapping) or not needed <= set(value) <= set(types):
        raise ValueError(f"expected the fields {', '.join(types)}, got {str(value)[:60]!r}")
    return kind(**{name: _rebuilt(value[name], types[name], names) for name in value})


def _is_needed(one: Field[Any]) -> bool:
    return one.default is MISSING and one.default_factory is MISSING
