"""Checks the readings of one file against the array: unusable recordings are left out, doubtful
ones get a warning."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import NO_FRAMES, InputError, Problem
from adaptfault.data.recordings.facts.infer import GIVE_LAYOUT, SLACK, describe_width
from adaptfault.data.recordings.facts.rates import Elapsed
from adaptfault.data.recordings.survey import Content
from diagnostics import SensorLayout


def check_width(
    content: Content, layout: SensorLayout, stated: str = "", *, strict: bool = False
) -> None:
    """Raise InputError if the frames of a file do not fit the layout.

    Args:
        content: of the file.
        layout: the array.
        stated: where the layout is from.
        strict: the layout is that of a model or a reference, so the recordings are of another
            sensor.
    """
    if content.shape is not None and content.shape != layout.shape:
        came = " x ".join(map(str, content.shape))
        expected = " x ".join(map(str, layout.shape))
        what = f"frames of {came} (pads x rows x cols) where the layout{stated} has {expected}"
        what += "; use recordings of the same sensor" if strict else f"; {GIVE_LAYOUT}"
        raise InputError.at(content.path, what)
    if content.width != layout.n_cells:
        expected = " x ".join(map(str, layout.shape))
        width = describe_width(content, layout.n_cells)
        what = f"{width}; the layout{stated} has {expected} cells, masked ones included"
        raise content.error(what, frame=content.surveys[0].first_line if content.text else None)


def check_readings(
    content: Content, layout: SensorLayout, length: int | None
) -> tuple[list[int], list[Problem]]:
    """Return the recordings of a file that can be used, and the problems.

    Recordings without frames or of another length than ``length`` are left out with an error.
    Missing and infinite readings are kept with a warning, which counts them over the cells that the
    layout has. Times that fall are told.
    """
    kept: list[int] = []
    problems: list[Problem] = []
    counts = {"infinite": 0, "missing": 0}
    first: dict[str, str] = {}
    present = layout.is_cell
    for i, survey in enumerate(content.surveys):
        error = ""
        if not survey.length:
            error = NO_FRAMES
        elif survey.width != layout.n_cells:
            error = f"{survey.width} values a frame where the others have {layout.n_cells}"
        elif length is not None and survey.length != length:
            error = (
                f"{_rows(content, survey.length)} where {length} were expected; record it again or"
                " change the number"
            )
        if error:
            problems.append(Problem("error", str(content.error(error, i))))
            continue
        kept.append(i)
        if survey.elapsed is not None:
            problems += _disorder(content, i, survey.elapsed)
        for name, gaps in (("infinite", survey.infinite), ("missing", survey.missing)):
            cells = (gaps.count > 0) & present
            if cells.any():
                counts[name] += int(gaps.count[cells].sum())
                first.setdefault(name, content.where(i, int(gaps.first[cells].min())))
    for name, count in counts.items():
        if count:
            kept_as = "taken" if name == "infinite" else "kept"
            what = (
                f"{count} {name} reading{'s' * (count != 1)}, first in {first[name]}: {kept_as} as"
                " missing"
            )
            problems.append(Problem.warning(content.path, what))
    return kept, problems


def _disorder(content: Content, i: int, elapsed: Elapsed) -> list[Problem]:
    """Warn of frames in the wrong order, and of a clock that falls back."""
    found = []
    if disorder := elapsed.disorder:
        where = content.where(i, elapsed.first_late)
        found.append(f"{disorder}, the first in {where}: kept as they stand")
    if elapsed.falls:
        times = "1 time is" if elapsed.falls == 1 else f"{elapsed.falls} times are"
        what = f"{times} before the one before, first in {content.where(i, elapsed.first_fall)}"
        what += ": the clock was reset, or the frames are not in order; kept as they stand"
        found.append(what)
    return [Problem.warning(content.path, what) for what in found]


def check_scale(
    path: PathLike[str] | str, recordings: Iterable[NDArray[Any]], layout: SensorLayout
) -> list[Problem]:
    """Refuse readings most of which exceed the full scale of a model or a reference; warn if none
    comes near it.

    Args:
        path: for messages.
        recordings: ``[T, D]`` each.
        layout: that of the model.

    Raises:
        InputError: more than half of the readings above 0 exceed the full scale.
    """
    # A cell that reads the same all the time shows no unit: it may be broken.
    moving = [
        frames[
            :,
            np.nanmin(frames, axis=0, initial=np.inf) < np.nanmax(frames, axis=0, initial=-np.inf),
        ]
        for frames in recordings
    ]
    readings = np.concatenate([frames[frames > 0] for frames in moving])
    if not readings.size:
        return []
    largest = float(readings.max())
    expected = f"where the full scale is {layout.full_scale:g} {layout.unit}"
    if np.median(readings) > 1.02 * layout.full_scale:
        what = f"readings reach {largest:.4g} {expected}; use recordings in the same unit"
        raise InputError.at(Path(path), what)
    if largest >= 0.1 * layout.full_scale:
        return []
    what = f"the largest reading is {largest:.4g} {expected}; is it the same unit?"
    return [Problem.warning(Path(path), what)]


def without_infinite(frames: NDArray[Any]) -> NDArray[Any]:
    """Return readings ``[T, D]`` with NaN in place of what is infinite: no converter gives it."""
    return np.where(np.isinf(frames), np.nan, frames) if frames.dtype.kind == "f" else frames


class OutOfRange:
    """Counts the readings of a file outside 0..full scale.

    Args:
        content: of the file.
        layout: the array.
    """

    def __init__(self, content: Content, layout: SensorLayout) -> None:
        self.content = content
        self.layout = layout
        self.count = 0
        self.first = ""
        self.extreme = 0.0
        self._seen: dict[int, int] = {}

    def add(self, i: int, frames: NDArray[np.float32], lines: NDArray[np.intp] | None) -> None:
        """Take in the next frames ``[t, D]`` of recording ``i``, in the layout's unit."""
        full = self.layout.full_scale
        slack = (SLACK - 1) * full
        before = self._seen.get(i, 0)
        self._seen[i] = before + len(frames)
        outside = (frames < -slack) | (frames > full + slack)
        outside &= self.layout.is_cell
        if not outside.any():
            return
        frame = int(np.flatnonzero(outside.any(axis=1))[0])
        self.count += int(outside.sum())
        place = before + frame if lines is None else int(lines[frame])
        self.first = self.first or self.content.where(i, place)
        farthest = frames[outside]
        self.extreme = max(self.extreme, float(farthest[np.abs(farthest).argmax()]), key=abs)

    def problem(self) -> Problem | None:
        """Return a warning; None if all readings fit."""
        if not self.count:
            return None
        what = (
            f"{self.count} reading{'s' * (self.count != 1)} outside 0..{self.layout.full_scale:g}"
            f" {self.layout.unit}, first in {self.first}, the farthest {self.extreme:g}: kept; if"
            " they are real, the layout's full scale is wrong"
        )
        return Problem.warning(self.content.path, what)


def out_of_range(found: list[Problem], files: int, layout: SensorLayout) -> list[Problem]:
    """Return the warnings about the range; one for all where most files have it, because then the
    scale is wrong."""
    if len(found) <= max(3, files // 2):
        return found
    what = (
        f"{len(found)} of {files} files hold readings outside 0..{layout.full_scale:g}"
        f" {layout.unit}: check the layout's full scale and unit; the first is"
    )
    return [Problem("warning", f"{what} {found[0].message}")]


def clamped_readings(clamped: NDArray[np.int64]) -> Problem:
    """Return the warning about readings below and above the tables, ``[2, D]``."""
    below, above = clamped.sum(axis=1).tolist()
    cells = int(clamped.any(axis=0).sum())
    what = (
        f"{below} readings below and {above} above the tables of {cells} cells, most on cell"
        f" {int(clamped.sum(axis=0).argmax())}: clamped to the tables' ends"
    )
    return Problem("warning", f"calibration: {what}")


def other_lengths(contents: Sequence[Content]) -> list[Problem]:
    """Warn of each file of another length, if there are at least 3 files and at least 9 in 10 share
    one length.

    Only files of one recording count: archives hold recordings of different lengths by design.
    """
    single = [content for content in contents if len(content.surveys) == 1]
    if len(single) < 3:
        return []
    common, shared = Counter(content.surveys[0].length for content in single).most_common(1)[0]
    if shared < 0.9 * len(single):
        return []
    problems = []
    for content in single:
        length = content.surveys[0].length
        if length != common:
            what = (
                f"{_rows(content, length)} where the others have {common}: kept; windows use whole"
                " windows only"
            )
            problems.append(Problem.warning(content.path, what))
    return problems


def _rows(content: Content, count: int) -> str:
    return f"{count} {'row' if content.text else 'frame'}{'s' * (count != 1)}"
