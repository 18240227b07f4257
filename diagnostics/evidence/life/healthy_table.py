"""What healthy cells do, given the others: a linear prediction, and a table P(observed level |
predicted level)."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.healthy.dual_ridge import covariance_and_precision, regression_on_known
from diagnostics.preprocessing.levels import MARGIN
from diagnostics.preprocessing.scale import Array

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Cells = NDArray[np.intp]
Levels = NDArray[np.uint8]

FAULTS = ("independent", "intermittent", "late", "copy", "clamped")
COPY = FAULTS.index("copy")
INTERMITTENT = FAULTS.index("intermittent")
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
_STEPS = 4  # of a prediction: a size
BESIDE = (0.01, 0.34, 0.67, 0.99)  # shares of the cells beside one that are loaded, between levels


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

    @cached_property
    def probabilities(self) -> Floats:
        """P(observed level | context), shape of ``table``."""
        return np.exp(self.table.astype(np.float64))

    def of_cell(self, cells: Cells) -> Cells:
        """Return where the table of each is."""
        return cells % len(self.table)


@dataclass(frozen=True)
class WireModel(HealthyTable):
    """Mean loads of healthy wires, given the cells that are not on them.

    Attributes:
        on: bool ``[W, D]``, cells on each wire.
        beside: bool ``[W, D]``, cells beside these that are not.
    """

    on: Mask
    beside: Mask

    def told(self, loads: Array, known: Mask) -> Mask:
        """Return in which pieces some known cell off each wire is loaded, bool ``[n, W]``.

        The others tell nothing of a wire where none of them is loaded: the pieces that are kept of
        a log hold some load, which is then its own, or that of a faulty cell.
        """
        others = (~self.on & known).astype(np.float32)
        found: Mask = (loads > UNLOADED).astype(np.float32) @ others.T > 0
        return found

    def contexts(self, expected: Floats, loads: Array, known: Mask) -> NDArray[np.intp]:
        """Return what the others say of each wire, 0 to M - 1, int ``[n, W]``.

        Args:
            expected: mean loads that they predict, ``[n, W]``.
            loads: root loads ``[n, D]``.
            known: bool ``[D]``, cells that predict others.
        """
        near = (self.beside & known).astype(np.float32)
        loaded = (loads > UNLOADED).astype(np.float32) @ near.T
        share = loaded / np.maximum(near.sum(axis=1), 1)
        level = levels_of(expected, self.predicted).astype(np.intp)
        return level * (len(BESIDE) + 1) + levels_of(share, np.asarray(BESIDE))

    def means(self, values: Array, eligible: Mask) -> Floats:
        """Return the means ``[n, W]`` over the eligible cells (bool ``[D]``) of each wire, of
        values ``[n, D]``."""
        of = (self.on & eligible).astype(np.float64)
        found: Floats = values @ (of / np.maximum(of.sum(axis=1, keepdims=True), 1)).T
        return found

    def expected(
        self, means: Sequence[ConditionalMean], loads: Array, known: Mask, eligible: Mask
    ) -> Generator[None, None, Floats]:
        """Yield between steps; return the mean load that the known cells off each wire predict,
        ``[n, W]``.

        Args:
            means: predictions of the cells.
            loads: root loads ``[n, D]``.
            known: bool ``[D]``, cells that predict others.
            eligible: bool ``[D]``, cells over which the mean is taken.
        """
        found = np.zeros((len(loads), len(self.on)))
        for w, on in enumerate(self.on):
            of = on & eligible
            for mean in means:
                if of[mean.outputs].any():
                    found[:, w] += mean.expected_sum(loads, known, on, of)
            found[:, w] /= max(1, of.sum())
            yield
        return found


@dataclass(frozen=True)
class LifeModel(HealthyTable):
    """What healthy cells do, given the others: ``reached`` is of the ``FAULTS``.

    Attributes:
        means: predictions, for each tile; each cell is an output of one.
        equal: float ``[D, 8]``, probability that a healthy cell reads the same as one beside it
            throughout a unit.
        amid: float ``[D, 5]``, probability of each level of how far a healthy cell reads from the
            mean beside it.
        tolerance: a cell whose readings lie within this of its highest one reads it, in the
            layout's unit.
        wires: of the cells' wires; None: there are none with enough cells.
    """

    means: tuple[ConditionalMean, ...]
    equal: Floats
    amid: Floats
    tolerance: float
    wires: WireModel | None

    def check(self, layout: SensorLayout) -> None:
        """Raise ValueError unless this is a model of ``layout``."""
        outputs = np.concatenate([mean.outputs for mean in self.means])
        if not np.array_equal(np.sort(outputs), np.flatnonzero(layout.present)):
            raise ValueError(f"the proof of life does not cover each cell of {layout} exactly once")
        shape = (self.n_contexts, len(self.levels) + 1)
        if self.table.shape not in ((1, *shape), (layout.n_cells, *shape)):
            raise ValueError(f"expected a table [1 or {layout.n_cells}, {shape[0]}, {shape[1]}]")
        if self.reached.shape != (len(FAULTS), layout.n_cells):
            raise ValueError(f"expected reached [{len(FAULTS)}, {layout.n_cells}]")
        if self.errs.shape != (layout.n_cells,):
            raise ValueError(f"expected errs [{layout.n_cells}]")
        if self.equal.shape != layout.beside.shape or self.amid.shape != (
            layout.n_cells,
            len(AMID) + 1,
        ):
            raise ValueError(f"expected equal and amid of {layout}")
        probabilities = np.concatenate(
            [[self.independent], self.errs, self.equal.ravel(), self.amid.ravel()]
        )
        if not ((probabilities > 0) & (probabilities <= 1)).all():
            raise ValueError("expected probabilities between 0 and 1")

    @property
    def n_contexts(self) -> int:
        """Number M of contexts."""
        return (len(self.predicted) + 1) * (len(BESIDE) + 1)

    def expected(self, loads: Array, known: Mask) -> Floats:
        """Return the expected root loads ``[n, D]``, given those of the ``known`` cells (bool
        ``[D]``)."""
        found = np.zeros(loads.shape)
        for mean in self.means:
            found[:, mean.outputs] = mean.predict(loads, known)
        return found

    def contexts(
        self, loads: Array, known: Mask, beside: Cells
    ) -> Generator[None, None, NDArray[np.intp]]:
        """Yield between steps; return what the others say of each cell, 0 to M - 1, int
        ``[n, D]``."""
        level = np.zeros(loads.shape, np.uint8)
        each = -(-len(self.means) // _STEPS)
        for k, mean in enumerate(self.means):
            level[:, mean.outputs] = levels_of(mean.predict(loads, known), self.predicted)
            if k % each == 0:
                yield
        around = loaded_beside(loads, known, beside)
        return level.astype(np.intp) * (len(BESIDE) + 1) + around

    def otherwise(self, gain: float, offset: float, cells: Cells) -> Floats:
        """Return P(observed level | context) of cells with a gain and an offset (of full scale),
        ``[cells, M, K]``."""
        above = np.append(self.levels, 1.0)
        below = np.append(0.0, self.levels)
        middle = (above + below) / 2
        middle[0] = 0.0
        load = np.clip(gain * middle**2 + offset, 0.0, 1.0)
        becomes = levels_of(np.sqrt(load), self.levels)
        table = self.probabilities[self.of_cell(cells)]
        found = np.full(table.shape, GUESS / len(middle))
        for before, after in enumerate(becomes.tolist()):
            found[:, :, after] += (1 - GUESS) * table[:, :, before]
        return found
