"""Reads files and folders of any known format, and lists every problem.

Every recording is gone through once before the array is decided (:mod:`.survey`), and a second time
for its frames. Small and large ones take the same way and get the same checks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adaptfault.data.addresses import is_address
from adaptfault.data.recordings.check import (
    check_readings,
    check_scale,
    check_width,
    other_lengths,
)
from adaptfault.data.recordings.dataset import Recordings
from adaptfault.data.recordings.doubts import copies, doubts
from adaptfault.data.recordings.errors import InputError, Problem, foreseeing, noted
from adaptfault.data.recordings.facts.classes import label_files
from adaptfault.data.recordings.facts.infer import PAPER, SLACK
from adaptfault.data.recordings.facts.layout_file import LAYOUT_NAME, layout_beside, not_stated
from adaptfault.data.recordings.facts.resolve import (
    Usual,
    check_agreement,
    check_statements,
    given_array,
    resolve_layout,
)
from adaptfault.data.recordings.facts.targets import TargetTable, target_files
from adaptfault.data.recordings.files import Found, find, passed_over
from adaptfault.data.recordings.opened import Opened
from adaptfault.data.recordings.readers import check_stated, readers
from adaptfault.data.recordings.recording import Recording, Shape
from adaptfault.data.recordings.remote import fetched
from adaptfault.data.recordings.survey import Content, Surveyor
from diagnostics import SensorLayout
from diagnostics.shown import shown

if TYPE_CHECKING:
    from adaptfault.data.calibration import Calibration

PathName = str | PathLike[str]

Listed = tuple[Found, list[Recording]]
"""A file, and the recordings in it."""

Select = Callable[[int], Iterable[int]]
"""Returns the numbers, from 0, of the recordings that are meant, of how many there are."""

ROOM = 256_000_000
"""Bytes of frames that :func:`open_recordings` keeps, so that small files are read once."""


def _nothing(done: int) -> None:
    """Nobody looks at the progress."""


@shown
@dataclass(frozen=True, eq=False)
class Loaded:
    """The recordings that could be read, and the problems.

    Attributes:
        recordings: at least one recording.
        problems: errors (a recording was left out) and warnings (a recording was kept), in the
            order of the files.
        inferred: one sentence for each fact of the array that no file, layout or option states,
            with the reason and the option that states it.
    """

    recordings: Recordings
    problems: tuple[Problem, ...] = ()
    inferred: tuple[str, ...] = ()

    def __str__(self) -> str:
        return "\n".join([str(self.recordings), *map(str, self.problems), *self.inferred])


def load(paths: PathName | Iterable[PathName], *, strict: bool = False, **options: Any) -> Loaded:
    """Read recordings; a bad file is listed and left out, the others are read.

    Each file's class comes from the file itself (.npz), or else from a table of labels, or else
    from the folder that holds it (``folder/<class>/<file>``). Files that all lie in one folder have
    no labels.

    Args:
        paths: a file, a folder, or several of them; addresses, as ``hf://datasets/me/touch``
            (:mod:`adaptfault.data.recordings.remote`); or a data set of LeRobot. Folders are
            searched to the bottom, in natural order.
        layout: the array; a layout file; a shape ``(2, 13, 6)``, "2x13x6" or, for one pad, "13x6".
            None: from the files, see Notes.
        shape: a shape alone, in the same forms, in place of ``layout``.
        labels: a table with the columns ``file,label``, paths relative to it. None: a folder's
            ``labels.csv``.
        frames: the number of frames that each recording must have; None = any.
        calibration: tables that turn the counts read into newtons (or the file that holds them).
        full_scale, unit, rate: override the layout and the files.
        strict: refuse files that state another full scale or rate than ``layout``, and readings
            that exceed its full scale, as a model's layout requires.
        targets: a table of the values that a regression learns, with the columns ``file``, maybe
            ``frame``, and one for each value, paths relative to it; a file has one recording, and
            one that is not in the table is left out. Labels are not read then.
        stated: what readers want to know: ``topic`` and ``field``, where the readings are in bags,
            see :func:`adaptfault.data.recordings.formats.bag.open`; ``key``, which arrays or
            features of a data set hold them; ``columns``, ``ignore``, ``time_column`` and
            ``label_column``, where they are in text files, see
            :func:`adaptfault.data.recordings.formats.csv_folder.open`.

    Raises:
        InputError: a path does not exist, no recording survives, or the layout, the table or the
            calibration is unusable.

    Notes:
        Without a layout, ``layout.json`` in the folders given is used where there is one. Otherwise
        the shape is the one of ``[n, T, pads, rows, cols]`` or ``[n, T, rows, cols]`` (one pad), or
        the paper's for frames of 220 readings. Without a full scale, counts get the one of the
        smallest converter of 8 to 16 bits that holds them; decimal numbers get the paper's 0..5 N
        for the paper's shape, else the range of the converter whose step they show, else 0 to the
        largest reading. The rate is the file's, or that of its times, or 10 Hz. Every inferred fact
        is in ``inferred``.
    """
    given = _all(paths)
    opened = open_recordings(given, strict=strict, room=None, **options)
    recordings = Recordings(
        tuple(opened),
        opened.layout,
        opened.labels,
        opened.class_names,
        opened.names,
        opened.targets,
        opened.value_names,
        opened.scan,
    )
    scale = check_scale(given[0], recordings, opened.layout) if strict else []
    told = copies(recordings.frames, recordings.names)
    problems = (*opened.problems, *opened.late_problems, *scale, *told)
    return Loaded(recordings, problems, opened.inferred)


def open_recordings(
    paths: PathName | Iterable[PathName],
    *,
    layout: SensorLayout | Sequence[int] | PathName | None = None,
    shape: Sequence[int] | str | None = None,
    labels: PathName | None = None,
    frames: int | None = None,
    calibration: Calibration | PathName | None = None,
    full_scale: float | None = None,
    unit: str | None = None,
    rate: float | None = None,
    strict: bool = False,
    targets: PathName | None = None,
    room: int | None = ROOM,
    progress: Callable[[int], None] = _nothing,
    select: Select | None = None,
    **stated: Any,
) -> Opened:
    """Return recordings of any size; their frames are read when they are asked for.

    Args:
        room: bytes of frames that are kept in memory; None: all.
        select: returns the numbers, from 0, of those recordings whose frames are read, of how many
            there are; None: all.
        progress: receives the number of frames of each block of the first reading.
        paths, stated, layout and the other options: as for :func:`load`.

    Raises:
        InputError: as :func:`load`.
    """
    problems: list[Problem] = []
    given = local_paths(paths, stated, problems)
    _check_options(given, layout, shape, frames, labels, targets)
    layout = shape if layout is None else layout
    array = given_array(layout) if layout is not None else layout_beside(given)
    tables = _calibration(calibration)
    values = None if targets is None else TargetTable(Path(targets))
    tables_given = (layout, labels, calibration, targets)
    aside = {Path(p).resolve() for p in tables_given if isinstance(p, str | PathLike)}
    found = find(given, readers(), aside, problems)
    surveyor = Surveyor(PAPER.full_scale * SLACK, 2**62 if room is None else room, progress)
    listed = _listed(found, _asked(stated, array), problems)
    contents, unread, n_found = _surveyed(listed, select, surveyor, problems)
    if values is not None:
        contents = target_files(contents, values, problems)
    else:
        contents = label_files(contents, labels, problems, unread)
    if not contents:
        raise _nothing_left(problems)
    options = {"full_scale": full_scale, "unit": unit, "rate": rate}
    unstated = not_stated(layout, given)
    known, inferred = resolve_layout(contents, array, options, tables, unstated, problems)
    is_beside = layout is None and array is not None
    beside = f" of the {LAYOUT_NAME} beside the recordings" if is_beside else ""
    calibrated = tables is not None
    usable = _usable(contents, known, beside, rate, frames, problems, calibrated, strict)
    scan = surveyor.scans.of(known, problems)
    return Opened(usable, known, inferred, tables, problems, values, n_found, scan)


def local_paths(
    paths: PathName | Iterable[PathName] | Any, stated: Mapping[str, Any], problems: list[Problem]
) -> list[Path]:
    """Return where paths are read: addresses as their copies on this machine.

    Args:
        paths, stated: as for :func:`load`.
        problems: warnings are added to it.
    """
    key = _key(stated)
    return [
        fetched(str(path), readers(), key, problems) if is_address(path) else Path(path)
        for path in _all(paths)
    ]


def _all(paths: PathName | Iterable[PathName] | Any) -> list[PathName]:
    """Return the paths that are given; that of a data set which says where it lies, as LeRobot's,
    is its ``root``."""
    root = getattr(paths, "root", None)
    if isinstance(root, str | PathLike) and not isinstance(paths, str | PathLike):
        return [root]
    return [paths] if isinstance(paths, str | PathLike) else list(paths)


def _key(stated: Mapping[str, Any]) -> str | None:
    """Return which arrays are stated to hold the readings, divided by commas."""
    key = stated.get("key")
    return key if isinstance(key, str | None) else ",".join(key)


def _check_options(
    given: Sequence[Path],
    layout: object,
    shape: object,
    frames: int | None,
    labels: object,
    targets: object,
) -> None:
    """Raise InputError where an option is wrong, or contradicts another one."""
    if layout is not None and shape is not None:
        raise InputError("layout and shape both given: one of them is enough")
    if not given:
        raise InputError("no path given; name a recording or a folder of recordings")
    if frames is not None and frames < 1:
        what = "expected the number of frames a recording must have, at least 1"
        raise InputError(f"frames {frames}: {what}")
    if labels is not None and targets is not None:
        what = "a model learns classes or values, not both"
        raise InputError(f"labels and targets both given: {what}")


def _asked(stated: Mapping[str, Any], array: SensorLayout | Shape | None) -> dict[str, Any]:
    """Return what readers are told of the files."""
    check_stated(stated)
    return {**stated, "key": _key(stated), "shape": getattr(array, "shape", array)}


def _surveyed(
    listed: Iterable[Listed], select: Select | None, surveyor: Surveyor, problems: list[Problem]
) -> tuple[list[Content], list[Found], int | None]:
    """Return the contents of files, what is not read of them where some are selected, and of how
    many recordings these are; what cannot be read is told, and the others are read."""
    contents = []
    unread: list[Found] = []
    n_found = None
    if select is not None:
        listed, unread, n_found = _selected(list(listed), select)
    for file, recordings in listed:
        with noted(problems), foreseeing(file.path):
            content = surveyor(file, recordings, problems)
            if content is not None:
                contents.append(content)
    return contents, unread, n_found


def _listed(
    found: Sequence[Found], asked: Mapping[str, Any], problems: list[Problem]
) -> Iterator[Listed]:
    """Yield the recordings of each file, none of whose frames is read yet; what cannot be read is
    told."""
    notes: list[Path] = []
    for file in found:
        recordings = None
        with noted(problems), foreseeing(file.path):
            recordings = list(file.reader.open(file.path, **asked))
        if recordings:
            yield file, recordings
        elif recordings is not None:
            notes.append(file.path)
    problems += passed_over(notes)


def _selected(listed: Sequence[Listed], select: Select) -> tuple[list[Listed], list[Found], int]:
    """Return the recordings that are selected, which keep their names, and their files, the other
    files that state no label of a recording, and how many recordings there are."""
    n_found = sum(len(recordings) for _, recordings in listed)
    chosen = set(select(n_found))
    number = iter(range(n_found))
    selected = []
    unread = []
    for file, recordings in listed:
        kept = [one for one in _named(file, recordings) if next(number) in chosen]
        if kept:
            selected.append((file, kept))
        elif any(one.label is None for one in recordings):
            unread.append(file)
    return selected, unread, n_found


def _named(file: Found, recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings of a file, which all have a name where they are several."""
    if len(recordings) < 2:
        return list(recordings)
    return [
        replace(one, name=one.name or f"{file.name}, recording {i}")
        for i, one in enumerate(recordings)
    ]


def _usable(
    contents: Sequence[Content],
    layout: SensorLayout,
    beside: str,
    rate: float | None,
    frames: int | None,
    problems: list[Problem],
    calibrated: bool,
    strict: bool,
) -> list[Content]:
    """Return the files that can be used; what is wrong, and doubts, are added to ``problems``.

    Args:
        contents: of the files.
        layout: the array.
        beside: where it was found, for messages; "": nowhere beside the recordings.
        rate: stated for all files.
        frames: that each recording must have; None: any.
        problems: of all files.
        calibrated: whether a calibration turns the counts into newtons.
        strict: whether a file that states something else is refused.

    Raises:
        InputError: none can be used.
    """
    usable = []
    usual = Usual.of(contents)
    for content in contents:
        with noted(problems):
            check_agreement(content, usual, layout, calibrated, rate)
            check_width(content, layout, beside, strict=strict)
            if strict:
                check_statements(content, layout, calibrated)
            kept, told = check_readings(content, layout, frames)
            problems += told
            if kept:
                usable.append(replace(content, kept=tuple(kept)))
    if not usable:
        raise _nothing_left(problems)
    is_labelled = any(one.labels or one.targets is not None for one in usable)
    problems += doubts(usable, layout, labelled=is_labelled)
    problems += other_lengths(usable) if frames is None else []
    return usable


def _calibration(calibration: Calibration | PathName | None) -> Calibration | None:
    if not isinstance(calibration, str | PathLike):
        return calibration
    # here: that module uses this package's errors
    from adaptfault.data.calibration import Calibration

    return Calibration.read(calibration)


def _nothing_left(problems: Sequence[Problem]) -> InputError:
    """Return the error for a run that has no recording left: the first problem, and how many there
    are."""
    errors = [problem for problem in problems if problem.level == "error"]
    found = errors or problems
    count = f"{len(found)} {'error' if errors else 'warning'}{'s' * (found != errors[:1])}"
    return InputError(f"{found[0].message} (no recording is left; {count} in all)")
