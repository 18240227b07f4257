"""What a reference itself shows: cells that hold a value in some of its recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.when.held import Held
from diagnostics.when.recording_numbers import ranges

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

_LISTED = 5  # places, or names of recordings, in a sentence


class ReferenceWarning(UserWarning):
    """A reference shows faults in some of its recordings."""


@dataclass(frozen=True)
class ReferenceFinding:
    """Cells of a reference that hold a value in some recordings although those beside them move.

    Attributes:
        cells: the cells, ascending.
        recordings: the numbers of these recordings, ascending, from 0.
        places: lines and cells in words.
    """

    cells: tuple[int, ...]
    recordings: tuple[int, ...]
    places: str

    @property
    def reason(self) -> str:
        """One sentence, with the numbers of the recordings."""
        several = "recording" if len(self.recordings) == 1 else "recordings"
        return self._sentence(f"{several} {ranges(self.recordings)}")

    def among(self, numbers: Sequence[int]) -> ReferenceFinding:
        """Return the same with the recordings' numbers among more; ``numbers``: of each."""
        return replace(self, recordings=tuple(numbers[number] for number in self.recordings))

    def named(self, names: Sequence[str]) -> str:
        """Return the sentence with the names of the recordings instead; ``names``: of all."""
        return self._sentence(_listed([names[number] for number in self.recordings]))

    def _sentence(self, where: str) -> str:
        return (
            f"the reference is no healthy one: in {where}, {self.places} held one value while the"
            " cells beside moved; nothing is learned from these readings"
        )


def reference_findings(held: Held, layout: SensorLayout) -> tuple[ReferenceFinding, ...]:
    """Return one finding for each set of recordings."""
    return tuple(
        ReferenceFinding(tuple(np.sort(cells).tolist()), recordings, _places(cells, layout))
        for recordings, cells in held.states()
    )


def _places(cells: NDArray[np.intp], layout: SensorLayout) -> str:
    """Return the lines and the other cells in words."""
    left = np.zeros(layout.n_cells, bool)
    left[cells] = True
    places = []
    for line in layout.lines:
        on = layout.cells_on(line)
        if len(on) > 1 and left[on].all():
            places.append(str(line))
            left[on] = False
    places += [layout.place(cell) for cell in np.flatnonzero(left).tolist()]
    return _listed(places, "; ")


def _listed(words: Sequence[str], separator: str = ", ") -> str:
    """Return the first words, and how many there are more."""
    more = f" and {len(words) - _LISTED} more" if len(words) > _LISTED else ""
    return f"{separator.join(words[:_LISTED])}{more}"
