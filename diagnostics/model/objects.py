"""Objects that lie still: their cells hold a load and look stuck, and are no faults.

A cell holds what its load hardly falls below from some piece on; contacts add to it. Neighbouring
cells that do are one object, or independent faults; the log odds of an object are

    log P(object here)
        + sum over its cells i  of  log P(loaded, v_i | object) - log (P(stuck at v_i) d_i + h_i)
        + sum over the cells beside it that rest  of  log P(rest | object)

v is what a cell holds. On an object it moves with the others as before: d is the likelihood ratio
of any fault to none in the log without v. h is the same of a healthy cell without an object to one
with it. An object may have any shape: it loads the cell beside a loaded one with some probability,
half of the time as the contacts of the reference do. Cells of an object are neither faulty nor
tested; without what they hold they tell what their pad shares.

No object holds a cell at full scale, nor takes the noise that it had at rest; no wire whose cells
read the same is one, nor what a cell may share with its pad; some cells of the pad rest beside it.

Not detected: objects on fewer than three cells; objects that explain no faulty cell; those of whose
cells the last contact may still go on; one on a whole pad, or that keeps contacts off its cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from diagnostics.decision.line_cover import PROVEN
from diagnostics.decision.static_load import StaticLoad
from diagnostics.layout import SensorLayout
from diagnostics.model.judge import Judgement, Model
from diagnostics.model.observed import HELD, Log
from diagnostics.model.record import Array, Cells, Mask, Record
from diagnostics.model.symbols import AT_REST, CONSTANT, NOTHING, root_load
from diagnostics.preprocessing.levels import ANYWHERE, EXPECTED

_FEWEST = 3  # cells of an object
_ROUNDS = 3
_EXPECTED_OBJECTS = 0.1  # prior probability of an object in a log
_BESIDE = 0.3  # probability that an object loads the cell beside a loaded one
_FLOOR = 0.2  # quantile of what a cell holds at most: contacts add to it
_NEARLY_ALL = 0.95  # of the pieces
_NOISY = 0.9  # P(constant | constant before, at rest) of a cell with noise, at most
_BLAMED = 0.5

Floats = NDArray[np.float64]


def judged_with_objects(
    model: Model, log: Log, layout: SensorLayout, explained: Mask
) -> tuple[Judgement, list[StaticLoad]]:
    """Return the judgement of a log without the cells of the objects that lie still, and these;
    ``explained`` cells (bool ``[D]``) are left out. The log is changed by it."""
    found: list[StaticLoad] = []
    judgement = model.judge_log(log, explained)
    if not (judgement.probability > _BLAMED).any():  # an object has to explain a fault
        return judgement, found
    held = HeldLoads.of(log, model)
    for _ in range(_ROUNDS):
        more = find_objects(model, judgement, log, held, layout, found)
        under = _cells_of(more, layout)
        if under.sum() <= _cells_of(found, layout).sum():
            break
        found = more
        judgement = model.judge_record(held.without(log, under, model), under | explained)
    return judgement, found


def _cells_of(objects: Sequence[StaticLoad], layout: SensorLayout) -> Mask:
    return _mask([cell for one in objects for cell in one.cells], layout.n_cells)


def _mask(cells: Sequence[int] | Cells, n: int) -> Mask:
    on = np.zeros(n, bool)
    on[list(cells)] = True
    return on


def find_objects(
    model: Model,
    judgement: Judgement,
    log: Log,
    held: HeldLoads,
    layout: SensorLayout,
    known: Sequence[StaticLoad] = (),
) -> list[StaticLoad]:
    """Return the objects in a log.

    Args:
        model: of the array.
        judgement: of the log without the cells of ``known`` objects.
        log: all of it.
        held: what its cells hold.
        layout: of the array.
        known: objects found before.
    """
    blamed = (judgement.probability > _BLAMED) | _cells_of(known, layout)
    holds = (held.load > 0) & ~_of_wires(held.load, blamed, layout, log.symbols.tolerance)
    touched = log.load[:, judgement.known & ~holds] > NOTHING
    if not touched.any():  # all that is loaded may be one contact
        return []
    # a line beside an object looks broken: contacts do not load it as the reference's did
    near = blamed | layout.with_neighbours(judgement.failing.cells | _cells_of(known, layout))
    resting = model.predictor.on_pad((judgement.known & ~holds).astype(np.float32))
    number = layout.connected(holds & (resting > 0))
    every = [number == i for i in range(1, number.max() + 1)]
    groups = [group for group in every if group.sum() >= _FEWEST and (group & near).any()]
    if not groups:
        return []
    chain = _Chain.of(model, judgement, log, held, layout, holds)
    found = []
    for group in groups:
        elsewhere = blamed & ~group
        stuck = max((elsewhere & holds).sum(), ANYWHERE * elsewhere.sum()) / model.present.sum()
        cells, odds = chain.most_likely(group, max(EXPECTED * ANYWHERE, float(stuck)))
        if odds > PROVEN and near[cells].any():
            since = int(log.record.begins[int(np.median(held.since[cells]))])
            found.append(StaticLoad.on(cells, float(expit(odds)), since, layout))
    return found


def _of_wires(load: Array, blamed: Mask, layout: SensorLayout, tolerance: float) -> Mask:
    """Return the ``blamed`` cells that hold what most cells on one of their wires do, bool
    ``[D]``."""
    found = np.zeros(len(load), bool)
    for line in layout.lines:
        cells = layout.cells_on(line)
        held = cells[blamed[cells] & (load[cells] > 0)]
        if len(held):
            same = held[np.abs(load[held] - np.median(load[held])) <= tolerance]
            if len(same) > max(2, len(cells) / 2):
                found[same] = True
    return found


@dataclass(frozen=True)
class HeldLoads:
    """What cells hold to the end of a log, ``[D]`` each.

    Attributes:
        load: reading above rest; 0: none.
        since: int, first piece.
    """

    load: Array
    since: Cells

    @classmethod
    def of(cls, log: Log, model: Model) -> HeldLoads:
        """Return what the cells of a log hold since before the last recording began."""
        rest = log.symbols.rest
        record = log.record
        n = len(record)
        last = int(np.argmax(record.recording == record.recording[-1]))
        if last == 0:
            last = n - HELD
        received = model.present & record.received.any(axis=0)
        lowest = np.minimum(_FLOOR, model.predictor.rests / 2)
        top = rest.full - log.symbols.tolerance
        since = _since((log.above > rest.near) & received)
        load = np.zeros(len(received), np.float32)
        for cell in np.flatnonzero(since < last).tolist():
            begin = (since[cell] + n) // 2  # a contact may have gone before
            above = log.above[begin:, cell]
            floor = np.quantile(above, lowest[cell])
            floor = np.median(above[above <= floor + 2 * rest.near[cell]])
            shared = np.median(record.mean[begin:, cell] - rest.level[cell] - above)
            # what it may share with its pad beside what it is known to
            more = shared * (1 / max(rest.share[cell], _FLOOR) - 1)
            least = rest.near[cell] + max(more, -shared)
            if floor > least and rest.level[cell] + floor < top:
                load[cell] = floor
        since = _since((log.above > load / 2) & (load > 0))
        return cls(np.where(since < last, load, 0), since)

    def during(self, log: Log) -> Mask:
        """Return the pieces in which each cell holds its load, bool ``[n, D]``."""
        found: Mask = np.greater_equal(np.arange(len(log.record))[:, None], self.since)
        return found

    def still(self, log: Log) -> Mask:
        """Return the pieces in which it reads no more, bool ``[n, D]``."""
        same = np.abs(log.above - self.load) <= 2 * log.symbols.tolerance
        found: Mask = self.during(log) & same
        return found

    def without(self, log: Log, cells: Mask, model: Model) -> Record:
        """Return the record without the loads of some cells, bool ``[D]``. A load may come with
        noise: those that have none at rest rest where they read no more."""
        lift = np.where(self.during(log) & cells, self.load, 0)
        rests = self.still(log) & cells & (_constant_at_rest(model) >= np.log(_NOISY))
        record = log.record
        mean = record.mean - np.where(rests, log.above, lift)
        low = np.where(rests, mean, record.low - lift)
        high = np.where(rests, mean, record.high - lift)
        return replace(record, low=low, high=high, mean=mean)


def _since(on: Mask) -> Cells:
    """Return the likeliest piece of each cell from which on nearly all are ``on`` (bool ``[n, D]``)
    and before which half of them are, int ``[D]``; n: none."""
    each = np.where(on, np.log(2 * _NEARLY_ALL), np.log(2 - 2 * _NEARLY_ALL))
    likely = np.flip(np.cumsum(np.flip(each, 0), 0), 0)
    found: Cells = np.where(likely.max(axis=0) > 0, likely.argmax(axis=0), len(on))
    return found


@dataclass(frozen=True)
class _Chain:
    """Compares an object with faults, cell by cell.

    Attributes:
        layout: of the array.
        present: number of its cells.
        width: ``[D]``, P(the load that each cell holds | stuck), at any value.
        usual: ``[D]``, P(it | object): half of them are any, half as those of the reference.
        others: bool ``[D]``, trusted cells that hold none.
        healthy: ``[D]``, log P(log | healthy, no object) - log P(log | healthy, object), as far as
            a fault explains it.
        dead: ``[D]``, evidence of any fault in the log less what the cells hold.
    """

    layout: SensorLayout
    present: int
    width: Array
    usual: Array
    others: Mask
    healthy: Array
    dead: Array

    @classmethod
    def of(
        cls,
        model: Model,
        judgement: Judgement,
        log: Log,
        held: HeldLoads,
        layout: SensorLayout,
        holds: Mask,
    ) -> _Chain:
        """Return the comparison for the cells that may hold a load, bool ``[D]``; other arguments
        as for :func:`find_objects`."""
        others = judgement.known & ~holds
        without = model.observed(model.log_of_record(held.without(log, holds, model)), others)
        units = judgement.units
        dead = model.evidence_of_any(without, units)
        blamed = model.evidence_of_any(model.observed(log, others), units)
        healthy = np.maximum(dead, 0) - np.maximum(blamed, 0)
        load = root_load(np.where(holds, held.load, 0), log.symbols.rest)
        edges = np.append(log.symbols.edges, 1.0)
        level = np.clip(np.searchsorted(edges, load, "right"), 1, len(edges) - 1) - 1
        width = np.diff(edges**2)[level]
        usual = ((width + 1 / (len(edges) - 1)) / 2).astype(np.float32)
        present = int(model.present.sum())
        return cls(layout, present, width, usual, others, healthy, dead)

    def most_likely(self, group: Mask, share: float) -> tuple[Cells, float]:
        """Return the cells of a group that one object explains best, and its log odds.

        Args:
            group: bool ``[D]``, neighbouring cells that hold a load.
            share: of the cells that are stuck.
        """
        own = -np.logaddexp(np.log(share * self.width) + self.dead, self.healthy)
        first = own + np.log(self.usual)
        gain = first + np.log(_BESIDE)
        chosen = [int(np.where(group, first, -np.inf).argmax())]
        on = _mask(chosen, len(group))
        odds = [np.log(_EXPECTED_OBJECTS / self.present) + first[chosen[0]]]
        while True:
            beside = self.layout.with_neighbours(on) & ~on & group
            if not beside.any():
                break
            best = int(np.where(beside, gain, -np.inf).argmax())
            on[best] = True
            chosen.append(best)
            odds.append(odds[-1] + gain[best])
        most = _FEWEST - 1 + int(np.argmax(odds[_FEWEST - 1 :]))
        on = _mask(chosen[: most + 1], len(group))
        around = self.layout.with_neighbours(on) & ~on & self.others
        return np.flatnonzero(on), float(odds[most] + np.log(1 - _BESIDE) * around.sum())


def _constant_at_rest(model: Model) -> Array:
    """Return log P(constant | at rest and constant a piece ago), ``[1, D]``."""
    constant = np.full((1, len(model.present)), CONSTANT, np.int8)
    return model.flatness.of_chain(np.full(constant.shape, AT_REST), constant, constant)
