"""Proof of life: do the readings of a cell depend on those of the others as a healthy cell's do?

Predicts the mean root load of each cell in each piece of the log from the other cells (conditional mean with a
Ledoit-Wolf covariance) and compares, over a table P(observed level | predicted level) of healthy cells,

    r_u = sum over the pieces t of unit u of  log P(level_t | fault) - log P(level_t | predicted level_t, healthy)

with four faults: the level is independent of the others (its own frequencies in the log, leaving the piece out); it is
that of the prediction some pieces ago (late); it is the healthy one up to its highest reading (clamped); it repeats
the reading of a cell beside it (copy). A fault that comes and goes reads as at rest in the units of a two-state Markov
chain (forward algorithm); one that was there once and has gone is none. Units are so long that those of the reference
are hardly correlated. Either side errs in a share e of the units (contamination, Huber 1964), and k units of the same
loads count as one:

    evidence = sum over u of  w_u log ((1 - e) exp(r_u) + e) / ((1 - e) + e exp(r_u)),   w_u = 1 / k_u

so that no unit counts for more than log(1/e). The table is tilted to the frequencies of the levels in the log
(iterative proportional fitting, Deming and Stephan 1940): a contact that hardly changes contradicts nobody. The factor
on the evidence of each fault keeps healthy cells of held-out reference recordings, with dead ones beside them, below
the threshold, for a log of any length. Cells that are refuted are replaced by what the others say, the worst of all
first, until nothing changes.

Not detected: faults that leave loads nearly as predicted (the mean of the neighbours, a peak that is kept), rare ones,
and what moves where the reference or the log has no contact.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import expit, logsumexp

from diagnostics.events.tiles import MOST_CELLS, tiles
from diagnostics.evidence.life_record import KEPT, LifeRecord
from diagnostics.healthy.cross_fitting import FOLDS
from diagnostics.healthy.dual_ridge import covariance_and_precision
from diagnostics.preprocessing.levels import FEWEST, MAJORITY, MARGIN, TESTED
from diagnostics.preprocessing.offset import OffsetTracker
from diagnostics.preprocessing.readings import SEGMENT, RecordingBlocks, spread
from diagnostics.preprocessing.scale import Array

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout
    from diagnostics.preprocessing.offset import ReferenceOffset
    from diagnostics.preprocessing.scale import Scale

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Cells = NDArray[np.intp]

FAULTS = ("independent", "intermittent", "late", "copy", "clamped")
_SHARES = (0.4, 0.3, 0.1, 0.1, 0.1)  # of them among faults
_LEVELS = 12  # of the root load: a size
_PREDICTED = 16  # levels of the prediction: a size
_BESIDE = (0.01, 0.34, 0.67, 0.99)  # shares of the cells beside one that are loaded, between levels
_OWN_ERRS = 20.0  # pseudo-count of units, of the share e of each cell
_LAGS = (1, 2, 3, 4)  # pieces
# Gain and offset, as a share of full scale, of a cell that reads otherwise than it did, but follows the others: a grid.
_OTHERWISE = (
    *((gain, 0.0) for gain in (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0)),
    *((1.0, offset) for offset in (0.02, 0.05, 0.1, 0.2, 0.4)),
)
_UNLOADED = 1e-3  # root load up to which a piece counts as unloaded
_SHRINKAGES = (4.0, 16.0, 64.0, 256.0, 1024.0)  # pseudo-counts of the table of all cells: a grid
_CONTAMINATIONS = (0.01, 0.02, 0.04, 0.08)  # shares e: a grid
_CORRELATED = 0.25  # correlation of successive units that is small
_MOST_PIECES = 6000  # of the reference: a size
_CERTAINLY_NOT = 1e3  # evidence against what is impossible
_ROUNDS = 16  # at most: a size
_REFUTED = 4.0  # evidence from which on a cell is replaced
_THRESHOLD = 9.0  # evidence of a certain fault: with its prior, P(faulty) = 0.994
_FAILS, _RECOVERS = 0.1, 0.3  # probability per unit
_AT_REST = 0.95  # of the pieces of a cell that is dead for a time are unloaded
_GUESS = 0.005  # of a uniform distribution over the levels, in any table: models err
_AGAINST = 1.0  # log ratio from which on a unit speaks against a cell
_SHOWN = 2.0  # evidence against independence that proves life
_THE_SAME = 0.1  # relative difference of loads that are the same
_TILTED = 8.0  # pseudo-count of pieces, of the frequency of a level
_FITS = 3  # of the tilt, by iterative proportional fitting: a size
_MOST_TILT = 16.0  # times as frequent as expected, or as rare, levels of healthy cells are in a log
_MOST_DISCOUNT, _HALF_DISCOUNT = 0.5, 100.0  # of the factors; units of the reference that halve it
_DEAD = 0.08  # share of the cells that are dead in some simulated logs
_HEALTHY = 0.99  # of the healthy cells in simulated logs
_DISTURBED = 1 / 3  # share of the tested cells: if more are refuted, all are disturbed


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
        mean, spread = own.mean(axis=0), own.std(axis=0)
        scale = np.where(spread < _UNLOADED, 0.0, spread)
        covariance, precision = covariance_and_precision(_standardised(own, mean, scale), 1.0)
        return cls(inputs, place, mean, scale, covariance, precision)

    @property
    def outputs(self) -> Cells:
        """The predicted cells."""
        return self.inputs[self.place]

    def predict(self, loads: Array, known: Mask) -> Floats:
        """Return the expected loads ``[n, outputs]``, given those of the ``known`` cells (bool ``[D]``) alone."""
        z = _standardised(loads[:, self.inputs], self.mean, self.scale)
        known = known[self.inputs]
        unknown = ~known
        if not known.any():
            z[:] = 0.0
        elif unknown.any():
            z[:, unknown] = z[:, known] @ self._regression(known, unknown).T
        z_own = z[:, self.place]
        others = z_own - z @ (self.precision[:, self.place] / np.diag(self.precision)[self.place])
        expected: Floats = others * self.scale[self.place] + self.mean[self.place]
        return expected

    def _regression(self, known: Mask, unknown: Mask) -> Floats:
        if unknown.sum() <= known.sum():
            within = self.precision[np.ix_(unknown, unknown)]
            found: Floats = -linalg.solve(within, self.precision[np.ix_(unknown, known)], assume_a="pos")
            return found
        within = self.covariance[np.ix_(known, known)]
        turned: Floats = linalg.solve(within, self.covariance[np.ix_(known, unknown)], assume_a="pos").T
        return turned


def _loaded_beside(loads: Array, known: Mask, beside: Cells) -> NDArray[np.intp]:
    """Return the level of the share of the known cells beside each cell that are loaded, int ``[n, D]``."""
    loaded = ((loads > _UNLOADED) & known).astype(np.float32)
    total = np.zeros(loads.shape, np.float32)
    count = np.zeros(loads.shape[1], np.float32)
    for other in beside.T:
        has = (other >= 0) & known[other]
        total += loaded[:, other] * has
        count += has
    share = total / np.maximum(count, 1)
    return np.searchsorted(_BESIDE, share, side="right")


def _standardised(loads: NDArray[np.floating], mean: Floats, scale: Floats) -> Floats:
    return np.where(scale > 0, (loads - mean) / np.where(scale > 0, scale, 1.0), 0.0)


@dataclass(frozen=True)
class LifeModel:
    """What healthy cells do, given the others.

    Attributes:
        means: predictions, for each tile; each cell is an output of one.
        levels: float ``[K - 1]``, root loads between the levels that are observed.
        predicted: float ``[M - 1]``, the same of those that are predicted.
        table: float ``[D, M, K]``, log P(observed level | context) of each healthy cell; ``[1, M, K]``: of all.
        equal: probability that a healthy cell reads the same as one beside it in a loaded unit.
        unit: segments of a unit.
        errs: float ``[D]``, share e of the units.
        tolerance: a cell whose readings lie within this of its highest one reads it, in the layout's unit.
        reached: float ``[5, D]``, evidence that a healthy cell reaches in a log, for each of the ``FAULTS``.
        units: number of units of these logs.
        counts: factor on all evidence, 0 to 1: a reference of few units contains few unusual contacts.
    """

    means: tuple[ConditionalMean, ...]
    levels: Floats
    predicted: Floats
    table: Array
    equal: float
    unit: int
    errs: Floats
    tolerance: float
    reached: Floats
    units: int
    counts: float

    @classmethod
    def fit(
        cls,
        recordings: Sequence[Floats],
        layout: SensorLayout,
        scale: Scale,
        offset: ReferenceOffset,
        tolerance: float,
    ) -> LifeModel | None:
        """Fit to fault-free recordings, ``[T, D]`` each; None: too few of them."""
        parts = _folds(recordings, layout, scale, offset)
        if parts is None:
            return None
        return _Fit(parts, layout, tolerance).model()

    def check(self, layout: SensorLayout) -> None:
        """Raise ValueError unless this is a model of ``layout``."""
        outputs = np.concatenate([mean.outputs for mean in self.means])
        if not np.array_equal(np.sort(outputs), np.flatnonzero(layout.present)):
            raise ValueError(f"the proof of life does not cover each cell of {layout} exactly once")
        shape = ((len(self.predicted) + 1) * (len(_BESIDE) + 1), len(self.levels) + 1)
        if self.table.shape not in ((1, *shape), (layout.n_cells, *shape)):
            raise ValueError(f"expected a table [1 or {layout.n_cells}, {shape[0]}, {shape[1]}]")
        if self.reached.shape != (len(FAULTS), layout.n_cells) or self.errs.shape != (layout.n_cells,):
            raise ValueError(f"expected reached and errs of {layout}")
        if not (self.unit > 0 and 0 < self.equal <= 1 and ((self.errs > 0) & (self.errs < 1)).all()):
            raise ValueError("expected a positive unit, and probabilities between 0 and 1")

    def expected(self, loads: Array, known: Mask) -> Floats:
        """Return the expected root loads ``[n, D]``, given those of the ``known`` cells (bool ``[D]``)."""
        found = np.zeros(loads.shape)
        for mean in self.means:
            found[:, mean.outputs] = mean.predict(loads, known)
        return found

    def contexts(self, loads: Array, known: Mask, beside: Cells) -> NDArray[np.intp]:
        """Return what the others say of each cell, as a number from 0 to M - 1, int ``[n, D]``."""
        level = np.searchsorted(self.predicted, self.expected(loads, known), side="right")
        return level * (len(_BESIDE) + 1) + _loaded_beside(loads, known, beside)

    def factors(self, units: int) -> Floats:
        """Return the factors ``[5, D]`` on the evidence in a log of so many units: healthy cells stay below the limit.

        The evidence against a healthy cell that the model predicts badly grows with the length of the log.
        """
        reached = np.maximum(self.reached, 0.0) * max(1.0, units / self.units)
        factors: Floats = self.counts * _THRESHOLD / np.maximum(_THRESHOLD, MARGIN * reached)
        return factors

    @cached_property
    def probabilities(self) -> Floats:
        """P(observed level | context) of each healthy cell, shape of ``table``."""
        return np.exp(self.table.astype(np.float64))

    def otherwise(self, gain: float, offset: float, cells: Cells) -> Floats:
        """Return P(observed level | context) of cells with a gain and an offset (of full scale), ``[cells, M, K]``."""
        middle = (np.append(self.levels, 1.0) + np.append(0.0, self.levels)) / 2
        middle[0] = 0.0
        load = np.clip(gain * middle**2 + offset, 0.0, 1.0)
        becomes = np.searchsorted(self.levels, np.sqrt(load), side="right")
        table = self.probabilities[self.of_cell(cells)]
        found = np.full(table.shape, _GUESS / len(middle))
        for before, after in enumerate(becomes.tolist()):
            found[:, :, after] += (1 - _GUESS) * table[:, :, before]
        return found

    def of_cell(self, cells: Cells) -> Cells:
        """Return where the table of each cell is."""
        return cells % len(self.table)


@dataclass(frozen=True)
class Life:
    """Evidence of each cell, ``[D]``.

    Attributes:
        evidence: float, log likelihood ratio of any of the faults : healthy.
        kind: int, number of the likeliest of the ``FAULTS``.
        shown: bool, the cell depends on the others as a healthy cell does.
        refuted: bool, cells that must not predict others.
        certain: bool, those of them that are faulty.
        lag: int, pieces by which the cell is late, if it is.
        source: int, the cell that it repeats, if it does.
        share: float, of the tested units in which a cell that comes and goes was dead.
        since: int, number of the first frame of the first unit against the cell.
        against: bool ``[units, D]``, units against the cell.
        begins: int ``[units]``, number of the first frame of each.
        highest: float, highest reading of a piece, in the layout's unit.
        floats: bool, certain cells that do not follow the others at all, not with a lower gain either.
        contradicting: share of the tested cells that are refuted, where it is so large that all are disturbed and none
            is faulty; else 0.
    """

    evidence: Floats
    kind: NDArray[np.intp]
    shown: Mask
    refuted: Mask
    certain: Mask
    lag: NDArray[np.intp]
    source: NDArray[np.intp]
    share: Floats
    since: NDArray[np.intp]
    against: Mask
    begins: NDArray[np.intp]
    highest: Floats
    floats: Mask
    contradicting: float

    @classmethod
    def unknown(cls, n_cells: int) -> Life:
        """Return the evidence of a log that tells nothing."""
        nothing, no = np.zeros(n_cells), np.zeros(n_cells, bool)
        zero = np.zeros(n_cells, np.intp)
        return cls(nothing, zero, no, no, no, zero, zero, nothing, zero, no[None], zero[:1], nothing, no, 0.0)

    @property
    def units(self) -> NDArray[np.intp]:
        """Number of units against each cell, int ``[D]``."""
        found: NDArray[np.intp] = self.against.sum(axis=0)
        return found

    def mostly_before(self, frame: NDArray[np.intp]) -> Mask:
        """Return the cells that most units against them contradict before a ``frame`` (int ``[D]``), bool ``[D]``."""
        before = (self.against & (self.begins[:, None] < frame)).sum(axis=0)
        found: Mask = before > MAJORITY * self.units
        return found

    @classmethod
    def assumed(cls, n_cells: int) -> Life:
        """Return the evidence where the reference tells nothing: a cell that moves counts as alive."""
        return replace(cls.unknown(n_cells), shown=np.ones(n_cells, bool))


class LifeTest:
    """The iterated test; each :meth:`step` takes a few milliseconds.

    Args:
        record: the log.
        model: of healthy cells.
        layout: the array.
        eligible: bool ``[D]``, cells that are present and not explained otherwise.
        constant: bool ``[D]``, cells that look stuck now, and predict no others; None: none.

    Attributes:
        result: None before the last step.
        of_faults: float ``[5, D]``, evidence of each of the ``FAULTS`` before the factors.
    """

    def __init__(
        self, record: LifeRecord, model: LifeModel, layout: SensorLayout, eligible: Mask, constant: Mask | None = None
    ) -> None:
        self.result: Life | None = None
        self._layout = layout
        self._model = model
        self._eligible = eligible
        self._constant = np.zeros(layout.n_cells, bool) if constant is None else constant
        self._known = eligible & ~self._constant
        self.of_faults = np.zeros((len(FAULTS), layout.n_cells))
        if len(record.number) < 2:
            self.result = Life.unknown(layout.n_cells)
            return
        self._record = record
        self._log = _Log.of(record.loads, record.means, record.segment, model)
        self._factors = model.factors(self.units)
        self._work = self._steps()

    def step(self) -> bool:
        """Do some work; return whether there is a result."""
        if self.result is None:
            next(self._work, None)
        return self.result is not None

    def finish(self) -> Life:
        """Do all work that is left, and return the result."""
        while self.result is None:
            self.step()
        return self.result

    def found(self) -> Floats:
        """Do all work that is left, and return the evidence of each fault before the factors, ``[5, D]``."""
        self.finish()
        return self.of_faults

    def given(self, known: Mask) -> Floats:
        """Return the same where only the ``known`` cells (bool ``[D]``) predict others."""
        return _full_evidence(self._log, self._model, known, self._layout.beside, self._record.means)[0]

    @property
    def units(self) -> int:
        """Number of units of the log."""
        return len(self._log.begins)

    def _steps(self) -> Iterator[None]:
        log, model = self._log, self._model
        beside = self._layout.beside
        refuted = np.zeros(len(self._eligible), np.intp)  # how often each cell was
        for _ in range(_ROUNDS):
            evidence, plain = self._fast(self._known)
            yield
            bad = self._eligible & (evidence > _REFUTED)
            around = np.where((beside >= 0) & self._known[beside], plain[beside], -np.inf)
            worst = plain.max(initial=-np.inf, where=bad & self._known)
            gone = bad & self._known & (plain >= around.max(axis=1, initial=-np.inf)) & (plain > MAJORITY * worst)
            refuted += gone
            # A cell that the others beside it had made look wrong comes back, but once only.
            allowed = self._eligible & ~self._constant
            known = self._known & ~gone | (allowed & ~bad & (refuted < 2))
            if (known == self._known).all():
                break
            self._known = known
        of_faults, details = _full_evidence(log, model, self._known, beside, self._record.means)
        yield
        self.of_faults = of_faults
        self.result = _concluded(of_faults, details, log, model, self._eligible, self._constant)

    def _fast(self, known: Mask) -> tuple[Floats, Floats]:
        """Return the highest evidence of two faults, which all others are near, and the same without factors."""
        log = self._log
        healthy, _ = log.healthy(self._model, known, self._layout.beside)
        independent = log.counted(log.own - healthy, self._model.errs).sum(axis=0)
        intermittent, _ = _forward(log.counted(log.at_rest - healthy, self._model.errs))
        evidence = np.maximum(independent * self._factors[0], intermittent * self._factors[1])
        return evidence, np.maximum(independent, intermittent)


@dataclass(frozen=True)
class _Log:
    """Levels of a log.

    Attributes:
        loads: mean root loads ``[n, D]``.
        read: bool ``[n, D]``, where a cell delivered readings.
        level: int ``[n, D]``.
        unit: int ``[n]``, ascending from 0.
        begins: int ``[units]``, number of the first segment of each.
        weight: float ``[units]``, 1 / (1 + k) of a unit with k others of the same loads: a contact that is held is one.
        own: float ``[n, D]``, log frequency of the level in the other pieces of the cell.
        at_rest: float ``[n, D]``, log probability of the level of a cell without load.
        cells: int ``[D]``, the cells.
    """

    loads: Array
    read: Mask
    level: NDArray[np.intp]
    unit: NDArray[np.intp]
    begins: NDArray[np.intp]
    weight: Floats
    own: Floats
    at_rest: Floats
    cells: Cells

    @classmethod
    def of(cls, loads: Array, readings: Array, segment: NDArray[np.intp], model: LifeModel) -> _Log:
        level = np.searchsorted(model.levels, loads, side="right")
        n_levels = len(model.levels) + 1
        n, d = level.shape
        counts = np.bincount((level + n_levels * np.arange(d)).ravel(), minlength=n_levels * d).reshape(d, n_levels)
        others = counts[np.arange(d), level].astype(np.float64) - 1
        own = np.log((others + 1 / n_levels) / n)
        at_rest = np.log(np.where(level == 0, _AT_REST, (1 - _AT_REST) / (n_levels - 1)))
        numbers = segment // model.unit
        begins = np.flatnonzero(np.diff(numbers, prepend=-1))
        unit = np.cumsum(np.diff(numbers, prepend=-1) != 0) - 1
        means = np.add.reduceat(loads, begins, axis=0) / np.diff(np.append(begins, n))[:, None]
        return cls(
            loads, np.isfinite(readings), level, unit, segment[begins], _novelty(means), own, at_rest, np.arange(d)
        )

    def on(self, cells: Cells) -> _Log:
        """Return the log of some of the cells."""
        return replace(
            self,
            loads=self.loads[:, cells],
            read=self.read[:, cells],
            level=self.level[:, cells],
            own=self.own[:, cells],
            at_rest=self.at_rest[:, cells],
            cells=self.cells[cells],
        )

    def healthy(self, model: LifeModel, known: Mask, beside: Cells) -> tuple[Floats, NDArray[np.intp]]:
        """Return log P(level | healthy) and the context, ``[n, D]`` each."""
        context = model.contexts(self.loads, known, beside)
        return self.given(model.probabilities[model.of_cell(self.cells)], context, self.level), context

    def given(self, table: Floats, context: NDArray[np.intp], level: NDArray[np.intp]) -> Floats:
        """Return log P(level | context) of cells whose levels are as frequent as they are in the log.

        Where contacts hardly change, a level is likely because the cell had it before, whatever the others say. The
        table of healthy cells is tilted, P(l | c) f(l) / sum over l' of P(l' | c) f(l'), with f the frequency in the
        log over the expected one, within limits.

        Args:
            table: P(level | context) of each cell, ``[D, M, K]``.
            context, level: int ``[n, D]``.
        """
        d = level.shape[1]
        m, k = table.shape[1:]
        contexts = np.bincount((context + m * np.arange(d)).ravel(), minlength=m * d).reshape(d, m)
        levels = np.bincount((level + k * np.arange(d)).ravel(), minlength=k * d).reshape(d, k)
        tilt = np.ones((d, k))
        for _ in range(_FITS):
            total = (table @ tilt[:, :, None])[:, :, 0]
            expected = tilt * ((contexts / total)[:, None, :] @ table)[:, 0]
            tilt = np.clip(tilt * (levels + _TILTED) / (expected + _TILTED), 1 / _MOST_TILT, _MOST_TILT)
        total = table @ tilt[:, :, None]
        given = np.log(table * tilt[:, None, :] / total)
        found: Floats = given[np.arange(d), context, level]
        return found

    def counted(self, ratio: Floats, errs: Floats) -> Floats:
        """Return the evidence of each unit, ``[units, D]``, of the log ratio of each piece, ``[n, D]``."""
        found: Floats = _robust(self.by_unit(ratio), errs) * self.weight[:, None]
        return found

    def by_unit(self, ratio: Floats) -> Floats:
        """Return the sums over the pieces of each unit that were read, ``[units, D]``."""
        begins = np.flatnonzero(np.diff(self.unit, prepend=-1))
        summed: Floats = np.add.reduceat(np.where(self.read, ratio, 0.0), begins, axis=0)
        return summed


def _novelty(means: NDArray[np.floating]) -> Floats:
    """Return the weight of each unit, ``[units]``, of the mean root loads in it, ``[units, D]``.

    Two units have the same loads if these differ by less than a tenth, over the cells whose loads change at all.
    """
    cells = spread(np.flatnonzero(np.ptp(means, axis=0) > _UNLOADED))
    changing = means[:, cells]
    size = changing.sum(axis=1)
    repeats = np.zeros(len(means))
    for u, one in enumerate(changing):
        differ = np.abs(changing - one).sum(axis=1)
        repeats[u] = (differ <= _THE_SAME * np.maximum(size, size[u])).sum() - 1
    return 1 / (1 + repeats)


def _robust(ratio: Floats, errs: Floats | float) -> Floats:
    """Return the log ratio of two models that both err in a share of the units, of their log ``ratio``."""
    other, most = np.log(errs), np.log1p(-errs)
    bounded: Floats = np.logaddexp(most + ratio, other) - np.logaddexp(most, other + ratio)
    return bounded


def _forward(dead: Floats) -> tuple[Floats, Floats]:
    """Return the log evidence ``[D]`` of a cell that dies and recovers, and P(dead) in each unit ``[units, D]``.

    Args:
        dead: float ``[units, D]``, log ratio dead : healthy.
    """
    alive, gone = np.zeros(dead.shape[1]), np.full(dead.shape[1], np.log(_FAILS))
    filtered = np.empty(dead.shape)
    for u, ratio in enumerate(dead):
        stays = np.logaddexp(alive + np.log(1 - _FAILS), gone + np.log(_RECOVERS))
        gone = np.logaddexp(alive + np.log(_FAILS), gone + np.log(1 - _RECOVERS)) + ratio
        alive = stays
        filtered[u] = gone - np.logaddexp(alive, gone)
    return np.logaddexp(alive, gone), np.exp(filtered)


def _from_some_unit(dead: Floats) -> Floats:
    """Return the log evidence ``[D]`` of a cell that is dead from a unit on, half of them from the first."""
    before = np.cumsum(dead, axis=0)
    later = logsumexp(before[-1] - before, axis=0) - np.log(len(dead))
    found: Floats = np.logaddexp(before[-1], later) - np.log(2)
    return found


def _up_to_some_unit(dead: Floats) -> Floats:
    """Return the log evidence ``[D]`` of a cell that was dead up to a unit, and works again; see _forward."""
    before = np.cumsum(dead, axis=0)
    found: Floats = logsumexp(before, axis=0) - np.log(len(dead)) + np.log(_FAILS * _RECOVERS)
    return found


def _since_it_works(dead: Floats) -> Floats:
    """Return the log ratio dead : healthy ``[D]`` after the unit up to which a cell was most likely dead, if any."""
    before = np.cumsum(dead, axis=0)
    found: Floats = before[-1] - np.maximum(before.max(axis=0), 0.0)
    return found


@dataclass(frozen=True)
class _Details:
    """What is known of each fault, ``[D]`` each, see :class:`Life`."""

    lag: NDArray[np.intp]
    source: NDArray[np.intp]
    share: Floats
    against: Mask  # [units, D], units against the cell
    highest: Floats
    now: Floats  # log ratio of dead : healthy since the cell, if it ever was dead, works again
    predicted: NDArray[np.intp]  # [n, D], context of each piece
    healthy: Floats  # [n, D], log P(level | healthy)


def _full_evidence(log: _Log, model: LifeModel, known: Mask, beside: Cells, readings: Array) -> tuple[Floats, _Details]:
    """Return the evidence of each fault, without factors, ``[5, D]``, and what is known of them."""
    cells = model.of_cell(np.arange(log.level.shape[1]))
    found = np.zeros((len(FAULTS), len(cells)))
    found[3], source = _copies(log, model, known, beside, readings)
    healthy, predicted = log.healthy(model, known & (found[3] <= _REFUTED), beside)

    def summed(fault: Floats) -> Floats:
        evidence: Floats = log.counted(fault - healthy, model.errs).sum(axis=0)
        return evidence

    independent = log.counted(log.own - healthy, model.errs)
    against = log.by_unit(log.own - healthy) > _AGAINST
    dead = log.counted(log.at_rest - healthy, model.errs)
    # What was dead once, and works again, is no fault any more.
    now = _since_it_works(independent)
    ever = independent.sum(axis=0)
    found[0] = np.where(now < -_THRESHOLD, np.minimum(ever, now), ever)
    found[1], filtered = _forward(dead)
    found[1] -= np.logaddexp(0.0, _up_to_some_unit(dead))
    tested = np.abs(dead) > TESTED
    share = ((filtered > MAJORITY) & tested).sum(axis=0) / np.maximum(tested.sum(axis=0), 1)
    table = model.probabilities[cells]
    lagged = []
    for lag in _LAGS:
        late = healthy.copy()
        late[lag:] = log.given(table, predicted[:-lag], log.level[lag:])
        lagged.append(summed(late))
    found[2] = logsumexp(lagged, axis=0) - np.log(len(lagged))
    plain = model.table[cells, predicted, log.level].astype(np.float64)
    found[4] = log.counted(_clamped(log, model, plain, predicted, readings) - plain, model.errs).sum(axis=0)
    against |= dead > _AGAINST
    lag = np.array(_LAGS)[np.argmax(lagged, axis=0)]
    highest = np.fmax.reduce(readings).astype(np.float64)
    return found, _Details(lag, source, share, against, highest, now, predicted, healthy)


def _following(log: _Log, model: LifeModel, details: _Details, cells: Cells) -> Floats:
    """Return the log ratio follows the others with another gain or offset : not at all, of some cells, ``[cells]``."""
    own = log.on(cells)
    healthy = details.healthy[:, cells]
    errs = model.errs[cells]
    independent = _from_some_unit(own.counted(own.own - healthy, errs))
    evidence = []
    for gain, offset in _OTHERWISE:
        changed = own.given(model.otherwise(gain, offset, cells), details.predicted[:, cells], own.level)
        evidence.append(_from_some_unit(own.counted(changed - healthy, errs)))
    found: Floats = np.max(evidence, axis=0) - independent
    return found


def _clamped(log: _Log, model: LifeModel, healthy: Floats, context: NDArray[np.intp], readings: Array) -> Floats:
    """Return log P(level | clamped), ``[n, D]``: any higher load explains the highest reading of a cell."""
    limit = readings.max(axis=0)
    piece, cell = np.nonzero((readings >= limit - model.tolerance) & (log.level > 0))
    of_level = model.table[model.of_cell(cell), context[piece, cell]]
    more = np.arange(of_level.shape[1]) >= log.level[piece, cell][:, None]
    clamped = healthy.copy()
    clamped[piece, cell] = logsumexp(np.where(more, of_level, -np.inf), axis=1)
    return clamped


def _copies(
    log: _Log, model: LifeModel, known: Mask, beside: Cells, readings: Array
) -> tuple[Floats, NDArray[np.intp]]:
    """Return the evidence ``[D]`` that a cell repeats one beside it, and which, int ``[D]``.

    Either cell of two that read the same may be the copy: the one that fits worse to the others, without both.
    """
    d = readings.shape[1]
    evidence = np.full((beside.shape[1], d), -np.inf)
    loaded = log.level > 0
    same = np.log(1 / model.equal)
    for k, other in enumerate(beside.T):
        either = loaded & loaded[:, other] & (other >= 0)
        equal = readings == readings[:, other]
        some = log.by_unit(either.astype(np.float64)) > 0
        differs = log.by_unit((either & ~equal).astype(np.float64)) > 0
        ratio = np.where(some, np.where(differs, np.log(model.errs), same), 0.0)
        evidence[k] = np.where(other >= 0, _robust(ratio, model.errs).sum(axis=0), -np.inf)
    best = evidence.argmax(axis=0)
    source = beside[np.arange(d), best]
    total = np.maximum(evidence[best, np.arange(d)] - np.log(beside.shape[1]), -_CERTAINLY_NOT)
    pairs = np.flatnonzero(total > _REFUTED)
    if len(pairs):
        alone = known.copy()
        alone[pairs] = False
        alone[source[pairs]] = False
        healthy, _ = log.healthy(model, alone, beside)
        fits = log.counted(healthy - log.own, model.errs).sum(axis=0)
        worse = fits[source[pairs]] - fits[pairs]
        copies, other = total[pairs] + _log_expit(worse), total[pairs] + _log_expit(-worse)
        total[pairs] = copies - np.logaddexp(0.0, other)
    return total, source


def _log_expit(x: Floats) -> Floats:
    found: Floats = -np.logaddexp(0.0, -x)
    return found


def _concluded(
    of_faults: Floats, details: _Details, log: _Log, model: LifeModel, eligible: Mask, constant: Mask
) -> Life:
    """Return the result."""
    scaled = of_faults * model.factors(len(log.begins))
    evidence = np.where(eligible, logsumexp(scaled + np.log(_SHARES)[:, None], axis=0), 0.0)
    shown = eligible & (details.now < -_SHOWN) & (of_faults[0] < 0)
    refuted = eligible & (evidence > _REFUTED)
    shown &= ~refuted
    certain = refuted & (evidence > _THRESHOLD)
    # A load that lies still, another specimen, a weak cell: it reads otherwise, but it follows the others.
    independent = refuted & (of_faults[0] >= of_faults.max(axis=0))
    cells = np.flatnonzero(independent)
    if len(cells):
        better = _following(log, model, details, cells)
        follows = better > _REFUTED
        evidence[cells[follows]] = np.minimum(evidence[cells[follows]], 0.0)
        independent[cells[better > 0]] = False
    tested = shown | refuted
    contradicting = float((refuted & ~constant).sum() / max(int((tested & ~constant).sum()), 1))
    if contradicting > _DISTURBED and (refuted & ~constant).sum() >= FEWEST:
        evidence = np.minimum(evidence, 0.0)
        shown = shown & ~refuted
        refuted = np.zeros_like(refuted)
    else:
        contradicting = 0.0
    floats = certain & independent
    begins = log.begins[details.against.argmax(axis=0)] * SEGMENT
    return Life(
        evidence=evidence,
        kind=of_faults.argmax(axis=0),
        shown=shown,
        refuted=refuted,
        certain=certain,
        lag=details.lag,
        source=details.source,
        share=details.share,
        since=np.where(details.against[0], 0, begins),
        against=details.against,
        begins=log.begins * SEGMENT,
        highest=details.highest,
        floats=floats,
        contradicting=contradicting,
    )


@dataclass(frozen=True)
class _Fold:
    """Pieces of some reference recordings: loads and readings ``[n, D]``, segment numbers int ``[n]``."""

    loads: Array
    readings: Array
    segment: NDArray[np.intp]


def _folds(
    recordings: Sequence[Floats], layout: SensorLayout, scale: Scale, offset: ReferenceOffset
) -> list[_Fold] | None:
    """Return the pieces of the reference in folds of whole recordings, with offsets tracked as in a log."""
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
                parts.append(_Fold(record.loads, record.means, record.segment))
        if not parts:
            return None
        folds.append(_joined(parts))
    return folds if min(len(fold.loads) for fold in folds) >= FEWEST else None


def _joined(parts: Sequence[_Fold]) -> _Fold:
    return _Fold(
        np.concatenate([part.loads for part in parts]),
        np.concatenate([part.readings for part in parts]),
        np.concatenate([part.segment for part in parts]),
    )


def _recorded(log: Floats, begin: int, present: Mask, scale: Scale, offset: ReferenceOffset) -> tuple[LifeRecord, int]:
    """Return the record of a log, of any length, and the number of the segment after it."""
    tracked = OffsetTracker.begin(log.shape[1])
    root: list[Array] = []
    readings: list[Array] = []
    number: list[int] = []
    for first in range(0, len(log), SEGMENT):
        frames = log[first : first + SEGMENT]
        tracked = tracked.extend(frames, scale, present, offset)
        loads = tracked.on(scale).root_load(tracked.off(frames))
        one = LifeRecord().extend(np.where(present, loads, np.float32(0)), frames, begin + first // SEGMENT)
        root += one.root
        readings += one.readings
        number += one.number
    return LifeRecord(tuple(root), tuple(readings), tuple(number)), begin + len(log) // SEGMENT + 1


class _Fit:
    """Fits the model by cross-fitting: tables, units and factors from folds that the predictions were not fitted on."""

    def __init__(self, folds: list[_Fold], layout: SensorLayout, tolerance: float) -> None:
        self._folds = folds
        self._layout = layout
        self._tolerance = tolerance
        self._present = layout.present.ravel()
        self._rng = np.random.default_rng(0)
        every = _joined(folds)
        self._levels = _edges(every.loads[:, self._present], _LEVELS)
        self._full = self._means(every.loads)
        self._used = (every.loads > _UNLOADED).sum(axis=0) >= FEWEST
        self._held_out = [
            self._means(_joined([other for j, other in enumerate(folds) if j != k]).loads) for k in range(len(folds))
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
        blank = LifeModel(
            self._full, self._levels, np.zeros(0), np.zeros((0, 0, 0), np.float32), self._equal(), 1,
            np.full(len(self._present), 0.05), self._tolerance, np.zeros((len(FAULTS), len(self._present))), 1, 1.0,
        )  # fmt: skip
        seen = [self._expected(replace(blank, means=means), fold) for means, fold in self._cross()]
        predicted = self._predicted_edges([expected for expected, _ in seen])
        counts = np.stack([self._counts(fold, *of, predicted) for fold, of in zip(self._folds, seen, strict=True)])
        total = counts.sum(axis=0)
        shrinkage = self._shrinkage(counts, total)
        fitted = replace(blank, predicted=predicted, table=_table(total, shrinkage))
        held_out = [
            replace(fitted, means=means, table=_table(total - counts[k], shrinkage))
            for k, (means, _) in enumerate(self._cross())
        ]
        unit = self._unit(held_out)
        errs, of_others = self._errs([replace(of, unit=unit) for of in held_out])
        held_out = [replace(of, unit=unit, errs=own) for of, own in zip(held_out, of_others, strict=True)]
        # First with the dead cells known: else healthy cells would be taken for dead ones, and mislead the others.
        reached, units = self._reached(held_out, informed=True)
        held_out = [replace(of, reached=reached, units=units) for of in held_out]
        reached = np.maximum(reached, self._reached(held_out, informed=False)[0])
        of_all = sum(len(np.unique(fold.segment // unit)) for fold in self._folds)
        # Few units contain few unusual contacts.
        counted = 1 - _MOST_DISCOUNT / (1 + of_all / _HALF_DISCOUNT)
        return replace(fitted, unit=unit, errs=errs, reached=reached, units=units, counts=counted)

    def _cross(self) -> list[tuple[tuple[ConditionalMean, ...], _Fold]]:
        return list(zip(self._held_out, self._folds, strict=True))

    def _equal(self) -> float:
        """Return how often a healthy cell reads the same as one beside it where both are loaded."""
        equal = both = 1
        other = self._layout.beside[:, 4]
        for fold in self._folds:
            loaded = (fold.loads > _UNLOADED) & (fold.loads[:, other] > _UNLOADED) & (other >= 0)
            both += int(loaded.sum())
            equal += int((loaded & (fold.readings == fold.readings[:, other])).sum())
        return equal / both

    def _expected(self, model: LifeModel, fold: _Fold) -> tuple[Floats, NDArray[np.intp]]:
        """Return predictions in which some cells are unknown, as in a log with dead ones, and levels of loads beside.

        Both are ``[n, D]``.
        """
        found = np.empty(fold.loads.shape)
        near = np.empty(fold.loads.shape, np.intp)
        parts = np.array_split(np.arange(len(fold.loads)), FOLDS)
        for part, left_out in zip(parts, np.linspace(0.0, 0.15, len(parts)), strict=True):
            known = self._present & (self._rng.random(len(self._present)) >= left_out)
            found[part] = model.expected(fold.loads[part], known)
            near[part] = _loaded_beside(fold.loads[part], known, self._layout.beside)
        return found, near

    def _predicted_edges(self, expected: list[Floats]) -> Floats:
        loaded = [
            of[:, self._present][fold.loads[:, self._present] > _UNLOADED]
            for of, fold in zip(expected, self._folds, strict=True)
        ]
        every = np.concatenate([of[:, self._present].ravel() for of in expected])
        share = np.linspace(0, 1, _PREDICTED // 2 + 1)[1:-1]
        edges: Floats = np.unique(
            np.concatenate([np.quantile(every, share), np.quantile(np.concatenate(loaded), share)])
        )
        return edges

    def _counts(self, fold: _Fold, expected: Floats, near: NDArray[np.intp], predicted: Floats) -> Floats:
        """Return how often each cell had each level in each context, ``[D, M, K]``; ``[1, M, K]`` of a large array."""
        around = len(_BESIDE) + 1
        m, k, d = (len(predicted) + 1) * around, len(self._levels) + 1, len(self._present)
        context = np.searchsorted(predicted, expected, side="right") * around + near
        level = np.searchsorted(self._levels, fold.loads, side="right")
        tables = d if self._present.sum() <= MOST_CELLS else 1
        index = (np.arange(d) % tables * m + context) * k + level
        counted = np.bincount(index[:, self._present].ravel(), minlength=tables * m * k)
        return counted.astype(np.float64).reshape(tables, m, k)

    def _shrinkage(self, counts: Floats, total: Floats) -> Floats:
        """Return the pseudo-count of each cell, ``[tables, 1, 1]``: the likeliest for folds that it has not seen."""
        likelihood = []
        for shrinkage in _SHRINKAGES:
            each = [(of * _table(total - of, shrinkage)).sum(axis=(1, 2)) for of in counts]
            likelihood.append(np.sum(each, axis=0))
        best = np.argmax(likelihood, axis=0)
        found: Floats = np.asarray(_SHRINKAGES)[best][:, None, None]
        return found

    def _unit(self, held_out: list[LifeModel]) -> int:
        """Return the segments of a unit: successive units of healthy cells are hardly correlated."""
        unit = 1
        while True:
            products = variance = 0.0
            fewest = np.inf
            for model, fold in zip(held_out, self._folds, strict=True):
                log = _Log.of(fold.loads, fold.readings, fold.segment, replace(model, unit=unit))
                healthy, _ = log.healthy(model, self._present, self._layout.beside)
                ratio = _robust(log.by_unit(log.own - healthy), model.errs)
                ratio = ratio - ratio.mean(axis=0)
                products += float((ratio[1:] * ratio[:-1]).sum())
                variance += float((ratio**2).sum())
                fewest = min(fewest, len(ratio))
            if products <= _CORRELATED * variance or fewest < 4 * FEWEST:
                return unit
            unit *= 2

    def _errs(self, held_out: list[LifeModel]) -> tuple[Floats, list[Floats]]:
        """Return the share of units in which each healthy cell contradicts, ``[D]``, and the same without each fold.

        The share of all cells is the likeliest of a grid; that of a cell has it as prior.
        """
        ratios = []
        for model, fold in zip(held_out, self._folds, strict=True):
            log = _Log.of(fold.loads, fold.readings, fold.segment, model)
            healthy, _ = log.healthy(model, self._present, self._layout.beside)
            ratios.append(log.by_unit(log.own - healthy))
        every = np.concatenate(ratios)[:, self._present].ravel()
        usual = max(_CONTAMINATIONS, key=lambda e: float(np.logaddexp(np.log1p(-e), np.log(e) + every).sum()))
        erred = np.stack([expit(ratio + np.log(usual / (1 - usual))).sum(axis=0) for ratio in ratios])
        units = np.array([len(ratio) for ratio in ratios])[:, None]

        def share(erred: Floats, units: Floats) -> Floats:
            found: Floats = (erred.sum(axis=0) + usual * _OWN_ERRS) / (units.sum() + _OWN_ERRS)
            # The rule of three: what was never seen in n units.
            found = np.clip(found, max(usual / 2, 3 / units.sum()), MAJORITY / 2)
            return np.where(self._used, found, MAJORITY / 2)  # what the reference hardly loaded is hardly known

        without = [share(np.delete(erred, k, axis=0), np.delete(units, k, axis=0)) for k in range(len(ratios))]
        return share(erred, units), without

    def _reached(self, held_out: list[LifeModel], *, informed: bool) -> tuple[Floats, int]:
        """Return the evidence ``[5, D]`` that healthy cells reach in logs with dead ones, and the units of these logs.

        Cells where contacts end are predicted worse than others: the limit is the highest evidence of the cell itself,
        and at least what all but a few of the cells reach.

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
                loads = fold.loads.copy()
                dead = self._rng.choice(cells, round(dead_share * len(cells)), replace=False)
                for cell in dead.tolist():
                    loads[:, cell] = self._rng.permutation(loads[:, self._rng.choice(cells)])
                healthy = np.setdiff1d(cells, dead)
                for record in _logs(_Fold(loads, fold.readings, fold.segment)):
                    test = LifeTest(record, model, self._layout, self._present)
                    known = np.isin(np.arange(len(self._present)), healthy)
                    found = (test.given(known) if informed else test.found())[:, healthy]
                    reached[:, healthy] = np.maximum(reached[:, healthy], found)
                    usual.append(found)
                    units.append(test.units)
        most = np.quantile(np.concatenate(usual, axis=1), _HEALTHY, axis=1)
        return np.maximum(reached, most[:, None]), int(np.median(units))


def _logs(fold: _Fold) -> list[LifeRecord]:
    """Return the pieces as records of logs, each of as many segments as are kept of a log."""
    numbers, begins = np.unique(fold.segment, return_index=True)
    loads, readings = np.split(fold.loads, begins[1:]), np.split(fold.readings, begins[1:])
    return [
        LifeRecord(
            tuple(loads[first : first + KEPT]), tuple(readings[first : first + KEPT]),
            tuple(numbers[first : first + KEPT].tolist()),
        )
        for first in range(0, len(numbers), KEPT)
    ]  # fmt: skip


def _edges(values: Array, n: int) -> Floats:
    """Return limits of n levels: of loads that are none, and equally many of the others."""
    loaded = values[values > _UNLOADED]
    if not len(loaded):
        return np.array([_UNLOADED, 0.5])
    return np.unique(np.append(_UNLOADED, np.quantile(loaded, np.linspace(0, 1, n)[1:-1]))).astype(np.float64)


def _table(counts: Floats, shrinkage: Floats | float) -> Array:
    """Return log P(level | prediction) of each cell, ``[D, M, K]``, shrunk towards that of all cells."""
    pooled = counts.sum(axis=0)
    usual = pooled.sum(axis=0) / pooled.sum()
    shared = (pooled + usual) / (pooled.sum(axis=1, keepdims=True) + 1)
    shared = (1 - _GUESS) * shared + _GUESS / counts.shape[2]
    table = (counts + shrinkage * shared) / (counts.sum(axis=2, keepdims=True) + shrinkage)
    log_table: Array = np.log(table).astype(np.float32)
    return log_table
