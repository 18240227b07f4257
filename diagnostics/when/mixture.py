"""Which recordings are a cell's healthy ones: a table of healthy symbols, and a chain of faults.

Cells and lines are units alike here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from diagnostics.preprocessing.levels import EXPECTED, FEWEST, LEAST_LOADED, LOW, MAJORITY
from diagnostics.when.chain import Course, Lasting, Loose
from diagnostics.when.log_gamma import log_gamma

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Symbol(IntEnum):
    """What a unit did in a recording."""

    MOVED = 0
    RESTED = 1
    HELD = 2
    """One value, not its rest, with dither."""
    RESTED_EXACTLY = 3
    HELD_EXACTLY = 4


_DEAD_MOVES = 0.02  # share of its recordings in which a dead unit moves
_DITHERS = 0.1  # share of the others in which it dithers
_ELSEWHERE = 0.4  # share of its held values that are not at rest
_DEAD = np.log(
    [
        _DEAD_MOVES,
        (1 - _DEAD_MOVES) * _DITHERS * (1 - _ELSEWHERE),
        (1 - _DEAD_MOVES) * _DITHERS * _ELSEWHERE,
        (1 - _DEAD_MOVES) * (1 - _DITHERS) * (1 - _ELSEWHERE),
        (1 - _DEAD_MOVES) * (1 - _DITHERS) * _ELSEWHERE,
    ]
)
_HELD = np.array([0.45, 0.05, 0.45, 0.05])  # pseudo-counts of the symbols that hold
QUIET_LEVELS = 3
_CONCENTRATIONS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # pseudo-counts of a unit's own table: a grid
_PASSES = 4  # over the states of one order: a size


@dataclass(frozen=True)
class Found:
    """What is found of each unit.

    Attributes:
        evidence: float ``[units]``, log odds faulty in these recordings : healthy; -inf: none.
        states: bool ``[n, units]``, the recordings.
    """

    evidence: Floats
    states: Mask


class Mixture:
    """The mixture over the recordings of each unit.

    A context is how far the cells beside a unit move, for each of three levels of how quiet the
    array is: ``level + n_levels * quiet``.

    Args:
        symbol: int ``[n, units]``.
        n_contexts: number of contexts.
        orders: of the recordings, in which a fault may go on from one to the next.
        classes: number of the class of each recording, int ``[n]``, where a class may leave a
            unit untouched; None: it may not, or the classes are unknown.
    """

    def __init__(
        self,
        symbol: NDArray[np.intp],
        n_contexts: int,
        orders: Sequence[NDArray[np.intp]],
        classes: NDArray[np.intp] | None = None,
    ) -> None:
        self._symbol = symbol
        self._contexts = n_contexts
        self._courses: list[tuple[NDArray[np.intp], Course]] = [
            (order, Lasting(len(order))) for order in orders
        ]
        self._courses.append((orders[0], Loose(len(orders[0]))))
        self._unit = np.broadcast_to(np.arange(symbol.shape[1]), symbol.shape)
        self._classes = classes
        self._independent = 1.0

    def first(self, context: NDArray[np.intp], known: Mask) -> Found:
        """Return what is found before anything is trusted: the units that hold a value most often
        do not count in the table of all."""
        counts = self._counts(context, known)
        used = counts[known.any(axis=0)]
        least = np.sort(used, axis=0)[: max(1, round((1 - LEAST_LOADED) * len(used)))]
        pooled = least.sum(axis=0) * (len(used) / len(least))
        total = used.sum(axis=(0, 2))
        pooled[:, Symbol.MOVED] = np.maximum(total - pooled[:, 1:].sum(axis=1), 0.0)
        return self._found(context, known, counts, pooled)

    def again(self, context: NDArray[np.intp], known: Mask, trusted: Mask, *, new: bool) -> Found:
        """Return what is found where the table is that of the ``trusted`` (bool ``[n, units]``).

        Args:
            context: int ``[n, units]``, what the others did.
            known: bool ``[n, units]``, where they did something.
            new: the share of independent recordings is estimated from these.
        """
        counts = self._counts(context, known & trusted)
        pooled = counts.sum(axis=0)
        if new:
            self._independent = self._independent_share(context, known & trusted, counts, pooled)
        return self._found(context, known, counts, pooled)

    def _counts(self, context: NDArray[np.intp], counted: Mask) -> Floats:
        """Return how often each unit had each symbol in each context, ``[units, C, symbols]``."""
        shape = (self._symbol.shape[1], self._contexts, len(Symbol))
        index = (self._unit * self._contexts + context) * len(Symbol) + self._symbol
        found = np.bincount(index[counted], minlength=int(np.prod(shape)))
        return found.astype(np.float64).reshape(shape)

    def _found(
        self, context: NDArray[np.intp], known: Mask, counts: Floats, pooled: Floats
    ) -> Found:
        """Return the likeliest of all orders."""
        table = _probabilities(pooled)
        priors = [size * table for size in _CONCENTRATIONS]
        likely = [float(each.sum()) for each in _marginals(counts, priors)]
        prior = priors[int(np.argmax(likely))]
        (healthy,) = _marginals(self._counts(context, known), [prior])
        best = Found(np.full(len(counts), -np.inf), np.zeros(known.shape, bool))
        for order, course in self._courses:
            states = self._states(context, known, prior, order, course)
            dead = np.where(states & known, _DEAD[self._symbol], 0.0).sum(axis=0)
            (rest,) = _marginals(self._counts(context, known & ~states), [prior])
            usual = np.maximum(healthy, rest + self._untouched(context, known, table, states))
            gain = self._independent * (rest + dead - usual) + course.prior(states[order])
            evidence = np.where(states.any(axis=0), gain, -np.inf)
            better = evidence > best.evidence
            best = Found(
                np.where(better, evidence, best.evidence), np.where(better, states, best.states)
            )
        return best

    def _untouched(
        self, context: NDArray[np.intp], known: Mask, table: Floats, states: Mask
    ) -> Floats:
        """Return the log likelihood that healthy units were not touched in their ``states``,
        ``[units]``; -inf where they moved in another recording of the same classes."""
        if self._classes is None:
            return np.full(known.shape[1], -np.inf)
        holds = np.log(table[:, 1:] / table[:, 1:].sum(axis=1, keepdims=True))
        likely = np.where(states & known, holds[context, self._symbol - 1], 0.0).sum(axis=0)
        moved = known & (self._symbol == Symbol.MOVED)
        never = ~(states & moved).any(axis=0)
        for one in np.unique(self._classes):
            of_class = (self._classes == one)[:, None]
            never &= ~(of_class & states).any(axis=0) | ~(of_class & moved).any(axis=0)
        return np.where(never, likely + np.log(EXPECTED), -np.inf)

    def _states(
        self,
        context: NDArray[np.intp],
        known: Mask,
        prior: Floats,
        order: NDArray[np.intp],
        course: Course,
    ) -> Mask:
        """Return the likeliest states, with the table of each unit from its healthy recordings."""
        states = np.zeros(known.shape, bool)
        own: Floats | float = 0.0
        for _ in range(_PASSES):
            rate = prior + own
            rate /= rate.sum(axis=-1, keepdims=True)
            rate = np.broadcast_to(rate, (known.shape[1], *rate.shape[-2:]))
            healthy = np.log(rate[self._unit, context, self._symbol])
            ratio = self._independent * np.where(known, _DEAD[self._symbol] - healthy, 0.0)
            found = np.zeros_like(states)
            found[order] = course.states(ratio[order])
            if (found == states).all():
                break
            states = found
            own = self._counts(context, known & ~states)
        return states

    def _independent_share(
        self, context: NDArray[np.intp], counted: Mask, counts: Floats, pooled: Floats
    ) -> float:
        """Return the share of the recordings that count as independent of each other.

        It is the variance of the sum of single recordings over that of successive ones, in the
        order in which they are most alike, both about the mean of each unit. The units that deviate
        most together do not count: what is dead in some recordings does, and would hide itself.
        """
        rate = counts + _probabilities(pooled)
        rate /= rate.sum(axis=2, keepdims=True)
        holds = 1 - rate[self._unit, context, Symbol.MOVED]
        deviation = np.where(counted, (self._symbol != Symbol.MOVED) - holds, 0.0)
        usual = deviation.sum(axis=0) / np.maximum(counted.sum(axis=0), 1)
        deviation = np.where(counted, deviation - usual, 0.0)
        alone = (deviation**2).sum(axis=0)
        begins = np.arange(0, len(deviation), FEWEST)
        used = max(1, round((1 - 2 * LOW) * len(alone)))
        share = 1.0
        for order, _ in self._courses:
            together = (np.add.reduceat(deviation[order], begins, axis=0) ** 2).sum(axis=0)
            counts_on = np.argsort(together - alone, kind="stable")[:used]
            of_single = float(alone[counts_on].sum())
            of_several = float(together[counts_on].sum())
            if of_several > of_single:
                share = min(share, of_single / of_several)
        return share


def _probabilities(counts: Floats) -> Floats:
    """Return P(symbol | context) of all units, ``[C, symbols]``.

    How often a unit moves depends on the context; which value it holds where it does not move, and
    whether it dithers, depends on how quiet the array is.
    """
    moves = counts[:, Symbol.MOVED]
    holds = counts[:, 1:].sum(axis=1)
    moving = (moves + MAJORITY) / (moves + holds + 1)
    of_quiet = counts[:, 1:].reshape(QUIET_LEVELS, -1, len(Symbol) - 1).sum(axis=1) + _HELD
    kinds = of_quiet / of_quiet.sum(axis=1, keepdims=True)
    each = np.repeat(kinds, len(counts) // QUIET_LEVELS, axis=0)
    return np.column_stack([moving, (1 - moving)[:, None] * each])


def _marginals(counts: Floats, priors: Sequence[Floats]) -> list[Floats]:
    """Return the log marginal likelihood (Dirichlet-multinomial) of counts
    ``[units, C, symbols]`` with each prior, pseudo-counts ``[C, symbols]``: ``[units]`` each.

    The gamma function is asked once for what units have in common.
    """
    times = counts.sum(axis=2)
    each = _Repeated.of(counts)
    of_all = _Repeated.of(times)
    return [each.gained(prior) - of_all.gained(prior.sum(axis=1)) for prior in priors]


@dataclass(frozen=True)
class _Repeated:
    """Counts of units that are not 0, each kind of them once.

    Attributes:
        units: number of all.
        unit: int ``[n]``, of each count.
        kind: int ``[n]``, of each count.
        place: int ``[kinds]``, where a count stands in the counts of its unit.
        count: float ``[kinds]``.
    """

    units: int
    unit: NDArray[np.intp]
    kind: NDArray[np.intp]
    place: NDArray[np.intp]
    count: Floats

    @classmethod
    def of(cls, counts: Floats) -> _Repeated:
        """Return those of counts ``[units, ...]``, whole numbers."""
        flat = counts.reshape(len(counts), -1)
        unit, place = np.nonzero(flat)
        size = int(flat.max(initial=0)) + 1
        keys, kind = np.unique(
            place * size + flat[unit, place].astype(np.intp), return_inverse=True
        )
        return cls(len(counts), unit, kind, keys // size, (keys % size).astype(np.float64))

    def gained(self, prior: Floats) -> Floats:
        """Return the sum of log gamma(prior + count) - log gamma(prior) of each unit."""
        before = prior.ravel()[self.place]
        gain = log_gamma(before + self.count) - log_gamma(before)
        found: Floats = np.bincount(self.unit, gain[self.kind], self.units).astype(np.float64)
        return found
