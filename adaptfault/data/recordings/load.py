"""Reads files and folders of any known format, and lists every problem.

Every recording is gone through once before the array is decided (:mod:`.survey`), and a second time
for its frames. Small and large ones take the same way and get the same checks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.addresses import is_address
from adaptfault.data.recordings.check import (
    OutOfRange,
    check_readings,
    check_scale,
    check_width,
    clamped_readings,
    other_lengths,
    out_of_range,
    without_infinite,
)
from adaptfault.data.recordings.dataset import Recordings
from adaptfault.data.recordings.doubts import copies, doubts
from adaptfault.data.recordings.errors import InputError, Problem, foreseeing
from adaptfault.data.recordings.facts.classes import class_indices, label_files
from adaptfault.data.recordings.facts.infer import PAPER, SLACK
from adaptfault.data.recordings.facts.layout_file import LAYOUT_NAME, layout_beside, not_stated
from adaptfault.data.recordings.facts.rates import Clock, Elapsed
from adaptfault.data.recordings.facts.resolve import (
    check_agreement,
    check_statements,
    given_array,
    resolve_layout,
)
from adaptfault.data.recordings.facts.targets import TargetTable, target_files
from adaptfault.data.recordings.files import Found, find, passed_over
from adaptfault.data.recordings.readers import check_stated, readers
from adaptfault.data.recordings.recording import BLOCK, Recording, Shape
from adaptfault.data.recordings.remote import fetched
from adaptfault.data.recordings.survey import Content, Surveyor
from diagnostics import SensorLayout
from diagnostics.shown import shown

if TYPE_CHECKING:
    from adaptfault.data.calibration import Calibration
    from diagnostics import Scan

PathName = str | PathLike[str]

Listed = tuple[Found, list[Recording]]
"""A file, and the recordings in it."""

ROOM = 256_000_000
"""Bytes of frames that :func:`open_recordings` keeps, so that small files are read once."""


PART = 5_000_000
"""Readings of a log that are in memory at once."""


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


class Opened:
    """Recordings whose frames are read when they are asked for; may be iterated more than once.

    Iterating yields float32 ``[T, D]`` in the layout's unit, one recording after the other; NaN =
    missing.

    Attributes:
        layout: the array.
        lengths: frames of each recording.
        labels, class_names, names, targets, value_names: as in
            :class:`~adaptfault.data.recordings.dataset.Recordings`.
        inferred: as in :class:`Loaded`.
        problems: errors and warnings.
        origins: the recordings as their readers give them: which arrays of a data set hold them.
        n_found: number of all recordings, of which these were selected.
        late_problems: warnings about the range of readings, after a whole iteration.
        scan: of the read-out, of all files; None: there is none.
    """

    def __init__(
        self,
        contents: Sequence[Content],
        layout: SensorLayout,
        inferred: tuple[str, ...],
        tables: Calibration | None,
        problems: list[Problem],
        values: TargetTable | None,
        n_found: int | None = None,
        scan: Scan | None = None,
    ) -> None:
        self.scan = scan
        self._tables = tables
        self.layout = layout
        self.inferred = inferred
        self._each = [(content, i) for content in contents for i in content.kept]
        self._surveys = [content.surveys[i] for content, i in self._each]
        self.origins = tuple(content.recordings[i] for content, i in self._each)
        self.names = tuple(content.name(i) for content, i in self._each)
        self.lengths = tuple(survey.length for survey in self._surveys)
        labels = [content.labels[i] if content.labels else None for content, i in self._each]
        orders = [content.facts.class_names for content in contents]
        self.labels, self.class_names = class_indices(labels, orders, problems)
        self.value_names: tuple[str, ...] = ()
        self.targets: tuple[NDArray[np.float32], ...] | None = None
        if values is not None:
            self.value_names = values.names
            self.targets = tuple(one.targets for one, _ in self._each if one.targets is not None)
        self.problems = tuple(problems)
        self.late_problems: tuple[Problem, ...] = ()
        self.n_found = len(self) if n_found is None else n_found

    @property
    def clock(self) -> Clock:
        """How regular the times of the frames are."""
        elapsed = Elapsed.of_all(survey.elapsed for survey in self._surveys)
        return Clock() if elapsed is None else elapsed.clock()

    @property
    def seconds(self) -> float:
        """How long the recordings took: by their times where there are some, else by their
        rate."""
        timed = Elapsed.of_all(survey.elapsed for survey in self._surveys)
        usual = None if timed is None else timed.unit()
        total = 0.0
        for survey in self._surveys:
            unit = survey.tick or usual
            if survey.elapsed is None or unit is None:
                total += survey.length / self.layout.rate
            else:
                total += survey.elapsed.seconds(unit)
        return total

    def __len__(self) -> int:
        return len(self.lengths)

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        for pieces in self._recordings():
            yield np.concatenate(list(pieces))

    def pieces(self, frames: int = BLOCK) -> Iterator[NDArray[np.float32]]:
        """Yield all recordings in pieces ``[t, D]`` of about so many frames, in constant memory.

        A piece holds frames of one recording.
        """
        for blocks in self._recordings():
            held: list[NDArray[np.float32]] = []
            for block in blocks:
                held.append(block)
                if sum(map(len, held)) >= frames:
                    yield np.concatenate(held)
                    held = []
            if held:
                yield np.concatenate(held)

    def parts(self, readings: int = PART) -> Iterator[list[NDArray[np.float32]]]:
        """Yield all recordings in lists of at most about so many readings; long recordings are cut.

        A log that is not larger is one list of whole recordings.
        """
        frames = max(1, readings // self.layout.n_cells)
        if sum(self.lengths) <= frames:
            yield list(self)
            return
        part: list[NDArray[np.float32]] = []
        for piece in self.pieces(frames):
            if part and sum(map(len, part)) + len(piece) > frames:
                yield part
                part = []
            part.append(piece)
        yield part

    def _recordings(self) -> Iterator[Iterator[NDArray[np.float32]]]:
        """Yield the blocks of each recording, calibrated."""
        clamped = np.zeros((2, self.layout.n_cells), dtype=np.int64)
        outside: list[Problem] = []
        files = 0
        for content, each in groupby(self._each, key=itemgetter(0)):
            files += 1
            range_ = OutOfRange(content, self.layout)
            for _, i in each:
                yield self._blocks(content, i, clamped, range_)
            problem = range_.problem()
            if problem is not None:
                outside.append(problem)
        late = out_of_range(outside, files, self.layout)
        if clamped.any():
            late.append(clamped_readings(clamped))
        self.late_problems = tuple(late)

    def _blocks(
        self, content: Content, i: int, clamped: NDArray[np.int64], range_: OutOfRange
    ) -> Iterator[NDArray[np.float32]]:
        for block in content.recordings[i].blocks():
            if not len(block.values):
                continue
            readings = without_infinite(block.values)
            if self._tables is not None:
                readings, out = self._tables.apply(readings)
                clamped += np.stack([out.below, out.above])
            with np.errstate(all="ignore"):
                readings = readings.astype(np.float32, copy=False)
            range_.add(i, readings, block.lines)
            yield readings


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
    select: Callable[[int], Iterable[int]] | None = None,
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
    before: list[Problem] = []
    given = [_place(path, stated, before) for path in _all(paths)]
    if layout is not None and shape is not None:
        raise InputError("layout and shape both given: one of them is enough")
    _check_options(given, frames, labels, targets)
    layout = shape if layout is None else layout
    array = given_array(layout) if layout is not None else layout_beside(given)
    tables = _calibration(calibration)
    values = None if targets is None else TargetTable(Path(targets))
    tables_given = (layout, labels, calibration, targets)
    aside = {Path(p).resolve() for p in tables_given if isinstance(p, str | PathLike)}
    found, problems = find(given, readers(), aside)
    problems[:0] = before
    surveyor = Surveyor(PAPER.full_scale * SLACK, 2**62 if room is None else room, progress)
    listed: Iterable[Listed] = _listed(found, _asked(stated, array), problems)
    unread: list[Found] = []
    n_found = None
    if select is not None:
        every = list(listed)
        n_found = sum(len(recordings) for _, recordings in every)
        listed = _selected(every, select(n_found))
        unread = _without_labels(every, [file for file, _ in listed])
    contents = _surveyed(listed, surveyor, problems)
    if values is not None:
        contents = target_files(contents, values, problems)
    else:
        table = None if labels is None else Path(labels)
        contents = label_files(contents, table, problems, unread)
    if not contents:
        raise nothing_left(problems)
    options = {"full_scale": full_scale, "unit": unit, "rate": rate}
    unstated = not_stated(layout, given)
    known, inferred = resolve_layout(contents, array, options, tables, unstated, problems)
    is_beside = layout is None and array is not None
    beside = f" of the {LAYOUT_NAME} beside the recordings" if is_beside else ""

    def check(content: Content) -> None:
        check_agreement(content, contents, tables is not None, rate)
        check_width(content, known, beside, strict=strict)
        if strict:
            check_statements(content, known, tables is not None)

    usable = _usable(contents, known, check, frames, problems)
    scan = surveyor.scans.of(known, problems)
    return Opened(usable, known, inferred, tables, problems, values, n_found, scan)


def local_paths(
    paths: PathName | Iterable[PathName] | Any, stated: Mapping[str, Any]
) -> list[Path]:
    """Return where paths are read: addresses as their copies on this machine.

    Args:
        paths, stated: as for :func:`load`.
    """
    return [_place(path, stated, []) for path in _all(paths)]


def _all(paths: PathName | Iterable[PathName] | Any) -> list[PathName]:
    """Return the paths that are given; that of a data set which says where it lies, as LeRobot's,
    is its ``root``."""
    root = getattr(paths, "root", None)
    if isinstance(root, str | PathLike) and not isinstance(paths, str | PathLike):
        return [root]
    return [paths] if isinstance(paths, str | PathLike) else list(paths)


def _place(path: PathName, stated: Mapping[str, Any], problems: list[Problem]) -> Path:
    """Return where to read a path: itself, or the copy of what is at an address."""
    if not is_address(path):
        return Path(path)
    key = stated.get("key")
    if not isinstance(key, str | None):
        key = ",".join(key)
    return fetched(str(path), readers(), key, problems)


def _check_options(
    given: Sequence[Path], frames: int | None, labels: object, targets: object
) -> None:
    """Raise InputError where an option is wrong, or contradicts another one."""
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
    key = stated.get("key")
    if not isinstance(key, str | None):
        key = ",".join(key)
    return {**stated, "key": key, "shape": getattr(array, "shape", array)}


def _surveyed(
    listed: Iterable[Listed], surveyor: Surveyor, problems: list[Problem]
) -> list[Content]:
    """Return the contents of files; what cannot be read is told, and the others are read."""
    contents = []
    for file, recordings in listed:
        try:
            with foreseeing(file.path):
                content = surveyor(file, recordings, problems)
                if content is not None:
                    contents.append(content)
        except InputError as error:
            problems.append(Problem("error", str(error)))
    return contents


def _listed(
    found: Sequence[Found], asked: Mapping[str, Any], problems: list[Problem]
) -> Iterator[Listed]:
    """Yield the recordings of each file, none of whose frames is read yet; what cannot be read is
    told."""
    notes: list[Path] = []
    for file in found:
        try:
            with foreseeing(file.path):
                recordings = list(file.reader.open(file.path, **asked))
        except InputError as error:
            problems.append(Problem("error", str(error)))
            continue
        if recordings:
            yield file, recordings
        else:
            notes.append(file.path)
    problems += passed_over(notes)


def _selected(listed: Sequence[Listed], numbers: Iterable[int]) -> list[Listed]:
    """Return the recordings with these numbers, which keep their names, and their files."""
    chosen = set(numbers)
    number = iter(range(sum(len(recordings) for _, recordings in listed)))
    selected = []
    for file, recordings in listed:
        kept = [one for one in _named(file, recordings) if next(number) in chosen]
        if kept:
            selected.append((file, kept))
    return selected


def _named(file: Found, recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings of a file, which all have a name where they are several."""
    if len(recordings) < 2:
        return list(recordings)
    return [
        replace(one, name=one.name or f"{file.name}, recording {i}")
        for i, one in enumerate(recordings)
    ]


def _without_labels(listed: Sequence[Listed], read: Sequence[Found]) -> list[Found]:
    """Return the files that are not ``read``, and state no label of a recording."""
    others = [(file, recordings) for file, recordings in listed if file not in read]
    return [file for file, recordings in others if any(one.label is None for one in recordings)]


def _usable(
    contents: Sequence[Content],
    layout: SensorLayout,
    check: Callable[[Content], None],
    frames: int | None,
    problems: list[Problem],
) -> list[Content]:
    """Return the files that can be used; what is wrong, and doubts, are added to ``problems``.

    Args:
        contents: of the files.
        layout: the array.
        check: raises InputError where a file does not fit the array or the other files.
        frames: that each recording must have; None: any.
        problems: of all files.

    Raises:
        InputError: none can be used.
    """
    usable = []
    for content in contents:
        try:
            check(content)
        except InputError as error:
            problems.append(Problem("error", str(error)))
            continue
        kept, told = check_readings(content, layout, frames)
        problems += told
        if kept:
            usable.append(replace(content, kept=tuple(kept)))
    if not usable:
        raise nothing_left(problems)
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


def nothing_left(problems: Sequence[Problem]) -> InputError:
    """Return the error for a run that has no recording left: the first problem, and how many there
    are."""
    errors = [problem for problem in problems if problem.level == "error"] or list(problems)
    counts = Counter(problem.level for problem in problems)
    count = (
        f"{counts['error']} error{'s' * (counts['error'] != 1)}"
        if counts["error"]
        else f"{counts['warning']} warnings"
    )
    return InputError(f"{errors[0].message} (no recording is left; {count} in all)")
