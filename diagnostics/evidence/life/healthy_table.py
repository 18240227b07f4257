"""What healthy cells do, given the others: a linear prediction, and a table P(observed level |
predicted level)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from diagnostics.healthy.dual_ridge import covariance_and_precision, regression_on_known
from diagnostics.preprocessing.levels import MARGIN
from diagnostics.preprocessing.scale import Array

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Cells = NDArray[np.intp]
Levels = NDArray[np.uint8]

FAULTS = ("independent", "intermittent", "late", "copy", "clamped")
COPY = FAULTS.index("copy")
INTERMITTENT = FAULTS.index("intermittent")
WEAK = len(FAULTS)  # what seems independent, and follows the others with a part of its load
UNLOADED = 1e-3  # root load up to which a piece counts as unloaded
AGAINST = 1.0  # log ratio from which on a unit speaks against a cell, or a wire
REFUTED = 4.0  # evidence from which on a cell predicts no others
THRESHOLD = 9.0  # evidence of a certain fault: with its prior, P(faulty) = 0.994
GUESS = 0.005  # of a uniform distribution over the levels, in any table: models err
# evidence that a healthy cell may reach in a log as long as those of the reference, though none did
_UNSEEN = 3.0
UNIT = 2  # pieces: a size
# distances from the mean of the cells beside one, over their spread, between levels
AMID = (
    0.02,
    0.08,
    0.25,
    0.6,
)
BESIDE = (0.01, 0.34, 0.67, 0.99)  # shares of the cells beside one that are loaded, between levels
FEWEST_CELLS = 3  # of a wire or a group, from which on they tell of it
STATES = 10  # of a group, see groups
FULL = 0.995  # root load of a cell at full scale
BEFORE = 3  # what a wire was a piece ago: unknown, at rest, loaded


@dataclass(frozen=True)
class ConditionalMean:
    """Linear prediction of some cells from others.

    Attributes:
        inputs: int ``[k]``, the cells.
        place: int ``[outputs]``, which of them are predicted.
        mean, scale: float ``[k]``; a scale of 0: constant in the reference.
        covariance, precision: float ``[k, k]``, of the standardised loads.
    """

    inputs: Cells
    place: Cells
    mean: Floats
    scale: Floats
    covariance: Floats
    precision: Floats

    @classmethod
    def fit(cls, loads: Array, inputs: Cells, place: Cells) -> ConditionalMean:
        """Fit to mean root loads ``[n, D]``."""
        own = loads[:, inputs].astype(np.float64)
        mean = own.mean(axis=0)
        spread = own.std(axis=0)
        scale = np.where(spread < UNLOADED, 0.0, spread)
        covariance, precision = covariance_and_precision(_standardised(own, mean, scale), 1.0)
        return cls(inputs, place, mean, scale, covariance, precision)

    @property
    def outputs(self) -> Cells:
        """The predicted cells."""
        return self.inputs[self.place]

    def predict(self, loads: Array, known: Mask) -> Floats:
        """Return the expected loads ``[n, outputs]``, given those of the ``known`` cells (bool
        ``[D]``) but the cell.

        With K the known cells, Q the inverse of their covariance, and unknown cells as the known
        ones predict them, E[z_i | K without i] = z_i - (P z)_i / Q_ii.
        """
        z = _standardised(loads[:, self.inputs], self.mean, self.scale)
        known = known[self.inputs]
        unknown = ~known
        own_precision = np.diag(self.precision).copy()
        if not known.any():
            z[:] = 0.0
        elif unknown.any():
            regression = regression_on_known(self.covariance, self.precision, known)
            z[:, unknown] = z[:, known] @ regression.T
            across = self.precision[np.ix_(unknown, known)]
            own_precision[known] += (across * regression).sum(axis=0)
        of_all = self.precision[:, self.place] / own_precision[self.place]
        expected_z = z[:, self.place] - z @ of_all
        expected: Floats = expected_z * self.scale[self.place] + self.mean[self.place]
        return expected

    def expected_sum(self, loads: Array, known: Mask, on: Mask, of: Mask) -> Floats:
        """Return the expected sum ``[n]`` of the loads of the outputs in ``of`` (bool ``[D]``).

        Args:
            loads: ``[n, D]``.
            known: bool ``[D]``, cells that predict others.
            on: bool ``[D]``, the cells of a wire, those in ``of`` among them: they do not.
        """
        known = (known & ~on)[self.inputs]
        outputs = self.place[of[self.outputs]]
        total = self.mean[outputs].sum()
        if not known.any() or not len(outputs):
            return np.full(len(loads), total)
        weight = np.zeros(len(known))
        weight[outputs] = self.scale[outputs]
        regression = regression_on_known(self.covariance, self.precision, known)
        z = _standardised(loads[:, self.inputs[known]], self.mean[known], self.scale[known])
        expected: Floats = total + z @ (weight[~known] @ regression)
        return expected


def _standardised(loads: NDArray[np.floating], mean: Floats, scale: Floats) -> Floats:
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
    return (loads - mean) * inverse


def levels_of(values: NDArray[np.floating], edges: Floats) -> Levels:
    """Return the number of the ``edges`` (ascending) that each value reaches:
    ``np.searchsorted(side="right")``."""
    level = np.zeros(values.shape, np.uint8)
    for edge in edges:
        level += values >= edge
    return level


def loaded_beside(loads: Array, known: Mask, beside: Cells) -> Levels:
    """Return the level of the share of the known cells beside each cell that are loaded,
    ``[n, D]``.

    Args:
        loads: root loads ``[n, D]``.
        known: bool ``[D]``.
        beside: int ``[D, 8]``, the cells beside each; -1: none.
    """
    of_cell = np.ascontiguousarray((loads > UNLOADED).T)
    loaded = np.zeros(of_cell.shape, np.uint8)
    count = np.zeros(len(of_cell), np.intp)
    for other in beside.T:
        counts = (other >= 0) & known[other]
        loaded += of_cell[other] & counts[:, None]
        count += counts
    shares = np.arange(beside.shape[1] + 1) / np.maximum(count, 1)[:, None]
    level = levels_of(shares, np.asarray(BESIDE))
    found: Levels = np.take_along_axis(level, loaded.astype(np.intp), axis=1).T
    return found


@dataclass(frozen=True)
class HealthyTable:
    """P(observed level | context) of healthy loads, and how far they go.

    Attributes:
        levels: float ``[K - 1]``, root loads between the levels that are observed.
        predicted: float ``[M - 1]``, the same of those that are predicted.
        table: float ``[D, M, K]``, log P(observed level | context) of each healthy load;
            ``[1, M, K]``: of all.
        independent: share of the units that count as independent of each other: those of one
            contact are alike.
        errs: float ``[D]``, share e of the units.
        reached: float ``[faults, D]``, evidence that a healthy load reaches in a log.
        units: number of units of these logs.
        counts: factor on all evidence, 0 to 1: a reference of few units contains few unusual
            contacts.
    """

    levels: Floats
    predicted: Floats
    table: Array
    independent: float
    errs: Floats
    reached: Floats
    units: int
    counts: float

    def factors(self, units: int) -> Floats:
        """Return the factors ``[faults, D]`` on the evidence in a log of so many units: healthy
        loads stay below the limit.

        The evidence against a healthy load that the model predicts badly grows with the length of
        the log; a log that is longer than those of the reference may hold contacts that are like
        none of these.
        """
        unseen = np.zeros((len(self.reached), 1))
        unseen[0] = _UNSEEN
        reached = np.maximum(self.reached, unseen) * max(1.0, units / self.units)
        factors: Floats = self.counts * THRESHOLD / np.maximum(THRESHOLD, MARGIN * reached)
        return factors

    @property
    def n_levels(self) -> int:
        """Number K of levels that are observed."""
        return len(self.levels) + 1

    @cached_property
    def probabilities(self) -> Floats:
        """P(observed level | context), shape of ``table``."""
        return np.exp(self.table.astype(np.float64))

    def of_cell(self, cells: Cells) -> Cells:
        """Return where the table of each is."""
        return cells % len(self.table)
