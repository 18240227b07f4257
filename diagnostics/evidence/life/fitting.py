"""Fit of the model of healthy cells by cross-fitting: table, units and limits from folds not used
for predictions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.tiles import MOST_CELLS, tiles
from diagnostics.evidence.life.fitting_wires import fit_wires, unknown_parts
from diagnostics.evidence.life.folds import Fold, folds_of, joined, logs_of
from diagnostics.evidence.life.groups import fit_groups, tested_groups
from diagnostics.evidence.life.healthy_table import (
    AMID,
    BESIDE,
    FAULTS,
    UNLOADED,
    ConditionalMean,
    Floats,
    levels_of,
    loaded_beside,
)
from diagnostics.evidence.life.levels_in_log import LifeLog
from diagnostics.evidence.life.life_model import LifeModel
from diagnostics.evidence.life.proof import LifeTest
from diagnostics.evidence.life.tables import (
    LEVELS,
    OWN_ERRS,
    counts_of,
    edges_of,
    log_table,
    predicted_edges,
    shares_of_errors,
    shrinkage_of,
)
from diagnostics.evidence.life.ways_to_fail import EvidenceOfLog
from diagnostics.evidence.life.wires import tested_wires
from diagnostics.preprocessing.levels import FEWEST
from diagnostics.preprocessing.scale import Array

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout
    from diagnostics.preprocessing.offset import ReferenceOffset
    from diagnostics.preprocessing.scale import Scale

_ERRS = 0.05  # share e of the units, before it is known
_LONGEST = 16  # units in a sum: a size
_CORRELATED = 0.25  # correlation of successive units that is small
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
    parts = folds_of(recordings, layout, scale, offset)
    if parts is None:
        return None
    return _Fit(parts, layout, tolerance).model()


class _Fit:
    """Fits the model by cross-fitting: tables, units and factors from folds that the predictions
    were not fitted on."""

    def __init__(self, folds: list[Fold], layout: SensorLayout, tolerance: float) -> None:
        self._folds = folds
        self._layout = layout
        self._tolerance = tolerance
        self._present = layout.present.ravel()
        self._rng = np.random.default_rng(0)
        every = joined(folds)
        self._levels = edges_of(every.loads[:, self._present], LEVELS)
        self._full = self._means(every.loads)
        self._used = (every.loads > UNLOADED).sum(axis=0) >= FEWEST
        self._held_out = [
            self._means(joined([other for j, other in enumerate(folds) if j != k]).loads)
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
            wires=None,
            groups=None,
        )
        seen = [self._expected(replace(blank, means=means), fold) for means, fold in self._cross()]
        predicted = predicted_edges(
            np.concatenate([of[:, self._present].ravel() for of, _ in seen]),
            np.concatenate([fold.loads[:, self._present].ravel() for fold in self._folds]),
        )
        counts = np.stack(
            [self._counts(fold, *of, predicted) for fold, of in zip(self._folds, seen, strict=True)]
        )
        total = counts.sum(axis=0)
        shrinkage = shrinkage_of(counts, total)
        fitted = replace(blank, predicted=predicted, table=log_table(total, shrinkage))
        held_out = [
            replace(fitted, means=means, table=log_table(total - counts[k], shrinkage))
            for k, (means, _) in enumerate(self._cross())
        ]
        by_unit = [
            self._independent(model, fold)
            for model, fold in zip(held_out, self._folds, strict=True)
        ]
        independent = self._independent_share(held_out)
        errs, of_others = shares_of_errors(by_unit, independent, self._present, self._used)
        fitted = self._beside(replace(fitted, independent=independent, errs=errs))
        held_out = [
            replace(of, independent=independent, errs=own, equal=fitted.equal, amid=fitted.amid)
            for of, own in zip(held_out, of_others, strict=True)
        ]
        wires, of_folds = fit_wires(held_out, self._folds, self._layout)
        held_out = [replace(of, wires=own) for of, own in zip(held_out, of_folds, strict=True)]
        groups, groups_of_folds = fit_groups(held_out, self._folds, self._layout)
        held_out = [
            replace(of, groups=own) for of, own in zip(held_out, groups_of_folds, strict=True)
        ]
        # First with the dead cells known: else healthy cells would be taken for dead ones, and
        # mislead the others.
        informed = self._reached(held_out, informed=True)
        held_out = [informed.on(of, 1.0) for of in held_out]
        reached = informed.and_of(self._reached(held_out, informed=False))
        of_all = independent * sum(map(len, by_unit))
        # Few units contain few unusual contacts.
        factor = 1 - _MOST_DISCOUNT / (1 + of_all / _HALF_DISCOUNT)
        return reached.on(replace(fitted, wires=wires, groups=groups), factor)

    def _cross(self) -> list[tuple[tuple[ConditionalMean, ...], Fold]]:
        return list(zip(self._held_out, self._folds, strict=True))

    def _beside(self, model: LifeModel) -> LifeModel:
        """Return the model with how often healthy cells read as one beside them, or as the mean of
        these."""
        d = len(self._present)
        same = np.zeros(model.equal.shape)
        loaded = np.zeros(model.equal.shape)
        amid = np.zeros((d, len(AMID) + 1))
        for fold in self._folds:
            log = LifeLog(
                fold.loads, fold.readings, fold.constant, fold.piece, model, self._layout.beside
            )
            for k in range(self._layout.beside.shape[1]):
                some, equal = log.same(k)
                loaded[:, k] += some.sum(axis=0)
                same[:, k] += equal.sum(axis=0)
            some, level = log.amid()
            for n in range(len(AMID) + 1):
                amid[:, n] += (some & (level == n)).sum(axis=0)
        same *= model.independent
        loaded *= model.independent
        amid *= model.independent
        usual = (same.sum() + 1) / (loaded.sum() + 1)
        equal = (same + usual * OWN_ERRS) / (loaded + OWN_ERRS)
        shared = (amid.sum(axis=0) + 1) / (amid.sum() + len(AMID) + 1)
        amid = (amid + shared * OWN_ERRS) / (amid.sum(axis=1, keepdims=True) + OWN_ERRS)
        return replace(model, equal=equal, amid=amid)

    def _expected(self, model: LifeModel, fold: Fold) -> tuple[Floats, NDArray[np.intp]]:
        """Return predictions in which some cells are unknown, as in a log with dead ones, and
        levels of loads beside.

        Both are ``[n, D]``.
        """
        found = np.empty(fold.loads.shape)
        near = np.empty(fold.loads.shape, np.intp)
        for part, known in unknown_parts(len(fold.loads), self._present, self._rng):
            found[part] = model.expected(fold.loads[part], known)
            near[part] = loaded_beside(fold.loads[part], known, self._layout.beside)
        return found, near

    def _counts(
        self, fold: Fold, expected: Floats, near: NDArray[np.intp], predicted: Floats
    ) -> Floats:
        """Return how often each cell had each level in each context, ``[D, M, K]``; ``[1, M, K]``
        of a large array."""
        around = len(BESIDE) + 1
        context = levels_of(expected, predicted).astype(np.intp) * around + near
        level = levels_of(fold.loads, self._levels)
        tables = len(self._present) if self._present.sum() <= MOST_CELLS else 1
        shape = (tables, (len(predicted) + 1) * around, len(self._levels) + 1)
        return counts_of(context, level, shape, self._present)

    def _independent(self, model: LifeModel, fold: Fold) -> Floats:
        """Return the log ratio independent of the others : healthy of each unit of a fold,
        ``[units, D]``."""
        log = LifeLog(
            fold.loads, fold.readings, fold.constant, fold.piece, model, self._layout.beside
        )
        healthy, _ = log.healthy(self._present)
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
            for record in logs_of(fold):
                log = LifeLog(
                    record.loads,
                    record.means,
                    record.constant,
                    record.piece,
                    model,
                    self._layout.beside,
                )
                healthy, _ = log.healthy(self._present)
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

    def _reached(self, held_out: list[LifeModel], *, informed: bool) -> _Reached:
        """Return what healthy cells and wires reach in logs with dead cells.

        Cells where contacts end are predicted worse than others: the limit is the highest evidence
        of the cell itself, and at least what all but a few of the cells reach.

        Args:
            held_out: a model for each fold, fitted to the others.
            informed: whether the test is told which cells are dead.
        """
        cells = np.flatnonzero(self._present)
        reached = np.full((len(FAULTS), len(self._present)), -np.inf)
        usual = []
        of_wires: list[Floats] = []
        of_groups: list[Floats] = []
        of_wire = np.random.default_rng(0)
        units = []
        for model, fold in zip(held_out, self._folds, strict=True):
            for dead_share in (0.0, _DEAD, _DEAD):
                broken = fold.copy()
                dead = self._rng.choice(cells, round(dead_share * len(cells)), replace=False)
                for cell in dead.tolist():
                    broken.kill(cell, int(self._rng.choice(cells)), self._rng)
                healthy = np.setdiff1d(cells, dead)
                known = np.isin(np.arange(len(self._present)), healthy)
                for record in logs_of(broken):
                    evidence = EvidenceOfLog.of(record, model, self._layout.beside)
                    if evidence is None:
                        continue
                    if not informed:
                        test = LifeTest(evidence, self._present)
                        test.finish()
                        known = test.known
                    found = evidence.ways(known).evidence[:, healthy]
                    reached[:, healthy] = np.maximum(reached[:, healthy], found)
                    usual.append(found)
                    units.append(evidence.log.units)
                    if model.groups is not None:
                        of_groups.append(tested_groups(evidence.log, model.groups, known).evidence)
                    if model.wires is not None:
                        out = model.wires.on[of_wire.integers(len(model.wires.on))]
                        for without in (np.zeros_like(out), out):
                            tested = tested_wires(
                                evidence.log,
                                model.wires,
                                known & ~without,
                                self._present & ~without,
                            )
                            of_wires.append(tested.evidence)
        most = np.quantile(np.concatenate(usual, axis=1), _HEALTHY, axis=1)
        reached = np.maximum(reached, most[:, None])
        wires = np.max(of_wires, axis=0, initial=0.0)[None] if of_wires else np.zeros((1, 0))
        groups = np.max(of_groups, axis=0, initial=0.0)[None] if of_groups else np.zeros((1, 0))
        return _Reached(reached, wires, groups, int(np.median(units)))


@dataclass(frozen=True)
class _Reached:
    """Evidence that healthy cells ``[5, D]``, wires ``[1, W]`` and groups ``[1, G]`` reach in logs
    of so many units."""

    cells: Floats
    wires: Floats
    groups: Floats
    units: int

    def and_of(self, other: _Reached) -> _Reached:
        """Return what they reach in either kind of logs."""
        return replace(
            self,
            cells=np.maximum(self.cells, other.cells),
            wires=np.maximum(self.wires, other.wires),
            groups=np.maximum(self.groups, other.groups),
        )

    def on(self, model: LifeModel, counts: float) -> LifeModel:
        """Return the model with these limits, and a factor on all evidence."""
        wires = model.wires
        if wires is not None:
            wires = replace(wires, reached=self.wires, units=self.units, counts=counts)
        groups = model.groups
        if groups is not None:
            groups = replace(groups, reached=self.groups, units=self.units, counts=counts)
        return replace(
            model,
            reached=self.cells,
            units=self.units,
            counts=counts,
            wires=wires,
            groups=groups,
        )
