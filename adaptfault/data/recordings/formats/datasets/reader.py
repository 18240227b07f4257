"""The reader of a format of named arrays, made of what opens its files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from adaptfault.data.recordings.errors import NO_FRAMES, InputError
from adaptfault.data.recordings.formats.datasets.beside import Stated
from adaptfault.data.recordings.formats.datasets.chooser import Chooser
from adaptfault.data.recordings.formats.datasets.contents import Opened, Opener
from adaptfault.data.recordings.formats.datasets.features import Pads, Sizes
from adaptfault.data.recordings.formats.datasets.parts import blocks, refused
from adaptfault.data.recordings.recording import Recording, Shape


def reader(opened: Opener) -> Callable[..., list[Recording]]:
    """Return the function ``open`` of a reader."""

    def open(
        path: Path,
        *,
        shape: Shape | None = None,
        key: str | None = None,
        time_column: str | None = None,
        label_column: str | None = None,
        **stated: Any,
    ) -> list[Recording]:
        """Return the recordings of a file: one, one a group (``demo_0``, ``episode_3``), or those
        that ``episode_ends`` or a column as ``episode_index`` divides.

        Args:
            path: the file.
            shape: ``(pads, rows, cols)`` where the user states it.
            key: names of the arrays that hold the readings, one a pad; None: found by their names
                (:mod:`adaptfault.data.recordings.formats.datasets.features`).
            time_column, label_column: arrays or attributes of times and classes; None: found by
                name.
            stated: what other readers ask for.

        Raises:
            InputError: the package of the format is not installed, the file is damaged or being
                written, or the arrays are not clear.
        """
        places = Stated(time_column, label_column)
        return recordings_of(path, partial(opened, path), shape=shape, key=key, stated=places)

    return open


def recordings_of(
    path: Path,
    opened: Opened,
    *,
    shape: Shape | None,
    key: str | None,
    stated: Stated,
    known: Mapping[str, Sizes] | None = None,
) -> list[Recording]:
    """Return the recordings of a file.

    Args:
        path: of the file, for messages.
        opened: opens it; raises InputError where it cannot be read.
        shape: ``(pads, rows, cols)`` where the user states it.
        key: which arrays hold the readings; None: found by their names.
        stated: where times and classes are.
        known: sizes of a frame of each array, where another file states them.

    Raises:
        InputError: no array of touch, or several that could be meant; times or classes are not
            where they are stated.
    """
    with opened(None) as contents:
        chooser = Chooser(path, contents, shape, stated, known)
        parts = list(chooser.parts(chooser.episodes(key)))
        if not any(part.last > part.first for part in parts):
            raise InputError.at(path, NO_FRAMES)
        common = Counter(chooser.sizes(part) for part in parts if part.last > part.first)
        sizes = common.most_common(1)[0][0]
        pads = Pads.of(sizes, shape)
        usual = next(part for part in parts if chooser.sizes(part) == sizes)
        facts = chooser.facts(usual, pads)
        found = []
        for part in parts:
            read = partial(blocks, path, opened, chooser.readings(part), pads)
            if chooser.sizes(part) != sizes and part.last > part.first:
                read = partial(refused, path, part, chooser.sizes(part), sizes)
            name = None if part.name is None else f"{path.name}, {part.name}"
            number = part.number if isinstance(part.number, int) else None
            row = chooser.row(part)
            device = chooser.device(part)
            found.append(Recording(facts, read, name, part.label, part.names, number, row, device))
    return found
