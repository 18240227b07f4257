"""Infers the shape, the full scale and the unit of an array from its recordings, where no file or
option states them.

Every function returns what it inferred together with the reason, so that the caller can report it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adaptfault.data.recordings.errors import InputError, Problem
from adaptfault.data.recordings.recording import Shape
from adaptfault.data.recordings.survey import Content
from diagnostics import SensorLayout

PAPER = SensorLayout.paper()

CONVERTER_BITS = (8, 10, 12, 14, 16)

SLACK = 1.02
"""Readings up to 2 % above the full scale are calibration error, not another scale."""

NO_UNIT = "a.u."
"""Arbitrary unit: the unit of readings where nothing states one."""

GIVE_LAYOUT = "give the layout of the array (--layout FILE or --shape 2x13x6; layout= in Python)"
GIVE_SCALE = (
    "give the full scale and unit (--full-scale 3.3 --unit V; full_scale= and unit= in Python)"
)

_SAMPLE = 20_000
"""Readings that the search for a converter step looks at."""

_SHARE = 0.99
"""Share of the distinct readings that are multiples of a converter's step: a stuck cell may read
anything."""

_WHOLE = 0.02
"""A reading is a multiple of a step if it is within this share of the step."""


@dataclass(frozen=True)
class Scale:
    """The range of readings, from 0 to ``full_scale`` in ``unit``.

    Attributes:
        full_scale, unit: as in SensorLayout.
        reason: what the full scale was inferred from.
        problems: warnings about it.
    """

    full_scale: float
    unit: str
    reason: str
    problems: tuple[Problem, ...] = ()


def infer_shape(contents: Sequence[Content]) -> tuple[Shape, str]:
    """Return the shape that most files state, or one that names in a file show, or the paper's for
    frames of 220 readings, and the reason.

    The reason is empty where a file states pads, rows and columns.

    Raises:
        InputError: no file states a shape and the frames have another width.
    """
    shapes = Counter(content.shape for content in contents)

    def rank(content: Content) -> tuple[bool, int]:
        return bool(content.facts.shape_reason), -shapes[content.shape]

    for content in sorted(contents, key=rank):
        if content.shape is not None:
            if content.facts.shape_reason:
                return content.shape, content.facts.shape_reason
            stored = list(content.facts.stored)
            several = len(stored) == 4 and content.shape[0] == 1 and stored[1] > 1
            return (
                content.shape,
                f"frames {stored} are {stored[0]} recordings of one pad" if several else "",
            )
    widths = Counter(content.width for content in contents)
    width = max(widths, key=lambda width: (widths[width], width == PAPER.n_cells))
    if width == PAPER.n_cells:
        return PAPER.shape, f"{width} values a frame fit the paper's sensor"
    first = next(content for content in contents if content.width == width)
    if first.text and abs(width - PAPER.n_cells) == 1:
        what = (
            f"{describe_width(first, PAPER.n_cells)} (the paper's sensor); for another array"
            f" {GIVE_LAYOUT}"
        )
    else:
        what = _unknown_shape(first)
    raise first.error(what, frame=first.surveys[0].first_line if first.text else None)


def _unknown_shape(content: Content) -> str:
    """Return a sentence on frames of a width that no file explains, with a shape that would fit."""
    width = content.width
    stored = content.facts.stored
    text = f"{width} value{'s' * (width != 1)} a frame, and nothing states their rows and columns; "
    column = content.head[:, 0]
    if content.text and width > 1 and len(column) > 2 and (np.diff(column) > 0).all():
        text += (
            "the first column rises from line to line: if it is a time or the number of the frame,"
            " name it 'time' or 'frame' in a header line; "
        )
        width -= 1
    frames, rows = stored[:2] if len(stored) == 3 else (0, 0)
    grid = (
        f"; if these are {frames} frames of one pad, --shape {rows}x{content.width}"
        if rows > 1
        else ""
    )
    return (
        f"{text}give --shape (rows x columns, such as {sides(width)}) or --layout FILE (layout= in"
        f" Python){grid}"
    )


def sides(cells: int) -> str:
    """Return the rows and columns of the squarest array of so many cells."""
    rows = max(rows for rows in range(1, math.isqrt(cells) + 1) if cells % rows == 0)
    return f"{rows}x{cells // rows}"


def describe_width(content: Content, expected: int) -> str:
    """Return a sentence on frames that have another width than expected, with the likely cause."""
    head = content.head
    width = content.width
    text = f"{width} value{'s' * (width != 1)} a frame, expected {expected}"
    if width == expected + 1 and content.text:
        if len(head) and np.isnan(head[:, -1]).all():
            return f"{text}: each line ends with a comma, remove it"
        return (
            f"{text}: if the first column is a time or the number of the frame, head it with 'time'"
            " or 'frame'"
        )
    if width == expected - 1 and content.text:
        return (
            f"{text}: a column is missing, write an empty cell for a missing reading; one of times,"
            " classes or states is no reading, --columns takes it as one"
        )
    if width > expected and content.text and content.shape is None:
        return f"{text}: --columns or --ignore says which columns are readings"
    return text


def infer_scale(contents: Sequence[Content], shape: Shape) -> Scale:
    """Return the scale that the readings fit.

    Whole numbers get the range of the smallest converter that holds them. Decimal numbers of the
    paper's array get the paper's 0..5 N. Decimal numbers of another array get the range of the
    converter whose step they show (:func:`converter_step`), or 0 to the largest reading, rounded up
    to two digits.

    Raises:
        InputError: no reading is above 0, or counts of all files exceed 16 bits.
    """
    contents = [content for content in contents if in_range(content)] or contents
    content = max(contents, key=lambda one: one.largest)
    largest = content.largest
    whole = all(content.counts for content in contents)
    in_text = all(content.text for content in contents)
    paper = shape == PAPER.shape
    # text does not separate 0 counts from 0 N
    newtons = paper and in_text and largest <= PAPER.full_scale * SLACK
    if whole and not newtons:
        return _converter_scale(largest, content)
    if paper and _fits_paper(largest, contents):
        return _paper_scale(largest, content)
    if largest <= 0:
        raise InputError.at(
            content.path, f"no reading is above 0, so nothing shows the range; {GIVE_SCALE}"
        )
    if (step := converter_step(contents)) and (bits := _bits(largest / step)):
        full_scale = float(f"{step * (2**bits - 1):.4g}")
        return Scale(
            full_scale,
            NO_UNIT,
            f"converter step {step:.3g}, {bits} bits, largest reading {largest:.4g}",
        )
    full_scale = 1.0 if 0.5 < largest <= 1 else _rounded_up(largest)
    return Scale(full_scale, NO_UNIT, f"largest reading {largest:.4g}, no converter step visible")


def in_range(content: Content) -> bool:
    """Return whether a converter of 16 bits gives the counts of a file; readings that are none
    may be anything."""
    return not content.counts or _bits(content.largest) is not None


def default_unit(full_scale: float, shape: Shape, contents: Sequence[Content]) -> str:
    """Return the unit of a full scale that was given without one."""
    if full_scale == 1.0:
        return "of full scale"
    if all(content.counts for content in contents) and full_scale > PAPER.full_scale:
        return "count"
    return PAPER.unit if (shape, full_scale) == (PAPER.shape, PAPER.full_scale) else NO_UNIT


def converter_step(contents: Sequence[Content]) -> float | None:
    """Return the step that all readings are multiples of; None where there is none, or it is a
    rounding to decimals.

    The candidate s is the least difference between two distinct readings v, refined by least
    squares: s = sum(v k) / sum(k^2), k = round(v / s). 99 % of the distinct readings have to be
    multiples of it. A step that is a power of ten shows how the file was written, not the
    converter.
    """
    values = np.concatenate([survey.sample for c in contents[:20] for survey in c.surveys[:20]])
    values = np.unique(values[:: max(1, len(values) // _SAMPLE)])
    gaps = np.diff(values, prepend=0.0)
    gaps = gaps[gaps > values[-1] * 1e-6] if len(values) else gaps
    if len(gaps) < 8:
        return None
    step = float(np.mean(gaps[gaps < 1.5 * gaps.min()]))
    # from few multiples to many: an error of the step adds up with the multiple
    for most in (16, 128, 1024, 2**16):
        near = values[values < most * step]
        multiples = np.rint(near / step)
        if multiples.any():
            step = float((near * multiples).sum() / (multiples**2).sum())
    if np.mean(np.abs(values / step - np.rint(values / step)) < _WHOLE) < _SHARE:
        return None
    tens = np.log10(step)
    return None if abs(tens - np.rint(tens)) < 1e-3 else step


def _fits_paper(largest: float, contents: Sequence[Content]) -> bool:
    """Return whether at most 1 % of the loaded readings exceed the paper's 5 N: a few spikes are
    not another scale."""
    if largest <= PAPER.full_scale * SLACK:
        return True
    surveys = [survey for content in contents for survey in content.surveys]
    loaded = sum(survey.loaded for survey in surveys)
    beyond = sum(survey.beyond for survey in surveys)
    return beyond <= 0.01 * loaded


def _paper_scale(largest: float, content: Content) -> Scale:
    problems: tuple[Problem, ...] = ()
    if 0 < largest <= 1.0:
        what = (
            "no reading exceeds 1: taken as newtons of 0..5; if they are scaled to 0..1 already, as"
            " the paper stores them, give the full scale 1 (--full-scale 1; full_scale=1 in Python)"
        )
        problems = (Problem.warning(content.path, what),)
    return Scale(
        PAPER.full_scale, PAPER.unit, f"the paper's sensor; largest reading {largest:.4g}", problems
    )


def _converter_scale(largest: float, content: Content) -> Scale:
    bits = _bits(largest)
    if bits is None:
        raise InputError.at(
            content.path, f"counts reach {largest:.0f}, more than 16 bits; {GIVE_SCALE}"
        )
    full_scale = 2**bits - 1
    reason = f"whole numbers, largest {largest:.0f}: a converter of {bits} bits"
    if largest > full_scale / 2:
        return Scale(full_scale, "count", reason)
    what = (
        f"no count exceeds {largest:.0f}: taken as 0..{full_scale}, which is too low if nothing was"
        " pressed hard"
    )
    return Scale(
        full_scale,
        "count",
        reason,
        (Problem.warning(content.path, f"{what}; {GIVE_SCALE}"),),
    )


def _bits(levels: float) -> int | None:
    """Return the bits of the smallest usual converter with so many levels above 0."""
    return next((bits for bits in CONVERTER_BITS if levels <= 2**bits - 0.5), None)


def _rounded_up(value: float) -> float:
    """Return a number rounded up to two significant digits."""
    power = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(f"{np.ceil(value / power - 1e-6) * power:.2g}")
