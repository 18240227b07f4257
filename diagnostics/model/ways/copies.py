"""Repeats the reading of a cell beside it, or the mean of those around it.

r = log P(at the other's reading) - log P(level | others, a piece ago), where either is loaded. Of
two cells that read the same, the one that the others expect less is the copy.

Not detected: which of two it is where the others expect both alike; a copy of a cell further away.
"""

from __future__ import annotations

import numpy as np

from diagnostics.faults import FaultKind
from diagnostics.model.observed import Observed
from diagnostics.model.over_time import USUAL, Units, for_good
from diagnostics.model.record import Array, Cells
from diagnostics.model.ways.way import MISS, Way


def _of(observed: Observed, units: Units, source: Array, above: Array, given: Array) -> Array:
    """Return the evidence ``[D]`` that each cell repeats a source.

    Args:
        observed: the log.
        units: of it.
        source: readings ``[n, D]``; NaN: none.
        above: how far it reads above its rest, ``[n, D]``.
        given: log P(observed level) of the source, ``[n, D]``.
    """
    log = observed.log
    away = np.abs(log.record.mean - source)
    loaded = (log.level > 0) | (above > log.symbols.rest.near)
    same = np.log(1 - MISS) - log.agree - observed.of_level
    ratio = np.where(away <= log.symbols.tolerance, same, np.log(MISS))
    told = loaded & observed.tells & np.isfinite(source)
    evidence = for_good(np.where(told, ratio, 0), units)
    # one of the two is the copy: what makes the other one it is as if this one were healthy
    expected = np.where(told, given - observed.of_level, 0).sum(axis=0)
    this = evidence - np.logaddexp(0, -expected)
    other = evidence - np.logaddexp(0, expected)
    found: Array = this - np.logaddexp(0, other)
    return np.where(told.any(axis=0), found, -np.inf)


def _each(observed: Observed, units: Units) -> tuple[Array, Cells]:
    """Return the evidence ``[sources, D]`` of each source, and the sources, int; -1: the mean."""
    beside = observed.predictor.beside
    known = observed.known
    read = observed.log.record.mean
    loads = observed.log.above
    found = []
    sources = []
    for other in beside.T:
        there = (other >= 0) & known[other]
        source = np.where(there, read[:, other], np.nan)
        given = observed.of_level[:, other]
        found.append(_of(observed, units, source, loads[:, other], given))
        sources.append(np.where(there, other, -1))
    certain = np.zeros_like(observed.of_level)
    found.append(_of(observed, units, _around(read, beside), _around(loads, beside), certain))
    sources.append(np.full(len(known), -1))
    return np.stack(found), np.stack(sources)


def _around(values: Array, beside: Cells) -> Array:
    """Return the mean of the values ``[n, D]`` of the cells beside each one; NaN: of fewer than
    two."""
    there = beside >= 0
    count = there.sum(axis=1)
    total = np.where(there, values[:, beside], 0).sum(axis=2)
    found: Array = np.where(count > 1, total / np.maximum(count, 1), np.nan)
    return found


def _evidence(observed: Observed, units: Units) -> Array:
    each, _ = _each(observed, units)
    found: Array = np.maximum(each.max(axis=0) - np.log(len(each)), np.log(MISS))
    return found


def _source(observed: Observed) -> Array:
    """Return the cell that each one repeats; NaN: the mean."""
    odd = np.full(observed.log.level.shape[1], USUAL, np.float32)
    each, sources = _each(observed, Units.of(observed, odd))
    best = each.argmax(axis=0)
    source = sources[best, np.arange(len(best))].astype(np.float32)
    return np.where(source < 0, np.float32(np.nan), source)


COPIES = Way(FaultKind.COPY, 0.05, _evidence, value=_source, decides=False)
