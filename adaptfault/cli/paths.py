"""What a command reads and what it writes: no output may be what was read.

An option that names a path states with its type what becomes of it, so that a new option is checked
as all others are.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from adaptfault.data.addresses import is_address

if TYPE_CHECKING:
    from adaptfault.cli.command import Command

Identity = tuple[int, int]  # device and inode: the same for each spelling and each link

# what begins the documents that a command writes anew at each run
_RESULT = re.compile(
    rb'"schema": "adaptfault\.(diagnosis|check|routine)/'
    rb'|<meta name="generator" content="adaptfault"|# HELP adaptfault_'
    rb"|<title>tactile cells: |Software\x00Matplotlib"
)
# of a folder that a command writes into
_ABOUT = ("manifest.json", "report.html", "ledger.jsonl", "result.json")
_CHECKPOINT = "training.safetensors"
LAYOUTS = ("layout.json", "layout.toml")  # that are read beside recordings, without an option
_BEGIN = 4096  # bytes of a document that say what it is


class Read(str):
    """A path that a command reads."""


class Stated(Read):
    """What may be a path that a command reads, or something else, as numbers of cells."""


class Written(str):
    """A file that a command writes; its folder is there."""


class WrittenFolder(Written):
    """A folder that a command writes into, made with the missing ones above it."""


class WrittenInto(WrittenFolder):
    """A folder that keeps what else it holds: a command adds some files to it, or replaces these.

    Attributes:
        files: their names.
    """

    files: tuple[str, ...] = ()


def written_into(*files: str) -> type[WrittenInto]:
    """Return the type of an option with a folder into which a command writes these files."""
    return type("WrittenInto", (WrittenInto,), {"files": files})


class WrittenRecordings(Written):
    """Recordings that a command writes: a file, or a folder."""


def check_paths(command: Command) -> None:
    """Check the paths of a command before anything heavy is imported.

    Raises:
        ValueError: an input is not there, an output has no name or no folder, or an output is what
            is read.
    """
    _check_bundle(command)
    inputs = list(_paths(command, Read))
    for _, path in inputs:
        # an empty path, as of a shell variable that is not set, is none either
        is_elsewhere = isinstance(path, Stated) or is_address(path)
        if not is_elsewhere and not os.path.lexists(path):
            raise ValueError(f"{path or repr(path)}: is not there; check the path")
    _check_model(command)
    outputs = list(_paths(command, Written))
    for option, path in outputs:
        _check_place(option, path)
    refuse_overwriting(command, [path for _, path in inputs])


def refuse_overwriting(command: Command, inputs: Sequence[str]) -> None:
    """Refuse outputs that are what is read, or hold it, or lie in it and are not a result of an
    earlier run.

    Args:
        command: of the command; its values of the type :class:`Written` are the outputs.
        inputs: paths that are read; those that are not there do not matter.

    Raises:
        ValueError: with the option and the path.
    """
    outputs = list(_paths(command, Written))
    named: dict[str, str] = {}
    for option, path in outputs:
        place = os.path.realpath(path)
        if place in named:
            raise ValueError(f"{option} {path}: {named[place]} names it, too; choose another name")
        named[place] = option
    there = [path for path in (*inputs, *_layouts(inputs)) if os.path.exists(path)]
    held = cache(_held)
    for option, path in outputs:
        for given in there:
            conflict = _conflict(path, given, held)
            if conflict is not None:
                raise ValueError(f"{option} {path}: {conflict}; choose another name")


def _layouts(inputs: Sequence[str]) -> list[str]:
    """Return the layouts that are read beside files."""
    folders = {os.path.dirname(path) for path in inputs if os.path.isfile(path)}
    return [os.path.join(folder, name) for folder in folders for name in LAYOUTS]


def _conflict(output: str, given: str, held: Callable[[str], set[Identity]]) -> str | None:
    """Return why an output must not be written while ``given`` is read; None where it may.

    ``held`` returns what a folder holds.
    """
    place = _identity(output)
    if place is not None and place == _identity(given):
        return "is read by this command"
    if isinstance(output, WrittenInto) and _identity(given) not in _above(output):
        for name in output.files:
            if _identity(os.path.join(output, name)) == _identity(given):
                return f"{name} would be written there, which is read"
        return None
    if place in _above(given):
        return f"holds {given}, which is read"
    if not os.path.isdir(given):
        return None
    within = _identity(given) in _above(output)
    if isinstance(output, WrittenRecordings) and within:
        return f"lies in {given}, and would be read as a recording of it"
    if place is None or _written_before(Path(output)):
        return None
    if within or place in held(given):
        return f"is there, in {given}, which is read"
    return None


def _paths(command: Command, kind: type[str]) -> Iterator[tuple[str, str]]:
    """Yield option and path of each value of a type."""
    for name, value in command.values().items():
        values = value if isinstance(value, list) else [value]
        for one in values:
            if isinstance(one, kind):
                yield f"--{name.replace('_', '-')}", one


def _check_place(option: str, path: str) -> None:
    """Raise ValueError for an output without a name, or in a folder that is not there."""
    if path == "":  # as of a shell variable that is not set: nothing would be written
        what = "folder" if isinstance(path, WrittenFolder) else "file"
        raise ValueError(f"{option} '': name a {what}")
    folder = os.path.dirname(path)
    made = isinstance(path, WrittenFolder)
    if folder and not made and not os.path.isdir(folder):
        raise ValueError(f"{option} {path}: the folder {folder} is not there; create it first")
    if type(path) is Written and os.path.isdir(path) and not path.lower().endswith(".zarr"):
        raise ValueError(f"{option} {path}: is a folder; name a file")


def _check_model(command: Command) -> None:
    """Raise ValueError where what is given as a model is none."""
    model = command.values().get("model")
    manifest = os.path.join(model or "", "manifest.json")
    if model is not None and not is_bundle(model) and not os.path.isfile(manifest):
        raise ValueError(
            f"{model}: expected a model, a folder with manifest.json as adaptfault train writes it,"
            " or a bundle"
        )


def _check_bundle(command: Command) -> None:
    """Raise ValueError where what is given as a bundle is none."""
    bundle = command.values().get("bundle")
    if bundle is not None and not is_bundle(bundle):
        what = (
            "expected a bundle, a folder with bundle.json; adaptfault train --out X.bundle"
            " makes one"
        )
        raise ValueError(f"{bundle}: {what}")


def is_bundle(folder: str | os.PathLike[str]) -> bool:
    """Return whether a folder holds the document of a bundle, or its copy."""
    return any(
        os.path.isfile(os.path.join(folder, name)) for name in ("bundle.json", "bundle.copy.json")
    )


def _identity(path: str | os.PathLike[str]) -> Identity | None:
    """Return what identifies a file or folder, however it is named; None where it is not there.

    A device or a pipe holds nothing that could be lost.
    """
    try:
        about = os.stat(Path(path))  # as it is written: a Path has no slash at the end
    except (OSError, ValueError):
        return None
    if not (stat.S_ISREG(about.st_mode) or stat.S_ISDIR(about.st_mode)):
        return None
    return about.st_dev, about.st_ino


def _above(path: str) -> set[Identity]:
    """Return the folders that hold a path, as it is named and as it is linked."""
    places = [Path(path).absolute(), Path(os.path.realpath(path))]
    folders = {folder for place in places for folder in place.parents}
    return {identity for folder in folders if (identity := _identity(folder)) is not None}


def _held(folder: str) -> set[Identity]:
    """Return the files and folders in a folder, those that it links to included."""
    found: set[Identity] = set()
    waiting = [folder]
    while waiting:
        try:
            entries = list(os.scandir(waiting.pop()))
        except OSError:
            continue
        for entry in entries:
            identity = _identity(entry.path)
            if identity is None or identity in found:
                continue
            found.add(identity)
            if entry.is_dir():
                waiting.append(entry.path)
    return found


def _written_before(path: Path) -> bool:
    """Return whether an output is of an earlier run, which may take its place."""
    if not path.is_dir():
        return bool(_RESULT.search(_begin(path)))
    if (path / _CHECKPOINT).is_file() or not any(path.iterdir()):
        return True
    return any(b"adaptfault" in _begin(path / name) for name in _ABOUT)


def _begin(path: Path) -> bytes:
    """Return how a file begins; nothing where it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(_BEGIN)
    except OSError:
        return b""
