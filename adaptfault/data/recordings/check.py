"""Checks the readings of one file against the array: unusable recordings are left out, doubtful ones get a warning."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.content import Content
from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.infer import GIVE_LAYOUT, SLACK, describe_width
from diagnostics import SensorLayout


def check_width(content: Content, layout: SensorLayout, stated: str = "", *, strict: bool = False) -> None:
    """Raise InputError if the frames of a file do not fit the layout.

    Args:
        content: of the file.
        layout: the array.
        stated: where the layout is from.
        strict: the layout is that of a model or a reference, so the recordings are of another sensor.
    """
    if content.shape is not None and content.shape != layout.shape:
        came, expected = (" x ".join(map(str, shape)) for shape in (content.shape, layout.shape))
        what = f"frames of {came} (pads x rows x cols) where the layout{stated} has {expected}"
        what += "; use recordings of the same sensor" if strict else f"; {GIVE_LAYOUT}"
        raise InputError.at(content.path, what)
    if content.width != layout.n_cells:
        expected = " x ".join(map(str, layout.shape))
        width = describe_width(content, layout.n_cells)
        what = f"{width}; the layout{stated} has {expected} cells, masked ones included"
        raise content.error(what, frame=0 if content.lines is not None else None)


def check_readings(content: Content, layout: SensorLayout, length: int | None) -> tuple[list[int], list[Problem]]:
    """Return the recordings of a file that can be used, and the problems.

    Recordings without frames or of another length than ``length`` are left out with an error. Missing and infinite
    readings are kept with a warning, which counts them over the cells that the layout has.
    """
    kept: list[int] = []
    problems: list[Problem] = []
    counts = {"infinite": 0, "missing": 0}
    first: dict[str, str] = {}
    present = layout.present.ravel()
    for i, frames in enumerate(content.frames):
        error = ""
        if not len(frames):
            error = "holds no frames; record it again or remove it"
        elif length is not None and len(frames) != length:
            error = f"{_rows(content, len(frames))} where {length} were expected; record it again or change the number"
        if error:
            problems.append(Problem("error", str(content.error(error, i))))
            continue
        kept.append(i)
        if frames.dtype.kind != "f":
            continue
        for name, found in (("infinite", np.isinf(frames)), ("missing", np.isnan(frames))):
            gaps = found & present
            if gaps.any():
                counts[name] += int(gaps.sum())
                first.setdefault(name, content.where(i, int(np.flatnonzero(gaps.any(axis=1))[0])))
    for name, count in counts.items():
        if count:
            kept_as = "taken" if name == "infinite" else "kept"
            what = f"{count} {name} reading{'s' * (count != 1)}, first in {first[name]}: {kept_as} as missing"
            problems.append(Problem("warning", located(content.path, what)))
    return kept, problems


def without_infinite(frames: NDArray[Any]) -> NDArray[Any]:
    """Return readings ``[T, D]`` with NaN in place of what is infinite: no converter gives it."""
    return np.where(np.isinf(frames), np.nan, frames) if frames.dtype.kind == "f" else frames


def check_range(
    content: Content, kept: Sequence[int], frames: Sequence[NDArray[np.float32]], layout: SensorLayout
) -> Problem | None:
    """Return a warning that counts the readings of a file outside 0..full scale, None if all fit."""
    slack = (SLACK - 1) * layout.full_scale
    present = layout.present.ravel()
    count, first, extreme = 0, "", 0.0
    for i, recording in zip(kept, frames, strict=True):
        outside = ((recording < -slack) | (recording > layout.full_scale + slack)) & present
        if outside.any():
            count += int(outside.sum())
            first = first or content.where(i, int(np.flatnonzero(outside.any(axis=1))[0]))
            extreme = max(extreme, *recording[outside].tolist(), key=abs)
    if not count:
        return None
    what = (
        f"{count} reading{'s' * (count != 1)} outside 0..{layout.full_scale:g} {layout.unit}, first in {first},"
        f" the farthest {extreme:g}: kept; if they are real, the layout's full scale is wrong"
    )
    return Problem("warning", located(content.path, what))


def other_lengths(contents: Sequence[Content]) -> list[Problem]:
    """Warn of each file of another length, if there are at least 3 files and at least 9 in 10 share one length.

    Only files of one recording count: archives hold recordings of different lengths by design.
    """
    single = [content for content in contents if len(content.frames) == 1]
    if len(single) < 3:
        return []
    common, shared = Counter(len(content.frames[0]) for content in single).most_common(1)[0]
    if shared < 0.9 * len(single):
        return []
    problems = []
    for content in single:
        if (length := len(content.frames[0])) != common:
            what = f"{_rows(content, length)} where the others have {common}: kept; windows use whole windows only"
            problems.append(Problem("warning", located(content.path, what)))
    return problems


def _rows(content: Content, count: int) -> str:
    return f"{count} {'row' if content.lines is not None else 'frame'}{'s' * (count != 1)}"
