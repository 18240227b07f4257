"""Lines that fail now and then: are their cells loaded as those off them say?

The cells of a line fail together and predict each other: one by one they look healthy. A line is a
cell one level up. It rests where the mean load of its cells is none, and a table counts

    P(rests | expected load, share of the cells beside it that are loaded, rested a piece ago)

on the cross-fitted reference. The expected load is what the cells off the line say. A line that
fails comes and goes, or is away where more than some load is expected. Contacts of one recording
are alike, and healthy lines are odd in some recordings: either side errs in a share of those, so
that a fault shows in several. The worst line is left out of what the others say, and those are
tested again.

That nothing touches a pad is no surprise: cells of others tell of no line. Of one that is all of
its pad nobody else tells: they make its cells doubtful, and prove nothing.

Not detected: a line with fewer than three cells that move, or one of which carries most of its
load; one without others on its pad; one whose cells keep a load or another rest while it is away.
A line that breaks once and for all is found by the values that its cells hold.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logsumexp

from diagnostics.layout import SensorLayout
from diagnostics.model.conditional_mean import ConditionalMean
from diagnostics.model.observed import Observed
from diagnostics.model.over_time import Units, coming_and_going, for_good, within_limit
from diagnostics.model.record import Array, Cells, Mask, Record, since_begin
from diagnostics.model.symbols import NOTHING
from diagnostics.preprocessing.levels import CERTAIN_RATIO, DOUBTED, EXPECTED_LATE
from diagnostics.preprocessing.levels import FEWEST as FEWEST_LOADED
from diagnostics.wiring import LineKind

FEWEST = 3  # cells that tell of a line
_KINDS: tuple[LineKind, ...] = ("row", "column", "converter", "position", "bus", "group")
_MOSTLY = 0.5  # of the load of a line
_BLOCK = 8  # units of a long recording that count as one
_LEVELS = 16  # of the expected load
_BESIDE = (0.01, 0.34, 0.67, 0.99)  # shares of the cells beside it, between levels
_BEFORE = 3  # a piece ago: unknown, at rest, loaded
_ALL_LINES = 50.0  # pieces of all lines that weigh on the table of one
_GUESS = 0.005  # of either state, in any context
_AWAY = 0.95  # share of the pieces in which a line that is away rests
_LIMITS = 4  # of the load beyond which a line opens
_ODD = 3.0  # evidence of a recording with which a healthy line is odd
_ODD_RECORDINGS = 50.0  # of all lines, which weigh on the share of one
_SEEN = 3.0  # over the recordings: the share of what was never seen in them
_RARELY = 1e-3
_OFTEN = 0.2
_RARE = float(np.log(EXPECTED_LATE))
_PRIOR = _RARE - CERTAIN_RATIO / 2  # and there may be contacts unlike the reference's
PROVEN = float(np.log(9.0) - _PRIOR)  # evidence: at odds of 9
_MOST = 4  # lines that fail in a log: where more do, the whole array is disturbed
_TELL = 0.5  # share of the cells beside a line that are known
_SPEAKS = 0.5  # log ratio of a piece that tells of a line
_PARTS = 8  # of the reference, with other cells and lines left out
_LEFT_OUT = 0.15  # of the cells, at most
_AGAINST = 1.0
_OUTLYING = 1.645 * 1.48  # median absolute deviations: one-sided, 5 %
_PULLED = float(np.log(2 / 3)) / 2  # of the root load
NO_HALF: Cells = np.zeros(0, np.intp)

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Failing:
    """The lines that fail in a log.

    Attributes:
        evidence: ``[D]``, of the worst line of each cell; 0: none.
        line: int ``[D]``, number of the line that fails, from 0; -1: none.
        probability: ``[D]``, that it does.
        share: ``[D]``, of the tested pieces in which it was away.
        since: int ``[D]``, number of the first frame of those.
        units: int ``[D]``, number of those.
        as_one: bool ``[D]``, cells that read as one, instead of being at rest.
    """

    evidence: Floats
    line: Cells
    probability: Floats
    share: Floats
    since: Cells
    units: Cells
    as_one: Mask

    @classmethod
    def none(cls, n_cells: int) -> Failing:
        """Return that none does."""
        nothing = np.zeros(n_cells)
        number = np.zeros(n_cells, np.intp)
        return cls(nothing, number - 1, nothing, nothing, number, number, number > 0)

    @property
    def cells(self) -> Mask:
        """bool ``[D]``, cells of lines that fail."""
        found: Mask = self.line >= 0
        return found

    @property
    def doubted(self) -> Mask:
        """bool ``[D]``, cells of lines that may fail."""
        found: Mask = expit(self.evidence + _RARE) > DOUBTED
        return found

    def with_one(self, on: Mask, evidence: float, ratio: Array, since: int) -> Failing:
        """Return the lines with one more: its cells, bool ``[D]``, log ratio of each piece, and
        first frame."""
        away = ratio > _AGAINST
        share = (ratio > _SPEAKS).sum() / max(1, (np.abs(ratio) > _SPEAKS).sum())
        return replace(
            self,
            evidence=np.where(on, evidence, self.evidence),
            line=np.where(on, self.line.max() + 1, self.line),
            probability=np.where(on, expit(evidence + _PRIOR), self.probability),
            share=np.where(on, share, self.share),
            since=np.where(on, since, self.since),
            units=np.where(on, away.sum(), self.units),
        )


@dataclass(frozen=True)
class Lines:
    """The lines of an array, and how healthy ones rest.

    Attributes:
        on: bool ``[W, D]``, living cells on each.
        beside: bool ``[W, D]``, cells beside these that are not.
        others: bool ``[W, D]``, all other living cells of its pads.
        predicted: expected loads between levels.
        usual: ``[D]``, mean load of each cell in the reference.
        resting: P(at rest | context) ``[1, W, M]``; while the model is fitted ``[halves, W, M]``,
            without each half of the recordings.
        half: int ``[n]``, of each piece, while the model is fitted; else empty.
        odd: ``[W]``, share of the recordings in which each healthy line is odd.
        highest: ``[W]``, evidence that it reaches.
        reached: units of the longest log in which it did.
    """

    on: Mask
    beside: Mask
    others: Mask
    usual: Array
    predicted: Array
    resting: Array
    half: Cells
    odd: Array
    highest: Array
    reached: int

    def means(self, load: Array, of: Mask) -> Floats:
        """Return the mean loads ``[n, W]`` of the cells in ``of``, bool ``[W, D]``."""
        count = np.maximum(of.sum(axis=1), 1)
        found: Floats = load @ of.T.astype(load.dtype) / count
        return found

    def expected(self, means: ConditionalMean, load: Array, known: Mask, of: Mask) -> Floats:
        """Return the mean loads ``[n, W]`` that ``known`` cells off each line expect."""
        count = np.maximum(of.sum(axis=1), 1)
        found: Floats = means.sums(load, known, self.on, of) / count
        return found

    def contexts(
        self, expected: Floats, rests: Mask, load: Array, first: Mask, known: Mask
    ) -> Cells:
        """Return what is known of each line and piece, 0 to M - 1, int ``[n, W]``; ``rests``: bool
        ``[n, W]``."""
        near = (self.beside & known).astype(np.float32)
        on = (load > NOTHING).astype(np.float32) @ near.T
        share = on / np.maximum(near.sum(axis=1), 1)
        level = np.searchsorted(self.predicted, expected, "right")
        around = level * (len(_BESIDE) + 1) + np.searchsorted(_BESIDE, share, "right")
        before = np.zeros(rests.shape, np.intp)
        before[1:] = np.where(first[1:, None], 0, 2 - rests[:-1])
        found: Cells = around * _BEFORE + before
        return found

    @property
    def alone(self) -> Mask:
        """Lines that are all of their pads, bool ``[W]``."""
        return np.asarray(~self.others.any(axis=1))

    def told(self, load: Array, known: Mask) -> Mask:
        """Return where a known cell beside those of a line is loaded on its pads, bool ``[n, W]``:
        else what is loaded is the line itself, or nothing touches it. Of a line that is all of its
        pads, cells of others tell."""
        others = (self.others & known).astype(np.float32)
        found: Mask = (load > NOTHING).astype(np.float32) @ others.T > 0
        return np.asarray(found | self.alone)

    def ratio(self, observed: Observed, known: Mask, eligible: Mask) -> tuple[Array, Cells]:
        """Return the log ratio away : healthy of each piece, and the level of the expected load,
        ``[n, W]`` each.

        Args:
            observed: the log.
            known: bool ``[D]``, cells that tell of others.
            eligible: bool ``[D]``, cells that tell of their own line.
        """
        log = observed.log
        of = self.on & eligible
        rests = self.means(log.load, of) <= NOTHING
        expected = observed.once(
            ("expected of lines", known.tobytes(), of.tobytes()),
            lambda: self.expected(observed.predictor.mean, log.load, known, of),
        )
        context = self.contexts(expected, rests, log.load, log.record.first, known)
        half = self.half if len(self.half) else np.zeros(len(context), np.intp)
        resting = self.resting[half[:, None], np.arange(len(self.on)), context]
        away = np.log(_AWAY) - np.log(resting)
        # a load that the others do not expect, as of a faulty cell, is no sign of an open line
        back = np.minimum(np.log(1 - _AWAY) - np.log(1 - resting), 0)
        ratio = np.where(rests, away, back)
        received = (log.record.received.astype(np.float32) @ of.T.astype(np.float32)) > 0
        told = self.told(log.load, known) & received
        level = context // (_BEFORE * (len(_BESIDE) + 1))
        return np.where(told, ratio, 0).astype(np.float32), level

    def evidence(
        self, observed: Observed, known: Mask, eligible: Mask
    ) -> tuple[Array, Array, Array, Units]:
        """Return the evidence of each line ``[W]``, before the limits, that of each block
        ``[blocks, W]``, the log ratio of each piece ``[n, W]``, and the blocks; arguments as for
        :meth:`ratio`."""
        ratio, level = self.ratio(observed, known, eligible)
        blocks = self._blocks(observed)
        of_pieces = coming_and_going(ratio, observed.log.record.first)
        of_blocks = blocks.of_units(of_pieces)
        opens = []
        for limit in np.linspace(1, len(self.predicted), _LIMITS).astype(np.intp):
            beyond = np.where(level >= limit, ratio, 0)
            opens.append(blocks.of_units(beyond).sum(axis=0))
        under_load = logsumexp(opens, axis=0) - np.log(_LIMITS)
        evidence = np.maximum(of_blocks.sum(axis=0), under_load)
        of = self.on & eligible
        enough = (of.sum(axis=1) >= FEWEST) & carried_by_several(self.usual * of)
        enough &= (self.beside & known).sum(axis=1) >= _TELL * self.beside.sum(axis=1)
        enough &= evidence > for_good(ratio, blocks)
        return np.where(enough, evidence, 0), of_blocks, ratio, blocks

    def _blocks(self, observed: Observed) -> Units:
        """Return the recordings of a log, in parts where they are long, as units."""
        units = Units.of(observed, self.odd)
        record = observed.log.record
        opens = np.flatnonzero(since_begin(units.opens) % _BLOCK == 0)
        begins = units.begins[opens]
        odd = np.maximum.reduceat(units.odd, opens, axis=0)
        of_piece = np.searchsorted(begins, np.arange(len(record)), "right") - 1
        return Units(begins, of_piece, odd, units.opens[opens])

    def failing(self, observed: Observed, moving: Mask, telling: Mask, failing: Failing) -> Failing:
        """Return the lines that fail in a log besides groups that are ``failing``.

        Args:
            observed: the log.
            moving: bool ``[D]``, cells that move and hold no load.
            telling: bool ``[D]``, those of them that tell of their line.
            failing: the groups.
        """
        of_groups = failing
        record = observed.log.record
        found = 0
        while len(self.on):
            free = ~failing.cells
            known = observed.known & free
            evidence, of_blocks, ratio, blocks = self.evidence(observed, known, telling & free)
            evidence = within_limit(evidence, self.highest, len(record.units) / self.reached)
            # that nothing touches a pad makes it doubtful, no more
            evidence = np.where(self.alone, np.minimum(evidence, PROVEN), evidence)
            on = self.on & moving & free
            of_cell = np.where(on, evidence[:, None], 0).max(axis=0)
            failing = replace(failing, evidence=np.maximum(failing.evidence, of_cell))
            worst = int(evidence.argmax())
            if evidence[worst] <= PROVEN:
                return failing
            if found == _MOST:
                break
            against = of_blocks[:, worst] > _AGAINST
            away = against[blocks.of_piece] & (ratio[:, worst] > _AGAINST)
            since = int(record.begins[away.argmax()])
            failing = failing.with_one(on[worst], float(evidence[worst]), ratio[:, worst], since)
            found += 1
        return of_groups

    def pulled(self, observed: Observed, shorted: Cells, faulty: Mask) -> Mask:
        """Return the cells on lines that a shorted crossing pulls, bool ``[D]``.

        Where the layers of a cell touch, a resistive array reads the rest of its row and column
        through it: a part of their load each. They read less together, and so agree with each
        other. With d the log ratio of the summed loads of a line and those that the others expect,
        it is pulled where d lies below the 0.05 quantile of a normal distribution with the median
        and the robust deviation of the other lines, and its load below two thirds.

        Args:
            observed: the log.
            shorted: int, the cells that are shorted.
            faulty: bool ``[D]``, cells that tell nothing of their line.
        """
        load = observed.log.load
        known = observed.log.far & ~faulty
        crossing = self.on[:, shorted].any(axis=1)
        # those on the lines in question tell nothing of the others
        tells = known & ~self.on[crossing].any(axis=0)
        of = self.on & known
        expected = self.expected(observed.predictor.mean, load, tells, of)
        loaded = expected > NOTHING
        total = np.where(loaded, self.means(load, of), 0).sum(axis=0)
        wanted = np.where(loaded, expected, 0).sum(axis=0)
        ratio = np.log(np.maximum(total, NOTHING) / np.maximum(wanted, NOTHING))
        ratio = np.where(loaded.sum(axis=0) >= FEWEST_LOADED, ratio, np.nan)
        others = ratio[~crossing & np.isfinite(ratio)]
        if len(others) < FEWEST_LOADED:
            return np.zeros_like(faulty)
        middle = np.median(others)
        least = middle - _OUTLYING * np.median(np.abs(others - middle))
        low = crossing & (ratio < least) & (ratio < middle + _PULLED)
        found: Mask = self.on[low].any(axis=0)
        return found


def cells_on(layout: SensorLayout, living: Mask, kinds: Collection[LineKind] = _KINDS) -> Mask:
    """Return the living cells (bool ``[D]``) on each line of some kinds, bool ``[W, D]``: three at
    least and not all of them; lines with the same cells once."""
    found: dict[bytes, Mask] = {}
    for line in layout.lines:
        on = np.zeros(layout.n_cells, bool)
        on[layout.cells_on(line)] = True
        on &= living
        if line.kind in kinds and FEWEST <= on.sum() < living.sum():
            found.setdefault(on.tobytes(), on)
    return np.array(list(found.values()), bool).reshape(-1, layout.n_cells)


def fit_lines(
    layout: SensorLayout,
    living: Mask,
    mean: ConditionalMean,
    load: Array,
    record: Record,
    half: Cells,
) -> tuple[Lines, Array]:
    """Return the lines, and P(at rest | context) without each half, ``[halves, W, M]``.

    Args:
        layout: of the array.
        living: bool ``[D]``.
        mean: cross-fitted.
        load: root loads ``[n, D]`` of the reference.
        record: of it.
        half: int ``[n]``, of each piece.
    """
    on = cells_on(layout, living)
    beside = np.zeros_like(on)
    others = np.zeros_like(on)
    for k, of in enumerate(on):
        beside[k] = layout.with_neighbours(of) & living & ~of
        others[k] = np.isin(layout.pad_of, layout.pad_of[of]) & living & ~of
    odd = np.full(len(on), _RARELY, np.float32)
    zero = np.zeros(len(on), np.float32)
    table = np.zeros((1, len(on), 0), np.float32)
    usual = load.mean(axis=0)
    blank = Lines(on, beside, others, usual, zero, table, NO_HALF, odd, zero, 1)
    means = blank.means(load, on)
    rests = means <= NOTHING
    expected = np.zeros(means.shape)
    parts = _parts(record, living, on)
    for part, known in parts:
        expected[part] = blank.expected(mean, load, known, on)[part]
    share = np.linspace(0, 1, _LEVELS // 2 + 1)[1:-1]
    loaded = expected[~rests]
    edges = [np.quantile(some, share) for some in (expected, loaded) if some.size]
    predicted = np.unique(np.concatenate(edges)).astype(np.float32) if edges else zero
    blank = replace(blank, predicted=predicted)
    context = np.zeros(means.shape, np.intp)
    told = np.zeros(means.shape, bool)
    for part, known in parts:
        first = record.first[part]
        context[part] = blank.contexts(expected[part], rests[part], load[part], first, known)
        told[part] = blank.told(load[part], known)
    n_contexts = (len(predicted) + 1) * (len(_BESIDE) + 1) * _BEFORE
    counts = np.zeros((half.max() + 1, len(on), n_contexts, 2))
    line = np.broadcast_to(np.arange(len(on)), rests.shape)
    halves = np.broadcast_to(half[:, None], rests.shape)
    np.add.at(counts, (halves[told], line[told], context[told], rests[told].astype(np.intp)), 1)
    total = counts.sum(axis=0)
    fitted = replace(blank, resting=_resting(total)[None])
    return fitted, np.stack([_resting(total - of_half) for of_half in counts])


def _parts(record: Record, living: Mask, on: Mask) -> list[tuple[slice, Mask]]:
    """Return parts of the reference, and the known cells of each, bool ``[D]``: fewer and fewer,
    without a line in every second part."""
    rng = np.random.default_rng(0)
    first = np.flatnonzero(record.first)
    ends = [some[0] for some in np.array_split(first, _PARTS) if len(some)]
    found = []
    for k, (begin, end) in enumerate(zip(ends, [*ends[1:], len(record)], strict=True)):
        known = living & (rng.random(len(living)) >= _LEFT_OUT * k / _PARTS)
        if k % 2 and len(on):
            known &= ~on[rng.integers(len(on))]
        found.append((slice(int(begin), int(end)), known))
    return found


def _resting(counts: Floats) -> Array:
    """Return P(at rest | context) of each line ``[W, M]`` of counts ``[W, M, 2]``, shrunk towards
    all lines."""
    pooled = counts.sum(axis=0)
    usual = (pooled[:, 1] + 0.5) / (pooled.sum(axis=1) + 1)
    own = (counts[..., 1] + _ALL_LINES * usual) / (counts.sum(axis=2) + _ALL_LINES)
    found: Array = np.clip(own, _GUESS, 1 - _GUESS).astype(np.float32)
    return found


def carried_by_several(usual: Array) -> Mask:
    """Return whether no cell carries most of the ``usual`` load of its line (``[W, D]``, 0 off it),
    bool ``[W]``: else the line does what that cell does."""
    found: Mask = usual.max(axis=1, initial=0) < _MOSTLY * usual.sum(axis=1)
    return found


def odd_of(evidence: Array) -> Array:
    """Return the share of the cases ``[n, W]`` in which each healthy line is odd."""
    odd = (evidence > _ODD).sum(axis=0)
    n = max(1, len(evidence))
    pooled = odd.sum() / max(1, evidence.size)
    share = (odd + _ODD_RECORDINGS * pooled) / (n + _ODD_RECORDINGS)
    found: Array = np.clip(share, max(_RARELY, min(_SEEN / n, _OFTEN)), _OFTEN).astype(np.float32)
    return found
