"""What a piece shows of a cell: a level of its load, and how flat it is.

Levels are 0 rest, quantiles of the loads of the reference, the top, and what is below rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnostics.model.record import Array, Cells, Mask, Record
from diagnostics.model.rest import DITHER, Rest

NOTHING = 1e-3  # root load up to which a cell is unloaded
HOLDS = 0.6  # dithers: readings this close to a value hold it
CONSTANT, DITHERS, MOVES, BEGINS = range(4)  # how flat; before the first piece of a recording
AT_REST, LOADED, AT_TOP, BELOW = range(4)  # groups of levels
_LEVELS = 10
SAME = 1e-5  # of full scale: readings this close are the same
_CELLS = 30.0  # pieces of all cells that weigh on the table of one
_ANY = 0.01  # of a uniform distribution in any table: tables err
_ACTIVE = (0.01, 0.3, 0.7)  # shares of the loaded cells that move


@dataclass(frozen=True)
class Symbols:
    """Levels and flatness of pieces.

    Attributes:
        edges: root loads between the levels.
        rest: how cells rest.
    """

    edges: Array
    rest: Rest

    @classmethod
    def fit(cls, above: Array, rest: Rest, living: Mask) -> Symbols:
        """Return levels that are equally frequent; ``above``: readings above rest ``[n, D]``."""
        load = root_load(above, rest)[:, living]
        loads = load[load > NOTHING]
        quantiles = [0.5]
        if len(loads):
            quantiles = np.quantile(loads, np.linspace(0, 1, _LEVELS - 1)[1:-1]).tolist()
        edges = np.unique([NOTHING, *quantiles]).astype(np.float32)
        return cls(edges, rest)

    def agree(self, step: float) -> Array:
        """Return of each level the probability that two readings in it agree; ``step``: of the
        converter."""
        same = max(2 * HOLDS * DITHER, step / self.rest.full)
        found: Array = np.minimum(1, same / self.ranges)
        return found

    @property
    def ranges(self) -> Array:
        """Share of full scale that the loads of each level span."""
        spans = np.maximum(np.diff(np.append(self.edges, 1.0) ** 2), 1e-9)
        found: Array = np.concatenate([[1e-9], spans, [1e-9, 1e-9]]).astype(np.float32)
        return found

    @property
    def n(self) -> int:
        """Number of levels."""
        return len(self.edges) + 3

    @property
    def top(self) -> int:
        """Level of the upper end; behind it comes what is below rest."""
        return len(self.edges) + 1

    @property
    def tolerance(self) -> float:
        """Readings this close to a value hold it."""
        return HOLDS * DITHER * self.rest.full

    def levels(
        self, record: Record, above: Array, holds: Mask, uneven: Array | float = 0.0
    ) -> NDArray[np.int8]:
        """Return the level of each piece, ``[n, D]``.

        Below rest is a value that a cell ``holds`` (bool ``[n, D]``), lower than it ever rested in
        the reference: one that moves may rest lower. ``uneven``: by how much lower a cell may rest,
        as its pad does what the reference never saw.
        """
        level = np.searchsorted(self.edges, root_load(above, self.rest), "right").astype(np.int8)
        level[record.mean >= self.rest.full - self.tolerance] = self.top
        lowest = np.minimum(self.rest.low - DITHER * self.rest.full, -self.rest.near)
        level[holds & (above + uneven < lowest)] = self.top + 1
        return level

    def flat(self, record: Record) -> NDArray[np.int8]:
        """Return how flat each piece is, ``[n, D]``."""
        ranges = record.high - record.low
        moves = (ranges > DITHER * self.rest.full).astype(np.int8)
        return moves + (ranges > SAME * self.rest.full)

    def group(self, level: NDArray[np.integer]) -> Cells:
        """Return the group of each level."""
        found: Cells = np.select(
            [level == 0, level == self.top, level > self.top], [AT_REST, AT_TOP, BELOW], LOADED
        )
        return found


def root_load(above: Array, rest: Rest) -> Array:
    """Return the root of the load, of full scale, of readings above rest."""
    beyond = np.nan_to_num(above - rest.near)
    found: Array = np.sqrt(np.maximum(beyond, 0) / rest.full).astype(np.float32)
    return found


@dataclass(frozen=True)
class Flatness:
    """How flat the pieces of a healthy cell are.

    Attributes:
        given_others: ``[D, 4, 4, 3]``, log P(flat | group of the level, activity of the others).
        chain: ``[D, 4, 4, 3]``, log P(flat | group of the level, flatness a piece ago).
    """

    given_others: Array
    chain: Array

    @classmethod
    def fit(
        cls,
        group: Cells,
        activity: Cells,
        flat: NDArray[np.int8],
        before: NDArray[np.int8],
        living: Mask,
    ) -> Flatness:
        """Count, shrunk towards all cells."""
        cell = np.broadcast_to(np.arange(flat.shape[1]), flat.shape)
        given = np.zeros((flat.shape[1], 4, 4, 3))
        np.add.at(given, (cell, group, np.broadcast_to(activity[:, None], flat.shape), flat), 1)
        chain = np.zeros_like(given)
        np.add.at(chain, (cell, group, before, flat), 1)
        return cls(_shrunk(given, living), _shrunk(chain, living))

    def of_others(self, group: Cells, activity: Cells, flat: NDArray[np.int8]) -> Array:
        """Return log P(flat | group, activity of the others ``[n]``), ``[n, D]``."""
        cells = np.arange(flat.shape[1])
        found: Array = self.given_others[cells, group, activity[:, None], flat]
        return found

    def of_chain(self, group: Cells, before: NDArray[np.int8], flat: NDArray[np.int8]) -> Array:
        """Return log P(flat | group, flatness a piece ago), ``[n, D]``."""
        cells = np.arange(flat.shape[1])
        found: Array = self.chain[cells, group, before, flat]
        return found


@dataclass(frozen=True)
class CrossFittedFlatness(Flatness):
    """Tables of which none has counted the recordings that it judges.

    Attributes:
        tables: without each of the folds; the first one stands for all.
        fold: int ``[n]``, of each piece.
    """

    tables: Sequence[Flatness]
    fold: Cells

    @classmethod
    def of(cls, tables: Sequence[Flatness], fold: Cells) -> CrossFittedFlatness:
        """Return the tables as one."""
        return cls(**vars(tables[0]), tables=tables, fold=fold)

    def of_others(self, group: Cells, activity: Cells, flat: NDArray[np.int8]) -> Array:
        """Return log P(flat | group, activity of the others ``[n]``), ``[n, D]``."""
        each = [table.of_others(group, activity, flat) for table in self.tables]
        found: Array = np.stack(each)[self.fold, np.arange(len(flat))]
        return found

    def of_chain(self, group: Cells, before: NDArray[np.int8], flat: NDArray[np.int8]) -> Array:
        """Return log P(flat | group, flatness a piece ago), ``[n, D]``."""
        each = [table.of_chain(group, before, flat) for table in self.tables]
        found: Array = np.stack(each)[self.fold, np.arange(len(flat))]
        return found


def _shrunk(count: NDArray[np.float64], living: Mask) -> Array:
    count[~living] = 0
    pooled = count.sum(axis=0) + 0.5
    pooled /= pooled.sum(axis=-1, keepdims=True)
    table = (count + _CELLS * pooled) / (count.sum(axis=-1, keepdims=True) + _CELLS)
    found: Array = np.log((1 - _ANY) * table + _ANY / 3).astype(np.float32)
    return found


def before_of(flat: NDArray[np.int8], record: Record) -> NDArray[np.int8]:
    """Return the flatness a piece ago, ``[n, D]``."""
    before = np.roll(flat, 1, axis=0)
    before[record.first] = BEGINS
    return before


def activity_of(level: NDArray[np.int8], flat: NDArray[np.int8], known: Mask) -> Cells:
    """Return how many of the loaded known cells move in each piece, 0 to 3, int ``[n]``."""
    loaded = (level > 0) & known
    moving = (loaded & (flat == MOVES)).sum(axis=1)
    share = moving / np.maximum(loaded.sum(axis=1), 1)
    found: Cells = np.digitize(share, _ACTIVE)
    return found
