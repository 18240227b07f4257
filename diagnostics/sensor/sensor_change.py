"""A change of the whole sensor, or of a pad: gain, or offset, of all its cells. No single cell
stands out as faulty.

Statistic, per recording r over the healthy cells: the baseline b_r is the median over cells of each
cell's 5 % quantile over time; the load l_r is the 99 % quantile of all readings above the baseline.
The gain is the ratio of the median loads of new and of reference recordings, and the offset is the
difference of their median baselines. A change is reported where the two-sample test of Kolmogorov
and Smirnov (``scipy.stats.ks_2samp``) of the new against the reference recordings has p < 1e-4, and
the size matters.

A pad is compared with the other pads of the same recordings: log l_r and b_r less their medians
over the other pads. So another force or object, which all pads feel, is no change of a pad. Where
two pads differ from each other, the one that differs more from itself has changed.

Not detected: a change with fewer than five recordings of contact, a change below the limits,
swapped cells, and gains of single cells, also of a replaced pad whose cells read as much on
average. Other objects or tasks than in the reference look like a change of the gain; of a pad,
where it takes another part in them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnostics.faults import FaultSet
from diagnostics.layout import SensorLayout
from diagnostics.preprocessing.levels import LIGHT, LOW, P_MIN
from diagnostics.preprocessing.quantiles import known_quantile
from diagnostics.sensor.gain import GAIN

_LEAST = 5  # recordings, new and reference
_FEW_PAIRS = 10_000  # of a new and a reference recording: a size
_HIGH = 0.99  # quantile of the readings of a recording: its load


@dataclass(frozen=True)
class SensorChange:
    """How the readings of all cells, or of those of a pad, differ from the reference.

    Attributes:
        gain: ratio of the loads, new : reference; 1 where no change was found.
        offset: difference of the baselines in the layout's unit; 0 where no change was found.
        recordings: number of new recordings that were compared.
        reason: one sentence.
        pad: index of the pad; None: the whole sensor.
    """

    gain: float
    offset: float
    recordings: int
    reason: str
    pad: int | None = None

    def of_cells(self, layout: SensorLayout) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return gain and offset of each cell, ``[D]`` each."""
        has_changed = (
            np.full(layout.n_cells, True) if self.pad is None else layout.pad_of == self.pad
        )
        return np.where(has_changed, self.gain, 1.0), np.where(has_changed, self.offset, 0.0)


def find_change(
    recordings: Sequence[NDArray[Any]],
    reference: Sequence[NDArray[Any]],
    layout: SensorLayout,
    faulty: FaultSet,
) -> SensorChange | None:
    """Return the change of a pad, else of the whole sensor; None where none is found. ``faulty``
    cells do not count."""
    healthy = np.flatnonzero(layout.is_cell & ~faulty.mask)
    if not len(healthy):
        return None
    compared = recordings, reference, layout, healthy
    return pad_change(*compared) or sensor_change(*compared)


def sensor_change(
    recordings: Iterable[NDArray[Any]],
    reference: Iterable[NDArray[Any]],
    layout: SensorLayout,
    healthy: NDArray[np.intp],
) -> SensorChange | None:
    """Compare recordings with healthy ones; None where no change of the whole sensor is found.

    Args:
        recordings: ``[T, D]`` each, in the layout's unit; NaN = missing.
        reference: healthy recordings, likewise.
        layout: the array.
        healthy: the cells to compare, int ``[n]``.
    """
    new, old = (_statistics(given, healthy) for given in (recordings, reference))
    offset = _change(new[:, 0], old[:, 0], LIGHT * layout.full_scale)
    contact = LIGHT * float(old[:, 1].max(initial=0.0))
    loads, loads_before = (np.log(given[given[:, 1] > contact, 1]) for given in (new, old))
    gain = float(np.exp(_change(loads, loads_before, np.log(GAIN))))
    if gain == 1.0 and offset == 0.0:
        return None
    return SensorChange(gain, offset, len(new), f"sensor changed: {_told(gain, offset, layout)}")


def pad_change(
    recordings: Iterable[NDArray[Any]],
    reference: Iterable[NDArray[Any]],
    layout: SensorLayout,
    healthy: NDArray[np.intp],
) -> SensorChange | None:
    """Compare the pads with each other; None where none of them has changed. Arguments as of
    :func:`sensor_change`.

    Of several pads that have changed, the one whose readings changed most is returned.
    """
    pad_of = layout.pad_of[healthy]
    pads = np.unique(pad_of)
    if len(pads) < 2:
        return None
    new, old = (
        _by_pad(list(given), [healthy[pad_of == pad] for pad in pads])
        for given in (recordings, reference)
    )
    contact = LIGHT * float(old[..., 1].max(initial=0.0))
    least = (np.log(GAIN), LIGHT * layout.full_scale)
    found = []
    for i in range(len(pads)):
        (log_new, idle_new), (log_old, idle_old) = (
            _beside(given, i, contact) for given in (new, old)
        )
        gain = _change(log_new, log_old, least[0])
        offset = _change(idle_new, idle_old, least[1])
        if gain or offset:
            loads = [np.log(given[i, given[i, :, 1] > contact, 1]) for given in (new, old)]
            strength = (
                abs(_shift(*loads)) / least[0] + abs(_shift(new[i, :, 0], old[i, :, 0])) / least[1]
            )
            found.append((strength, int(pads[i]), float(np.exp(gain)), offset))
    if not found:
        return None
    _, pad, gain, offset = max(found)
    reason = f"pad {pad} changed: {_told(gain, offset, layout)}, compared with the other pads"
    advice = "if it was replaced, record healthy data with it and train anew"
    return SensorChange(gain, offset, new.shape[1], f"{reason}; {advice}", pad)


def _told(gain: float, offset: float, layout: SensorLayout) -> str:
    parts = []
    if gain != 1.0:
        parts.append(f"readings are about {gain:.2g}x of what they were")
    if offset != 0.0:
        parts.append(f"the readings of idle cells are shifted by {offset:+.2g} {layout.unit}")
    return " and ".join(parts)


def _by_pad(recordings: list[NDArray[Any]], cells: list[NDArray[np.intp]]) -> NDArray[np.float64]:
    """Return baseline and load of each pad in each recording with a reading of all pads,
    ``[pads, n, 2]``."""
    received = [
        r for r in recordings if all((~np.isnan(np.asarray(r)[:, pad])).any() for pad in cells)
    ]
    return np.stack([_statistics(received, pad) for pad in cells])


def _beside(
    given: NDArray[np.float64], pad: int, contact: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return log load, of recordings with contact, and baseline of a pad, less the medians over the
    other pads."""
    others = np.delete(given, pad, axis=0)
    load = np.where(others[..., 1] > contact, others[..., 1], np.nan)
    both = (given[pad, :, 1] > contact) & ~np.isnan(load).all(axis=0)
    gain = np.log(given[pad, both, 1]) - np.log(np.nanmedian(load[:, both], axis=0))
    return gain, given[pad, :, 0] - np.median(others[..., 0], axis=0)


def _change(new: NDArray[np.float64], old: NDArray[np.float64], least: float) -> float:
    """Return the difference of two medians, 0 where it is below ``least`` or may be chance."""
    change = _shift(new, old)
    return change if abs(change) >= least and differ(new, old) else 0.0


def differ(new: NDArray[np.float64], old: NDArray[np.float64]) -> bool:
    """Return whether two samples ``[n]``, of at least five recordings each, differ by more than
    chance."""
    from scipy.stats import ks_2samp  # slow to import, and rarely needed

    if min(len(new), len(old)) < _LEAST:
        return False
    # the exact distribution of many overflows, with a warning
    few = len(new) * len(old) <= _FEW_PAIRS
    p = ks_2samp(new, old, method="exact" if few else "asymp").pvalue
    return bool(p < P_MIN)


def _statistics(
    recordings: Iterable[NDArray[Any]], healthy: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return baseline and load of each recording with a reading, ``[n, 2]``."""
    rows = []
    for recording in recordings:
        frames = np.asarray(recording)[:, healthy]
        frames = frames[:, ~np.isnan(frames).all(axis=0)] if len(frames) else frames
        if frames.size:
            baseline = float(np.median(known_quantile(frames, LOW, axis=0)))
            rows.append((baseline, float(known_quantile(frames.ravel(), _HIGH, axis=0)) - baseline))
    return np.array(rows, dtype=np.float64).reshape(-1, 2)


def _shift(new: NDArray[np.float64], old: NDArray[np.float64]) -> float:
    """Return the difference of two medians; 0 for too few values."""
    return float(np.median(new) - np.median(old)) if min(len(new), len(old)) >= _LEAST else 0.0
