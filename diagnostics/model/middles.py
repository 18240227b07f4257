"""What most of some values agree on: of the cells of a pad in each piece, or of the blocks around
each one."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from diagnostics.model.record import Array, Cells, Mask, Record, since_begin

EVEN = 0.5  # of an offset: by which the cells that share it differ
NOISES = 3.0
AROUND = 7  # blocks that tell where a cell rests
FEWEST_AROUND = 4  # of them, at least
NEARLY_ALL = 0.75  # of so few
_HALF = 0.25  # of a positive offset, which a contact is as well; and by no more than some noises


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


def even(above: Array, noise: float, finest: float) -> tuple[Array, Array, Array]:
    """Return the middle of what half of the cells of a pad, at least, read alike, how surely they
    share it, and how surely no contact is as even: within the ``finest`` noise, ``[n]`` each;
    ``above``: ``[n, k]`` in ascending order."""
    middle, width = shortest(above, 0.5)
    below = np.maximum(noise, EVEN * -middle)
    most = np.clip(_HALF * middle, noise, NOISES * noise)
    middle = np.nan_to_num(middle)
    return middle, _narrow(width, np.where(middle < 0, below, most)), _narrow(width, finest)


def _narrow(width: Array, limit: Array | float) -> Array:
    """Return 1 up to the ``limit``, and 0 from twice of it on; between, a part: a jump would look
    like a load."""
    found: Array = np.nan_to_num(np.clip(2 - width / limit, 0, 1))
    return found


def around(shared: Array, sure: Mask, record: Record) -> Array:
    """Return what a pad ``shared`` (``[n]``) before or after each piece in its recording, where it
    is ``sure`` (bool ``[n]``), whichever is less; 0: nowhere."""
    n = len(shared)
    step = np.arange(n)
    begin = step - since_begin(record.first)
    last = np.maximum.accumulate(np.where(sure, step, -1))
    before = np.where(last >= begin, shared[last], np.inf)
    end = _next(np.append(record.first[1:], True))
    coming = _next(sure)
    after = np.where(coming <= end, shared[np.minimum(coming, n - 1)], np.inf)
    less = np.where(np.abs(before) <= np.abs(after), before, after)
    found: Array = np.where(np.isinf(less), 0, less)
    return found


def throughout(shared: Array, sure: Mask, record: Record) -> Array:
    """Return what a pad ``shared`` (``[n]``) at least in each recording, where it is ``sure``
    (bool ``[n]``); 0: nowhere, or less."""
    first = np.flatnonzero(record.first)
    lowest = np.minimum.reduceat(np.where(sure, shared, np.inf), first)
    lowest = np.where(np.isinf(lowest), 0, np.maximum(lowest, 0))
    found: Array = np.repeat(lowest, np.diff(np.append(first, len(record))))
    return found


def _next(on: Mask) -> Cells:
    """Return the next step that is ``on`` (bool ``[n]``), this one or a later one, int ``[n]``; n:
    none."""
    n = len(on)
    found: Cells = np.flip(np.minimum.accumulate(np.flip(np.where(on, np.arange(n), n))))
    return found


def agreed(values: Array, limit: Array) -> tuple[Array, Mask]:
    """Return what most of the blocks around each one agree on, ``[blocks, k]``, and whether they
    do: they differ by less than the ``limit`` ``[k]``. Few blocks are all around each other, and
    nearly all of them have to agree."""
    if len(values) < AROUND:
        middle, width = shortest(values.T, NEARLY_ALL)
        every = np.broadcast_to(middle, values.shape).astype(np.float32)
        return every, np.broadcast_to(width <= limit, values.shape).copy()
    half = AROUND // 2
    mirrored = np.pad(values, ((half, half), (0, 0)), mode="reflect")
    windows = sliding_window_view(mirrored, 2 * half + 1, axis=0)
    middle, width = shortest(windows.reshape(-1, 2 * half + 1), 0.5)
    return middle.reshape(values.shape), width.reshape(values.shape) <= limit
