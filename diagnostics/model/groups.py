"""Groups that fail as a whole: cells of one bus, converter or connector that read as one.

Healthy cells of a group differ from each other, and have noise. Behind a bad connector all of them
read one value, whatever it is and however it moves, or none changes (:class:`AsOne`). So the state
of a group in a piece is one of

    usual; as one in all frames, at rest, loaded, or at the top

and is compared with a Markov chain of the reference, P(state | state a piece ago), cross-fitted. A
group that fails is in any of the last three equally often.

Not detected: groups whose healthy cells all read the same without noise, as at a threshold, where
they fail to just that; a group that fails and keeps the loads and the noise of its cells; one with
a cell that is stuck at another value.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import SensorLayout
from diagnostics.model.as_one import AsOne
from diagnostics.model.lines import (
    FEWEST,
    NO_HALF,
    PROVEN,
    Failing,
    cells_on,
    odd_of,
)
from diagnostics.model.observed import Log
from diagnostics.model.over_time import Units, coming_and_going, for_good, within_limit
from diagnostics.model.record import Array, Cells, Mask, Record
from diagnostics.model.symbols import NOTHING, Symbols
from diagnostics.wiring import LineKind

USUAL, AT_REST, LOADED, AT_TOP = range(4)  # states
_BEGINS = 4  # before the first piece of a recording
_KINDS: tuple[LineKind, ...] = ("converter", "bus", "group")
_ALL_GROUPS = 30.0  # pieces of all groups that weigh on the table of one
_ANY = 0.01  # of a uniform distribution in the table: tables err
_AS_ONE = 0.95  # of the pieces of a group that fails
_RECOVERS = 0.1  # probability a piece
_NOISELESS = 0.25  # share of the pieces that are constant where cells have no noise
_RARE = 0.05
_MOST = 0.5

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Groups:
    """The groups of an array, and how often healthy ones read as one.

    Attributes:
        as_one: finds the frames.
        chain: log P(state | state a piece ago) ``[1, G, 5, 4]``; while the model is fitted
            ``[halves, G, 5, 4]``, without each half of the recordings.
        half: int ``[n]``, of each piece, while the model is fitted; else empty.
        odd: ``[G]``, share of the pieces in which each healthy group is odd.
        highest: ``[G]``, evidence that it reaches.
        reached: pieces of the longest log in which it did.
    """

    as_one: AsOne
    chain: Array
    half: Cells
    odd: Array
    highest: Array
    reached: int

    def states(self, log: Log, eligible: Mask) -> Cells:
        """Return the state of each group in each piece, int ``[n, G]``; ``eligible``: bool ``[D]``,
        cells that tell of theirs."""
        found = np.zeros((len(log.record), len(self.as_one.on)), np.intp)
        for g, on in enumerate(self.as_one.on):
            cells = np.flatnonzero(on & eligible)
            if len(cells) < FEWEST:
                continue
            top = (log.level[:, cells] == log.symbols.top).mean(axis=1)
            loaded = (log.load[:, cells] > NOTHING).mean(axis=1) > _MOST
            where = np.select([top == 1, loaded], [AT_TOP, LOADED], AT_REST)
            one = log.record.as_one[:, g] >= 1
            # rest levels that creep below the range of the converter have no noise
            if one[where == AT_REST].sum() > (1 - _NOISELESS) * (where == AT_REST).sum():
                one &= where != AT_REST
            # under a contact that is too heavy, some cells at its edge are not at the top
            at_edge = (top >= _MOST) & (top < 1)
            if at_edge.sum() > _RARE * (top == 1).sum():
                one &= top < 1
            found[:, g] = np.where(one, where, USUAL)
        return found

    def ratio(self, log: Log, eligible: Mask) -> Array:
        """Return the log ratio fails : healthy of each piece ``[n, G]``; arguments as for
        :meth:`states`."""
        state = self.states(log, eligible)
        half = self.half if len(self.half) else np.zeros(len(state), np.intp)
        before = _before(state, log.record)
        healthy = self.chain[half[:, None], np.arange(state.shape[1]), before, state]
        fails = np.where(state > 0, np.log(_AS_ONE / 3), np.log(1 - _AS_ONE))
        found: Array = (fails - healthy).astype(np.float32)
        return found

    def evidence(self, log: Log, eligible: Mask) -> tuple[Array, Array]:
        """Return the evidence of each group ``[G]``, before the limits, and of each piece
        ``[n, G]``; of those that hold a value since they broke their cells tell: 0."""
        ratio = self.ratio(log, eligible)
        record = log.record
        piece = np.arange(len(record))
        odd = np.broadcast_to(self.odd, ratio.shape)
        units = Units(piece, piece, odd, record.first)
        # how often a group fails is not known: at least once
        of_pieces = units.of_units(ratio)
        steps = coming_and_going(of_pieces, record.first, 1 / len(ratio), _RECOVERS)
        comes_and_goes = steps.sum(axis=0)
        lasts = for_good(ratio, units)
        evidence = np.maximum(comes_and_goes, lasts)
        begin = np.flip(ratio, 0).cumsum(axis=0)[::-1].argmax(axis=0)
        for g, on in enumerate(self.as_one.on):
            readings = record.mean[begin[g] :, on].mean(axis=1)
            if lasts[g] >= comes_and_goes[g] and np.ptp(readings) <= 2 * self.as_one.tolerance:
                evidence[g] = 0
        return evidence, of_pieces

    def failing(self, log: Log, eligible: Mask) -> Failing:
        """Return the groups that fail in a log, the largest first, which explain those in them;
        ``eligible``: bool ``[D]``, cells that move."""
        failing = Failing.none(len(eligible))
        if not len(self.as_one.on):
            return failing
        evidence, ratio = self.evidence(log, eligible)
        evidence = within_limit(evidence, self.highest, len(ratio) / self.reached)
        on = self.as_one.on & eligible
        proven = evidence > PROVEN
        # what most of them do is the array's, or that of the recordings
        if proven.sum() > _MOST * len(proven):
            return failing
        of_cell = np.where(on, evidence[:, None], 0).max(axis=0)
        failing = replace(failing, evidence=of_cell.astype(np.float64))
        for g in np.argsort(-on.sum(axis=1), kind="stable").tolist():
            cells = on[g] & ~failing.cells
            if proven[g] and cells.any():
                since = _first_frame(ratio[:, g], log.record, g)
                failing = failing.with_one(cells, float(evidence[g]), ratio[:, g], since)
                failing = replace(failing, as_one=failing.as_one | cells)
        return failing


def _before(state: Cells, record: Record) -> Cells:
    """Return the state of each group a piece ago, int ``[n, G]``."""
    found = np.roll(state, 1, axis=0)
    found[record.first] = _BEGINS
    return found


def _first_frame(ratio: Array, record: Record, group: int) -> int:
    """Return the number of the first frame in which a group failed, by the log ratio of each piece
    ``[n]``: that of the first run of pieces that speaks against it at least half as much as the
    worst one. The piece before may end as one."""
    summed = np.maximum(ratio, 0).astype(np.float64)
    for k in range(1, len(ratio)):
        if ratio[k] > 0:
            summed[k] += summed[k - 1]
    piece = int((summed >= _MOST * summed.max()).argmax())
    while piece and ratio[piece - 1] > 0:
        piece -= 1
    since = int(record.begins[piece])
    if record.first[piece]:
        return since
    frames = since - int(record.begins[piece - 1])
    return since - round(float(record.as_one[piece - 1, group]) * frames)


def as_one_of(
    layout: SensorLayout, living: Mask, symbols: Symbols, flat: NDArray[np.int8], tolerance: float
) -> AsOne:
    """Return what finds the frames in which the groups of an array read as one.

    Args:
        layout: of the array.
        living: bool ``[D]``.
        symbols: of the model.
        flat: ``[n, D]``, of the reference.
        tolerance: readings within +- this of a value are that value.
    """
    noise = bool((flat[:, living] == 0).mean() <= _NOISELESS)
    unloaded = (symbols.rest.level + symbols.rest.near).astype(np.float32)
    return AsOne(cells_on(layout, living, _KINDS), unloaded, tolerance, noise)


def fit_groups(as_one: AsOne, log: Log, half: Cells) -> tuple[Groups, Array]:
    """Return the groups, and their chains without each half, ``[halves, G, 5, 4]``; ``log``: the
    reference; ``half``: int ``[n]``, of each piece."""
    n = len(as_one.on)
    zero = np.zeros(n, np.float32)
    blank = Groups(as_one, np.zeros((1, n, 5, 4), np.float32), NO_HALF, zero, zero, 1)
    state = blank.states(log, np.ones(as_one.on.shape[1], bool))
    counts = np.zeros((half.max() + 1, n, 5, 4))
    group = np.broadcast_to(np.arange(n), state.shape)
    halves = np.broadcast_to(half[:, None], state.shape)
    np.add.at(counts, (halves, group, _before(state, log.record), state), 1)
    total = counts.sum(axis=0)
    chains = np.stack([_chain(total - of_half) for of_half in counts])
    held_out = replace(blank, chain=chains, half=half)
    odd = odd_of(held_out.ratio(log, np.ones(as_one.on.shape[1], bool)))
    return replace(blank, chain=_chain(total)[None], odd=odd), chains


def _chain(counts: Floats) -> Array:
    """Return log P(state | state a piece ago) of counts ``[G, 5, 4]``, shrunk towards all groups;
    what was never seen is as rare as it is in any context."""
    pooled = counts.sum(axis=0)
    usual = pooled.sum(axis=0) / max(1, pooled.sum())
    pooled = (pooled + usual) / (pooled.sum(axis=-1, keepdims=True) + 1)
    own = (counts + _ALL_GROUPS * pooled) / (counts.sum(axis=-1, keepdims=True) + _ALL_GROUPS)
    found: Array = np.log((1 - _ANY) * own + _ANY / counts.shape[-1]).astype(np.float32)
    return found
