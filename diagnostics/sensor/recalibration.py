"""Recalibration: gain and offset of each cell of a replaced pad, learned from recordings without
labels.

A new specimen of a pad has other gains and offsets. The reading of cell i is modelled as

    reading = g_i usual reading + o_i

o_i follows from low quantiles, without noise that came. log g_i is the mean of 2 log(y_e / m_e)
over the events e that load the cell, for its root load y_e and the mean m_e that the healthy model
expects from the other cells; the readings are corrected and the means computed again, until they
agree (Gauss-Seidel).
Cells of one pad share a normal prior of log g, with mean and variance estimated from them
(random-effects model, DerSimonian and Laird 1986), so that cells with few events take the gain of
their pad. A pad was replaced where its cells differ from each other: either half of the recordings
gives them the same gains or offsets, with a standard deviation over the cells (the root of the
comedian of the halves, which a few faulty cells do not raise; Falk 1997) of half of log 1.3 or 1 %
of full scale. Another task changes the loads of all cells alike; a strap gives neighbours alike
offsets, those of a new pad are independent. The correction must also raise the pseudo-likelihood of
recordings that it was not learned from, by more than four standard errors over these recordings; by
two in the older and in the newer half, where it is to be undone. Exchanged wires, once put back,
must not raise it more.

Not detected: other noise, other thresholds, and gains of cells that no event loads: these take the
mean of their pad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import chi2

from diagnostics.healthy.model import contact_events
from diagnostics.healthy.prediction import OUTLIERS, log_student_t
from diagnostics.preprocessing.levels import FEWEST, LOW, MARGIN, SLIGHT
from diagnostics.preprocessing.readings import held
from diagnostics.sensor.gain import GAIN

if TYPE_CHECKING:
    from diagnostics.evidence.reference import Reference
    from diagnostics.healthy.prediction import Prediction
    from diagnostics.layout import SensorLayout
    from diagnostics.preprocessing.scale import Array

_FEWEST = 12  # recordings
_FEWEST_EVENTS = 3  # of a cell: fewer prove no gain
_ERRORS = 4.0  # standard errors of the gain in pseudo-likelihood
# of the correction; share of each correction that is applied: neighbours err together
_ROUNDS = 4
_STEP = 0.6
_LEAST_VARIANCE = 0.02  # of 2 log(y / m) in one event: events of a log are similar
_MEDIAN_DEVIATION = 0.6745  # of a normal distribution, in standard deviations
_FARTHEST = 1.5  # 2 log(y / m) of one event counts no more
_WIDE = 1.5  # standardised errors beyond this count less (Huber 1964)

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Learned = tuple[Floats, Floats]  # log gain and offset of each cell, [D]


@dataclass(frozen=True)
class Recalibration:
    """Gains and offsets of replaced pads: reading = gain x usual reading + offset.

    Attributes:
        gain, offset: float ``[D]``; 1 and 0 on pads that were not replaced.
        pads: the replaced pads.
        recordings: number of recordings that it was learned from.
        throughout: whether the older and the newer half of them show it, each by itself.
    """

    gain: Floats
    offset: Floats
    pads: tuple[int, ...]
    recordings: int
    throughout: bool = True

    @property
    def reason(self) -> str:
        """One sentence."""
        pads = f"pad{'s' if len(self.pads) > 1 else ''} {', '.join(map(str, self.pads))}"
        return f"{pads} replaced: gains and offsets learned from {self.recordings} recordings"

    def on(self, layout: SensorLayout) -> Mask:
        """Return the cells of the replaced pads, bool ``[D]``."""
        return np.isin(layout.pad_of, self.pads)

    def undo(self, frames: NDArray[Any], full_scale: float) -> NDArray[Any]:
        """Return frames ``[..., D]`` as the reference would read them, within 0 to
        ``full_scale``."""
        return recalibrated(frames, self.gain, self.offset, full_scale)


def recalibrated(
    frames: NDArray[Any], gain: Floats, offset: Floats, full_scale: float
) -> NDArray[Any]:
    """Return ``(frames - offset) / gain`` within 0 to ``full_scale``; readings that no converter
    gives stay."""
    frames = frames if frames.dtype.kind == "f" else frames.astype(np.float64)
    given = (np.abs(frames - full_scale / 2) <= 1.5 * full_scale) & ((gain != 1) | (offset != 0))
    return np.where(given, np.clip((frames - offset) / gain, 0.0, full_scale), frames).astype(
        frames.dtype
    )


def find_recalibration(
    recordings: Sequence[NDArray[Any]],
    healthy: Sequence[NDArray[Any]],
    reference: Reference,
    layout: SensorLayout,
    excluded: Mask,
    statically_loaded: Mask,
    *,
    rival: Sequence[NDArray[Any]] | None = None,
) -> Recalibration | None:
    """Return gains and offsets of the pads that read otherwise; None where none does, or the data
    do not tell.

    Args:
        recordings: new ones, loads ``[T, D]`` each; NaN = missing.
        healthy: those of the reference, likewise.
        reference: fitted to them.
        layout: the array.
        excluded: bool ``[D]``, cells that are faulty.
        statically_loaded: bool ``[D]``, cells under an object. Its pad was replaced only if the
            other cells read otherwise too.
        rival: the recordings with wires put back, which must not explain the log better.
    """
    used = layout.present.ravel() & ~excluded & (reference.dead == 0)
    new = [filled for r in recordings if (filled := complete(r, reference)) is not None]
    old = [filled for r in healthy if (filled := complete(r, reference)) is not None]
    if reference.model is None or len(new) < _FEWEST or len(old) < _FEWEST:
        return None
    usual = noise_of(old)
    least = np.quantile(np.concatenate(old), LOW, axis=0)
    fit = Fit(reference, layout, used, least, usual)
    halves = new[::2], new[1::2]
    of_halves = [fit.learned(half) for half in halves]
    differing = [on for on in fit.pads if fit.differ(on & used, *of_halves)]
    if not differing:
        return None
    clear = [on & ~statically_loaded for on in differing]
    # of pseudo-likelihood in each recording, [recordings, with gains or without, differing pads]
    gains = []
    for (log_gain, offset), other in zip(of_halves, halves[::-1], strict=True):
        plain = fit.scores(other, 0 * log_gain, 0 * offset)
        gains.append(
            [
                [fit.scores(other, s * log_gain * on, offset * on) - plain for on in clear]
                for s in (1, 0)
            ]
        )
    gained = np.concatenate(gains, axis=2)
    # in order of time: the first half was learned from the even recordings, and scored the others
    gained = gained[..., np.argsort(np.r_[1 : len(new) : 2, : len(new) : 2])]
    best = gained.mean(axis=2).argmax(axis=0)
    certain = [i for i in range(len(differing)) if _certain(gained[best[i], i])]
    if not certain:
        return None
    log_gain, offset = fit.learned(new)
    gain = np.ones_like(log_gain)
    rest = reference.scale.baseline
    if rival is not None and fit.prefers(rival, halves, of_halves, [differing[i] for i in certain]):
        return None
    replaced = []
    throughout = True
    moved = np.zeros_like(offset)
    for i in certain:
        on = differing[i]
        _, errors = _correlation(offset, clear[i], layout)
        # what lies on few pairs of cells is not told from a strap
        hidden = statically_loaded[on].any() and not np.isfinite(errors)
        if not hidden and not neighbours_agree(offset, clear[i], layout):
            replaced.append(int(layout.pad_of[on][0]))
            throughout &= _throughout(gained[best[i], i])
            gain[on] = np.exp(log_gain[on]) if best[i] == 0 else 1.0
            moved[on] = (rest + offset - gain * rest)[on]
    if not replaced:
        return None
    return Recalibration(gain, moved, tuple(replaced), len(new), throughout)


def neighbours_agree(offset: Floats, on: Mask, layout: SensorLayout) -> bool:
    """Return whether neighbouring cells of a pad (bool ``[D]``) have alike offsets (``[D]``): a
    strap or an object loads them so."""
    correlation, errors = _correlation(offset, on, layout)
    return bool(correlation > _ERRORS * errors)


def _correlation(offset: Floats, on: Mask, layout: SensorLayout) -> tuple[float, float]:
    """Return the correlation of the offsets (``[D]``) of neighbouring cells of a pad (bool
    ``[D]``), and its error."""
    known = layout.grid(np.where(on, offset, np.nan))
    pairs = [[np.delete(known, end, axis).ravel() for end in (-1, 0)] for axis in (1, 2)]
    a, b = np.concatenate(pairs, axis=1)
    both = ~np.isnan(a) & ~np.isnan(b)
    a = a[both]
    b = b[both]
    if len(a) < _FEWEST or not a.std() or not b.std():
        return 0.0, np.inf
    return float(np.corrcoef(a, b)[0, 1]), 1 / np.sqrt(len(a))


def common_spread(one: Floats, other: Floats, on: Mask) -> float:
    """Return the standard deviation over some cells of what two estimates (``[D]``) have in common.

    The root of the comedian (Falk 1997), a median of products: a few faulty cells differ from the
    others in both.
    """
    if not on.any():
        return 0.0
    products = (one[on] - np.median(one[on])) * (other[on] - np.median(other[on]))
    return float(np.sqrt(max(np.median(products), 0.0))) / _MEDIAN_DEVIATION


def _certain(gained: Floats, errors: float = _ERRORS) -> bool:
    """Return whether the mean of values ``[n]`` is positive by more than so many standard
    errors."""
    error = gained.std(ddof=1) / np.sqrt(len(gained))
    return bool(gained.mean() > errors * error and gained.mean() > 0)


def _throughout(gained: Floats) -> bool:
    """Return whether values ``[n]``, in order of time, are positive in each half of them."""
    older, newer = np.array_split(gained, 2)
    return _certain(older, _ERRORS / 2) and _certain(newer, _ERRORS / 2)


@dataclass(frozen=True)
class Fit:
    """Gains and offsets of a sensor against its reference.

    Attributes:
        reference: of the array.
        layout: the array.
        used: bool ``[D]``, cells that serve as predictors.
        least: float ``[D]``, low quantile of the readings of the reference.
        noise: float ``[D]``, its noise.
    """

    reference: Reference
    layout: SensorLayout
    used: Mask
    least: Floats
    noise: Floats

    @property
    def pads(self) -> list[Mask]:
        """The cells of each pad, bool ``[D]``."""
        present = self.layout.present.ravel()
        return [(self.layout.pad_of == i) & present for i in range(self.layout.pads)]

    def differ(self, on: Mask, one: Learned, other: Learned) -> bool:
        """Return whether either half of a log gives some cells (bool ``[D]``) the same gains or
        offsets, which differ between the cells.

        What is learned is shrunk: half of what matters is enough.
        """
        by_gain = common_spread(one[0], other[0], on)
        by_offset = common_spread(one[1], other[1], on)
        slight = SLIGHT * self.reference.scale.full_scale
        return bool(by_gain >= np.log(GAIN) / 2 or by_offset >= slight / 2)

    def prefers(
        self,
        rival: Sequence[NDArray[Any]],
        halves: tuple[Sequence[Floats], Sequence[Floats]],
        of_halves: Sequence[Learned],
        pads: Sequence[Mask],
    ) -> bool:
        """Return whether other recordings, of the same log, are more likely than its halves with
        the gains and offsets of some pads that were learned from the other half.

        Cells that count as faulty are scored too: wires that are exchanged make them so.
        """
        everywhere = replace(self, used=self.layout.present.ravel() & (self.reference.dead == 0))
        on = np.any(pads, axis=0)
        ours = 0.0
        for (log_gain, offset), other in zip(of_halves, halves[::-1], strict=True):
            ours += everywhere.scores(other, log_gain * on, offset * on).sum()
        put_back = [one for r in rival if (one := complete(r, self.reference)) is not None]
        nothing = np.zeros(self.layout.n_cells)
        return bool(everywhere.scores(put_back, nothing, nothing).sum() > ours)

    def learned(self, recordings: Sequence[Floats]) -> Learned:
        """Return log gain and offset of each cell, ``[D]``; the offset in the layout's unit, of the
        baseline."""
        offset = self.rest(recordings) - self.least
        log_gain = np.zeros(len(offset))
        for _ in range(_ROUNDS):
            features, _ = self._events(recordings, log_gain, offset)
            if not len(features):
                break
            ratio, variance = self._ratios(features, self._predicted(features))
            for pad in self.pads:
                on = pad & self.used
                log_gain[on] += _STEP * (
                    _shrunk((log_gain + ratio)[on], variance[on]) - log_gain[on]
                )
        return log_gain, offset

    def rest(self, recordings: Sequence[Floats]) -> Floats:
        """Return a low quantile of each cell, ``[D]``, less how far noise lowers it that most cells
        have, beyond that of another gain."""
        low: Floats = np.quantile(np.concatenate(recordings), LOW, axis=0)
        came = np.maximum(noise_of(recordings) - 2 * self.noise, 0.0)
        noisier = self.used.any() and np.median(came[self.used]) > 0
        return low - ndtri(LOW) * came if noisier else low

    def scores(self, recordings: Sequence[Floats], log_gain: Floats, offset: Floats) -> Floats:
        """Return the log pseudo-likelihood of each recording, with the readings corrected."""
        features, of = self._events(recordings, log_gain, offset)
        if not len(features):
            return np.zeros(len(recordings))
        expected = self._predicted(features)
        loaded = features[:, 2] > 0
        never = np.clip(expected.never, 1e-6, 1 - 1e-6)
        error = np.where(loaded, features[:, 1] - expected.mean, 0.0) / np.nan_to_num(
            expected.spread, nan=np.inf
        )
        # A density of readings: a higher gain spreads them.
        of_load = log_student_t(error, OUTLIERS) - log_gain / 2
        score = np.where(loaded, np.log1p(-never) + of_load, np.log(never))[:, self.used].sum(
            axis=1
        )
        by_recording: Floats = np.bincount(of, score, len(recordings)).astype(np.float64)
        return by_recording

    def _predicted(self, features: Array) -> Prediction:
        assert self.reference.model is not None
        return self.reference.model.predict(features, self.used)

    def _events(
        self, recordings: Sequence[Floats], log_gain: Floats, offset: Floats
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return the features ``[n, 4, D]`` of the events with the readings corrected, and the
        recording of each."""
        rest = self.reference.scale.baseline
        gain = np.exp(log_gain)
        top = self.layout.full_scale
        found = [
            (event.whole.features(), i)
            for i, recording in enumerate(recordings)
            for event in contact_events(
                np.clip((recording - rest - offset) / gain + rest, 0.0, top), self.reference.scale
            )
        ]
        if not found:
            return np.zeros((0, 4, len(offset)), np.float32), np.zeros(0, np.intp)
        features, of = zip(*found, strict=True)
        return np.stack(features), np.array(of)

    def by_recording(self, recordings: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Return the mean of 2 log(y / m) of each cell in each recording, and its precision,
        ``[n, D]`` each; 0 and 0 where nothing tells it."""
        nothing = np.zeros(self.layout.n_cells)
        total = np.zeros((len(recordings), self.layout.n_cells))
        precision = np.zeros_like(total)
        features, of = self._events(recordings, nothing, nothing)
        if not len(features):
            return total, precision
        ratio, error = self._each_ratio(features, self._predicted(features))
        weight = 1 / (error**2 + _LEAST_VARIANCE)
        np.add.at(total, of, weight * np.clip(ratio, -_FARTHEST, _FARTHEST))
        np.add.at(precision, of, weight)
        return total / np.maximum(precision, np.finfo(float).tiny), precision

    def _each_ratio(self, features: Array, expected: Prediction) -> tuple[Floats, Floats]:
        """Return 2 log(y / m) of each event and its standard error, ``[n, D]`` each; 0 and inf
        where the cell, or what is expected of it, is hardly loaded."""
        load = features[:, 1].astype(np.float64)
        spread = np.nan_to_num(expected.spread, nan=np.inf)
        shown = (features[:, 3] > 0.5) & (expected.mean > MARGIN * self.reference.scale.root_near)
        ratio = 2 * np.log(np.maximum(load, 1e-6) / np.maximum(expected.mean, 1e-6))
        error = 2 * spread / np.maximum(expected.mean, 1e-6)
        return np.where(shown, ratio, 0.0), np.where(shown, error, np.inf)

    def _ratios(self, features: Array, expected: Prediction) -> tuple[Floats, Floats]:
        """Return the mean of 2 log(y / m) of each cell, and its variance, ``[D]``; NaN: too few
        events."""
        ratio, error = self._each_ratio(features, expected)
        plain = weight = 1 / error**2
        mean = np.zeros(ratio.shape[1])
        for _ in range(10):  # iteratively reweighted
            mean = (weight * ratio).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12)
            weight = plain * np.minimum(
                1.0, _WIDE * error / np.maximum(np.abs(ratio - mean), 1e-12)
            )
        total = np.maximum(weight.sum(axis=0), 1e-12)
        variance = np.maximum((weight * (ratio - mean) ** 2).sum(axis=0) / total, _LEAST_VARIANCE)
        variance *= (weight**2).sum(axis=0) / total**2  # 1 / effective number of events
        few = (weight > 0).sum(axis=0) < _FEWEST_EVENTS
        return np.where(few, np.nan, mean), np.where(few, np.nan, variance)


def _shrunk(log_gain: Floats, variance: Floats) -> Floats:
    """Return log gains ``[n]`` shrunk to their common mean (random-effects model); NaN becomes the
    mean."""
    known = np.isfinite(log_gain)
    if known.sum() < 2:
        return np.zeros(len(log_gain))
    x = log_gain[known]
    weight = 1 / variance[known]
    mean = (weight * x).sum() / weight.sum()
    surplus = (weight * (x - mean) ** 2).sum() - (len(x) - 1)
    between = max(0.0, surplus / (weight.sum() - (weight**2).sum() / weight.sum()))
    mean = (x / (variance[known] + between)).sum() / (1 / (variance[known] + between)).sum()
    shrunk = np.full(len(log_gain), mean)
    shrunk[known] += between / (between + variance[known]) * (x - mean)
    return shrunk


def noise_of(recordings: Sequence[Floats]) -> Floats:
    """Return the standard deviation of the noise of each cell in the quietest times, ``[D]``."""
    quiet = [
        frames[: len(frames) // FEWEST * FEWEST].reshape(-1, FEWEST, frames.shape[1]).std(axis=1)
        for frames in recordings
    ]
    spreads = np.concatenate(quiet)
    if not len(spreads):
        return np.zeros(recordings[0].shape[1])
    least = np.sqrt(chi2.ppf(LOW, FEWEST - 1) / FEWEST)  # spread of so few normal errors
    noise: Floats = np.quantile(spreads, LOW, axis=0) / least
    return noise


def complete(recording: NDArray[Any], reference: Reference) -> Floats | None:
    """Return a recording with the last reading where one is missing; None without any reading."""
    frames = np.asarray(recording, dtype=np.float64)
    if not np.isfinite(frames).any():
        return None
    known: Floats = held(frames, np.full(frames.shape[1], np.nan))[1:]
    return np.where(np.isnan(known), reference.scale.baseline, known)
