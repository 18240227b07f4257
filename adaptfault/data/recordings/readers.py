"""The readers of recordings, one a format, found through the entry point group
``adaptfault.readers``.

A reader is a module (or any object) with::

    SUFFIXES = (".csv",)                            # how their names end, in lower case
    def open(path, **stated): -> Iterable[Recording]
    def accepts(path): -> bool                      # optional: whether a folder is one of its own

Where a file holds arrays by name, what opens it is enough: ``formats.datasets.reader.reader`` makes
``open`` of it, and finds readings, times, episodes and classes.

``stated`` is what the user says about the files: ``shape``, ``key``, ``topic``, ``columns`` and
what else the reader asks for; it ignores the rest. A file that turns out to be none of its format,
as notes that end in ``.txt``, gives no recording. A package that declares such an entry point is
used by every command::

    [project.entry-points."adaptfault.readers"]
    mine = "my_package.my_format"
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from functools import cache
from inspect import Parameter, signature
from pathlib import Path
from typing import Any, Protocol

from adaptfault.data.plugins import plugins
from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.recording import Recording

GROUP = "adaptfault.readers"

BUILT_IN = {
    "csv": "adaptfault.data.recordings.formats.csv_folder",
    "npz": "adaptfault.data.recordings.formats.npz",
    "npy": "adaptfault.data.recordings.formats.npy",
    "bag": "adaptfault.data.recordings.formats.bag",
    "lerobot": "adaptfault.data.recordings.formats.datasets.lerobot",
    "zarr": "adaptfault.data.recordings.formats.datasets.zarr_store",
    "hdf5": "adaptfault.data.recordings.formats.datasets.hdf5",
    "mat": "adaptfault.data.recordings.formats.datasets.mat",
    "parquet": "adaptfault.data.recordings.formats.datasets.parquet",
    "jsonl": "adaptfault.data.recordings.formats.datasets.jsonl",
}
"""Those of this package, as its entry points name them; they are there without an installation,
too."""


class Reader(Protocol):
    """The reader of one format."""

    SUFFIXES: tuple[str, ...]

    def open(self, path: Path, **stated: Any) -> Iterable[Recording]:
        """Return the recordings of a file.

        Raises:
            InputError: the file cannot be read.
        """
        ...


@cache
def readers() -> Mapping[str, Reader]:
    """Return the reader of each format by its name."""
    return plugins(GROUP, BUILT_IN)


def check_stated(stated: Mapping[str, Any]) -> None:
    """Raise InputError where a keyword is nearly one that a reader asks for.

    Another name may be one that a reader of another package takes without naming it.
    """
    known: set[str] = set()
    for reader in readers().values():
        for name, parameter in signature(reader.open).parameters.items():
            if parameter.kind is Parameter.KEYWORD_ONLY:
                known.add(name)
    for name in stated:
        close = [] if name in known else get_close_matches(name, known, 1)
        if close:
            raise InputError(f"{name}=: there is no such keyword; is {close[0]}= meant?")


def suffixes(known: Mapping[str, Reader]) -> tuple[str, ...]:
    """Return the suffixes that readers accept, sorted."""
    return tuple(sorted({suffix for reader in known.values() for suffix in reader.SUFFIXES}))


def reader_of(path: Path, known: Mapping[str, Reader], *, is_folder: bool) -> Reader | None:
    """Return the reader of a file or of a folder that is one recording; None where there is
    none."""
    for reader in known.values():
        if is_folder:
            accepts = getattr(reader, "accepts", None)
            if accepts is not None and accepts(path):
                return reader
        elif path.name.lower().endswith(tuple(reader.SUFFIXES)):
            return reader
    return None
