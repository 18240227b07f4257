"""Finds the files that hold recordings among the paths a user gives."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from adaptfault.data.recordings.bag import is_bag
from adaptfault.data.recordings.errors import InputError, Problem, located
from adaptfault.data.recordings.labels import TABLE, natural_key


@dataclass(frozen=True)
class Found:
    """One file to read.

    Attributes:
        path: where it is.
        name: how to call it: below a folder that was given, its path from there ("normal/0001.csv").
        root: the folder that was given, or the one that holds a file that was given.
        table: the root's table of labels, if it has one.
    """

    path: Path
    name: str
    root: Path
    table: Path | None = None

    @property
    def is_direct(self) -> bool:
        """Whether the file lies in the root itself, not in a folder below it."""
        return self.path.parent == self.root


def find(
    paths: Sequence[Path], suffixes: Collection[str], aside: Collection[Path]
) -> tuple[list[Found], list[Problem]]:
    """Return the files with one of the suffixes and the bags, each once; folders in natural order, with subfolders.

    Args:
        paths: files and folders, in the order wanted.
        suffixes: in lower case, with the point.
        aside: resolved paths of files that are no recordings (tables, layouts).

    Raises:
        InputError: a path does not exist.
    """
    found: dict[Path, Found] = {}
    problems: list[Problem] = []
    for path in paths:
        try:
            exists, is_folder = path.exists(), path.is_dir()
        except (OSError, ValueError) as error:
            raise InputError.at(repr(str(path)), f"is not a path ({error}); check it") from None
        if not exists:
            raise InputError.at(path, "is not there; check the path")
        if is_folder and is_bag(path):
            found.setdefault(path.resolve(), Found(path, str(path), path.parent))
        elif is_folder:
            candidates: Iterator[Found] = _below(path, suffixes, problems)
            before = len(found)
            found |= {c.path.resolve(): c for c in candidates if c.path.resolve() not in aside | found.keys()}
            if len(found) == before:
                what = f"the folder holds no recordings; expected files that end in {', '.join(sorted(suffixes))}"
                problems.append(Problem("error", located(path, what)))
        elif path.suffix.lower() not in suffixes or not path.is_file():
            what = f"is no recording; expected a folder or a file that ends in {', '.join(sorted(suffixes))}"
            problems.append(Problem("error", located(path, what)))
        else:
            found.setdefault(path.resolve(), Found(path, str(path), path.parent))
    return list(found.values()), problems


def _below(root: Path, suffixes: Collection[str], problems: list[Problem]) -> Iterator[Found]:
    """Yield the files below a folder, passing over hidden ones (macOS leaves "._name.csv" beside each file)."""

    def unreadable(error: OSError) -> None:
        what = f"the folder cannot be read ({error.strerror}); check its permissions"
        problems.append(Problem("error", located(str(error.filename), what)))

    table = root / TABLE
    files: list[Path] = []
    seen: set[str] = set()
    for folder, folders, names in os.walk(root, onerror=unreadable, followlinks=True):
        seen.add(os.path.realpath(folder))  # a link may lead back to a folder above it
        folders[:] = [
            name for name in folders if not name.startswith(".") and os.path.realpath(Path(folder, name)) not in seen
        ]
        if "metadata.yaml" in names and is_bag(Path(folder)):
            files.append(Path(folder))
            folders[:] = []
        else:
            files += (Path(folder, name) for name in names if not name.startswith("."))
    recordings = [f for f in files if f != table and (is_bag(f) or (f.suffix.lower() in suffixes and f.is_file()))]
    for file in sorted(recordings, key=lambda f: [natural_key(part) for part in f.relative_to(root).parts]):
        yield Found(file, file.relative_to(root).as_posix(), root, table if table.is_file() else None)
