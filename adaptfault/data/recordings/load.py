"""Reads files and folders of any known format into :class:`Recordings`, and lists every problem."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.bag import STORAGES, read_bag
from adaptfault.data.recordings.check import check_range, check_readings, check_width, other_lengths, without_infinite
from adaptfault.data.recordings.classes import class_indices, label_files
from adaptfault.data.recordings.content import Content, Shape
from adaptfault.data.recordings.csv_folder import read_csv
from adaptfault.data.recordings.dataset import Recordings
from adaptfault.data.recordings.errors import InputError, Problem
from adaptfault.data.recordings.files import Found, find
from adaptfault.data.recordings.layout_file import LAYOUT_NAME, layout_beside
from adaptfault.data.recordings.npz import read_npy, read_npz
from adaptfault.data.recordings.resolve import Resolved, check_agreement, check_statements, given_array, resolve_layout
from diagnostics import SensorLayout

if TYPE_CHECKING:
    from adaptfault.data.calibration import Calibration

PathName = str | PathLike[str]

READERS: Mapping[str, Callable[[Path], Content]] = {".csv": read_csv, ".npz": read_npz, ".npy": read_npy}
"""The reader of each format by the end of the file's name; bags, which may be folders, have their own."""


@dataclass(frozen=True, eq=False)
class Loaded:
    """The recordings that could be read, and the problems.

    Attributes:
        recordings: at least one recording.
        problems: errors (a recording was left out) and warnings (a recording was kept), in the order of the files.
        inferred: one sentence for each fact of the array that no file, layout or option states, with the reason and
            the option that states it.
    """

    recordings: Recordings
    problems: tuple[Problem, ...] = ()
    inferred: tuple[str, ...] = ()


def load(
    paths: PathName | Iterable[PathName],
    *,
    layout: SensorLayout | Shape | PathName | None = None,
    labels: PathName | None = None,
    frames: int | None = None,
    calibration: Calibration | PathName | None = None,
    full_scale: float | None = None,
    unit: str | None = None,
    rate: float | None = None,
    topic: str | None = None,
    field: str | None = None,
    strict: bool = False,
) -> Loaded:
    """Read recordings; a bad file is listed and left out, the others are read.

    Each file's class comes from the file itself (.npz), or else from a table of labels, or else from the folder that
    holds it (``folder/<class>/<file>``). Files that all lie in one folder have no labels.

    Args:
        paths: a file, a folder, or several of them. Folders are searched to the bottom, in natural order.
        layout: the array; a layout file; a shape ``(2, 13, 6)``, "2x13x6" or, for one pad, "13x6". None: from the
            files, see Notes.
        labels: a table with the columns ``file,label``, paths relative to it. None: a folder's ``labels.csv``.
        frames: the number of frames that each recording must have; None = any.
        calibration: tables that turn the counts read into newtons (or the file that holds them).
        full_scale, unit, rate: override the layout and the files.
        strict: refuse files that state another full scale or rate than ``layout``, as a model's layout requires.
        topic, field: where the readings are in bags, see :func:`adaptfault.data.recordings.bag.read_bag`.

    Raises:
        InputError: a path does not exist, no recording survives, or the layout, the table or the calibration is
            unusable.

    Notes:
        Without a layout, ``layout.json`` in the folders given is used where there is one. Otherwise the shape is the
        one of ``[n, T, pads, rows, cols]`` or ``[n, T, rows, cols]`` (one pad), or the paper's for frames of 220
        readings. Without a full scale, counts get the one of the smallest converter of 8 to 16 bits that holds them;
        decimal numbers get the paper's 0..5 N for the paper's shape, else the range of the converter whose step they
        show, else 0 to the largest reading. The rate is the file's, or 10 Hz. Every inferred fact is in ``inferred``.
    """
    given = [Path(paths)] if isinstance(paths, str | PathLike) else [Path(path) for path in paths]
    if not given:
        raise InputError("no path given; name a recording or a folder of recordings")
    if frames is not None and frames < 1:
        raise InputError(f"frames {frames}: expected the number of frames a recording must have, at least 1")
    array = given_array(layout) if layout is not None else layout_beside(given)
    shape = array.shape if isinstance(array, SensorLayout) else array
    tables = _calibration(calibration)
    aside = {Path(p).resolve() for p in (layout, labels, calibration) if isinstance(p, str | PathLike)}
    found, problems = find(given, (*READERS, *STORAGES), aside)
    contents = _read(found, shape, topic, field, problems)
    contents = label_files(contents, None if labels is None else Path(labels), problems)
    if not contents:
        raise nothing_left(problems)
    resolved = resolve_layout([content for _, content in contents], array, full_scale, unit, rate, tables)
    problems += resolved.problems
    if tables is not None:
        try:
            tables.check(resolved.layout)
        except ValueError as error:
            raise InputError(f"calibration: {error}") from None
    stated = f" of the {LAYOUT_NAME} beside the recordings" if layout is None and array is not None else ""
    return _assemble(contents, resolved, frames, tables, problems, strict=strict, stated=stated)


def _read(
    found: Sequence[Found], shape: Shape | None, topic: str | None, field: str | None, problems: list[Problem]
) -> list[tuple[Found, Content]]:
    """Return the content of each file that can be read; what cannot is added to the problems."""
    contents: list[tuple[Found, Content]] = []
    for file in found:
        try:
            reader = READERS.get(file.path.suffix.lower()) if file.path.is_file() else None
            content = reader(file.path) if reader else read_bag(file.path, topic=topic, field=field)
        except InputError as error:
            problems.append(Problem("error", str(error)))
        else:
            problems += content.problems
            contents.append((file, content.read_as(shape) if shape else content))
    return contents


def _assemble(
    contents: Sequence[tuple[Found, Content]],
    resolved: Resolved,
    length: int | None,
    tables: Calibration | None,
    problems: list[Problem],
    *,
    strict: bool,
    stated: str,
) -> Loaded:
    """Check each file against the layout, calibrate it, and put the recordings of all together."""
    layout = resolved.layout
    out_of_range: list[Problem] = []
    clamped = np.zeros((2, layout.n_cells), dtype=np.int64)
    frames: list[NDArray[np.float32]] = []
    names: list[str] = []
    labels: list[str | None] = []
    usable: list[Content] = []
    every = [content for _, content in contents]
    for file, content in contents:
        try:
            check_agreement(content, every, tables is not None)
            check_width(content, layout, stated, strict=strict)
            if strict:
                check_statements(content, layout, tables is not None)
        except InputError as error:
            problems.append(Problem("error", str(error)))
            continue
        kept, found = check_readings(content, layout, length)
        problems += found
        if not kept:
            continue
        usable.append(content)
        readings = [without_infinite(content.frames[i]) for i in kept]
        if tables is not None:
            readings = [_calibrated(recording, tables, clamped) for recording in readings]
        readings = [recording.astype(np.float32, copy=False) for recording in readings]
        if problem := check_range(content, kept, readings, layout):
            out_of_range.append(problem)
        frames += readings
        names += (_name(file, content, i) for i in kept)
        labels += (content.labels[i] if content.labels else None for i in kept)
    if not frames:
        raise nothing_left(problems)
    if length is None:
        problems += other_lengths(usable)
    problems += _summary(out_of_range, len(usable), layout)
    if clamped.any():
        problems.append(_clamped(clamped))
    indices, class_names = class_indices(labels, [content.class_names for content in usable], problems)
    recordings = Recordings(tuple(frames), layout, indices, class_names, tuple(names))
    return Loaded(recordings, tuple(problems), resolved.inferred)


def _calibration(calibration: Calibration | PathName | None) -> Calibration | None:
    if not isinstance(calibration, str | PathLike):
        return calibration
    from adaptfault.data.calibration import Calibration  # here: that module uses this package's errors

    return Calibration.read(calibration)


def _calibrated(recording: NDArray[Any], tables: Calibration, clamped: NDArray[np.int64]) -> NDArray[np.float32]:
    newtons, out = tables.apply(recording)
    clamped += np.stack([out.below, out.above])
    return newtons


def _clamped(clamped: NDArray[np.int64]) -> Problem:
    below, above = (int(n) for n in clamped.sum(axis=1))
    cells = int(clamped.any(axis=0).sum())
    what = (
        f"{below} readings below and {above} above the tables of {cells} cells, most on cell"
        f" {int(clamped.sum(axis=0).argmax())}: clamped to the tables' ends"
    )
    return Problem("warning", f"calibration: {what}")


def _summary(out_of_range: list[Problem], files: int, layout: SensorLayout) -> list[Problem]:
    """Return the warnings about the range; one for all where most files have it, because then the scale is wrong."""
    if len(out_of_range) <= max(3, files // 2):
        return out_of_range
    what = (
        f"{len(out_of_range)} of {files} files hold readings outside 0..{layout.full_scale:g} {layout.unit}:"
        " check the layout's full scale and unit; the first is"
    )
    return [Problem("warning", f"{what} {out_of_range[0].message}")]


def _name(file: Found, content: Content, i: int) -> str:
    if content.names is not None:
        return content.names[i]
    return file.name if len(content.frames) == 1 else f"{file.name}, recording {i}"


def nothing_left(problems: Sequence[Problem]) -> InputError:
    """Return the error for a run that has no recording left: the first problem, and how many there are."""
    errors = [problem for problem in problems if problem.level == "error"] or list(problems)
    counts = Counter(problem.level for problem in problems)
    count = (
        f"{counts['error']} error{'s' * (counts['error'] != 1)}" if counts["error"] else f"{counts['warning']} warnings"
    )
    return InputError(f"{errors[0].message} (no recording is left; {count} in all)")
