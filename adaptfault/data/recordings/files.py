"""Finds the files that hold recordings among the paths a user gives."""

from __future__ import annotations

import logging
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.facts.labels import TABLE, TARGETS, natural_key
from adaptfault.data.recordings.readers import Reader, reader_of, suffixes

_log = logging.getLogger(__name__)

_UNREAD = {
    ".bag": "is a bag of ROS 1: left out; rosbags-convert (pip install rosbags) makes one of ROS 2"
    " of it, which is read",
    ".zarr": "is no Zarr store, as nothing in it describes one: left out; copy it whole, or let the"
    " name of an archive end in .zarr.zip",
}
_BAG = "metadata.yaml"  # of a bag of ROS 2; what it begins with, in so many bytes:
_OF_BAG = b"rosbag2_bagfile_information"
_HEAD = 1000
_NO_BAG = "describes a bag, and no file of one lies beside it: left out; copy the whole folder"


@dataclass(frozen=True)
class Found:
    """One file to read.

    Attributes:
        path: where it is.
        name: how to call it: below a folder that was given, its path from there
            ("normal/0001.csv").
        root: the folder that was given, or the one that holds a file that was given.
        reader: of its format.
        table: the root's table of labels, if it has one.
    """

    path: Path
    name: str
    root: Path
    reader: Reader
    table: Path | None = None

    @property
    def is_direct(self) -> bool:
        """Whether the file lies in the root itself, not in a folder below it."""
        return self.path.parent == self.root


def find(
    paths: Sequence[Path],
    known: Mapping[str, Reader],
    aside: Collection[Path],
    problems: list[Problem],
) -> list[Found]:
    """Return the files that a reader accepts, each once; folders in natural order, with subfolders.

    Args:
        paths: files and folders, in the order wanted.
        known: the readers.
        aside: resolved paths of files that are no recordings (tables, layouts).
        problems: of all files.

    Raises:
        InputError: a path does not exist.
    """
    found: dict[Path, Found] = {}
    endings = ", ".join(suffixes(known))
    for path in paths:
        try:
            exists = path.exists()
            is_folder = path.is_dir()
        except (OSError, ValueError) as error:
            raise InputError.at(repr(str(path)), f"is not a path ({error}); check it") from None
        if not exists:
            raise InputError.at(path, "is not there; check the path")
        reader = reader_of(path, known, is_folder=is_folder)
        if reader is not None and (is_folder or path.is_file()):
            found.setdefault(path.resolve(), Found(path, str(path), path.parent, reader))
        elif is_folder:
            before = len(found)
            for one in _below(path, known, problems):
                place = one.path.resolve()
                if place not in aside:
                    found.setdefault(place, one)
            if len(found) == before and not _unread(path):
                what = f"the folder holds no recordings; expected files that end in {endings}"
                problems.append(Problem("error", located(path, what)))
        else:
            what = f"is no recording; expected a folder or a file that ends in {endings}"
            problems.append(Problem("error", located(path, _unread(path) or what)))
    for one in found.values():
        _log.debug("%s: read by %s", one.path, getattr(one.reader, "__name__", one.reader))
    return list(found.values())


def _below(root: Path, known: Mapping[str, Reader], problems: list[Problem]) -> Iterator[Found]:
    """Yield the files below a folder, passing over hidden ones (macOS leaves "._name.csv" beside
    each file)."""

    def unreadable(error: OSError) -> None:
        what = f"the folder cannot be read ({error.strerror}); check its permissions"
        problems.append(Problem("error", located(str(error.filename), what)))

    table = root / TABLE
    files: list[tuple[Path, Reader]] = []
    seen: set[str] = set()
    for folder, folders, names in os.walk(root, onerror=unreadable, followlinks=True):
        seen.add(os.path.realpath(folder))  # a link may lead back to a folder above it
        unread = _unread(Path(folder))
        if unread:
            problems.append(Problem("error", located(folder, unread)))
            folders.clear()
            continue
        below = []
        for name in folders:
            path = Path(folder, name)
            if name.startswith(".") or os.path.realpath(path) in seen:
                continue
            reader = reader_of(path, known, is_folder=True)
            if reader is None:
                below.append(name)
            else:
                files.append((path, reader))
        folders[:] = below
        for name in names:
            path = Path(folder, name)
            reader = reader_of(path, known, is_folder=False)
            unread = _unread(path) or _no_file(path)
            if name.startswith(".") or (reader is None and not _unread(path)):
                _log.debug("%s: passed over", path)
            elif unread:
                problems.append(Problem("error", located(path, unread)))
            elif reader is not None:
                files.append((path, reader))
    files.sort(key=lambda file: [natural_key(part) for part in file[0].relative_to(root).parts])
    labels = table if table.is_file() else None
    for path, reader in files:
        if path not in (table, root / TARGETS):
            yield Found(path, path.relative_to(root).as_posix(), root, reader, labels)


def _unread(path: Path) -> str:
    """Return why a file or folder that no reader takes is left out; empty: its name says nothing of
    recordings."""
    suffix = path.suffix.lower()
    if not path.is_dir():
        return _UNREAD.get(suffix, "")
    if suffix == ".zarr":
        return _UNREAD[suffix]
    with suppress(OSError):
        described = path / _BAG
        if described.is_file():
            with described.open("rb") as file:
                return _NO_BAG if _OF_BAG in file.read(_HEAD) else ""
    return ""


def _no_file(path: Path) -> str:
    """Return why a name of a folder is no file; empty: it is one."""
    if path.is_file():
        return ""
    if path.exists():
        return "is a pipe, a device or a socket, no file: left out"
    return "is a link to a file that is not there: left out; copy what it leads to"


def passed_over(notes: Sequence[Path]) -> list[Problem]:
    """Return one warning for all files that hold no line of numbers."""
    if not notes:
        return []
    more = f", and {len(notes) - 1} more" if len(notes) > 1 else ""
    what = f"is no recording, it holds no line of numbers: passed over{more}"
    return [Problem.warning(notes[0], what)]
