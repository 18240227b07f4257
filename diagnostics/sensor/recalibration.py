"""Recalibration: gain and offset of each cell of a replaced pad, learned from recordings without
labels.

A new specimen of a pad has other gains and offsets. The reading of cell i is modelled as

    reading = g_i usual reading + o_i

o_i follows from low quantiles, without noise that came. log g_i is the mean of 2 log(y_t / m_t)
over the pieces t that load the cell, for its root load y_t and the conditional mean m_t that the
model of the array expects from the other cells; the readings are corrected and the means computed
again, until they agree (Gauss-Seidel). Successive pieces that load a cell are one contact, and
count as one.
Cells of one pad share a normal prior of log g, with mean and variance estimated from them
(random-effects model, DerSimonian and Laird 1986), so that cells with few contacts take the gain of
their pad. A pad was replaced where its cells differ from each other: either half of the recordings
gives them the same gains or offsets, with a standard deviation over the cells (the root of the
comedian of the halves, which a few faulty cells do not raise; Falk 1997) of half of log 1.3 or 1 %
of full scale. Another task changes the loads of all cells alike; a strap gives neighbours alike
offsets, those of a new pad are independent. The correction must also raise the pseudo-likelihood of
recordings that it was not learned from, by more than four standard errors over these recordings; by
two in the older and in the newer half, where it is to be undone. Exchanged wires, once put back,
must not raise it more.

Not detected: other noise, other thresholds, and gains of cells that no contact loads: these take
the mean of their pad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv, ndtri

from diagnostics.evidence.prediction import OUTLIERS, log_student_t
from diagnostics.model.symbols import NOTHING, root_load
from diagnostics.preprocessing.levels import FEWEST, LOW, SLIGHT
from diagnostics.preprocessing.readings import complete
from diagnostics.sensor.gain import GAIN

if TYPE_CHECKING:
    from diagnostics.evidence.reference import Reference
    from diagnostics.layout import SensorLayout
    from diagnostics.model.judge import Model
    from diagnostics.model.record import Array, Record

_FEWEST = 12  # recordings
_FEWEST_LOADED = 3  # recordings that load a cell: fewer prove no gain
_SHOWN = 0.1  # root load that is expected, from which on a cell shows its gain
_RARELY = 0.002  # a cell is loaded, or unloaded, whatever the others say
_ERRORS = 4.0  # standard errors of the gain in pseudo-likelihood
# of the correction; share of each correction that is applied: neighbours err together
_ROUNDS = 4
_STEP = 0.6
_LEAST_VARIANCE = 0.02  # of 2 log(y / m) in one contact: contacts of a log are similar
_MEDIAN_DEVIATION = 0.6745  # of a normal distribution, in standard deviations
_FARTHEST = 1.5  # 2 log(y / m) of one piece counts no more
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
    used = layout.is_cell & ~excluded & (reference.dead == 0)
    new = complete(recordings, reference.scale.baseline)
    old = complete(healthy, reference.scale.baseline)
    if reference.model is None or len(new) < _FEWEST or len(old) < _FEWEST:
        return None
    fit = Fit.of(reference, layout, used, old)
    halves = new[::2], new[1::2]
    of_halves = [fit.learned(half) for half in halves]
    differing = [on for on in fit.pads if fit.differ(on & used, *of_halves)]
    if not differing:
        return None
    clear = [on & ~statically_loaded for on in differing]
    gained = fit.gained(halves, of_halves, clear)
    best = gained.mean(axis=2).argmax(axis=0)
    certain = [i for i in range(len(differing)) if mean_is_positive(gained[best[i], i])]
    pads = [differing[i] for i in certain]
    if not pads or (rival is not None and fit.prefers(rival, halves, of_halves, pads)):
        return None
    log_gain, offset = fit.learned(new)
    gain = np.ones_like(log_gain)
    rest = fit.model.symbols.rest.level
    moved = np.zeros_like(offset)
    replaced = []
    throughout = True
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


def mean_is_positive(gained: Floats, errors: float = _ERRORS) -> bool:
    """Return whether the mean of values ``[n]`` is positive by more than so many standard
    errors."""
    error = gained.std(ddof=1) / np.sqrt(len(gained))
    return bool(gained.mean() > errors * error and gained.mean() > 0)


def _throughout(gained: Floats) -> bool:
    """Return whether values ``[n]``, in order of time, are positive in each half of them."""
    older, newer = np.array_split(gained, 2)
    return mean_is_positive(older, _ERRORS / 2) and mean_is_positive(newer, _ERRORS / 2)


@dataclass(frozen=True)
class Fit:
    """Gains and offsets of a sensor against its reference.

    Attributes:
        reference: of the array.
        model: of the same.
        layout: the array.
        used: bool ``[D]``, cells that serve as predictors.
        least: float ``[D]``, low quantile of the readings of the reference.
        noise: float ``[D]``, its noise.
        usual: float ``[D]``, mean of 2 log(y / m) there.
    """

    reference: Reference
    model: Model
    layout: SensorLayout
    used: Mask
    least: Floats
    noise: Floats
    usual: Floats

    @classmethod
    def of(
        cls, reference: Reference, layout: SensorLayout, used: Mask, healthy: Sequence[Floats]
    ) -> Fit:
        """Return the fit to the ``healthy`` recordings of a reference that has a model."""
        assert reference.model is not None
        least = np.quantile(np.concatenate(healthy), LOW, axis=0)
        known = used & reference.model.living
        none = np.zeros(layout.n_cells)
        fit = cls(reference, reference.model, layout, known, least, noise_of(healthy), none)
        usual, _ = _ratios(*fit.by_recording(healthy))
        return replace(fit, usual=np.nan_to_num(usual))

    @property
    def pads(self) -> list[Mask]:
        """The cells of each pad, bool ``[D]``."""
        present = self.layout.is_cell
        return [(self.layout.pad_of == i) & present for i in range(self.layout.pads)]

    def differ(self, on: Mask, one: Learned, other: Learned) -> bool:
        """Return whether either half of a log gives some cells (bool ``[D]``) the same gains or
        offsets, which differ between the cells.

        What is learned is shrunk: half of what matters is enough.
        """
        by_gain = common_spread(one[0], other[0], on)
        by_offset = common_spread(one[1], other[1], on)
        slight = SLIGHT * self.model.symbols.rest.full
        return bool(by_gain >= np.log(GAIN) / 2 or by_offset >= slight / 2)

    def gained(
        self, halves: Sequence[Sequence[Floats]], of_halves: Sequence[Learned], pads: Sequence[Mask]
    ) -> Floats:
        """Return how much more likely each recording is with the gains and offsets of a pad, or its
        offsets alone, that were learned from the other half: ``[2, pads, recordings]``, in order of
        time."""
        gains = []
        for (log_gain, offset), other in zip(of_halves, halves[::-1], strict=True):
            plain = self.scores(other, 0 * log_gain, 0 * offset)
            both = [
                [self.scores(other, s * log_gain * on, offset * on) for on in pads] for s in (1, 0)
            ]
            gains.append(np.array(both) - plain)
        # the first half was learned from the even recordings, and scored the others
        n = sum(map(len, halves))
        return np.concatenate(gains, axis=2)[..., np.argsort(np.r_[1:n:2, :n:2])]

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
        everywhere = replace(self, used=self.layout.is_cell & self.model.living)
        on = np.any(pads, axis=0)
        ours = 0.0
        for (log_gain, offset), other in zip(of_halves, halves[::-1], strict=True):
            ours += everywhere.scores(other, log_gain * on, offset * on).sum()
        put_back = complete(rival, self.reference.scale.baseline)
        nothing = np.zeros(self.layout.n_cells)
        return bool(everywhere.scores(put_back, nothing, nothing).sum() > ours)

    def learned(self, recordings: Sequence[Floats]) -> Learned:
        """Return log gain and offset of each cell, ``[D]``; the offset in the layout's unit, of the
        baseline."""
        offset = self.rest(recordings) - self.least
        log_gain = np.zeros(len(offset))
        record = self.model.record_of(recordings)
        for _ in range(_ROUNDS):
            each, precision = self._by_recording(record, log_gain, offset)
            ratio, variance = _ratios(each, precision)
            for pad in self.pads:
                on = pad & self.used
                log_gain[on] += _STEP * (
                    _shrunk((log_gain + ratio - self.usual)[on], variance[on]) - log_gain[on]
                )
        return log_gain, offset

    def rest(self, recordings: Sequence[Floats]) -> Floats:
        """Return a low quantile of each cell, ``[D]``, less how far noise lowers it that most cells
        of its pad have, beyond that of another gain."""
        low: Floats = np.quantile(np.concatenate(recordings), LOW, axis=0)
        came = np.maximum(noise_of(recordings) - 2 * self.noise, 0.0)
        for pad in self.pads:
            on = pad & self.used
            if on.any() and np.median(came[on]) > 0:
                low[pad] -= ndtri(LOW) * came[pad]
        return low

    def scores(self, recordings: Sequence[Floats], log_gain: Floats, offset: Floats) -> Floats:
        """Return the log pseudo-likelihood of a piece of each recording, with the readings
        corrected."""
        record = self.model.record_of(recordings)
        load = self._loads(record, log_gain, offset)
        mean, surely = self._expected(load)
        loaded = load > _SHOWN
        error = np.where(loaded, load - mean, 0.0) / self.model.predictor.error
        # A density of readings: a higher gain spreads them.
        of_load = log_student_t(error, OUTLIERS) - log_gain / 2
        p = np.clip(surely, _RARELY, 1 - _RARELY)
        score = np.where(loaded, np.log(p) + of_load, np.log1p(-p))[:, self.used].sum(axis=1)
        pieces = np.bincount(record.recording, minlength=len(recordings))
        found: Floats = np.bincount(record.recording, score, len(recordings)) / np.maximum(
            pieces, 1
        )
        return found

    def _loads(self, record: Record, log_gain: Floats, offset: Floats) -> Array:
        """Return the root loads of the pieces with the readings corrected, ``[n, D]``."""
        rest = self.model.symbols.rest
        above = (record.mean - rest.level - offset) / np.exp(log_gain)
        return root_load(np.minimum(above, rest.full), rest)

    def _expected(self, load: Array) -> tuple[Array, Array]:
        """Return the root load that is expected of each cell by the others, and how surely it is
        loaded, ``[n, D]`` each."""
        return self.model.predictor.mean.predict(load, self.used)

    def by_recording(self, recordings: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Return the mean of 2 log(y / m) of each cell in each recording, and its precision,
        ``[n, D]`` each; 0 and 0 where nothing tells it."""
        nothing = np.zeros(self.layout.n_cells)
        return self._by_recording(self.model.record_of(recordings), nothing, nothing)

    def _by_recording(
        self, record: Record, log_gain: Floats, offset: Floats
    ) -> tuple[Floats, Floats]:
        """Return what :meth:`by_recording` does, with the readings corrected."""
        load = self._loads(record, log_gain, offset)
        mean, _ = self._expected(load)
        shown = (load > NOTHING) & (mean > _SHOWN) & np.isfinite(self.model.predictor.error)
        expected = np.maximum(mean, _SHOWN)
        ratio = 2 * np.log(np.where(shown, load, expected) / expected)
        error = 2 * self.model.predictor.error / expected
        weight = np.where(shown, 1 / (error**2 + _LEAST_VARIANCE), 0.0)
        begins = shown & ~(np.roll(shown, 1, axis=0) & ~record.first[:, None])
        first = np.flatnonzero(np.diff(record.recording, prepend=-1))
        weights = np.add.reduceat(weight, first, axis=0)
        clipped = np.clip(ratio, -_FARTHEST, _FARTHEST)
        total = np.add.reduceat(weight * clipped, first, axis=0)
        contacts = np.add.reduceat(begins, first, axis=0, dtype=float)
        pieces = np.maximum(np.add.reduceat(shown, first, axis=0, dtype=float), 1)
        found = total / np.maximum(weights, np.finfo(float).tiny)
        return found, weights * contacts / pieces


def _ratios(ratio: Floats, precision: Floats) -> tuple[Floats, Floats]:
    """Return the mean of 2 log(y / m) of each cell over the recordings, ``[n, D]``, and its
    variance, ``[D]`` each; NaN: too few recordings load it."""
    weight = precision
    mean = np.zeros(ratio.shape[1])
    for _ in range(10):  # iteratively reweighted
        mean = (weight * ratio).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12)
        away = np.abs(ratio - mean) * np.sqrt(precision)
        weight = precision * np.minimum(1.0, _WIDE / np.maximum(away, 1e-12))
    total = np.maximum(weight.sum(axis=0), 1e-12)
    variance = np.maximum((weight * (ratio - mean) ** 2).sum(axis=0) / total, _LEAST_VARIANCE)
    variance *= (weight**2).sum(axis=0) / total**2  # 1 / effective number of recordings
    few = (weight > 0).sum(axis=0) < _FEWEST_LOADED
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
    # of so few normal errors the spread: chi2.ppf of scipy.stats, which is slow to import
    least = np.sqrt(2 * gammaincinv((FEWEST - 1) / 2, LOW) / FEWEST)
    noise: Floats = np.quantile(spreads, LOW, axis=0) / least
    return noise
