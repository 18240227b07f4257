"""One signal: cells that all show the same input, as where the select lines of a multiplexer do not
step.

With s_t the median over some cells in frame t, each cell i is regressed on it: x_i = a_i + g_i s +
noise. The cells show one signal where s explains nearly all of each of them, no a_i differs from 0,
and the gains g_i are equal, or a smooth function of the place in the scan (a parabola: the input
discharges while it is scanned). Healthy cells of an array that is loaded alike everywhere agree in
s, and differ in rest and gain by more than 0.5 %.

Tried are the whole array, each pad, and in a pad with rows and columns all its rows, or all its
columns.

Not detected: a signal of less than 5 % of full scale, one that begins within the log, and fewer
than four cells.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import FEWEST, LIGHT, LOW, RARE

_ALIKE = 0.005  # by which gains, or rests as a share of the signal, may differ
_ERRORS = 4.0  # standard errors
_NOISE = 0.15  # of the signal, in standard deviations
_FEWEST_CELLS = 4
_FEWEST_IN_LINE = 3  # of which there are several
_FRAMES = 20  # fewer show nothing

Floats = NDArray[np.float64]
Cells = NDArray[np.intp]


@dataclass(frozen=True)
class OneSignal:
    """Cells that show one signal.

    Attributes:
        cells: of all lines, or of the pad, or of the array.
        reason: one sentence.
    """

    cells: tuple[int, ...]
    reason: str


def find_one_signal(sample: Floats, layout: SensorLayout) -> tuple[OneSignal, ...]:
    """Return the groups of cells that show one signal; of groups within each other the largest.

    Args:
        sample: frames of a log, ``[n, D]``, in the layout's unit; NaN = missing.
        layout: the array.
    """
    present = layout.is_cell
    least = LIGHT * layout.full_scale
    every = np.flatnonzero(present)
    step = "the select lines / the multiplexer do not step"
    if layout.pads > 1 and _is_one(sample, every, least):
        return (OneSignal(tuple(every.tolist()), _told(len(every), "", step)),)
    found = []
    for pad in range(layout.pads):
        cells = np.flatnonzero(present & (layout.pad_of == pad))
        where = f" of pad {pad}" if layout.pads > 1 else ""
        if _is_one(sample, cells, least):
            found.append(OneSignal(tuple(cells.tolist()), _told(len(cells), where, step)))
            continue
        for lines, kind, other in _lines(layout, pad):
            if _are_one_each(sample, lines, least):
                of_lines = tuple(np.sort(np.concatenate(lines)).tolist())
                text = f"in each {kind}{where} all cells show one signal: the {other} select lines"
                found.append(OneSignal(of_lines, f"{text} / the multiplexer do not step"))
                break
    return tuple(found)


def _told(count: int, where: str, why: str) -> str:
    return f"all {count} cells{where} show one signal: {why}"


def _lines(layout: SensorLayout, pad: int) -> Iterator[tuple[list[Cells], str, str]]:
    """Yield the rows of a pad, and its columns, with their names and those of the others."""
    if not layout.is_matrix:
        return
    cells = layout.grid(np.where(layout.is_cell, np.arange(layout.n_cells), -1))[pad]
    if min(cells.shape) < 2:
        return
    for of_lines, kind, other in ((cells, "row", "column"), (cells.T, "column", "row")):
        lines = [line[line >= 0] for line in of_lines]
        yield [line for line in lines if len(line)], kind, other


def _are_one_each(sample: Floats, lines: list[Cells], least: float) -> bool:
    """Return whether each line that has a signal shows one, and there are several of these."""
    has_signal = [line for line in lines if _range(_signal(sample[:, line])) >= least]
    if len(has_signal) < 2 or any(len(line) < _FEWEST_IN_LINE for line in has_signal):
        return False
    return all(_is_one(sample, line, least, fewest=_FEWEST_IN_LINE) for line in has_signal)


def _signal(readings: Floats) -> Floats:
    """Return the median of readings ``[n, cells]`` in each frame that misses none, ``[m]``."""
    return np.asarray(np.median(readings[~np.isnan(readings).any(axis=1)], axis=1))


def _range(signal: Floats) -> float:
    """Return the range of a signal, without its extremes; 0 for too few frames."""
    if len(signal) < _FRAMES:
        return 0.0
    low, high = np.quantile(signal, [RARE, 1 - RARE])
    return float(high - low)


def _is_one(sample: Floats, cells: Cells, least: float, fewest: int = _FEWEST_CELLS) -> bool:
    """Return whether some cells of a sample ``[n, D]`` show one signal of at least this size."""
    received = ~np.isnan(sample[:, cells]).all(axis=0)
    readings = sample[:, cells[received]]
    readings = readings[~np.isnan(readings).any(axis=1)]
    if len(readings) < _FRAMES:
        return False
    moves = np.ptp(readings, axis=0) > 0
    if moves.sum() < max(fewest, (1 - 2 * LOW) * len(cells)):
        return False
    readings = readings[:, moves]
    signal = np.median(readings, axis=1)
    size = _range(signal)
    if size < least:
        return False
    middle = signal.mean()
    spread = signal.std()
    n = len(signal)
    gains = (signal - middle) @ readings / (n * spread**2)
    rests = readings.mean(axis=0) - gains * middle
    noise = (readings - rests - gains * signal[:, None]).std(axis=0)
    if (noise > _NOISE * np.abs(gains) * spread).any():
        return False
    gain_error = noise / (spread * np.sqrt(n))
    rest_error = gain_error * np.hypot(spread, middle)
    if (np.abs(rests) > _ALIKE * size + _ERRORS * rest_error).any():
        return False
    place = np.arange(len(gains), dtype=np.float64)
    degree = 2 if len(gains) >= FEWEST else 0
    smooth = np.polyval(np.polyfit(place, gains, degree), place)
    return bool((np.abs(gains - smooth) <= 2 * _ALIKE + _ERRORS * gain_error).all())
