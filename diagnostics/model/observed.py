"""What a log shows of each cell and piece, and how likely a healthy cell shows it."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from diagnostics.model.middles import EVEN
from diagnostics.model.predictor import Predictor
from diagnostics.model.record import Array, Mask, Record
from diagnostics.model.rest import DITHER
from diagnostics.model.symbols import (
    MOVES,
    NOTHING,
    Flatness,
    Symbols,
    activity_of,
    before_of,
    root_load,
)

HELD = 3  # pieces at the end at one load: it may be stuck
_STAYS = 0.05  # of a root load, or of those of a pad: a smaller change is none
_LIGHT = 1  # level up to which a load is no witness of a contact
_ODD = 8.0  # nats of a unit beyond those expected
# of a held value without and with dither
_LOOKS = np.log([[0.99, 0.007, 0.003], [0.1, 0.88, 0.02]])
_USUALLY = 8.0  # cells that the usual look of a piece is worth

Kept = TypeVar("Kept")


class Log:
    """A log as symbols.

    Attributes:
        record: its pieces.
        living: bool ``[D]``, cells that ever moved in the reference.
        received: bool ``[D]``, cells that deliver readings.
        far: bool ``[D]``, those that move by more than a dither.
        above: readings above rest ``[n, D]``, without what the pad shares.
        sunk: bool ``[n, D]``, where the pad has sunk so far that a cell rests at 0, without noise.
        disturbed: bool ``[D]``, cells of pads that share what the reference never saw: an offset, a
            drift, noise, coarse steps, or a top that loads reach.
        saturated: whether any load may read as the top.
        step: of the converter, where it is coarser than that of the reference; else 0.
        either: int8 ``[shifts, n, D]``, levels that a reading may have: near an edge, either.
        value: ``[D]``, reading at the end, of the pieces that agree with the last one.
        holds: bool ``[n, D]``, pieces at this value.
    """

    def __init__(self, record: Record, symbols: Symbols, present: Mask, living: Mask) -> None:
        self.record = record
        self.symbols = symbols
        self.living = living
        rest = symbols.rest
        lowest = np.fmin.reduce(record.low)
        highest = np.fmax.reduce(record.high)
        self.received = present & record.received.any(axis=0)
        self.far = self.received & (highest - lowest > DITHER * rest.full)
        telling = living & self.received
        shared = rest.shared(record, telling)
        self.above = rest.above(record, shared.offset)
        self.sunk: Mask = (shared.offset < 0) & (rest.level + shared.offset <= rest.near)
        noise = rest.noise_of(record, self.above, telling)
        unsure, self.step = rest.unsure(record, noise, shared, telling)
        wider = unsure > rest.near
        self.saturated = rest.saturates(record, self.above, telling & self.far)
        self.disturbed: Mask = shared.unseen | rest.noisier(noise)
        if self.is_coarse:
            self.disturbed = np.ones_like(self.disturbed)
        # on a pad that nothing touches a cell rests that stays about its rest, wherever that is
        moves = np.fmax.reduce(record.mean) - np.fmin.reduce(record.mean) > DITHER * rest.full
        untouched = ~np.isin(rest.pad, rest.pad[moves & telling])
        about = np.where(untouched & living, DITHER * rest.full, np.where(wider, unsure, 0))
        self.above = np.where(np.abs(self.above) <= about, 0, self.above)
        self.value = _held(record.mean, DITHER * rest.full)
        # beyond the range of the reference every reading is the top
        top = rest.full - symbols.tolerance
        saturates = self.value >= top
        low = np.where(saturates, top, self.value - symbols.tolerance)
        high = np.where(saturates, np.inf, self.value + symbols.tolerance)
        self.holds = (record.low >= low) & (record.high <= high)
        doubt = np.where(wider, unsure, rest.near / 2)
        shifts = [np.zeros_like(doubt), -doubt, doubt]
        if self.step or wider.any():
            shifts += [-doubt / 2, doubt / 2]
        # an offset that the reference never saw: a cell may share none of it, or sink by half
        uneven = np.where(shared.unseen, (1 + EVEN) * np.maximum(shared.offset, 0), 0)
        self.either = np.stack(
            [symbols.levels(record, self.above + shift, self.holds, uneven) for shift in shifts]
        )
        self._alone: Array | None = None

    @cached_property
    def load(self) -> Array:
        """Root loads ``[n, D]``."""
        return root_load(self.above, self.symbols.rest)

    @property
    def level(self) -> NDArray[np.int8]:
        """Level of each piece, ``[n, D]``."""
        found: NDArray[np.int8] = self.either[0]
        return found

    @cached_property
    def agree(self) -> Array:
        """Log P(two readings of the level of each piece agree), ``[n, D]``."""
        found: Array = np.log(self.symbols.agree(self.step))[self.level]
        return found

    @cached_property
    def finest(self) -> Array:
        """Readings of a cell that differ by less are the same, but for its noise, ``[D]``."""
        rest = self.symbols.rest
        found: Array = np.maximum(max(rest.least, self.step / 2), rest.noise)
        return found

    @cached_property
    def same_by_chance(self) -> Array:
        """Log P(two readings of the level of each piece are the same), ``[n, D]``."""
        ranges = self.symbols.ranges[self.level] * self.symbols.rest.full
        found: Array = np.log(np.minimum(1, 2 * self.finest / ranges))
        return found

    @cached_property
    def flat(self) -> NDArray[np.int8]:
        """How flat each piece is, ``[n, D]``."""
        return self.symbols.flat(self.record)

    @cached_property
    def before(self) -> NDArray[np.int8]:
        """How flat the piece before each one is, ``[n, D]``."""
        return before_of(self.flat, self.record)

    @cached_property
    def run(self) -> NDArray[np.intp]:
        """Number of pieces at the value of the end, up to the end, ``[D]``."""
        at_end = np.logical_and.accumulate(np.flip(self.holds, 0), 0)
        found: NDArray[np.intp] = at_end.sum(axis=0)
        return found

    @property
    def overloaded(self) -> Mask:
        """Cells that move and end at a top that any load may reach, bool ``[D]``."""
        found: Mask = self.far & (self.level[-1] == self.symbols.top) & self.saturated
        return found

    @property
    def is_coarse(self) -> bool:
        """Whether readings tell loads less finely than in the reference."""
        return bool(self.step or self.saturated)

    def alone(self, predictor: Predictor) -> Array:
        """Return log P(observed level) ``[n, D]`` by what each cell read a piece ago, nobody
        else."""
        if self._alone is None:
            nobody = np.zeros_like(self.received)
            self._alone = self.likelihood(
                predictor(self.load, self.load, self.record.first, nobody)
            )
        return self._alone

    def likelihood(self, levels: Array, lag: int = 0) -> Array:
        """Return log P of each piece from ``lag`` on by P(level) ``[n - lag, D, K]``: of the
        likeliest level that the reading may have."""
        if self.saturated:
            top = self.symbols.top
            levels = levels.copy()
            levels[..., top] = levels[..., 1 : top + 1].sum(axis=-1)
        chosen = self.either[:, lag:, :, None].astype(np.intp)
        found: Array = np.take_along_axis(levels[None], chosen, 3)[..., 0].max(axis=0)
        if self.step:
            # a step holds several levels; what is below rest by half of one is at rest
            loads = np.where(chosen[3:] > self.symbols.top, 0, chosen[3:])
            up_to = np.pad(np.cumsum(levels, -1), ((0, 0), (0, 0), (1, 0)))
            least = np.take_along_axis(up_to, loads.min(axis=0), 2)
            most = np.take_along_axis(up_to, loads.max(axis=0) + 1, 2)
            found = np.maximum(found, (most - least)[..., 0])
        return np.log(found)


def _held(mean: Array, dither: float) -> Array:
    """Return the value that each cell holds at the end, ``[D]``: the mean of its last pieces
    ``[n, D]`` that differ from the last one by no more than a dither."""
    from_end = np.flip(mean, 0)
    alike = np.logical_and.accumulate(np.abs(from_end - mean[-1]) <= dither, 0)
    count = np.maximum(alike.sum(axis=0), 1)
    found: Array = (np.where(alike, from_end, 0).sum(axis=0) / count).astype(np.float32)
    return np.where(alike[0], found, np.float32(np.nan))


def _same(load: Array) -> Mask:
    """Return where loads ``[n, D]`` are those of a piece ago."""
    before = np.roll(load, 1, axis=0)
    found: Mask = np.abs(load - before) <= _STAYS * np.maximum(load, before)
    return found


class Observed:
    """What the ``known`` cells, bool ``[D]``, say of a log.

    Attributes:
        levels: P(level) ``[n, D, K]``.
        unwitnessed: where nobody tells of a contact, bool ``[n, D]``.
        of_level: log P(observed level) ``[n, D]``.
        of_flatness: log P(observed flatness | level, how many others move) ``[n, D]``.
        alone: log P(observed level) ``[n, D]`` by the past of the cell, nobody else.
        alike: how many others look alike, and of how many, ``[n, D]`` each.
    """

    def __init__(self, log: Log, known: Mask, predictor: Predictor, flatness: Flatness) -> None:
        self.log = log
        self.known = known
        self.predictor = predictor
        self.flatness = flatness
        self.levels = predictor(log.load, log.load, log.record.first, known)
        self.unwitnessed = self._unwitnessed()
        self.of_level = np.where(self.unwitnessed, 0, log.likelihood(self.levels))
        self.group = log.symbols.group(log.level)
        activity = activity_of(log.level, log.flat, known)
        self.alike = self._alike()
        usual = flatness.of_others(self.group, activity, log.flat)
        self.of_flatness = self._shared(usual)
        self.alone = log.alone(predictor)
        self._kept: dict[Hashable, Any] = {}

    def once(self, name: Hashable, found: Callable[[], Kept]) -> Kept:
        """Return what is ``found`` of a log by these cells, which is asked once."""
        if name not in self._kept:
            self._kept[name] = found()
        kept: Kept = self._kept[name]
        return kept

    def _unwitnessed(self) -> Mask:
        """Return where nobody tells of a contact, bool ``[n, D]``.

        Nobody on a pad is loaded but lightly: that nothing touches it is no surprise, however often
        something usually does; nor that cells rest a little higher. Or nobody is known: all loads
        may be one contact.
        """
        log = self.log
        if not self.known.any():
            return log.level < log.symbols.top
        witnesses = (log.level > _LIGHT) & self.known
        touched = self.predictor.on_pad(witnesses.astype(np.float32)) > 0
        found: Mask = (log.level <= _LIGHT) & ~touched
        return found

    def _alike(self) -> tuple[Array, Array]:
        """Return how many of the other known cells of the pad that rest as a cell does, or do not,
        are as flat in the same piece, and how many there are, ``[n, D]`` each."""
        log = self.log
        alike = np.zeros(log.level.shape, np.float32)
        every = np.zeros(log.level.shape, np.float32)
        for rests in (True, False):
            mine = (log.level == 0) == rests
            tell = mine & self.known
            for flat in range(MOVES + 1):
                of_flat = tell & (log.flat == flat)
                count = self.predictor.on_pad(of_flat.astype(np.float32)) - of_flat
                every += np.where(mine, count, 0)
                alike += np.where(mine & (log.flat == flat), count, 0)
        return alike, every

    def _shared(self, usual: Array) -> Array:
        """Return log P(observed flatness) ``[n, D]``: the ``usual`` one, or more where so many
        others on the pad look alike: noise is what a pad shares."""
        alike, every = self.alike
        posterior = np.log((alike + _USUALLY * np.exp(usual)) / (every + _USUALLY))
        found: Array = np.maximum(usual, posterior)
        return found

    def constancy(self, *, dithers: bool) -> Array:
        """Return the log ratio ``[n, D]`` of how flat a piece is, given the one before, where a
        cell holds its value: nothing where no known cell moves, at rest where steps are coarser, or
        where a disturbed pad dithers there, or at a top that any load reaches."""
        log = self.log
        moves = ((log.flat == MOVES) & self.known).any(axis=1)
        healthy = self._shared(self.flatness.of_chain(self.group, log.before, log.flat))
        ratio = _LOOKS[int(dithers)][log.flat] - healthy
        tells = log.holds & (log.flat != MOVES) & moves[:, None]
        if log.step:
            tells &= log.level > 0
        if dithers:
            tells &= (log.level > 0) | ~log.disturbed
        if log.saturated:
            tells &= log.level != log.symbols.top
        tells &= ~self.stays | (log.level == 0)
        tells &= ~log.sunk
        found: Array = np.where(tells, ratio, 0).astype(np.float32)
        return found

    @cached_property
    def tells(self) -> Mask:
        """Where a reading tells a fault from none, bool ``[n, D]``."""
        return self.log.record.received & ~self.stays

    @cached_property
    def stays(self) -> Mask:
        """Where a cell stays while the load that known cells of its pad report stays, bool
        ``[n, D]``: so does a healthy one, but not below its rest, nor at the top while no other
        is loaded, nor beyond what the reference shows: no load that stays holds it there."""
        log = self.log
        load = np.where(self.known, log.load, 0).astype(np.float32)
        of_pad = self.predictor.on_pad(load)
        # an offset that is found anew moves nobody
        every = np.stack([log.above, log.record.mean])
        changes = np.abs(np.diff(every, axis=1, prepend=every[:, :1])).min(axis=0)
        dithers = changes <= DITHER * log.symbols.rest.full
        nobody_moves = self.predictor.on_pad((self.known & ~dithers).astype(np.float32)) == 0
        of_others = _same(of_pad) | nobody_moves
        stays = of_others & (_same(log.load) | dithers) & ~log.record.first[:, None]
        symbols = log.symbols
        beside_others = of_pad - load > NOTHING
        usual = log.record.mean <= symbols.rest.full + symbols.tolerance
        at_top = (log.level == symbols.top) & usual & beside_others
        found: Mask = stays & ((log.level < symbols.top) | at_top)
        return found

    def delayed(self, lag: int) -> Array:
        """Return log P(observed level) ``[n, D]`` by what the others said ``lag`` pieces ago; by
        what they say where nothing was said then."""
        return self.once(("delayed", lag), lambda: self._delayed(lag))

    def _delayed(self, lag: int) -> Array:
        log = self.log
        found = self.of_level.copy()
        if len(found) > lag:
            told = log.load[:-lag]
            own = log.load[lag:]
            levels = self.predictor(told, own, log.record.first[lag:], self.known)
            found[lag:] = log.likelihood(levels, lag)
        return found

    @cached_property
    def odd(self) -> Mask:
        """Units in which cells read what a healthy one hardly does, bool ``[units, D]``."""
        expected = np.einsum("ndk,ndk->nd", self.levels, np.log(self.levels))
        surprise = self.log.record.sum_of_units(self.of_level - expected)
        found: Mask = surprise < -_ODD
        return found
