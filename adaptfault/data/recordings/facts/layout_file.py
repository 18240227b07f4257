"""Reads the description of an array from a JSON or TOML file, or from its shape as text
("2x13x6")."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from adaptfault.data.atomic import atomic_write
from adaptfault.data.printable import printable
from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.text import read_json_object, read_text, shown
from adaptfault.data.recordings.recording import Shape
from diagnostics import SensorLayout

LAYOUT_NAME = "layout.json"
"""The name of the layout that is read from a folder of recordings without an option;
``layout.toml`` is read too."""

MOST_CELLS = 1_000_000
"""A layout with more positions is a typing error, and would fill the memory."""

_OF_RECORDINGS = frozenset(("full_scale", "unit", "rate"))

_SIZES = re.compile(r"\s*(?:(\d{1,9})\s*[xX×*,]\s*)?(\d{1,9})\s*[xX×*,]\s*(\d{1,9})\s*", re.ASCII)


def looks_like_shape(text: str) -> bool:
    """Return whether text is a shape such as "2x13x6" or "10x10" (and not the name of a file)."""
    return _SIZES.fullmatch(text) is not None


def parse_shape(text: str) -> Shape:
    """Return ``(pads, rows, cols)`` from "2x13x6"; "10x10" is one pad, ``(1, 10, 10)``.

    Raises:
        InputError: the text is no shape, or a size is 0 or too large.
    """
    match = _SIZES.fullmatch(text)
    if match is None:
        raise InputError(
            f"shape {shown(text)}: expected pads x rows x columns, such as 2x13x6, or 10x10 for"
            " one pad"
        )
    pads, rows, cols = (int(size or 1) for size in match.groups())
    if min(pads, rows, cols) < 1:
        raise InputError(f"shape {shown(text)}: every size must be at least 1, such as 2x13x6")
    if pads * rows * cols > MOST_CELLS:
        raise InputError(f"shape {shown(text)}: more than {MOST_CELLS} cells; check the sizes")
    return pads, rows, cols


def layout_beside(paths: Sequence[Path]) -> SensorLayout | None:
    """Return the layout in the :data:`LAYOUT_NAME` of the folders given, or of the folders that
    hold the files given.

    None unless every path has one, and all are the same.

    Raises:
        InputError: such a file is no layout.
    """
    files = _files_beside(paths)
    if not files or not all(file.is_file() for file in files):
        return None
    layouts = {read_layout(file) for file in files}
    return layouts.pop() if len(layouts) == 1 else None


def _files_beside(paths: Sequence[Path]) -> list[Path]:
    files = [(path if path.is_dir() else path.parent) / LAYOUT_NAME for path in paths]
    files = [file if file.is_file() else file.with_suffix(".toml") for file in files]
    return list(dict.fromkeys(files))


def not_stated(layout: object, paths: Sequence[Path]) -> frozenset[str]:
    """Return which of full scale, unit and rate the file of a layout leaves to the recordings.

    Args:
        layout: as the user gives it; None: the file beside the recordings.
        paths: of the recordings.
    """
    if layout is None:
        files = [file for file in _files_beside(paths) if file.is_file()]
    elif isinstance(layout, str | PathLike) and not looks_like_shape(str(layout)):
        files = [Path(layout)]
    else:
        files = []
    missing = [_OF_RECORDINGS - set(_document(file)) for file in files]
    return frozenset().union(*missing)


def read_layout(path: str | PathLike[str]) -> SensorLayout:
    """Read a layout from a file of the schema "adaptfault.layout/1", as ``SensorLayout.to_dict``
    gives it.

    A name that ends in ``.toml`` is TOML, any other JSON.

    Raises:
        InputError: the file cannot be read, is no JSON or TOML, or a field is missing, unknown or
            of a wrong kind; named.
    """
    path = Path(path)
    document = _document(path)
    for name, kind in (
        ("pads", int),
        ("rows", int),
        ("cols", int),
        ("axes", int),
        ("full_scale", float),
        ("rate", float),
        ("unit", str),
    ):
        if name in document and not _is(document[name], kind):
            kind_name = {int: "a whole number", float: "a number", str: "text"}[kind]
            what = (
                f"field {name!r}: expected {kind_name}, got {shown(str(document[name]))};"
                " correct it"
            )
            raise InputError.at(path, what)
    sizes = [document.get(name, 1) for name in ("pads", "rows", "cols", "axes")]
    if sizes[0] * sizes[1] * sizes[2] * sizes[3] > MOST_CELLS:
        raise InputError.at(
            path, f"fields 'pads', 'rows', 'cols': more than {MOST_CELLS} cells; check the sizes"
        )
    if "present" in document and not _is_mask(document["present"]):
        raise InputError.at(
            path, "field 'present': expected lists [pads][rows][cols] of true and false; correct it"
        )
    try:
        return SensorLayout.from_dict(document)
    except RecursionError:
        raise InputError.at(path, "nests too deep for a layout; correct the file") from None
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError.at(path, f"is no layout: {error}; correct the file") from None


def write_layout(
    path: str | PathLike[str], layout: SensorLayout, reasons: Sequence[str] = ()
) -> None:
    """Write a layout as TOML, which :func:`read_layout` reads.

    Args:
        path: of the file.
        layout: the array.
        reasons: one sentence each, why a fact is as it is; comments of the file.

    Raises:
        OSError: the file cannot be written.
    """
    lines = ["# The array: pads x rows x columns, range, unit and rate."]
    lines += [f"# inferred: {' '.join(printable(reason).split())}" for reason in reasons]
    fields = layout.to_dict()
    groups = fields.pop("groups", None)
    lines += [f"{name} = {_toml(value)}" for name, value in fields.items() if value is not None]
    if groups is not None:
        lines += ["", "[groups]"]
        lines += [f"{_toml(name)} = {_toml(cells)}" for name, cells in groups.items()]
    atomic_write(Path(path), ("\n".join(lines) + "\n").encode())


def _toml(value: Any) -> str:
    """Return a number, text or list as TOML: as JSON, but for one character that TOML escapes."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _document(path: Path) -> dict[str, Any]:
    return _read_toml(path) if path.suffix.lower() == ".toml" else read_json_object(path)


def _read_toml(path: Path) -> dict[str, Any]:
    if sys.version_info >= (3, 11):  # slow to import, and rarely needed
        import tomllib
    else:
        import tomli as tomllib
    try:
        return tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise InputError.at(path, f"is not TOML ({error}); correct it") from None
    except RecursionError:
        raise InputError.at(path, "is not TOML that can be read; write it again") from None


def _is(value: Any, kind: type) -> bool:
    if isinstance(value, bool):
        return False
    return isinstance(value, int | float) if kind is float else isinstance(value, kind)


def _is_mask(lists: Any) -> bool:
    """Return whether lists of one length hold true and false alone."""
    try:
        mask = np.array(lists)
    except ValueError:
        return False
    return mask.dtype.kind in "biuf" and mask.ndim <= 3 and bool(np.isin(mask, (0, 1)).all())
