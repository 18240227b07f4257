"""How cells rest, and what a pad shares: the offset by which all its cells read more or less.

For pad p and piece t, with r the rest of each cell::

    c_p(t) = w m,   m = middle of the shortest interval that holds half of (reading - r) over the
                        cells of the pad (shorth, Andrews et al. 1972),
    w = 1 where it is narrow, 0 where it is twice as wide

Cell i shows a share a_i of it, learned from the reference. It is subtracted where the interval is
narrow: no contact is so even. All cells of the pad tell,
constant ones as well: those that are trusted would be others once the offset is wrong.

Not detected: an offset of a pad with few cells; one that comes with a contact of more than half of
them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diagnostics.model.record import Array, Cells, Mask, Record

NARROW = 0.002  # of full scale: readings differ by it without a load
DITHER = 0.01  # of full scale: a stuck value with the dither of its converter
_FEWEST = 6  # cells of a pad that tell what it shares
_EVEN = 0.5  # of a negative offset: by which the cells that share it differ
_NOISES = 3.0  # by which those that share a positive one differ; a contact may be even, too
_RESTS = 0.25  # share of the recordings in which a cell rests at some time, at least
_WIDER = 8.0  # than their interval is the spread of all, where these rest and others do not
_ROUNDS = 3
_SURE = 20.0  # pieces that a share of 1 is worth
_MOST = 1.0  # share of the offset of a pad that a cell shows
_UNSTEADY = 0.05  # of full scale: the rest of a cell differs between recordings by less


@dataclass(frozen=True)
class Rest:
    """How cells read without a contact.

    Attributes:
        level: ``[D]``, reading of each cell at rest, in the layout's unit.
        near: ``[D]``, readings this far above or below it are no load.
        full: highest reading that the reference shows, or full scale.
        high: ``[D]``, highest reading of each cell in the reference.
        pad: int ``[D]``, pad of each cell.
        share: ``[D]``, of what its pad shares that each cell shows.
    """

    level: Array
    near: Array
    full: float
    high: Array
    pad: Cells
    share: Array

    def offset(self, record: Record, telling: Mask) -> Array:
        """Return what each cell shares with its pad in each piece, ``[n, D]``; ``telling``: bool
        ``[D]``, cells that are received and live."""
        found: Array = self.share * self.of_pads(record, telling)
        return found

    def of_pads(self, record: Record, telling: Mask) -> Array:
        """Return the offset of each cell's pad in each piece, ``[n, D]``."""
        found = np.zeros(record.mean.shape, np.float32)
        stuck = self._stuck(record)
        for pad in np.unique(self.pad).tolist():
            cells = self.pad == pad
            tell = np.flatnonzero(cells & telling & (self.share > _EVEN))
            live = tell[~stuck[tell]]
            if 2 * len(live) > len(tell):
                tell = live
            if len(tell) < _FEWEST:
                continue
            middle, width = shortest(record.mean[:, tell] - self.level[tell], 0.5)
            noise = float(np.median(self.near[tell]))
            below = np.maximum(noise, _EVEN * -middle)
            limit = np.where(middle < 0, below, _NOISES * noise)
            # twice as wide, nothing is shared; between, a part: a jump would look like a load
            shared = middle * np.clip(2 - width / limit, 0, 1)
            found[:, cells] = np.nan_to_num(shared)[:, None]
        return found

    def _stuck(self, record: Record) -> Mask:
        """Return the cells that hold one value away from rest throughout, bool ``[D]``: where most
        of their pad do not, they share nothing with it."""
        ranges = np.fmax.reduce(record.high) - np.fmin.reduce(record.low)
        away = np.abs(record.mean[0] - self.level) > self.near
        found: Mask = away & (ranges <= DITHER * self.full)
        return found

    def above(self, record: Record, telling: Mask) -> Array:
        """Return how far each piece reads above the rest of the cell without what its pad shares,
        ``[n, D]``. Cells that share less than others read more, those that share more no less."""
        offset = self.offset(record, telling)
        above = record.mean - self.level - offset
        uneven = _EVEN * np.maximum(-offset, 0)
        found: Array = np.where(above < 0, np.minimum(above + uneven, 0), above)
        return found


def fit_rest(record: Record, full: float, step: float, pad: Cells, living: Mask) -> Rest:
    """Return how cells of the reference rest; ``step``: of their converter; ``living``: bool
    ``[D]``."""
    first = np.flatnonzero(record.first)
    least = max(NARROW * full, 2 * step)
    level, _ = _lowest(record.mean, first, least)
    near = np.full_like(level, least)
    high = np.fmax.reduce(record.high)
    share = np.ones_like(level)
    rest = Rest(level, near, full, high, pad, share)
    for _ in range(_ROUNDS):
        share = _share(record, rest, living, least)
        without = record.mean - share * rest.of_pads(record, living)
        level, spread = _lowest(without, first, least)
        range_ = record.high - record.low
        resting = np.where(without <= level + 2 * spread, range_, np.nan)
        noise = np.nan_to_num(np.nanmedian(resting, axis=0))
        unsteady = np.minimum(spread, _UNSTEADY * full)
        near = np.fmax(least, 2 * np.fmax(noise, unsteady)).astype(np.float32)
        rest = Rest(level, near, full, high, pad, share)
    return rest


def _share(record: Record, rest: Rest, living: Mask, least: float) -> Array:
    """Return the share of the offset of its pad that each cell shows, ``[D]``: least squares over
    the pieces in which it is not loaded, shrunk to 1; ``least``: a smaller offset tells nothing."""
    offset = rest.of_pads(record, living)
    above = record.mean - rest.level
    resting = np.abs(above) <= rest.near + 2 * np.abs(offset)
    tells = resting & (np.abs(offset) > least)
    x = np.where(tells, offset, 0).astype(np.float64)
    y = np.where(tells, above, 0)
    prior = _SURE * rest.near.astype(np.float64) ** 2
    slope = ((x * y).sum(axis=0) + prior) / ((x * x).sum(axis=0) + prior)
    found: Array = np.clip(slope, 0, _MOST).astype(np.float32)
    return found


def _lowest(readings: Array, first: Cells, least: float) -> tuple[Array, Array]:
    """Return the usual lowest reading of a recording and how it differs between them, ``[D]`` each;
    ``first``: first pieces; ``least``: readings this close are the same.

    Where some recordings agree much better than all do, the others begin and end in a contact.
    """
    lowest = np.fmin.reduceat(readings, first, axis=0)
    middle, width = shortest(lowest.T, _RESTS)
    low, usual, median = np.nan_to_num(np.nanquantile(lowest, [0.1, 0.25, 0.5], axis=0))
    spread = median - low
    agree = _WIDER * np.maximum(width, least) < spread
    level = np.where(agree, middle, usual).astype(np.float32)
    return level, np.where(agree, _WIDER * width, spread).astype(np.float32)


def shortest(values: Array, share: float) -> tuple[Array, Array]:
    """Return middle and width of the shortest interval that holds a share of the values of each
    row, ``[n]`` each of ``[n, k]``."""
    ordered = np.sort(values, axis=1)
    held = int(share * values.shape[1])
    widths = ordered[:, held:] - ordered[:, : values.shape[1] - held]
    widths = np.where(np.isnan(widths), np.inf, widths)
    at = widths.argmin(axis=1)
    row = np.arange(len(values))
    middle = (ordered[row, at] + ordered[row, at + held]) / 2
    return middle, widths[row, at]
