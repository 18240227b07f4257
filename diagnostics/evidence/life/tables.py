"""Tables P(observed level | context) and shares of errors, from folds that predictions were not
fitted on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from diagnostics.evidence.life.healthy_table import GUESS, UNLOADED, Floats, Mask
from diagnostics.preprocessing.levels import MAJORITY
from diagnostics.preprocessing.scale import Array

LEVELS = 12  # of the root load: a size
PREDICTED = 16  # levels of the prediction: a size
OWN_ERRS = 20.0  # pseudo-count of independent units of all cells, in the frequencies of each cell
_SHRINKAGES = (4.0, 16.0, 64.0, 256.0, 1024.0)  # pseudo-counts of the table of all cells: a grid
_CONTAMINATIONS = (0.01, 0.02, 0.04, 0.08)  # shares e: a grid


def edges_of(values: NDArray[np.floating], n: int) -> Floats:
    """Return limits of n levels: of loads that are none, and equally many of the others."""
    loaded = values[values > UNLOADED]
    if not len(loaded):
        return np.array([UNLOADED, 0.5])
    return np.unique(np.append(UNLOADED, np.quantile(loaded, np.linspace(0, 1, n)[1:-1]))).astype(
        np.float64
    )


def predicted_edges(expected: Floats, loads: NDArray[np.floating]) -> Floats:
    """Return limits of the levels of predictions, of the expected loads and the observed ones, 1-D
    each."""
    share = np.linspace(0, 1, PREDICTED // 2 + 1)[1:-1]
    loaded = expected[loads > UNLOADED]
    if not len(loaded):
        loaded = expected
    edges: Floats = np.unique(
        np.concatenate([np.quantile(expected, share), np.quantile(loaded, share)])
    )
    return edges


def counts_of(
    context: NDArray[np.integer],
    level: NDArray[np.integer],
    shape: tuple[int, int, int],
    counted: Mask,
) -> Floats:
    """Return how often each cell had each level in each context, ``[tables, M, K]``.

    Args:
        context, level: int ``[n, D]``.
        shape: of the table; tables is D, or 1: of all.
        counted: bool ``[D]`` or ``[n, D]``, cells that count.
    """
    tables, m, k = shape
    index = (np.arange(level.shape[1]) % tables * m + context.astype(np.intp)) * k + level
    found = np.bincount(index[np.broadcast_to(counted, index.shape)], minlength=tables * m * k)
    return found.astype(np.float64).reshape(shape)


def log_table(counts: Floats, shrinkage: Floats | float) -> Array:
    """Return log P(level | prediction) of each cell, ``[D, M, K]``, shrunk towards that of all
    cells."""
    pooled = counts.sum(axis=0)
    usual = pooled.sum(axis=0) / pooled.sum()
    shared = (pooled + usual) / (pooled.sum(axis=1, keepdims=True) + 1)
    shared = (1 - GUESS) * shared + GUESS / counts.shape[2]
    table = (counts + shrinkage * shared) / (counts.sum(axis=2, keepdims=True) + shrinkage)
    log_table: Array = np.log(table).astype(np.float32)
    return log_table


def shrinkage_of(counts: Floats, total: Floats) -> Floats:
    """Return the pseudo-count of each cell, ``[tables, 1, 1]``: the likeliest for folds that it
    has not seen."""
    likelihood = []
    for shrinkage in _SHRINKAGES:
        each = [(of * log_table(total - of, shrinkage)).sum(axis=(1, 2)) for of in counts]
        likelihood.append(np.sum(each, axis=0))
    best = np.argmax(likelihood, axis=0)
    found: Floats = np.asarray(_SHRINKAGES)[best][:, None, None]
    return found


def shares_of_errors(
    ratios: Sequence[Floats],
    independent: float,
    present: Mask,
    used: Mask,
    least: float = MAJORITY,
) -> tuple[Floats, list[Floats]]:
    """Return the share of units in which each healthy cell contradicts, ``[D]``, and the same
    without each fold.

    The share of all cells is the likeliest of a grid; that of a cell has it as prior.

    Args:
        ratios: log ratio independent : healthy of each unit, ``[units, D]``, for each fold.
        independent: share of the units that count as independent of each other.
        present: bool ``[D]``, cells that count.
        used: bool ``[D]``, those that the reference loaded.
        least: share of a cell at least, of that of all.
    """
    every = np.concatenate(ratios)[:, present].ravel()
    usual = max(
        _CONTAMINATIONS,
        key=lambda e: float(np.logaddexp(np.log1p(-e), np.log(e) + every).sum()),
    )
    erred = independent * np.stack(
        [expit(ratio + np.log(usual / (1 - usual))).sum(axis=0) for ratio in ratios]
    )
    units = independent * np.array([len(ratio) for ratio in ratios])[:, None]

    def share(erred: Floats, units: Floats) -> Floats:
        found: Floats = (erred.sum(axis=0) + usual * OWN_ERRS) / (units.sum() + OWN_ERRS)
        # The rule of three: what was never seen in n units.
        found = np.clip(found, max(least * usual, 3 / units.sum()), MAJORITY / 2)
        # what the reference hardly loaded is hardly known
        return np.where(used, found, MAJORITY / 2)

    without = [
        share(np.delete(erred, k, axis=0), np.delete(units, k, axis=0)) for k in range(len(ratios))
    ]
    return share(erred, units), without
