"""A data set that is too large for one run, or one machine, in parts: each is kept as soon as one
pass over it is done, and what was kept is not made again. So a run that was killed goes on.

A part is known by the files, their sizes and times, by how they are read, and by its number; files
that changed since are read anew. Workers are processes of this machine, or those of the Dask
cluster that fleets use, which see the same paths.

Not detected: a file that changed while its size and time did not.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from adaptfault.data.atomic import atomic_write, make_folder
from adaptfault.data.recordings import InputError, local_paths, open_recordings
from adaptfault.inspection.groupings import groupings_of
from adaptfault.inspection.quick_statistics import SCHEMA, Statistics

_LOST = "a worker was lost ({}); start the run again: it goes on with the parts that are left"


class _Empty(Exception):
    """A part has no recording, as there are more parts than recordings."""


@dataclass(frozen=True)
class Work:
    """What is to be read.

    Attributes:
        paths: of the recordings.
        options: how they are read, as ``open_recordings`` takes them.
        parts: number of the parts.
    """

    paths: tuple[str, ...]
    options: Mapping[str, Any]
    parts: int

    def key(self) -> str:
        """Return what identifies the files and how they are read."""
        found = hashlib.sha256(f"{SCHEMA} {self.parts}".encode())
        stated = {name: str(value) for name, value in self.options.items()}
        found.update(json.dumps(stated, sort_keys=True).encode())
        for place in local_paths(self.paths, self.options, []):
            for file in sorted(place.rglob("*")) if place.is_dir() else [place]:
                if file.is_file():
                    about = file.stat()
                    found.update(f"{file} {about.st_size} {about.st_mtime_ns}".encode())
        return found.hexdigest()[:16]

    def numbers(self, part: int, n: int) -> range:
        """Return the numbers of the recordings of a part, of ``n``.

        Raises:
            _Empty: it has none.
        """
        found = range(n * part // self.parts, n * (part + 1) // self.parts)
        if not found:
            raise _Empty
        return found


@dataclass(frozen=True)
class Made:
    """A part that was made.

    Attributes:
        number: of the part, from 0.
        stored: what is kept of it; None: it has no recording, or none that can be read.
        problem: why none of it can be read; "": it can.
    """

    number: int
    stored: bytes | None
    problem: str = ""


def made(work: Work, number: int) -> Made:
    """Return a part, read once; what cannot be read is told in it."""
    try:
        log = open_recordings(
            work.paths, select=partial(work.numbers, number), **dict(work.options)
        )
        statistics = Statistics.of(log, groupings_of(log, work.paths))
    except _Empty:
        return Made(number, None)
    except InputError as error:
        return Made(number, None, str(error))
    return Made(number, statistics.to_bytes())


def in_parts(
    work: Work, folder: Path, *, jobs: int = 1, dask: str | None = None
) -> tuple[Statistics, int]:
    """Return the statistics of a data set, and how many parts were there already.

    Args:
        work: what is to be read.
        folder: of the parts; made where it is not there.
        jobs: processes of this machine that read side by side.
        dask: address of a scheduler whose workers read in their place; None: none.

    Raises:
        InputError: nothing can be read.
        OSError: a part cannot be kept, or the workers are lost.
    """
    make_folder(folder)
    key = work.key()
    places = [folder / f"{key}-{i + 1}-of-{work.parts}.npz" for i in range(work.parts)]
    left = [number for number, place in enumerate(places) if not place.is_file()]
    problems: list[str] = []
    for one in _done(work, left, jobs, dask):
        if one.stored is not None:
            atomic_write(places[one.number], one.stored)
        elif one.problem:
            problems.append(one.problem)
    kept = [Statistics.load(place) for place in places if place.is_file()]
    if not kept:
        raise InputError(problems[0] if problems else "there is no recording")
    statistics = Statistics.joined(kept)
    return replace(statistics, unread=(*statistics.unread, *problems)), work.parts - len(left)


def _done(work: Work, numbers: Sequence[int], jobs: int, dask: str | None) -> Iterator[Made]:
    """Yield parts as they are made."""
    if dask is not None:
        yield from _on_dask(work, numbers, dask)
    elif jobs == 1:
        for number in numbers:
            yield made(work, number)
    else:
        from joblib import Parallel, delayed

        parallel = Parallel(jobs, return_as="generator_unordered", batch_size=1)
        yield from parallel(delayed(made)(work, number) for number in numbers)


def _on_dask(work: Work, numbers: Sequence[int], dask: str) -> Iterator[Made]:
    from distributed import as_completed

    from adaptfault.data.cluster import connected

    with connected(dask) as client:
        futures = client.map(partial(made, work), numbers, pure=False)
        for future in as_completed(futures, loop=client.loop):
            if future.status != "finished":
                raise OSError(_LOST.format(type(future.exception()).__name__))
            one: Made = future.result()
            yield one
