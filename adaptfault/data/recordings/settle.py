"""Decides which array the files were recorded from: by options, by a layout, by the files, or by a guess."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from adaptfault.data.recordings.content import Content, Shape
from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.guess import guess_scale, guess_shape, unit_of
from adaptfault.data.recordings.layout_file import looks_like_shape, parse_shape, read_layout
from diagnostics import SensorLayout

if TYPE_CHECKING:
    from adaptfault.data.calibration import Calibration


_SAME_RATE = 0.05
"""Rates that differ by less are the same: those of bags are measured."""


def given_array(layout: SensorLayout | Shape | str | PathLike[str] | None) -> SensorLayout | Shape | None:
    """Return a layout or at least its shape, from any way to give it."""
    if layout is None or isinstance(layout, SensorLayout):
        return layout
    if isinstance(layout, tuple | list):
        return parse_shape("x".join(map(str, layout)))
    if isinstance(layout, str) and looks_like_shape(layout):
        return parse_shape(layout)
    return read_layout(layout)


def settle_layout(
    contents: Sequence[Content],
    array: SensorLayout | Shape | None,
    full_scale: float | None,
    unit: str | None,
    rate: float | None,
    tables: Calibration | None,
) -> tuple[SensorLayout, list[Problem]]:
    """Decide on the layout: options first, then a layout that was given, then what files say, then a guess.

    Raises:
        InputError: an option makes no layout, or nothing tells the shape or the scale.
    """
    problems: list[Problem] = []
    overrides = {"full_scale": full_scale, "unit": unit, "rate": rate}
    if isinstance(array, SensorLayout):
        said: dict[str, Any] = {name: getattr(array, name) for name in (*overrides, "present")}
        shape = array.shape
        if tables is not None and array.unit != "N":  # that was the layout of the counts
            said |= {"full_scale": None, "unit": None}
    else:
        shape = array or guess_shape(contents)
        fitting = [c for c in contents if c.shape in (None, shape)]
        said = {name: _first(getattr(content, name) for content in fitting) for name in (*overrides, "present")}
        if tables is not None:  # files describe counts
            said |= {"full_scale": None, "unit": None}
    said |= {name: value for name, value in overrides.items() if value is not None}
    if said["full_scale"] is None:
        width = shape[0] * shape[1] * shape[2]
        scaled = [content for content in contents if content.width == width] or contents
        if tables is not None:
            said["full_scale"], said["unit"] = tables.full_scale, said["unit"] or "N"
        else:
            scale = guess_scale(scaled)
            said["full_scale"], said["unit"] = scale.full_scale, said["unit"] or scale.unit
            problems += scale.problems
    try:
        said["unit"] = said["unit"] or ("N" if tables is not None else unit_of(float(said["full_scale"]), contents))
        layout = SensorLayout(*shape, **{name: value for name, value in said.items() if value is not None})
    except (TypeError, ValueError) as error:
        raise InputError(f"layout: {error}; correct the option") from None
    return layout, problems + ([] if tables is not None else _contradicted(contents, layout))


def _contradicted(contents: Sequence[Content], layout: SensorLayout) -> list[Problem]:
    """Warn if the first file that states a scale states another than the layout that is used."""
    content = next((c for c in contents if c.full_scale is not None), None)
    if content is None or content.full_scale == layout.full_scale:
        return []
    what = f"the file says 0..{content.full_scale:g} {content.unit or ''}".rstrip()
    return [
        Problem("warning", located(content.path, f"{what}, but 0..{layout.full_scale:g} {layout.unit} was asked for"))
    ]


def _first(values: Iterable[Any]) -> Any:
    return next((value for value in values if value is not None), None)


def check_agreement(content: Content, contents: Sequence[Content], calibrated: bool) -> None:
    """Raise InputError if a file contradicts the first file that says the same: they are of different arrays.

    The scale of counts that get ``calibrated`` does not matter: the tables do.
    """
    for name in ("rate",) if calibrated else ("full_scale", "unit", "rate"):
        value = getattr(content, name)
        reference = _first(getattr(other, name) for other in contents)
        if name == "rate" and value is not None and abs(value - reference) < _SAME_RATE * reference:
            continue
        if value is not None and value != reference:
            what = f"{name.replace('_', ' ')} {value} where the files before it have {reference}; load them apart"
            raise InputError.at(content.path, what)
    if content.present is None:
        return
    reference = _first(other.present for other in contents if other.shape == content.shape)
    if not np.array_equal(content.present, reference):
        raise InputError.at(content.path, "another mask of present cells than the files before it; load them apart")
