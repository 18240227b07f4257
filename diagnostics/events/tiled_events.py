"""The contact events of each tile of an array."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.contact_events import EventLog
from diagnostics.events.tiles import Tile

if TYPE_CHECKING:
    from diagnostics.preprocessing.scale import Array

Cells = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class TiledEvents:
    """The contact events of each tile so far.

    Attributes:
        tiles: the tiles of the array.
        of: the events of each tile, over its inputs.
    """

    tiles: tuple[Tile, ...]
    of: tuple[EventLog, ...]
    _needed: tuple[int, ...]

    @classmethod
    def begin(
        cls, all_tiles: tuple[Tile, ...], needed: NDArray[np.bool_] | None = None
    ) -> TiledEvents:
        """Return the state before any frame. Tiles without a ``needed`` output (bool ``[D]``) are
        skipped."""
        scored = (
            i for i, tile in enumerate(all_tiles) if needed is None or needed[tile.outputs].any()
        )
        return cls(all_tiles, (EventLog(),) * len(all_tiles), tuple(scored))

    def extend(
        self,
        root: Array,
        numbers: Cells,
        root_near: float,
        start: Cells,
    ) -> TiledEvents:
        """Return the events after more frames, see ``EventLog.extend``; tiles in which nothing
        moves do not change."""
        if len(self.tiles) == 1:
            return self.replaced([self.of[0].extend(root, numbers, root_near, start)])
        of = list(self.of)
        moving = start > numbers[0]
        for i in self._needed:
            cells = self.tiles[i].inputs
            if moving[cells].any():
                of[i] = of[i].extend(root[:, cells], numbers, root_near, start[cells])
        return self.replaced(of)

    def split(self, most: int, keep: int) -> tuple[TiledEvents, TiledEvents]:
        """Return (the events to drop, those to keep): in tiles with more than ``most``, the last
        ``keep`` stay."""
        none = EventLog()
        parts = [
            events.split(keep) if len(events.kept) > most else (none, events) for events in self.of
        ]
        return self.replaced([old for old, _ in parts]), self.replaced([kept for _, kept in parts])

    def replaced(self, of: Sequence[EventLog]) -> TiledEvents:
        """Return the same tiles with other events."""
        return replace(self, of=tuple(of))

    def kept(self) -> Iterator[tuple[int, EventLog]]:
        """Yield the tiles with events, and these."""
        return ((i, events) for i, events in enumerate(self.of) if events.kept)
