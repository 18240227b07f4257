"""Ageing: the condition of each cell in the recordings of one run, from which trends over many runs
are estimated.

Statistics, per cell, with the load l(t) = r(t) - b and the contact limit c = 5 % of the largest
load in the reference::

    baseline   b = 5 % quantile of all r(t), if the 25 % quantile is within
               2 % of full scale: the cell rests
    peak       median, over contacts (runs of frames with l(t) > c that reach 2 c), of the
               highest load in each
    gain       peak : peak in the reference
    offset     (b - b in the reference) / full scale
    noise      1.4826 / sqrt(6) * median |second difference| of the unloaded
               frames / full scale; median over recordings
    blinks     number of losses of a load for at most 6 frames, per loaded frame

The noise equals the median absolute deviation of white noise (Rousseeuw and Croux 1993); a second
difference is free of slow loads. A statistic is NaN where the recordings do not tell: fewer than 5
contacts of the cell, here or in the reference, 20 loaded frames, or a cell that does not rest. Its
gain then refers to the baseline of the reference.

Not detected: what the contacts do not test. Loads that have become too weak to be contacts drop
out, so that the gain of a cell of weak loads is too large. Other objects or tasks than in the
reference change the gains of all cells.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.evidence.intermittency import ALIKE, LONGEST_BLINK
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import LEAST_LOADED, LIGHT, LOW, SLIGHT
from diagnostics.preprocessing.readings import CELLS

# contacts and frames without which a statistic is NaN
_CONTACTS = 5
_LOADED = 20
_UNLOADED = 8

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CellCondition:
    """Condition of each cell, float ``[D]`` each; NaN: the recordings do not tell.

    Attributes:
        gain: ratio of the loads to those of the reference.
        offset: shift of the baseline since the reference, as a share of full scale.
        noise: standard deviation of the unloaded readings, as a share of full scale.
        blinks: short losses of a load, per loaded frame.
    """

    gain: Floats
    offset: Floats
    noise: Floats
    blinks: Floats

    @property
    def values(self) -> Floats:
        """The four statistics, ``[4, D]``, in the order of :data:`STATISTICS`."""
        return np.stack([getattr(self, name) for name in STATISTICS])


STATISTICS = tuple(field.name for field in fields(CellCondition))
"""Names of the statistics of a cell."""


def cell_condition(
    recordings: Iterable[NDArray[Any]], reference: Iterable[NDArray[Any]], layout: SensorLayout
) -> CellCondition:
    """Return the condition of the cells in recordings, compared with healthy ones.

    Args:
        recordings: loads ``[T, D]`` each, in the layout's unit; NaN = missing.
        reference: healthy recordings, likewise.
        layout: the array.
    """
    old = _Measured.of([np.asarray(r, np.float64) for r in reference], layout)
    new = _Measured.of([np.asarray(r, np.float64) for r in recordings], layout, old)
    absent = ~layout.is_cell
    return CellCondition(
        *(
            np.where(absent, np.nan, statistic)
            for statistic in (
                new.peak / old.peak,
                np.where(new.rests & old.rests, new.baseline - old.baseline, np.nan)
                / layout.full_scale,
                new.noise / layout.full_scale,
                new.blinks,
            )
        )
    )


@dataclass(frozen=True, eq=False)
class _Measured:
    """Peak, baseline and noise in the layout's unit, blinks per loaded frame, whether it rests,
    ``[D]``; limit c."""

    peak: Floats
    baseline: Floats
    noise: Floats
    blinks: Floats
    rests: NDArray[np.bool_]
    limit: float

    @classmethod
    def of(
        cls, recordings: Sequence[Floats], layout: SensorLayout, reference: _Measured | None = None
    ) -> _Measured:
        """Measure; the reference gives the limit of contacts, and the baseline of cells that do not
        rest."""
        d = layout.n_cells
        recordings = [frames for frames in recordings if len(frames)]
        if not recordings:
            unknown = np.full(d, np.nan)
            none = np.zeros(d, bool)
            return cls(unknown, unknown, unknown, unknown, none, LIGHT * layout.full_scale)
        blocks = [slice(first, first + CELLS) for first in range(0, d, CELLS)]
        pooled = (np.concatenate([frames[:, block] for frames in recordings]) for block in blocks)
        low, quarter = np.hstack(
            [[_quantile(readings, share) for share in (LOW, LEAST_LOADED)] for readings in pooled]
        )
        rests = quarter - low <= SLIGHT * layout.full_scale
        if reference is None:
            largest = max(
                (float(np.fmax.reduce(frames - low, axis=None)) for frames in recordings),
                default=np.nan,
            )
            usable = np.isfinite(largest) and largest > 0
            baseline = low
            limit = LIGHT * min(largest if usable else layout.full_scale, layout.full_scale)
        else:
            baseline = np.where(rests, low, reference.baseline)
            limit = reference.limit
        cells = []
        peaks = []
        noise = []
        blinks = np.zeros(d)
        loaded = np.zeros(d)
        for frames in recordings:
            load = frames - baseline
            of, peak, lost = _contacts(load, limit)
            cells.append(of)
            peaks.append(peak)
            blinks += np.bincount(lost, minlength=d)
            loaded += (load > limit).sum(axis=0)
            noise.append(_noise(load, limit))
        enough = np.where(loaded >= _LOADED, loaded, np.nan)
        medians = _medians(np.concatenate(cells), np.concatenate(peaks), d)
        calm = np.where(rests, _quantile(np.stack(noise), 0.5), np.nan)
        return cls(medians, baseline, calm, blinks / enough, rests, limit)


def _quantile(values: Floats, share: float) -> Floats:
    """Return a quantile over the first axis without the missing values, rounded down; NaN where all
    are missing."""
    n = np.count_nonzero(~np.isnan(values), axis=0)
    which = np.floor(share * np.maximum(n - 1, 0)).astype(np.intp)
    found: Floats = np.take_along_axis(np.sort(values, axis=0), which[None], axis=0)[0]
    return found


def _contacts(load: Floats, limit: float) -> tuple[NDArray[np.intp], Floats, NDArray[np.intp]]:
    """Return the cell and the peak of each contact, and the cell of each blink."""
    n, d = load.shape
    padded = np.zeros((d, n + 1))  # one unloaded frame ends the contacts of each cell
    padded[:, :n] = np.nan_to_num(load.T)
    x = padded.ravel()
    edges = np.flatnonzero(np.diff((x > limit).astype(np.int8), prepend=0))
    starts = edges[::2]
    ends = edges[1::2]
    cells = starts // (n + 1)
    if not len(starts):
        return cells, np.zeros(0), cells
    before = x[ends[:-1] - 1]
    after = x[starts[1:]]
    blink = (cells[1:] == cells[:-1]) & (starts[1:] - ends[:-1] <= LONGEST_BLINK)
    # In one step each way, and to about the same load: no contact does that.
    blink &= (
        (before > 2 * limit)
        & (x[ends[:-1]] <= limit / 2)
        & (np.abs(after - before) <= ALIKE * before)
    )
    peaks = np.maximum.reduceat(x, starts)
    # noise divides a load near the limit into many contacts that end below
    contact = peaks > 2 * limit
    return cells[contact], peaks[contact], cells[1:][blink]


def _medians(cells: NDArray[np.intp], values: Floats, d: int) -> Floats:
    """Return the median of the values of each cell; NaN for fewer than 5."""
    count = np.bincount(cells, minlength=d)
    ordered = values[np.lexsort((values, cells))]
    first = count.cumsum() - count
    found = np.full(d, np.nan)
    some = np.flatnonzero(count >= _CONTACTS)
    found[some] = (
        ordered[(first + (count - 1) // 2)[some]] + ordered[(first + count // 2)[some]]
    ) / 2
    return found


def _noise(load: Floats, limit: float) -> Floats:
    """Return the noise of each cell in the frames without load; NaN for fewer than 8."""
    if len(load) < 3:
        return np.full(load.shape[1], np.nan)
    quiet = np.abs(load) <= limit
    calm = quiet[:-2] & quiet[1:-1] & quiet[2:]
    curvature = np.where(calm, np.abs(np.diff(load, 2, axis=0)), np.nan)
    noise = 1.4826 / np.sqrt(6) * _quantile(curvature, 0.5)
    return np.where(calm.sum(axis=0) >= _UNLOADED, noise, np.nan)
