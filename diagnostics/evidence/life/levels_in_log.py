"""The log as levels of load, by piece and by unit, and the log likelihoods of these levels."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.life.healthy_table import (
    AMID,
    UNIT,
    UNLOADED,
    Cells,
    Floats,
    HealthyTable,
    Levels,
    Mask,
    levels_of,
)
from diagnostics.evidence.life.life_model import LifeModel
from diagnostics.evidence.life.record import PIECE, LifeRecord
from diagnostics.preprocessing.readings import spread
from diagnostics.preprocessing.scale import Array

_AT_REST = 0.95  # of the pieces of a cell that is dead for a time are unloaded
_THE_SAME = 0.1  # relative difference of loads that are the same
_TILTED = 8.0  # pseudo-count of pieces, of the frequency of a level
_FITS = 3  # of the tilt, by iterative proportional fitting: a size
_MOST_TILT = 16.0  # times as frequent as expected, or as rare, levels of healthy cells are in a log
_SATURATED = 50.0  # log ratio of a unit beyond which nothing changes


class LevelLog:
    """Levels of loads in a log, and how likely they are.

    Args:
        loads: mean root loads of the pieces, ``[n, D]``.
        readings: their mean readings ``[n, D]``, in the layout's unit; NaN: none.
        piece: number of each, int ``[n]``, ascending.
        model: of healthy loads.
        weight: of each unit ``[units]``; None: see the property.
        level: of each load, ``[n, D]``; None: by the limits of the model.
        unit: pieces of a unit.

    Attributes:
        level: of each load, ``[n, D]``.
        unit_begins: int ``[units]``, number of the first piece of each unit.
    """

    def __init__(
        self,
        loads: NDArray[np.floating],
        readings: NDArray[np.floating],
        piece: NDArray[np.intp],
        model: HealthyTable,
        weight: Floats | None = None,
        level: Levels | None = None,
        unit: int = UNIT,
    ) -> None:
        self.table = model
        self.loads = loads
        self._weight = weight
        self.level = levels_of(loads, model.levels) if level is None else level
        self.piece = piece
        self.readings = readings
        self._read = np.isfinite(readings)
        self._all_read = bool(self._read.all())
        self.unit_begins = np.flatnonzero(np.diff(piece // unit, prepend=-1))
        self._cell = np.arange(self.level.shape[1])

    @property
    def units(self) -> int:
        """Number of units."""
        return len(self.unit_begins)

    @property
    def begins(self) -> NDArray[np.intp]:
        """Number of the first frame of each unit, int ``[units]``."""
        found: NDArray[np.intp] = self.piece[self.unit_begins] * PIECE
        return found

    @cached_property
    def own(self) -> Floats:
        """Log frequency of each level in the other pieces of the cell, ``[n, D]``."""
        n_levels = self.table.n_levels
        others = np.maximum(_counted(self.level, n_levels) - 1, 0)
        log_frequency = np.log((others + 1 / n_levels) / len(self.level))
        found: Floats = log_frequency[self._cell, self.level]
        return found

    @cached_property
    def at_rest(self) -> Floats:
        """Log probability of each level of a cell without load, ``[n, D]``."""
        n_levels = self.table.n_levels
        loaded = np.log((1 - _AT_REST) / (n_levels - 1))
        found = np.full(self.level.shape, loaded)
        found[self.level == 0] = np.log(_AT_REST)
        return found

    @cached_property
    def weight(self) -> Floats:
        """Weight of each unit ``[units]``: share of independent ones, over 1 + k with k others of
        the same loads."""
        if self._weight is not None:
            return self._weight
        length = np.diff(np.append(self.unit_begins, len(self.loads)))[:, None]
        means = np.add.reduceat(self.loads, self.unit_begins, axis=0) / length
        return self.table.independent * _novelty(means)

    def tilted(
        self, table: Floats, context: NDArray[np.intp], level: NDArray[np.integer]
    ) -> Floats:
        """Return log P(level | context) of cells whose levels are as frequent as they are in the
        log.

        Where contacts hardly change, a level is likely because the cell had it before, whatever the
        others say. The table of healthy cells is tilted, P(l | c) f(l) / sum over l' of P(l' | c)
        f(l'), with f the frequency in the log over the expected one, within limits.

        Args:
            table: P(level | context) of each cell, ``[D, M, K]``.
            context, level: int ``[n, D]``.
        """
        contexts = _counted(context, table.shape[1])
        levels = _counted(level, table.shape[2])
        tilt = np.ones(levels.shape)
        for _ in range(_FITS):
            total = (table @ tilt[:, :, None])[:, :, 0]
            expected = tilt * ((contexts / total)[:, None, :] @ table)[:, 0]
            wanted = tilt * (levels + _TILTED) / (expected + _TILTED)
            tilt = np.clip(wanted, 1 / _MOST_TILT, _MOST_TILT)
        total = (table @ tilt[:, :, None])[:, :, 0]
        cell = np.arange(level.shape[1])
        probability = table[cell, context, level] * tilt[cell, level] / total[cell, context]
        found: Floats = np.log(probability)
        return found

    def counted(self, ratio: Floats, cells: Cells | None = None) -> Floats:
        """Return the evidence of each unit, ``[units, D]``, of the log ratio of each piece,
        ``[n, D]``.

        Args:
            cells: int ``[D]``, which cells these are; None: all.
        """
        errs = self.table.errs if cells is None else self.table.errs[cells]
        found: Floats = bounded(self.by_unit(ratio, cells), errs) * self.weight[:, None]
        return found

    def by_unit(self, ratio: Floats, cells: Cells | None = None) -> Floats:
        """Return the sums over the pieces of each unit that were read, ``[units, D]``; arguments as
        in counted."""
        if not self._all_read:
            read = self._read if cells is None else self._read[:, cells]
            ratio = np.where(read, ratio, 0.0)
        summed: Floats = np.add.reduceat(ratio, self.unit_begins, axis=0)
        return summed

    def any_by_unit(self, holds: Mask) -> Mask:
        """Return whether something holds in a piece of each unit, bool ``[units, D]``, of each
        piece ``[n, D]``."""
        found: Mask = np.logical_or.reduceat(holds, self.unit_begins, axis=0)
        return found


class LifeLog(LevelLog):
    """Levels of the cells in a log.

    Args:
        loads: mean root loads of the pieces, ``[n, D]``.
        readings: their mean readings ``[n, D]``, in the layout's unit.
        constant: bool ``[n, D]``, where the readings of the piece did not change.
        piece: number of each, int ``[n]``, ascending.
        model: of healthy cells.
        beside: int ``[D, 8]``, the cells beside each; -1: none.

    Attributes:
        ends_as_one: int ``[n, G]``, frames at the end of each piece in which a group reads as one;
            None: unknown.
    """

    ends_as_one: NDArray[np.uint8] | None = None

    def __init__(
        self,
        loads: Array,
        readings: Array,
        constant: Mask,
        piece: NDArray[np.intp],
        model: LifeModel,
        beside: Cells,
    ) -> None:
        super().__init__(loads, readings, piece, model)
        self.constant = constant
        self.model = model
        self.beside = beside

    @classmethod
    def of(cls, record: LifeRecord, model: LifeModel, beside: Cells) -> LifeLog:
        """Return the levels in the record of a log."""
        log = cls(record.loads, record.means, record.constant, record.piece, model, beside)
        log.ends_as_one = record.frames_as_one if record.ends_as_one else None
        return log

    def healthy(self, known: Mask) -> tuple[Floats, NDArray[np.intp]]:
        """Return log P(level | healthy) and the context, ``[n, D]`` each.

        Args:
            known: bool ``[D]``, the cells that predict others.
        """
        context = self.model.contexts(self.loads, known, self.beside)
        table = self.model.probabilities[self.model.of_cell(self._cell)]
        return self.tilted(table, context, self.level), context

    def same(self, k: int) -> tuple[Mask, Mask]:
        """Return in which units a cell and its neighbour k are both loaded, and read the same,
        ``[units, D]`` each."""
        other = self.beside[:, k]
        loaded = self.level > 0
        either = loaded & loaded[:, other] & (other >= 0)
        differs = either & (self.readings != self.readings[:, other])
        some = self.any_by_unit(either)
        return some, some & ~self.any_by_unit(differs)

    def amid(self) -> tuple[Mask, Levels]:
        """Return how far a cell is from the mean of those beside it.

        The distance is relative to the mean distance of the cells beside it from their mean,
        without the farthest one: it may be dead.

        Returns:
            The units in which it and some beside it are loaded, bool ``[units, D]``; levels
            ``[units, D]``.
        """
        has = self.beside >= 0
        count = np.maximum(has.sum(axis=1), 2)
        mean = np.zeros(self.readings.shape)
        some = np.zeros(self.readings.shape, bool)
        for k, other in enumerate(self.beside.T):
            mean += np.where(has[:, k], self.readings[:, other], 0.0)
            some |= (self.level[:, other] > 0) & has[:, k]
        mean /= count
        total_beside = np.zeros(self.readings.shape)
        farthest = np.zeros(self.readings.shape)
        for k, other in enumerate(self.beside.T):
            away = np.where(has[:, k], np.abs(self.readings[:, other] - mean), 0.0)
            total_beside += away
            np.maximum(farthest, away, out=farthest)
        usual_beside = (total_beside - farthest) / (count - 1)
        distance = np.abs(self.readings - mean) / (usual_beside + self.model.tolerance)
        some &= (self.level > 0) & self._read & (has.sum(axis=1) > 1) & np.isfinite(distance)
        total = np.add.reduceat(np.where(some, distance, 0.0), self.unit_begins, axis=0)
        pieces = np.add.reduceat(some.astype(np.intp), self.unit_begins, axis=0)
        return pieces > 0, levels_of(total / np.maximum(pieces, 1), np.asarray(AMID))


def _counted(numbers: NDArray[np.integer], n: int) -> NDArray[np.intp]:
    """Return how often each number from 0 to n - 1 occurs in each column, int ``[D, n]``."""
    d = numbers.shape[1]
    index = numbers + n * np.arange(d)
    return np.bincount(index.ravel(), minlength=n * d).reshape(d, n)


def _novelty(means: Floats) -> Floats:
    """Return the weight of each unit, ``[units]``, of the mean root loads in it, ``[units, D]``.

    Two units have the same loads if these differ by less than a tenth, over the cells whose loads
    change at all.
    """
    cells = spread(np.flatnonzero(np.ptp(means, axis=0) > UNLOADED))
    changing = means[:, cells]
    size = changing.sum(axis=1)
    repeats = np.zeros(len(means))
    for u, one in enumerate(changing):
        differ = np.abs(changing - one).sum(axis=1)
        repeats[u] = (differ <= _THE_SAME * np.maximum(size, size[u])).sum() - 1
    return 1 / (1 + repeats)


def bounded(ratio: Floats, errs: Floats | float) -> Floats:
    """Return the log ratio of two models that both err in a share of the units, of their log
    ``ratio``."""
    likelihood = np.exp(np.clip(ratio, -_SATURATED, _SATURATED))
    right = 1 - errs
    found: Floats = np.log((right * likelihood + errs) / (right + errs * likelihood))
    return found
