"""How cells rest, and what a pad shares: offset, drift, noise and the step of its converter.

For pad p and piece t, with r the rest of each cell and d what it drifted by since the reference::

    c_p(t) = w m + (1 - w) c_p(before or after),
    m = middle of the shortest interval that holds half of (reading - r - d) / a over the cells of
        the pad (shorth, Andrews et al. 1972),
    w = 1 where it is narrow, 0 where it is twice as wide

Cell i shows a share a_i of it, learned from the reference; where the reference never saw as much,
in turn with c from the log (rank one, by alternating least squares). It is subtracted where
the interval is narrow, compared with m: no contact is so even. A contact with most of a pad hides
what it shares; then that is what it shared before or after it in the same recording. All cells of
the pad tell, constant ones as well, but at either end of the converter: those that are trusted
would be others once the offset is wrong. None rests below 0.

A drift of single cells is a fault. Where most cells of a pad have drifted, each by its own amount,
it is none: d is what the lowest readings of most recordings around agree on. What is noisier, or
read in larger steps, than the reference rests within a wider range.

Not detected: an offset of a pad with few cells; one that comes with a contact of all of them; a
drift in fewer than four recordings, or one that goes on in fewer than seven; an object that lies on
most of a pad throughout them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from diagnostics.model.middles import (
    AROUND,
    EVEN,
    FEWEST_AROUND,
    NEARLY_ALL,
    NOISES,
    agreed,
    around,
    even,
    shortest,
    throughout,
)
from diagnostics.model.record import Array, Cells, Mask, Record, since_begin
from diagnostics.preprocessing.quantiles import known_quantile

NARROW = 0.002  # of full scale: readings differ by it without a load
DITHER = 0.01  # of full scale: a stuck value with the dither of its converter
_FEWEST = 6  # cells of a pad that tell what it shares
_SETTLES = 0.75  # of the recordings
_RESTS = 0.25  # share of the recordings in which a cell rests at some time, at least
_WIDER = 8.0  # than their interval is the spread of all, where these rest and others do not
_LASTS = 0.25  # share of the pieces in which a pad has drifted, at least
_ROUNDS = 3
_SURE = 20.0  # pieces that a share of 1 is worth
_MOST = 2.0  # share of the offset of a pad that a cell shows in a log; in the reference 1
_BLOCK = 64  # pieces of a recording that are looked at as one
_MEDIAN = 5  # of them, those that tell where its pad does
_QUIET = 0.1  # quantile of the changes between two pieces: a cell that no load moves
_QUIETEST = 0.25  # of the cells of a pad: noise is what all have
_OF_DEVIATION = 0.178  # this quantile of a normal deviate's changes
_USUALLY = 0.95  # of the pieces of the reference
_OFTEN = 0.9  # of those of a log
_NOISIER = 2.0  # times as noisy, or coarse, as the reference
_UNSEEN = 1.5  # times what the reference usually shows: it never saw as much
_FEWEST_STEPS = 3  # between the readings of a cell that has steps
_APART = 10.0  # times what n readings of a range are apart at least, range / n^2: by steps
_SATURATES = 0.1  # of the loaded readings of a usual cell are at the top
_WITHIN = 4.0  # standard deviations
_UNSTEADY = 0.05  # of full scale: the rest of a cell differs between recordings by less


@dataclass(frozen=True)
class Shared:
    """What the pads of a log share.

    Attributes:
        drift: by how much each cell rests higher than it did in the reference, ``[n, D]``.
        offset: by how much it reads more than at rest without a load, ``[n, D]``.
        unseen: bool ``[D]``, cells of pads on which the reference never saw as much.
        unknown: by how much more or less each cell may have drifted, ``[D]``.
    """

    drift: Array
    offset: Array
    unseen: Mask
    unknown: Array


@dataclass(frozen=True)
class Rest:
    """How cells read without a contact.

    Attributes:
        level: ``[D]``, reading of each cell at rest, in the layout's unit.
        near: ``[D]``, readings this far above or below it are no load.
        full: highest reading that the reference shows, or full scale.
        high: ``[D]``, highest reading of each cell in the reference.
        low: ``[D]``, lowest one above its rest.
        pad: int ``[D]``, pad of each cell.
        share: ``[D]``, of what its pad shares that each cell shows.
        noise: ``[D]``, how far each cell reads from rest in the reference by noise.
        offsets: ``[D]``, offset of its pad that few pieces of the reference exceed.
        drifts: ``[D]``, by how much it rests higher or lower in parts of the reference.
        settles: bool ``[D]``, cells that come to rest in nearly all recordings of the reference.
        pressed: bool ``[D]``, cells of pads that a contact loads as a whole, and as evenly.
        step: of the converter.
        at_top: share of the loaded readings of a usual cell that are at the top.
    """

    level: Array
    near: Array
    full: float
    high: Array
    low: Array
    pad: Cells
    share: Array
    noise: Array
    offsets: Array
    drifts: Array
    settles: Mask
    pressed: Mask
    step: float = 0.0
    at_top: float = 0.0

    @property
    def least(self) -> float:
        """Readings that differ by less are the same."""
        return max(NARROW * self.full, 2 * self.step)

    def shared(self, record: Record, telling: Mask) -> Shared:
        """Return what the pads of a log share; ``telling``: bool ``[D]``, cells that are received
        and live."""
        drift, unknown = self.drift(record, telling)
        above = record.mean - self.level - drift
        share = self.share
        of_pads = self.of_pads(record, telling, drift)
        # what the reference shows tells more, unless it never saw as much
        unseen = _usually(of_pads, _OFTEN) > _UNSEEN * self.offsets
        if unseen.any():
            own = _share(above, of_pads, self.near, share)
            in_turn = self.of_pads(record, telling, drift, own)
            own = _share(above, in_turn, self.near, share)
            of_pads = np.where(unseen, in_turn, of_pads)
            share = np.where(unseen, own, share)
        unseen |= (drift != 0).mean(axis=0) > _LASTS
        return Shared(drift, drift + share * of_pads, unseen, unknown)

    def of_pads(
        self,
        record: Record,
        telling: Mask,
        drift: Array | float = 0.0,
        share: Array | None = None,
    ) -> Array:
        """Return the offset of each cell's pad in each piece, ``[n, D]``, beside the ``drift`` of
        each cell; ``share``: ``[D]``, of it that each cell shows; None: all show the same."""
        found = np.zeros(record.mean.shape, np.float32)
        above = record.mean - self.level - drift
        stuck = self._stuck(record, above)
        # at either end of the converter a reading tells no offset
        at_top = record.mean >= self.full * (1 - DITHER)
        at_end = at_top | ((record.high <= 0) & (self.level > self.near))
        for pad in np.unique(self.pad).tolist():
            cells = self.pad == pad
            tell = np.flatnonzero(cells & telling & (self.share > EVEN))
            live = tell[~stuck[tell]]
            if 2 * len(live) > len(tell):
                tell = live
            if len(tell) < _FEWEST:
                continue
            alike = above[:, tell]
            if share is not None:  # of a usual cell's: else all shrink, and what they are of grows
                alike = alike * np.median(share[tell]) / np.maximum(share[tell], EVEN)
            of_pad = np.sort(np.where(at_end[:, tell], np.nan, alike), axis=1)
            noise = float(np.median(self.near[tell]))
            finest = max(self.least, min(noise, float(np.median(self.noise[tell]))))
            middle, weight, surely = even(of_pad, noise, finest)
            beside = around(middle, weight >= 1, record)
            nowhere = beside == 0
            # no load is negative, nor as even: in a contact with most of a pad the lowest tell
            lowest = of_pad[:, : len(tell) // 2 + 1]
            if lowest.shape[1] > _FEWEST:
                of_lowest, sunk, evenly = even(lowest, noise / 2, noise / 2)
                enough = lowest.shape[1] >= 2 * _FEWEST
                raised: Array = evenly * (enough & nowhere)
                sure: Array = np.where(of_lowest < 0, sunk, raised)
                beside = sure * of_lowest + (1 - sure) * beside
            shared = weight * middle + (1 - weight) * beside
            if self.pressed[cells].any():
                lasts = throughout(middle, weight >= 1, record)
                shared = np.minimum(shared, np.maximum(lasts, surely * middle))
            found[:, cells] = shared[:, None]
        return found

    def drift(self, record: Record, telling: Mask) -> tuple[Array, Array]:
        """Return by how much each cell rests higher than it did in the reference, where most of its
        pad do, each by an amount of its own, ``[n, D]``, and by how much that may err, ``[D]``.

        That is what the lowest readings of most of the recordings around agree on: a contact
        differs from recording to recording. Cells that contacts often do not leave alone in one
        tell nothing.
        """
        found = np.zeros(record.mean.shape, np.float32)
        unknown = np.zeros(record.mean.shape[1], np.float32)
        first = _blocks(record)
        if len(first) < FEWEST_AROUND:
            return found, unknown
        above = record.mean - self.level
        # what stays at an end of the converter is no rest
        at_end = (record.high <= 0) | (record.low >= self.full * (1 - DITHER))
        live = telling & self.settles & ~at_end.all(axis=0)
        lowest = np.fmin.reduceat(above, first, axis=0)
        of_block = np.zeros_like(lowest)
        for pad in np.unique(self.pad).tolist():
            cells = np.flatnonzero((self.pad == pad) & np.isfinite(lowest).all(axis=0))
            tell = live[cells]
            if tell.sum() < _FEWEST:
                continue
            low = lowest[:, cells]
            near = self.near[cells]
            middle = median_filter(np.median(low[:, tell], axis=1), _MEDIAN, mode="nearest")
            shared = middle[:, None]
            own, agree = agreed(low - shared, NOISES * near)
            apart = np.median(np.abs(own[:, tell]), axis=1, keepdims=True)
            usual = np.abs(own) <= NOISES * (apart + near)
            agree &= usual | (np.abs(shared + own) <= near)  # as the others, or not at all
            rests = shared + np.where(agree, own, 0)
            beyond = np.abs(rests) > np.maximum(near, _NOISIER * self.drifts[cells])
            displaced = (agree & beyond)[:, tell].mean(axis=1) > EVEN
            few = len(first) < AROUND
            if few and displaced.mean() < NEARLY_ALL:
                continue  # a contact with most of a pad
            of_block[np.ix_(displaced, cells)] = rests[displaced]
            if few:  # a cell that a contact hides in some may have drifted as the others did
                err = np.where(agree, 0, NOISES * apart)[displaced]
                unknown[cells] = err.max(axis=0, initial=0)
        pieces = np.diff(np.append(first, len(record)))
        found[:] = np.repeat(of_block, pieces, axis=0)
        return found, unknown

    def _stuck(self, record: Record, above: Array) -> Mask:
        """Return the cells that hold one value away from rest throughout, bool ``[D]``: where most
        of their pad do not, they share nothing with it."""
        ranges = np.fmax.reduce(record.high) - np.fmin.reduce(record.low)
        away = np.abs(above[0]) > self.near
        found: Mask = away & (ranges <= DITHER * self.full)
        return found

    def above(self, record: Record, offset: Array) -> Array:
        """Return how far each piece reads above the rest of the cell without the ``offset`` that
        its pad shares, ``[n, D]`` each. Cells that share less than others read more, those that
        share more no less; none rests below 0."""
        above = record.mean - np.maximum(self.level + offset, 0)
        uneven = EVEN * np.maximum(-offset, 0)
        found: Array = np.where(above < 0, np.minimum(above + uneven, 0), above)
        return found

    def unsure(
        self, record: Record, noise: Array, shared: Shared, telling: Mask
    ) -> tuple[Array, float]:
        """Return how far above or below rest a cell reads without a load in this log, ``[D]``, and
        the step of its converter: ``near``, or more where the pad is noisier than in the reference,
        its drift is unknown, or the converter is coarser.

        Args:
            record: of the log.
            noise: as :meth:`noise_of` returns it, ``[D]``.
            shared: as :meth:`shared` returns it.
            telling: bool ``[D]``, cells that are received and live.
        """
        step = _step(record, telling, 1e-5 * self.full)
        drifts = np.maximum(shared.unknown, _change(shared.drift, record))
        moves = np.maximum(noise, drifts)
        found = np.where(moves > _NOISIER * self.noise, np.maximum(self.near, moves), self.near)
        if step <= max(NARROW * self.full, _NOISIER * self.step):
            step = 0.0
        return np.maximum(found, step).astype(np.float32), step

    def noisier(self, noise: Array) -> Mask:
        """Return the cells that read further from rest by ``noise`` ``[D]`` than in the reference,
        bool ``[D]``."""
        found: Mask = noise > np.maximum(self.near, _NOISIER * self.noise)
        return found

    def saturates(self, record: Record, above: Array, telling: Mask) -> bool:
        """Return whether loads reach the top that did not in the reference; arguments as for
        :meth:`noise_of`."""
        return self.share_at_top(record, above, telling) > _SATURATES + _NOISIER * self.at_top

    def share_at_top(self, record: Record, above: Array, telling: Mask) -> float:
        """Return the share of the loaded readings of a usual cell that are at the top; arguments as
        for :meth:`noise_of`."""
        top = record.mean >= self.full * (1 - DITHER)
        count = (top | (above > self.near)).sum(axis=0)
        returns = (top[:-1] & ~top[1:]).any(axis=0)
        stuck = top[-1] & ~returns
        used = telling & (count > 0) & ~stuck
        shares = top.sum(axis=0)[used] / count[used]
        return float(np.median(shares)) if used.any() else 0.0

    def noise_of(self, record: Record, above: Array, telling: Mask) -> Array:
        """Return how far a cell reads from rest by noise, ``[D]``.

        Args:
            record: of the log.
            above: readings above rest ``[n, D]``.
            telling: bool ``[D]``, cells that are received and live.
        """
        found = np.zeros(above.shape[1], np.float32)
        follows = ~record.first[1:]
        if follows.sum() < _FEWEST:
            return found
        change = np.abs(np.diff(above, axis=0))[follows]
        usual = np.nan_to_num(np.quantile(change, _QUIET, axis=0)) / _OF_DEVIATION
        for pad in np.unique(self.pad).tolist():
            cells = (self.pad == pad) & telling
            if cells.sum() >= _FEWEST:
                quiet = np.quantile(usual[cells], _QUIETEST)
                found[cells] = np.maximum(found[cells], _WITHIN * quiet)
        return found


def _change(drift: Array, record: Record) -> Array:
    """Return by how much each cell drifts while its pad is told anew, ``[D]`` of ``[n, D]``."""
    of_block = drift[_blocks(record)]
    later = AROUND // 2
    found: Array = np.abs(of_block[later:] - of_block[:-later]).max(axis=0, initial=0)
    return found


def _step(record: Record, telling: Mask, same: float) -> float:
    """Return the smallest difference between two readings of a usual cell, where so many readings
    without steps would come much closer; 0: too few do. Readings as close as ``same`` are equal."""
    read = np.sort(np.concatenate([record.low[:, telling], record.high[:, telling]]), axis=0)
    steps = np.diff(read, axis=0)
    smallest = np.where(steps > same, steps, np.inf).min(axis=0)
    moved = (read > read[0] + smallest / 2).sum(axis=0)
    closest = (read[-1] - read[0]) / np.maximum(moved, 1) ** 2
    # a cell that rests, and is then stuck, reads two values
    sure = ((steps > same).sum(axis=0) >= _FEWEST_STEPS) & (smallest > _APART * closest)
    return float(np.median(smallest[sure])) if sure.sum() >= _FEWEST else 0.0


def fit_rest(record: Record, full: float, step: float, pad: Cells, living: Mask) -> Rest:
    """Return how cells of the reference rest; ``step``: of their converter; ``living``: bool
    ``[D]``."""
    first = np.flatnonzero(record.first)
    every = np.ones(record.mean.shape[1], bool)
    usual = every.astype(np.float32)
    none = np.zeros_like(usual)
    most = np.full_like(usual, np.inf)
    high = np.fmax.reduce(record.high)
    rest = Rest(none, none, full, high, none, pad, usual, none, most, most, every, every, step)
    least = rest.least
    level, _ = _lowest(record.mean, first, least)
    noise = rest.noise_of(record, record.mean, living)
    rest = replace(rest, level=level, near=least * usual, noise=noise)
    for _ in range(_ROUNDS):
        of_pads = rest.of_pads(record, living)
        share = _share(record.mean - rest.level, of_pads, rest.near, usual, least)
        share = np.minimum(share, usual)
        without = record.mean - share * of_pads
        level, spread = _lowest(without, first, least)
        range_ = record.high - record.low
        resting = np.where(without <= level + 2 * spread, range_, np.nan)
        moves = np.nan_to_num(known_quantile(resting, 0.5, axis=0)).astype(np.float32)
        unsteady = np.minimum(spread, _UNSTEADY * full)
        near = np.fmax(least, 2 * np.fmax(moves, unsteady)).astype(np.float32)
        rest = replace(rest, level=level, near=near, share=share)
    lowest = np.fmin.reduceat(without, first, axis=0)
    settles = (lowest <= level + near).mean(axis=0) >= _SETTLES
    rest = replace(rest, settles=settles)
    at_once = replace(rest, pressed=~every).of_pads(record, living)
    comes = at_once > rest.of_pads(record, living) + near
    rest = replace(rest, pressed=comes.mean(axis=0) > 1 - _USUALLY)
    shared = rest.shared(record, living)
    above = rest.above(record, shared.offset)
    noise = np.maximum(rest.noise_of(record, above, living), _change(shared.drift, record))
    at_top = rest.share_at_top(record, above, living)
    offsets = np.maximum(np.maximum(near, DITHER * full), _usually(rest.of_pads(record, living)))
    drifts = _usually(replace(rest, drifts=none).drift(record, living)[0])
    low = np.nan_to_num(np.fmin.reduce(above))
    return replace(rest, low=low, noise=noise, offsets=offsets, drifts=drifts, at_top=at_top)


def _usually(values: Array, share: float = _USUALLY) -> Array:
    """Return what the size of a ``share`` of the values ``[n, D]`` does not exceed, ``[D]``."""
    found: Array = np.quantile(np.abs(values), share, axis=0).astype(np.float32)
    return found


def _share(above: Array, of_pads: Array, near: Array, prior: Array, least: float = 0.0) -> Array:
    """Return the share of the offset of its pad that each cell shows, ``[D]``: least squares over
    the pieces in which it is not loaded, shrunk to a ``prior`` ``[D]``.

    Args:
        above: readings above rest ``[n, D]``.
        of_pads: offset of each cell's pad, ``[n, D]``.
        near: ``[D]``, as of :class:`Rest`.
        prior: share that is expected.
        least: a smaller offset tells nothing.
    """
    resting = np.abs(above) <= near + 2 * np.abs(of_pads)
    tells = resting & (np.abs(of_pads) > least)
    x = np.where(tells, of_pads, 0).astype(np.float64)
    y = np.where(tells, above, 0)
    sure = _SURE * near.astype(np.float64) ** 2
    slope = ((x * y).sum(axis=0) + sure * prior) / ((x * x).sum(axis=0) + sure)
    found: Array = np.clip(slope, 0, _MOST).astype(np.float32)
    return found


def _lowest(readings: Array, first: Cells, least: float) -> tuple[Array, Array]:
    """Return the usual lowest reading of a recording and how it differs between them, ``[D]`` each;
    ``first``: first pieces; ``least``: readings this close are the same.

    Where some recordings agree much better than all do, the others begin and end in a contact: a
    quarter of them anywhere, or the lowest tenth.
    """
    lowest = np.fmin.reduceat(readings, first, axis=0)
    middle, width = shortest(lowest.T, _RESTS)
    bottom = known_quantile(lowest, 0.0, axis=0)
    low = np.nan_to_num(known_quantile(lowest, 0.1, axis=0))
    usual = np.nan_to_num(known_quantile(lowest, 0.25, axis=0))
    median = np.nan_to_num(known_quantile(lowest, 0.5, axis=0))
    spread = median - low
    some = _WIDER * np.maximum(width, least) < spread
    few = ~some & (_WIDER * np.maximum(low - bottom, least) < spread)
    level = np.select([some, few], [middle, (low + bottom) / 2], usual).astype(np.float32)
    of_few = np.nan_to_num(2 * (low - bottom))
    return level, np.select([some, few], [_WIDER * width, of_few], spread).astype(np.float32)


def _blocks(record: Record) -> Cells:
    """Return the first pieces of recordings, and of the parts of long ones, int ``[blocks]``."""
    return np.flatnonzero(since_begin(record.first) % _BLOCK == 0)
