"""Numbers of pads, rows, columns and cells as a person counts them, from 0 or from 1.

Sentences, files and indices count from 0. For a person who counts from 1, a finished sentence is
renumbered here. Bits of an address, frames and recordings keep their numbers, and so do names of
groups.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from diagnostics.layout import SensorLayout

_NUMBER = r"\d+(?!\w|[./]\w)"
_PLACE = (
    r"(?<![\w/.])(?:pad|row|column|position|axis|cell)"
    rf"(?: {_NUMBER}|s {_NUMBER}(?:(?:-|, | and ){_NUMBER})*)"
)


@dataclass(frozen=True)
class Numbering:
    """How positions are counted.

    Attributes:
        first: number of the first pad, row, column, position, axis and cell.
        names: of groups and cells, which keep their numbers ("triangle 7").
    """

    first: int = 0
    names: tuple[str, ...] = ()

    @classmethod
    def from_layout(cls, layout: SensorLayout, first: int) -> Numbering:
        """Return the numbering of an array that keeps the names of its groups and cells."""
        cells = [name for name in layout.names or () if re.search(_PLACE, name, re.IGNORECASE)]
        return cls(first, (*(layout.groups or ()), *cells))

    def text(self, sentence: str) -> str:
        """Return a sentence that counts from 0 with its positions counted from ``first``."""
        if not self.first:
            return sentence
        names = sorted(self.names, key=len, reverse=True)
        kept = "|".join(rf"(?<!\w){re.escape(name)}(?!\w)" for name in names)
        pattern = f"(?P<kept>{kept or '(?!)'})|{_PLACE}"
        return re.sub(pattern, self._renumbered, sentence, flags=re.IGNORECASE)

    def _renumbered(self, found: re.Match[str]) -> str:
        if found["kept"] is not None:
            return found[0]
        return re.sub(r"\d+", lambda number: str(int(number[0]) + self.first), found[0])
