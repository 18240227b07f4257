"""Decides which array the files were recorded from: by options, by a layout, by the files, or by
inference."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.printable import printable
from adaptfault.data.recordings.errors import InputError, Problem
from adaptfault.data.recordings.facts.infer import (
    default_unit,
    in_range,
    infer_scale,
    infer_shape,
    sides,
)
from adaptfault.data.recordings.facts.layout_file import looks_like_shape, parse_shape, read_layout
from adaptfault.data.recordings.facts.rates import Elapsed
from adaptfault.data.recordings.recording import DECLARED, Shape
from adaptfault.data.recordings.survey import Content
from diagnostics import SensorLayout

if TYPE_CHECKING:
    from adaptfault.data.calibration import Calibration

_KEPT = "present", *DECLARED
"""What a layout states besides the shape and what the options override."""

_LONGEST_NAME = 40  # letters of the name of a cell
_SAME_RATE = 0.05
"""Rates that differ by less are the same: those of bags are measured."""


def given_array(
    layout: SensorLayout | Sequence[int] | str | PathLike[str] | None,
) -> SensorLayout | Shape | None:
    """Return a layout, or at least its shape, from any of the forms in which the user may give
    it."""
    if layout is None or isinstance(layout, SensorLayout):
        return layout
    if isinstance(layout, PathLike) or (isinstance(layout, str) and not looks_like_shape(layout)):
        return read_layout(layout)
    if isinstance(layout, str):
        return parse_shape(layout)
    sizes = layout if isinstance(layout, Iterable) else [layout]
    return parse_shape("x".join(map(str, sizes)))


def resolve_layout(
    contents: Sequence[Content],
    array: SensorLayout | Shape | None,
    options: Mapping[str, Any],
    tables: Calibration | None,
    unstated: Collection[str],
    problems: list[Problem],
) -> tuple[SensorLayout, tuple[str, ...]]:
    """Decide on the layout: options first, then a layout that was given, then the files, then
    inference. Return it, and one sentence for each fact that was inferred.

    Args:
        contents: of the files.
        array: a layout or a shape that was given.
        options: full_scale, unit and rate; None where they are not given.
        tables: of calibration.
        unstated: which of these three the layout leaves to the files.
        problems: warnings are added to them.

    Raises:
        InputError: an option makes no layout, or the shape or the scale cannot be inferred.
    """
    inferred = _of_readers(contents)
    if isinstance(array, SensorLayout):
        shape = array.shape
        stated = {name: getattr(array, name) for name in (*options, *_KEPT)}
        stated |= {name: _most(getattr(c.facts, name) for c in contents) for name in unstated}
    else:
        shape, reason = (array, "") if array else infer_shape(contents)
        if reason:
            inferred.append(f"shape {'x'.join(map(str, shape))} ({reason}); otherwise give --shape")
        shape = _with_axes(contents, shape)
        problems += _without_rows(contents, shape)
        stated = _of_files(contents, shape, options)
        stated["device"] = _device(contents, problems)
    # what is stated without newtons is that of the counts
    if tables is not None and not (isinstance(array, SensorLayout) and array.unit == "N"):
        stated |= {"full_scale": None, "unit": None}
    stated |= {name: value for name, value in options.items() if value is not None}
    if not isinstance(array, SensorLayout):
        inferred += _lost(contents, [name for name in ("full_scale", "rate") if not stated[name]])
    if stated["full_scale"] is None:
        inferred += _scale(contents, shape, tables, stated, problems)
    measured, reason_of_rate = _measured_rate(contents)
    known = {name: value for name, value in stated.items() if value is not None}
    if measured is not None:
        known.setdefault("rate", measured)
    try:
        usual = default_unit(float(stated["full_scale"]), shape, contents)
        known.setdefault("unit", usual if tables is None else "N")
        pads, rows, wide = shape
        names = getattr(array, "names", None) or _names(contents, math.prod(shape))
        layout = SensorLayout(pads, rows, wide // known.get("axes", 1), names=names, **known)
    except (TypeError, ValueError, ZeroDivisionError) as error:
        raise InputError(f"layout: {error}; correct the option") from None
    problems += _contradicted(contents, layout, tables)
    if stated["rate"] is None:
        inferred.append(f"rate {layout.rate:g} Hz ({reason_of_rate}); otherwise give --rate")
    return layout, tuple(inferred)


def _of_files(contents: Sequence[Content], shape: Shape, options: Iterable[str]) -> dict[str, Any]:
    """Return what the files of a shape state."""
    fitting = [content for content in contents if content.shape in (None, shape)]
    names = (*options, "present")
    stated = {name: _most(getattr(one.facts, name) for one in fitting) for name in names}
    declared = [one.facts.declared for one in fitting if one.facts.declared]
    return stated | dict(next(iter(declared), {}))


def _scale(
    contents: Sequence[Content],
    shape: Shape,
    tables: Calibration | None,
    stated: dict[str, Any],
    problems: list[Problem],
) -> list[str]:
    """State full scale and unit by tables, or as the readings show; return the sentence on it."""
    if tables is not None:
        stated |= {"unit": stated["unit"] or "N", "full_scale": tables.full_scale}
        return []
    scaled = [content for content in contents if content.width == math.prod(shape)]
    scale = infer_scale(scaled or contents, shape)
    stated |= {"unit": stated["unit"] or scale.unit, "full_scale": scale.full_scale}
    problems += scale.problems
    what = f"full scale {scale.full_scale:g} {stated['unit']} ({scale.reason})"
    return [f"{what}; otherwise give --full-scale and --unit"]


def _device(contents: Sequence[Content], problems: list[Problem]) -> str | None:
    """Return the device that the files state; None, and a warning where they state several."""
    of: dict[str, Path] = {}
    for content in contents:
        if content.facts.device is not None:
            of.setdefault(content.facts.device, content.path)
    if len(of) < 2:
        return next(iter(of), None)
    told = ", ".join(f"{device} ({path.name})" for device, path in of.items())
    what = f"recordings of {len(of)} devices: {told}; cells are judged as of one, load them apart"
    problems.append(Problem("warning", what))
    return None


def _names(contents: Sequence[Content], cells: int) -> Sequence[str] | None:
    """Return what the files call the cells; None where they do not, or not all the same."""
    held = [_printable(c.facts.names) for c in contents if len(c.facts.names) == cells]
    return held[0] if held and all(names == held[0] for names in held) else None


def _printable(names: Sequence[str]) -> tuple[str, ...]:
    """Return names as a message can hold them."""
    return tuple(
        " ".join(printable(name).replace(",", " ").split())[:_LONGEST_NAME] for name in names
    )


def _of_readers(contents: Sequence[Content]) -> list[str]:
    """Return what readers inferred, each sentence once, with the file."""
    paths: dict[str, list[Path]] = {}
    for content in contents:
        for text in content.facts.inferred:
            paths.setdefault(text, []).append(content.path)
    found = []
    for text, of in paths.items():
        more = f" and {len(of) - 1} more" if len(of) > 1 else ""
        found.append(f"{of[0].name}{more}: {text}")
    return found


def _with_axes(contents: Sequence[Content], shape: Shape) -> Shape:
    """Return a shape with the axes of each position, where it counts positions alone."""
    axes = _most(content.facts.declared.get("axes") for content in contents) or 1
    pads, rows, cols = shape
    if all(content.width == axes * math.prod(shape) for content in contents):
        return pads, rows, cols * axes
    return shape


def _without_rows(contents: Sequence[Content], shape: Shape) -> list[Problem]:
    """Warn where pads are told by names alone, so that their rows and columns are unknown."""
    told = [c for c in contents if c.shape == shape and c.facts.shape_reason]
    if not told or shape[1] > 1 or shape[2] == 1:
        return []
    pads, _, cells = shape
    cells //= told[0].facts.declared.get("axes", 1)
    rows = f"give --shape {pads}x{sides(cells)}, or {pads}x1x{cells} if they have none"
    if told[0].facts.present is not None:  # they differ in size
        rows = (
            "number rows and columns in the names of the columns, as palm_r0_c0, or give --shape"
            f" {pads}x1x{cells} if they have none"
        )
    what = (
        f"{told[0].facts.shape_reason}, and nothing states their rows and columns: taken as {pads}"
        f" pad{'s' * (pads > 1)} without rows, so that a broken row or column shows as single"
        f" cells; {rows}"
    )
    return [Problem.warning(told[0].path, what)]


def _measured_rate(contents: Sequence[Content]) -> tuple[float | None, str]:
    """Return the rate that the clocks of all files show together, and where it is from."""
    clocks = [content for content in contents if content.elapsed is not None]
    if not clocks:
        return None, "assumed: no file states one"
    tick = clocks[0].tick
    same = [content for content in clocks if content.tick == tick]
    elapsed = Elapsed.of_all(content.elapsed for content in same)
    rate = None if elapsed is None else elapsed.rate(tick)
    if rate is None:
        return None, "assumed: no time in the files rises at 2 to 2000 Hz"
    what = "time column" if clocks[0].text else "times of the frames"
    more = f" and {len(same) - 1} more" if len(same) > 1 else ""
    return rate, f"{what} of {clocks[0].path.name}{more}"


def _lost(contents: Sequence[Content], missing: Sequence[str]) -> list[str]:
    """Return a sentence on archives without the JSON file that may state what they do not."""
    bare = [
        c
        for c in contents
        if c.path.suffix.lower() == ".npz" and not c.path.with_suffix(".json").is_file()
    ]
    numbered = [c for c in bare if c.facts.numbered]
    if not bare or not (numbered or missing):
        return []
    what = ["class names (the numbers of the labels are used)"] * bool(numbered)
    what += [name.replace("_", " ") for name in missing]
    first = (numbered or bare)[0].path
    return [
        f"{first}: no {first.stem}.json beside it, and the archive does not state:"
        f" {', '.join(what)}"
    ]


def _contradicted(
    contents: Sequence[Content], layout: SensorLayout, tables: Calibration | None
) -> list[Problem]:
    """Warn if the first file that states a scale states another than the layout that is used.

    Raises:
        InputError: the tables, which state the scale, are of another array.
    """
    if tables is not None:
        try:
            tables.check(layout)
        except ValueError as error:
            raise InputError(f"calibration: {error}") from None
        return []
    content = next((c for c in contents if c.facts.full_scale is not None), None)
    if content is None or content.facts.full_scale == layout.full_scale:
        return []
    what = f"the file states 0..{content.facts.full_scale:g} {content.facts.unit or ''}".rstrip()
    used = f"0..{layout.full_scale:g} {layout.unit} is used, as the option or layout states"
    return [Problem.warning(content.path, f"{what}, but {used}")]


def _most(values: Iterable[Any]) -> Any:
    """Return what most values are, of several the first; None: unknown."""
    counts: Counter[Any] = Counter()
    held: dict[Any, Any] = {}
    for value in values:
        if value is not None:
            key: Any = value if isinstance(value, int | float | str) else repr(value)
            if isinstance(value, np.ndarray):
                key = value.tobytes()
            counts[key] += 1
            held.setdefault(key, value)
    return held[max(counts, key=counts.__getitem__)] if counts else None


@dataclass(frozen=True)
class Usual:
    """What most files state.

    Attributes:
        full_scale, unit, rate: None: no file states it.
        present: by shape.
        in_range: whether the counts of a file have at most 16 bits.
    """

    full_scale: float | None
    unit: str | None
    rate: float | None
    present: Mapping[Shape | None, NDArray[np.bool_]]
    in_range: bool

    @classmethod
    def of(cls, contents: Sequence[Content]) -> Usual:
        """Return what most of some files state."""
        masks: dict[Shape | None, list[NDArray[np.bool_]]] = {}
        for content in contents:
            if content.facts.present is not None:
                masks.setdefault(content.shape, []).append(content.facts.present)
        return cls(
            _most(content.facts.full_scale for content in contents),
            _most(content.facts.unit for content in contents),
            _most(content.rate for content in contents),
            {shape: _most(of_shape) for shape, of_shape in masks.items()},
            any(map(in_range, contents)),
        )


def check_agreement(
    content: Content, usual: Usual, layout: SensorLayout, calibrated: bool, rate: float | None
) -> None:
    """Raise InputError if a file contradicts what most files state or hold: they are of different
    arrays.

    Args:
        content: of the file.
        usual: of all files.
        layout: the array.
        calibrated: the scale of counts does not matter: the tables define it.
        rate: as the user states it; then that of the files does not matter.
    """
    for name in () if calibrated else ("full_scale", "unit"):
        value = getattr(content.facts, name)
        reference = getattr(usual, name)
        if value is not None and value != reference:
            raise _disagrees(content, name.replace("_", " "), value, reference)
    stated = None if rate is not None else content.rate
    if stated is not None and usual.rate is not None and not same_rate(stated, usual.rate):
        raise _disagrees(content, "rate", content.rate, usual.rate)
    if usual.in_range and not in_range(content) and content.largest > layout.full_scale:
        what = f"counts reach {content.largest:.0f}, more than 16 bits, and those of other files"
        raise InputError.at(content.path, f"{what} do not; load them apart")
    if content.facts.present is None:
        return
    if not np.array_equal(content.facts.present, usual.present[content.shape]):
        raise InputError.at(
            content.path, "another mask of present cells than other files; load them apart"
        )


def _disagrees(content: Content, name: str, came: object, expected: object) -> InputError:
    what = f"{name} {came} where other files have {expected}; load them apart"
    return InputError.at(content.path, f"{what}, or give --rate" if name == "rate" else what)


def check_statements(content: Content, layout: SensorLayout, calibrated: bool) -> None:
    """Raise InputError if a file states another full scale, device or rate than the layout."""
    full_scale = None if calibrated else content.facts.full_scale
    if full_scale is not None and not math.isclose(full_scale, layout.full_scale, rel_tol=1e-3):
        came = f"full scale {full_scale:g} {content.facts.unit or ''}".rstrip()
        what = (
            f"{came} where {layout.full_scale:g} {layout.unit} is expected; use recordings of the"
            " same sensor"
        )
        raise InputError.at(content.path, what)
    device = content.facts.device
    if layout.device is not None and device not in (None, layout.device):
        what = (
            f"device {device} where {layout.device} is expected: recordings of another robot; use"
            " recordings of the same sensor"
        )
        raise InputError.at(content.path, what)
    if content.rate is not None and not same_rate(content.rate, layout.rate):
        what = (
            f"rate {content.rate:g} Hz where {layout.rate:g} Hz is expected; use recordings of the"
            " same sensor"
        )
        raise InputError.at(content.path, what)


def same_rate(one: float, other: float) -> bool:
    """Return whether two rates differ by less than the jitter of measured ones."""
    return abs(one - other) < _SAME_RATE * max(one, other)
