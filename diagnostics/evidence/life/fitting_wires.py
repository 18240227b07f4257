"""Fit of the model of healthy wires."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diagnostics.evidence.life.folds import Fold
from diagnostics.evidence.life.healthy_table import UNLOADED, Floats, Mask, levels_of
from diagnostics.evidence.life.levels_in_log import LifeLog
from diagnostics.evidence.life.life_model import LifeModel, WireModel, cells_on_lines
from diagnostics.evidence.life.tables import (
    LEVELS,
    counts_of,
    edges_of,
    log_table,
    predicted_edges,
    shares_of_errors,
    shrinkage_of,
)
from diagnostics.evidence.life.wires import wire_log
from diagnostics.healthy.cross_fitting import FOLDS
from diagnostics.preprocessing.levels import FEWEST

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout
    from diagnostics.wiring import LineKind

# all but those of address bits
_KINDS: tuple[LineKind, ...] = ("row", "column", "converter", "position", "bus", "group")
_LEFT_OUT = 0.15  # most cells that are unknown in predictions, as in a log with dead ones


def fit_wires(
    held_out: Sequence[LifeModel], folds: Sequence[Fold], layout: SensorLayout
) -> tuple[WireModel | None, list[WireModel | None]]:
    """Return the model, and that for each fold, fitted to the others; None: no wire has enough
    cells.

    Args:
        held_out: models of the cells for each fold, fitted to the others.
        folds: of the reference.
        layout: the array.
    """
    on = cells_on_lines(layout, _KINDS)
    if not len(on):
        return None, [None] * len(folds)
    present = layout.present.ravel()
    every = np.ones(len(on), bool)
    blank = WireModel(
        levels=np.zeros(0),
        predicted=np.zeros(0),
        table=np.zeros((0, 0, 0), np.float32),
        independent=held_out[0].independent,
        errs=np.zeros(0),
        reached=np.zeros((1, len(on))),
        units=1,
        counts=1.0,
        on=on,
        beside=np.stack([layout.with_neighbours(of) & present & ~of for of in on]),
    )
    loads = [blank.means(fold.loads, present) for fold in folds]
    expected = [
        _expected(blank, model, fold, present) for model, fold in zip(held_out, folds, strict=True)
    ]
    levels = edges_of(np.concatenate(loads), LEVELS)
    predicted = predicted_edges(np.concatenate(expected).ravel(), np.concatenate(loads).ravel())
    shape = (len(on), (len(predicted) + 1) * blank.per_level, len(levels) + 1)
    blank = replace(blank, levels=levels, predicted=predicted)
    counts = np.stack(
        [
            counts_of(
                blank.contexts(of, own, fold.loads, fold.piece, present),
                levels_of(own, levels),
                shape,
                blank.told(fold.loads, present),
            )
            for of, own, fold in zip(expected, loads, folds, strict=True)
        ]
    )
    total = counts.sum(axis=0)
    shrinkage = shrinkage_of(counts, total)
    fitted = replace(blank, table=log_table(total, shrinkage))
    models = [replace(fitted, table=log_table(total - of, shrinkage)) for of in counts]
    ratios = []
    for model, fold, wires in zip(held_out, folds, models, strict=True):
        log = LifeLog(fold.loads, fold.readings, fold.constant, fold.piece, model, layout.beside)
        own, _, healthy = wire_log(log, wires, present, present)
        ratios.append(own.by_unit(own.own - healthy))
    used = np.sum([(own > UNLOADED).sum(axis=0) for own in loads], axis=0) >= FEWEST
    errs, without = shares_of_errors(ratios, blank.independent, every, used)
    return replace(fitted, errs=errs), [
        replace(model, errs=of) for model, of in zip(models, without, strict=True)
    ]


def _expected(wires: WireModel, model: LifeModel, fold: Fold, present: Mask) -> Floats:
    """Return the predicted mean loads ``[n, W]``, where some cells are unknown."""
    found = np.empty((len(fold.loads), len(wires.on)))
    for part, known in unknown_parts(len(found), present, np.random.default_rng(1)):
        found[part] = wires.expected(model.means, fold.loads[part], known, present)
    return found


def unknown_parts(
    n: int, present: Mask, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, Mask]]:
    """Yield parts of n pieces, and which of the ``present`` cells are known in each: fewer and
    fewer."""
    parts = np.array_split(np.arange(n), FOLDS)
    for part, left_out in zip(parts, np.linspace(0.0, _LEFT_OUT, len(parts)), strict=True):
        yield part, present & (rng.random(len(present)) >= left_out)
