"""What recordings themselves tell about their array, where nobody said it: its shape, full scale and unit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.content import Content, Shape
from adaptfault.data.recordings.errors import InputError, Problem, located
from diagnostics import SensorLayout

PAPER = SensorLayout.paper()

CONVERTER_BITS = (8, 10, 12, 14, 16)

SLACK = 1.02
"""Readings up to 2 % above full scale are taken for calibration error, not for another scale."""

GIVE_LAYOUT = "give the layout of the array (--layout FILE or --shape 2x13x6; layout= in Python)"
GIVE_SCALE = "give the full scale and unit (a layout with full_scale and unit, or full_scale= and unit= in Python)"


@dataclass(frozen=True)
class Scale:
    """The range of readings, from 0 to ``full_scale`` in ``unit``, and what is doubtful about it."""

    full_scale: float
    unit: str
    problems: tuple[Problem, ...] = ()


def guess_shape(contents: Sequence[Content]) -> Shape:
    """Return the shape that a file states, or the paper's for frames of 220 readings.

    Raises:
        InputError: no file states one and the frames have another width.
    """
    for content in contents:
        if content.shape is not None:
            return content.shape
    widths = Counter(content.width for content in contents)
    width = max(widths, key=lambda width: (widths[width], width == PAPER.n_cells))
    if width == PAPER.n_cells:
        return PAPER.shape
    first = next(content for content in contents if content.width == width)
    what = f"{describe_width(first, PAPER.n_cells)} (the paper's sensor); for another array {GIVE_LAYOUT}"
    raise first.error(what, frame=0 if first.lines is not None else None)


def describe_width(content: Content, expected: int) -> str:
    """Say that frames have another width than expected, and what it looks like."""
    frames, width = content.frames[0], content.width
    text = f"{width} value{'s' * (width != 1)} a frame, expected {expected}"
    if width == expected + 1 and content.lines is not None:
        if len(frames) and np.isnan(frames[:, -1].astype(np.float64)).all():
            return f"{text}: each line ends with a comma, remove it"
        return f"{text}: if the first column is a time or a number of the frame, remove it"
    if width == expected - 1 and content.lines is not None:
        return f"{text}: a column is missing, write an empty cell for a missing reading"
    return text


def guess_scale(contents: Sequence[Content]) -> Scale:
    """Return the scale that the readings fit: a converter's for counts, the paper's 5 N for decimal numbers.

    Raises:
        InputError: no scale fits.
    """
    largest, content = max(((_largest(c.frames), c) for c in contents), key=lambda pair: pair[0])
    whole = all(content.counts for content in contents)
    in_text = all(content.lines is not None for content in contents)
    newtons = PAPER.full_scale * SLACK
    if whole and not (in_text and largest <= newtons):  # text cannot tell 0 counts from 0 N
        return _converter_scale(largest, content)
    if largest > newtons:
        pressed = sum(int((f > 0).sum()) for c in contents for f in c.frames)
        beyond = sum(int((f > newtons).sum()) for c in contents for f in c.frames)
        if beyond > 0.01 * pressed:  # a few spikes do not make another scale; the check of readings names them
            what = f"readings reach {largest:g}, more than the paper's {PAPER.full_scale:g} N; {GIVE_SCALE}"
            raise InputError.at(content.path, what)
    problems: tuple[Problem, ...] = ()
    if 0 < largest <= 1.0:
        what = (
            "no reading exceeds 1: taken as newtons of 0..5; if they are scaled to 0..1 already, as the paper stores"
            " them, give the full scale 1 (a layout with full_scale 1, or full_scale=1 in Python)"
        )
        problems = (Problem("warning", located(content.path, what)),)
    return Scale(PAPER.full_scale, PAPER.unit, problems)


def unit_of(full_scale: float, contents: Sequence[Content]) -> str:
    """Return the unit of a full scale that was given without one."""
    if full_scale == 1.0:
        return "of full scale"
    return "count" if all(content.counts for content in contents) and full_scale > PAPER.full_scale else PAPER.unit


def _converter_scale(largest: float, content: Content) -> Scale:
    full_scale = next((2**bits - 1 for bits in CONVERTER_BITS if largest <= 2**bits - 1), None)
    if full_scale is None:
        raise InputError.at(content.path, f"counts reach {largest:.0f}, more than 16 bits; {GIVE_SCALE}")
    if largest > full_scale / 2:
        return Scale(full_scale, "count")
    what = f"no count exceeds {largest:.0f}: taken as 0..{full_scale}, which is too low if nothing was pressed hard"
    return Scale(full_scale, "count", (Problem("warning", located(content.path, f"{what}; {GIVE_SCALE}")),))


def _largest(frames: Sequence[NDArray[Any]]) -> float:
    """Return the largest finite reading, 0 where there is none."""
    return max((float(np.max(f, initial=0, where=np.isfinite(f))) for f in frames), default=0.0)
