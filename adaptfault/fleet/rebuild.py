"""Rebuilds dataclasses from JSON, each field by its declared type."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints


def rebuilt(value: Any, kind: Any, names: Mapping[str, Any] | None = None) -> Any:
    """Return a value that came from JSON as the type that it had.

    Args:
        value: of JSON.
        kind: a dataclass, ``tuple[X, ...]``, a union of such, or a plain type.
        names: what names stand for that only a type checker imports.

    Raises:
        ValueError: a field without a default is missing, or one is unknown or of another type.
    """
    if get_origin(kind) in (Union, UnionType):
        return _of_union(value, get_args(kind), names)
    if get_origin(kind) is tuple:
        if not isinstance(value, list | tuple):
            raise ValueError(f"expected a list, got {str(value)[:60]!r}")
        return tuple(rebuilt(one, get_args(kind)[0], names) for one in value)
    if is_dataclass(kind):
        return _of_dataclass(value, kind, names)
    plain = (int, float) if kind is float else (kind,)
    if type(value) not in plain:
        raise ValueError(f"expected {kind.__name__}, got {str(value)[:60]!r}")
    return value


def _of_union(value: Any, kinds: tuple[Any, ...], names: Mapping[str, Any] | None) -> Any:
    problem = ValueError()
    for kind in kinds:
        try:
            return rebuilt(value, kind, names)
        except ValueError as error:
            problem = error
    raise problem


def _of_dataclass(value: Any, kind: Any, names: Mapping[str, Any] | None) -> Any:
    types = get_type_hints(kind, localns=dict(names or {}))
    needed = {one.name for one in fields(kind) if _is_needed(one)}
    if not isinstance(value, Mapping) or not needed <= set(value) <= set(types):
        raise ValueError(f"expected the fields {', '.join(types)}, got {str(value)[:60]!r}")
    return kind(**{name: rebuilt(value[name], types[name], names) for name in value})


def _is_needed(one: Field[Any]) -> bool:
    return one.default is MISSING and one.default_factory is MISSING
