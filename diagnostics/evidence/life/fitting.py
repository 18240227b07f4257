"""Fit of the model of healthy cells by cross-fitting: table, units and limits from folds not used
for predictions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from diagnostics.events.tiles import MOST_CELLS, tiles
from diagnostics.evidence.life.healthy_table import (
    AMID,
    BESIDE,
    FAULTS,
    GUESS,
    UNLOADED,
    ConditionalMean,
    Floats,
    LifeModel,
    Mask,
    levels_of,
    loaded_beside,
)
from diagnostics.evidence.life.levels_in_log import LifeLog
from diagnostics.evidence.life.proof import LifeTest
from diagnostics.evidence.life.record import KEPT, PIECE, LifeRecord
from diagnostics.evidence.life.ways_to_fail import EvidenceOfLog
from diagnostics.evidence.stepping import finished
from diagnostics.healthy.cross_fitting import FOLDS
from diagnostics.preprocessing.levels import FEWEST, MAJORITY
from diagnostics.preprocessing.offset import OffsetTracker
from diagnostics.preprocessing.readings import SEGMENT, RecordingBlocks
from diagnostics.preprocessing.scale import Array

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout
    from diagnostics.preprocessing.offset import ReferenceOffset
    from diagnostics.preprocessing.scale import Scale

_LEVELS = 12  # of the root load: a size
_PREDICTED = 16  # levels of the prediction: a size
_OWN_ERRS = 20.0  # pseudo-count of independent units of all cells, in the frequencies of each cell
_SHRINKAGES = (4.0, 16.0, 64.0, 256.0, 1024.0)  # pseudo-counts of the table of all cells: a grid
_CONTAMINATIONS = (0.01, 0.02, 0.04, 0.08)  # shares e: a grid
_ERRS = 0.05  # share e of the units, before it is known
_LONGEST = 16  # units in a sum: a size
_CORRELATED = 0.25  # correlation of successive units that is small
_MOST_PIECES = 6000  # of the reference: a size
_MOST_DISCOUNT = 0.5  # of the factors
_HALF_DISCOUNT = 100.0  # units of the reference that halve it
_DEAD = 0.08  # share of the cells that are dead in some simulated logs
_HEALTHY = 0.99  # of the healthy cells in simulated logs


def fit_life(
    recordings: Sequence[Floats],
    layout: SensorLayout,
    scale: Scale,
    offset: ReferenceOffset,
    tolerance: float,
) -> LifeModel | None:
    """Fit the model to fault-free recordings, ``[T, D]`` each; None: too few of them."""
    parts = _folds(recordings, layout, scale, offset)
    if parts is None:
        return None
    return _Fit(parts, layout, tolerance).model()


@dataclass(frozen=True)
class _Fold:
    """Pieces of some reference recordings: loads and readings ``[n, D]``, piece numbers int
    ``[n]``."""

    loads: Array
    readings: Array
    piece: NDArray[np.intp]

    def copy(self) -> _Fold:
        """Return a copy whose loads and readings can be changed."""
        return _Fold(self.loads.copy(), self.readings.copy(), self.piece)

    def kill(self, cell: int, source: int, rng: np.random.Generator) -> None:
        """Let a cell read, equally often, what another one (``source``) read at other times, or
        nothing."""
        if rng.random() < MAJORITY:
            self.loads[:, cell] = 0.0
            # NaN without any reading
            self.readings[:, cell] = np.fmin.reduce(self.readings[:, cell])
            return
        order = rng.permutation(len(self.loads))
        self.loads[:, cell] = self.loads[order, source]
        self.readings[:, cell] = self.readings[order, source]


def _folds(
    recordings: Sequence[Floats], layout: SensorLayout, scale: Scale, offset: ReferenceOffset
) -> list[_Fold] | None:
    """Return the pieces of the reference in folds of whole recordings, with offsets tracked as in a
    log."""
    blocks = RecordingBlocks.of(recordings)
    order = np.random.default_rng(0).permutation(len(blocks))
    frames = np.cumsum([len(blocks.given[i]) for i in order])
    order = order[: max(FEWEST, int(np.searchsorted(frames, _MOST_PIECES * SEGMENT // 4)))]
    if len(order) < FEWEST:
        return None
    present = layout.present.ravel()
    folds = []
    for k in range(FOLDS):
        mine = order[k::FOLDS]
        parts = []
        begin = 0
        for some in np.array_split(mine, max(1, len(mine) // FEWEST)):
            log = np.concatenate([blocks[i] for i in some])
            record, begin = _recorded(log, begin, present, scale, offset)
            if record.number:
                parts.append(_Fold(record.loads, record.means, record.piece))
        if not parts:
            return None
        folds.append(_joined(parts))
    return folds if min(len(fold.loads) for fold in folds) >= FEWEST else None


def _joined(parts: Sequence[_Fold]) -> _Fold:
    return _Fold(
        np.concatenate([part.loads for part in parts]),
        np.concatenate([part.readings for part in parts]),
        np.concatenate([part.piece for part in parts]),
    )


def _recorded(
    log: Floats, begin: int, present: Mask, scale: Scale, offset: ReferenceOffset
) -> tuple[LifeRecord, int]:
    """Return the record of a log, of any length, and the number of the segment after it."""
    tracked = OffsetTracker.begin(log.shape[1])
    root: list[Array] = []
    readings: list[Array] = []
    number: list[int] = []
    for first in range(0, len(log), SEGMENT):
        frames = log[first : first + SEGMENT]
        tracked = tracked.extend(frames, scale, present, offset)
        loads = tracked.on(scale).root_load(tracked.off(frames))
        one = LifeRecord().extend(
            np.where(present, loads, np.float32(0)), frames, begin + first // SEGMENT
        )
        root += one.root
        readings += one.readings
        number += one.number
    return LifeRecord(tuple(root), tuple(readings), tuple(number)), begin + len(log) // SEGMENT + 1


class _Fit:
    """Fits the model by cross-fitting: tables, units and factors from folds that the predictions
    were not fitted on."""

    def __init__(self, folds: list[_Fold], layout: SensorLayout, tolerance: float) -> None:
        self._folds = folds
        self._layout = layout
        self._tolerance = tolerance
        self._present = layout.present.ravel()
        self._rng = np.random.default_rng(0)
        every = _joined(folds)
        self._levels = _edges(every.loads[:, self._present], _LEVELS)
        self._full = self._means(every.loads)
        self._used = (every.loads > UNLOADED).sum(axis=0) >= FEWEST
        self._held_out = [
            self._means(_joined([other for j, other in enumerate(folds) if j != k]).loads)
            for k in range(len(folds))
        ]

    def _means(self, loads: Array) -> tuple[ConditionalMean, ...]:
        found = []
        for tile in tiles(self._layout):
            inputs = tile.inputs[self._present[tile.inputs]]
            outputs = tile.outputs[self._present[tile.outputs]]
            if len(outputs):
                found.append(ConditionalMean.fit(loads, inputs, np.searchsorted(inputs, outputs)))
        return tuple(found)

    def model(self) -> LifeModel:
        """Return the fitted model."""
        n_cells = len(self._present)
        blank = LifeModel(
            means=self._full,
            levels=self._levels,
            predicted=np.zeros(0),
            table=np.zeros((0, 0, 0), np.float32),
            equal=np.ones(self._layout.beside.shape),
            amid=np.ones((n_cells, len(AMID) + 1)),
            independent=1.0,
            errs=np.full(n_cells, _ERRS),
            tolerance=self._tolerance,
            reached=np.zeros((len(FAULTS), n_cells)),
            units=1,
            counts=1.0,
        )
        seen = [self._expected(replace(blank, means=means), fold) for means, fold in self._cross()]
        predicted = self._predicted_edges([expected for expected, _ in seen])
        counts = np.stack(
            [self._counts(fold, *of, predicted) for fold, of in zip(self._folds, seen, strict=True)]
        )
        total = counts.sum(axis=0)
        shrinkage = self._shrinkage(counts, total)
        fitted = replace(blank, predicted=predicted, table=_table(total, shrinkage))
        held_out = [
            replace(fitted, means=means, table=_table(total - counts[k], shrinkage))
            for k, (means, _) in enumerate(self._cross())
        ]
        by_unit = [
            self._independent(model, fold)
            for model, fold in zip(held_out, self._folds, strict=True)
        ]
        independent = self._independent_share(held_out)
        errs, of_others = self._errs(by_unit, independent)
        fitted = self._beside(replace(fitted, independent=independent, errs=errs))
        held_out = [
            replace(of, independent=independent, errs=own, equal=fitted.equal, amid=fitted.amid)
            for of, own in zip(held_out, of_others, strict=True)
        ]
        # First with the dead cells known: else healthy cells would be taken for dead ones, and
        # mislead the others.
        reached, units = self._reached(held_out, informed=True)
        held_out = [replace(of, reached=reached, units=units) for of in held_out]
        reached = np.maximum(reached, self._reached(held_out, informed=False)[0])
        of_all = independent * sum(map(len, by_unit))
        # Few units contain few unusual contacts.
        counted = 1 - _MOST_DISCOUNT / (1 + of_all / _HALF_DISCOUNT)
        return replace(fitted, reached=reached, units=units, counts=counted)

    def _cross(self) -> list[tuple[tuple[ConditionalMean, ...], _Fold]]:
        return list(zip(self._held_out, self._folds, strict=True))

    def _beside(self, model: LifeModel) -> LifeModel:
        """Return the model with how often healthy cells read as one beside them, or as the mean of
        these."""
        d = len(self._present)
        same = np.zeros(model.equal.shape)
        loaded = np.zeros(model.equal.shape)
        amid = np.zeros((d, len(AMID) + 1))
        for fold in self._folds:
            log = LifeLog(fold.loads, fold.readings, fold.piece, model, self._layout.beside)
            for k in range(self._layout.beside.shape[1]):
                some, equal = log.same(k)
                loaded[:, k] += some.sum(axis=0)
                same[:, k] += equal.sum(axis=0)
            some, level = finished(log.amid())
            for n in range(len(AMID) + 1):
                amid[:, n] += (some & (level == n)).sum(axis=0)
        same *= model.independent
        loaded *= model.independent
        amid *= model.independent
        usual = (same.sum() + 1) / (loaded.sum() + 1)
        equal = (same + usual * _OWN_ERRS) / (loaded + _OWN_ERRS)
        shared = (amid.sum(axis=0) + 1) / (amid.sum() + len(AMID) + 1)
        amid = (amid + shared * _OWN_ERRS) / (amid.sum(axis=1, keepdims=True) + _OWN_ERRS)
        return replace(model, equal=equal, amid=amid)

    def _expected(self, model: LifeModel, fold: _Fold) -> tuple[Floats, NDArray[np.intp]]:
        """Return predictions in which some cells are unknown, as in a log with dead ones, and
        levels of loads beside.

        Both are ``[n, D]``.
        """
        found = np.empty(fold.loads.shape)
        near = np.empty(fold.loads.shape, np.intp)
        parts = np.array_split(np.arange(len(fold.loads)), FOLDS)
        for part, left_out in zip(parts, np.linspace(0.0, 0.15, len(parts)), strict=True):
            known = self._present & (self._rng.random(len(self._present)) >= left_out)
            found[part] = model.expected(fold.loads[part], known)
            near[part] = loaded_beside(fold.loads[part], known, self._layout.beside)
        return found, near

    def _predicted_edges(self, expected: list[Floats]) -> Floats:
        loaded = [
            of[:, self._present][fold.loads[:, self._present] > UNLOADED]
            for of, fold in zip(expected, self._folds, strict=True)
        ]
        every = np.concatenate([of[:, self._present].ravel() for of in expected])
        share = np.linspace(0, 1, _PREDICTED // 2 + 1)[1:-1]
        edges: Floats = np.unique(
            np.concatenate([np.quantile(every, share), np.quantile(np.concatenate(loaded), share)])
        )
        return edges

    def _counts(
        self, fold: _Fold, expected: Floats, near: NDArray[np.intp], predicted: Floats
    ) -> Floats:
        """Return how often each cell had each level in each context, ``[D, M, K]``; ``[1, M, K]``
        of a large array."""
        around = len(BESIDE) + 1
        m = (len(predicted) + 1) * around
        k = len(self._levels) + 1
        d = len(self._present)
        context = levels_of(expected, predicted).astype(np.intp) * around + near
        level = levels_of(fold.loads, self._levels)
        tables = d if self._present.sum() <= MOST_CELLS else 1
        index = (np.arange(d) % tables * m + context) * k + level
        counted = np.bincount(index[:, self._present].ravel(), minlength=tables * m * k)
        return counted.astype(np.float64).reshape(tables, m, k)

    def _shrinkage(self, counts: Floats, total: Floats) -> Floats:
        """Return the pseudo-count of each cell, ``[tables, 1, 1]``: the likeliest for folds that it
        has not seen."""
        likelihood = []
        for shrinkage in _SHRINKAGES:
            each = [(of * _table(total - of, shrinkage)).sum(axis=(1, 2)) for of in counts]
            likelihood.append(np.sum(each, axis=0))
        best = np.argmax(likelihood, axis=0)
        found: Floats = np.asarray(_SHRINKAGES)[best][:, None, None]
        return found

    def _independent(self, model: LifeModel, fold: _Fold) -> Floats:
        """Return the log ratio independent of the others : healthy of each unit of a fold,
        ``[units, D]``."""
        log = LifeLog(fold.loads, fold.readings, fold.piece, model, self._layout.beside)
        healthy, _ = finished(log.healthy(self._present))
        return log.by_unit(log.own - healthy)

    def _independent_share(self, held_out: list[LifeModel]) -> float:
        """Return the share of the units that count as independent of each other: those of one
        contact are alike.

        It is the variance of m independent units over that of the sum of m successive ones, with m
        so large that successive sums are hardly correlated.

        Args:
            held_out: a model for each fold, fitted to the others.
        """
        each = []
        for model, fold in zip(held_out, self._folds, strict=True):
            for record in _logs(fold):
                log = LifeLog(record.loads, record.means, record.piece, model, self._layout.beside)
                healthy, _ = finished(log.healthy(self._present))
                counted = log.counted(log.own - healthy)
                each.append(counted - counted.mean(axis=0))
        alone = sum(float((of**2).sum()) for of in each)
        m = 1
        while True:
            sums = [np.add.reduceat(of, np.arange(0, len(of), m), axis=0) for of in each]
            products = sum(float((of[1:] * of[:-1]).sum()) for of in sums)
            together = sum(float((of**2).sum()) for of in sums)
            if products <= _CORRELATED * together or m >= _LONGEST:
                return min(1.0, alone / together)
            m *= 2

    def _errs(self, ratios: list[Floats], independent: float) -> tuple[Floats, list[Floats]]:
        """Return the share of units in which each healthy cell contradicts, ``[D]``, and the same
        without each fold.

        The share of all cells is the likeliest of a grid; that of a cell has it as prior.

        Args:
            ratios: log ratio independent : healthy of each unit, ``[units, D]``, for each fold.
            independent: share of the units that count as independent of each other.
        """
        every = np.concatenate(ratios)[:, self._present].ravel()
        usual = max(
            _CONTAMINATIONS,
            key=lambda e: float(np.logaddexp(np.log1p(-e), np.log(e) + every).sum()),
        )
        erred = independent * np.stack(
            [expit(ratio + np.log(usual / (1 - usual))).sum(axis=0) for ratio in ratios]
        )
        units = independent * np.array([len(ratio) for ratio in ratios])[:, None]

        def share(erred: Floats, units: Floats) -> Floats:
            found: Floats = (erred.sum(axis=0) + usual * _OWN_ERRS) / (units.sum() + _OWN_ERRS)
            # The rule of three: what was never seen in n units.
            found = np.clip(found, max(usual / 2, 3 / units.sum()), MAJORITY / 2)
            # what the reference hardly loaded is hardly known
            return np.where(self._used, found, MAJORITY / 2)

        without = [
            share(np.delete(erred, k, axis=0), np.delete(units, k, axis=0))
            for k in range(len(ratios))
        ]
        return share(erred, units), without

    def _reached(self, held_out: list[LifeModel], *, informed: bool) -> tuple[Floats, int]:
        """Return the evidence ``[5, D]`` that healthy cells reach in logs with dead ones, and the
        units of these logs.

        Cells where contacts end are predicted worse than others: the limit is the highest evidence
        of the cell itself, and at least what all but a few of the cells reach.

        Args:
            held_out: a model for each fold, fitted to the others.
            informed: whether the test is told which cells are dead.
        """
        cells = np.flatnonzero(self._present)
        reached = np.full((len(FAULTS), len(self._present)), -np.inf)
        usual = []
        units = []
        for model, fold in zip(held_out, self._folds, strict=True):
            for dead_share in (0.0, _DEAD, _DEAD):
                broken = fold.copy()
                dead = self._rng.choice(cells, round(dead_share * len(cells)), replace=False)
                for cell in dead.tolist():
                    broken.kill(cell, int(self._rng.choice(cells)), self._rng)
                healthy = np.setdiff1d(cells, dead)
                known = np.isin(np.arange(len(self._present)), healthy)
                for record in _logs(broken):
                    evidence = EvidenceOfLog.of(record, model, self._layout.beside)
                    if evidence is None:
                        continue
                    if not informed:
                        test = LifeTest(evidence, self._present)
                        test.finish()
                        known = test.known
                    found = finished(evidence.ways(known)).evidence[:, healthy]
                    reached[:, healthy] = np.maximum(reached[:, healthy], found)
                    usual.append(found)
                    units.append(evidence.log.units)
        most = np.quantile(np.concatenate(usual, axis=1), _HEALTHY, axis=1)
        return np.maximum(reached, most[:, None]), int(np.median(units))


def _logs(fold: _Fold) -> list[LifeRecord]:
    """Return the pieces as records of logs, each of as many segments as are kept of a log."""
    numbers, begins = np.unique(fold.piece // (SEGMENT // PIECE), return_index=True)
    loads = np.split(fold.loads, begins[1:])
    readings = np.split(fold.readings, begins[1:])
    return [
        LifeRecord(
            tuple(loads[first : first + KEPT]),
            tuple(readings[first : first + KEPT]),
            tuple(numbers[first : first + KEPT].tolist()),
        )
        for first in range(0, len(numbers), KEPT)
    ]


def _edges(values: Array, n: int) -> Floats:
    """Return limits of n levels: of loads that are none, and equally many of the others."""
    loaded = values[values > UNLOADED]
    if not len(loaded):
        return np.array([UNLOADED, 0.5])
    return np.unique(np.append(UNLOADED, np.quantile(loaded, np.linspace(0, 1, n)[1:-1]))).astype(
        np.float64
    )


def _table(counts: Floats, shrinkage: Floats | float) -> Array:
    """Return log P(level | prediction) of each cell, ``[D, M, K]``, shrunk towards that of all
    cells."""
    pooled = counts.sum(axis=0)
    usual = pooled.sum(axis=0) / pooled.sum()
    shared = (pooled + usual) / (pooled.sum(axis=1, keepdims=True) + 1)
    shared = (1 - GUESS) * shared + GUESS / counts.shape[2]
    table = (counts + shrinkage * shared) / (counts.sum(axis=2, keepdims=True) + shrinkage)
    log_table: Array = np.log(table).astype(np.float32)
    return log_table
