"""Finds the files that hold recordings among the paths a user gives."""

from __future__ import annotations

import logging
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.facts.labels import TABLE, TARGETS, natural_key
from adaptfault.data.recordings.readers import Reader, reader_of, suffixes

_log = logging.getLogger(__name__)


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
            if len(found) == before:
                what = f"the folder holds no recordings; expected files that end in {endings}"
                problems.append(Problem("error", located(path, what)))
        else:
            what = f"is no recording; expected a folder or a file that ends in {endings}"
            problems.append(Problem("error", located(path, what)))
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
            if reader is not None and not name.startswith(".") and path.is_file():
                files.append((path, reader))
            elif reader is not None and not name.startswith(".") and path.exists():
                what = "is a pipe, a device or a socket, no file: passed over"
                problems.append(Problem.warning(path, what))
            else:
                _log.debug("%s: passed over", path)
    files.sort(key=lambda file: [natural_key(part) for part in file[0].relative_to(root).parts])
    labels = table if table.is_file() else None
    for path, reader in files:
        if path not in (table, root / TARGETS):
            yield Found(path, path.relative_to(root).as_posix(), root, reader, labels)


def passed_over(notes: Sequence[Path]) -> list[Problem]:
    """Return one warning for all files that hold no line of numbers."""
    if not notes:
        return []
    more = f", and {len(notes) - 1} more" if len(notes) > 1 else ""
    what = f"is no recording, it holds no line of numbers: passed over{more}"
    return [Problem.warning(notes[0], what)]
