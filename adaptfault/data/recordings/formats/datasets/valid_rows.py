"""Which readings are valid in the rows of tables whose episodes were read as recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.valid import Masks, Places

Bools = NDArray[np.bool_]


class ValidRows:
    """Gives the rows of tables their masks, in the order in which the recordings were read.

    Args:
        masks: bool ``[T, D]`` of each recording.
        places: what the arrays of the recordings are called.
        source: the data set, for messages.

    Attributes:
        features: the columns that hold readings.

    Raises:
        InputError: the recordings have no columns in common.
    """

    def __init__(self, masks: Masks, places: Places, source: Path) -> None:
        if not places.features:
            raise InputError.at(source, "holds readings without names; a copy needs them")
        self.features = places.features
        self._sizes = places.sizes
        self._masks = enumerate(masks)
        self._places = places
        self._source = source
        self._held: dict[int, list[Bools]] = {}

    def of(self, episodes: NDArray[np.int64] | None, rows: int) -> list[Bools]:
        """Return the mask of each feature, bool ``[rows, ...]``.

        Args:
            episodes: the episode of each row, ``[rows]``; None: all are of one.
            rows: of the table.

        Raises:
            InputError: an episode has another number of frames than of rows.
        """
        numbers = np.zeros(rows, np.int64) if episodes is None else episodes
        found: list[Bools] = []
        for number in np.unique(numbers).tolist():
            at = np.flatnonzero(numbers == number)
            mask = self._take(None if episodes is None else number)
            if mask is None:
                continue
            parts = [self._by_row(part, len(at), number) for part in mask]
            self._sizes = tuple(part.shape[1:] for part in parts)
            found = found or self._nothing(rows)
            for whole, part in zip(found, parts, strict=True):
                whole[at] = part
        return found or self._nothing(rows)

    def _nothing(self, rows: int) -> list[Bools]:
        return [np.zeros((rows, *sizes), dtype=bool) for sizes in self._sizes]

    def _by_row(self, mask: Bools, rows: int, number: int) -> Bools:
        """Return a mask ``[T, ...]`` by rows, which may hold several frames each."""
        steps, rest = divmod(len(mask), rows)
        if rest or not steps:
            what = f"episode {number} has {rows} rows and {len(mask)} frames"
            raise InputError.at(self._source, f"{what}; a copy needs as many frames in each row")
        return mask if steps == 1 else mask.reshape(rows, steps, *mask.shape[1:])

    def _take(self, number: int | None) -> list[Bools] | None:
        """Return the mask of an episode by feature; None where it was not read."""
        if number is None:
            i, mask = next(self._masks)
            return self._places.parts(i, mask)
        if not self._places.is_read(number):
            return None
        while number not in self._held:
            i, mask = next(self._masks)
            self._held[self._places.number(i)] = self._places.parts(i, mask)
        return self._held.pop(number)
