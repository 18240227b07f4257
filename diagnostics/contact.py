"""What healthy looks like: how a touch loads a cell, given how it loads the others.

Two logistic regressions for each cell, fitted on the touches of fault-free recordings, say whether it stays unloaded
throughout a touch and whether it stays loaded throughout, and a linear one how hard it is loaded. An open cell looks
unloaded, and so does a healthy one beside the contact: everything turns on how sharply the two can be told apart.
Models of single frames, nearest frames, trees, a neural network and one model shared by all cells were each worse on
real grasps than these regressions on whole touches.

Which cells can be trusted differs from log to log. What the others would have read is filled in from the trusted ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import expit, logit

from diagnostics.few import covariance_and_precision
from diagnostics.few import logistic as logistic_of_few
from diagnostics.layout import SensorLayout
from diagnostics.patches import Patch
from diagnostics.readings import Readings
from diagnostics.temporal import segments
from diagnostics.touches import SEGMENT, Array, Scale, Summary, Touch, Touches

_SAMPLES = 3000  # stretches of touches that the model is fitted on, about
_MOST_DRAWS = 8  # stretches of one touch: more of them say the same
_SHORTEST = 6  # frames of a stretch
RIDGE = 0.03  # on standardised inputs, per sample
_STEPS = 200  # of accelerated gradient descent; the ridge makes it converge
_RESTING_QUANTILE = 0.05  # of a cell's readings: where it rests
_SUREST = 0.002  # a probability is never taken for nearer to 0 or 1, however many touches there were
_LEAST_SPREAD = 0.02  # of the root load: nothing is predicted more exactly
_NOVEL = 0.1  # share of touches that resemble nothing known
_BLOCK = 4096  # cells looked at together
FEATURES = 4  # of a cell in a touch, see Summary.features


@dataclass(frozen=True)
class Expected:
    """What healthy cells would do in each of n stretches, given the trusted cells.

    Attributes:
        never: float ``[n, D]``, P(unloaded throughout).
        always: float ``[n, D]``, P(loaded throughout).
        mean: float ``[n, D]``, expected mean root load.
        spread: float ``[D]``, scale of the error of ``mean``; NaN: cells of which nothing is known.
    """

    never: NDArray[np.float64]
    always: NDArray[np.float64]
    mean: NDArray[np.float64]
    spread: NDArray[np.float64]

    def within(
        self, low: NDArray[np.float64], high: NDArray[np.float64], cells: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """Return P(mean root load from ``low`` to ``high``), ``[n, k]``, of k ``cells``; the bounds are ``[k]``."""
        mean, spread = self.mean[:, cells], self.spread[cells]
        likely = _student_t((high - mean) / spread) - _student_t((low - mean) / spread)
        # Now and then a touch is like none before: then any load is as likely as any other.
        p = (1 - _NOVEL) * likely + _NOVEL * (np.minimum(high, 1.0) - low)
        return np.where(np.isnan(spread), 1.0, p)


@dataclass(frozen=True)
class Start:
    """What is known of a patch before its own touches are seen.

    Attributes:
        weight, bias: ``[4, inputs, 2, outputs]`` and ``[2]``, of features that are not standardised.
        ridge: of what is learned on top of them.
        taper: ``[inputs, inputs]``, how much two cells may have to do with each other.
    """

    weight: NDArray[np.float64]
    bias: NDArray[np.float64]
    ridge: float
    taper: NDArray[np.float64]


@dataclass(frozen=True)
class Tile:
    """The model of some cells (``outputs``) from those around them (``inputs``, which hold the outputs too).

    Attributes:
        inputs, outputs: int, cell indices; ``place``: where the outputs lie among the inputs.
        mean, scale: of the features of the inputs, ``[4, inputs]``.
        weight: ``[4 inputs, 2 outputs]``, never loaded and always loaded; no cell speaks for itself.
        bias: ``[2 outputs]``.
        covariance, precision: of the mean root loads, standardised, ``[inputs, inputs]``.
        spread: ``[outputs]``.
        surest: no probability is nearer to 0 or 1.
    """

    inputs: NDArray[np.intp]
    outputs: NDArray[np.intp]
    place: NDArray[np.intp]
    mean: Array
    scale: Array
    weight: Array
    bias: Array
    covariance: NDArray[np.float64]
    precision: NDArray[np.float64]
    spread: NDArray[np.float64]
    surest: float

    def __post_init__(self) -> None:
        # Matrix products round differently in another memory order: a stored and restored one must say the same.
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                object.__setattr__(self, name, np.ascontiguousarray(value))

    @property
    def patch(self) -> Patch:
        """The cells that it is about."""
        return Patch(self.inputs, self.outputs)

    @cached_property
    def alone(self) -> Tile:
        """The same model of an array that has no cells but the inputs."""
        return replace(self, inputs=np.arange(len(self.inputs)), outputs=self.place)

    @classmethod
    def fit(
        cls,
        features: Array,
        inputs: NDArray[np.intp],
        outputs: NDArray[np.intp],
        surest: float,
        start: Start | None = None,
    ) -> Tile:
        """Fit on ``[n, 4, D]``; no probability is taken for nearer to 0 or 1 than ``surest``.

        One patch of many, of few samples, has a ``start``.
        """
        from sklearn.covariance import LedoitWolf

        x = features[:, :, inputs]
        mean, scale = x.mean(axis=0), x.std(axis=0)
        if start is None:
            scale[scale < 1e-4] = np.inf  # what never changes tells nothing
        else:  # or has not changed yet
            scale = np.broadcast_to(np.maximum(scale.mean(axis=1, keepdims=True), 1e-2), scale.shape).copy()
        z = (x - mean) / scale
        place = np.searchsorted(inputs, outputs)
        targets = np.concatenate([x[:, 2, place] == 0, x[:, 3, place] == 1], axis=1).astype(np.float32)
        own = np.zeros((FEATURES, len(inputs), 2, len(outputs)), bool)
        own[:, place, :, np.arange(len(outputs))] = True
        flat, forbidden = z.reshape(len(z), -1), own.reshape(FEATURES * len(inputs), -1)
        if start is None:
            weight, bias = _logistic(flat, targets, forbidden)
            estimate = LedoitWolf().fit(z[:, 1].astype(np.float64))
            covariance, precision = estimate.covariance_, estimate.precision_
        else:
            shared = start.weight.reshape(len(forbidden), -1).astype(np.float32)
            shared_odds = x.reshape(len(z), -1) @ shared + np.repeat(start.bias, len(outputs)).astype(np.float32)
            y = targets.reshape(len(z), 2, -1)
            of_samples, own_bias = logistic_of_few(flat, y, z[:, :, place], start.ridge, shared_odds.reshape(y.shape))
            weight, bias = flat.T @ of_samples.reshape(len(z), -1), own_bias.ravel()
            weight[forbidden] = 0
            weight += shared * scale.reshape(-1, 1)
            bias += mean.reshape(-1) @ shared + np.repeat(start.bias, len(outputs)).astype(np.float32)
            covariance, precision = covariance_and_precision(z[:, 1].astype(np.float64), start.taper)
        if not z[:, 1].any():  # cells of which none was ever touched say nothing of each other
            covariance = precision = np.eye(len(inputs))
        z1 = z[:, 1].astype(np.float64)
        error = (z1 @ precision / np.diag(precision))[:, place] * np.where(np.isfinite(scale[1]), scale[1], 0)[place]
        # Where nothing is loaded nothing errs: the spread is that of the loaded stretches.
        told = x[:, 2, place] > 0
        spread = np.sqrt((error**2 * told).sum(axis=0) / np.maximum(told.sum(axis=0), 1))
        usual = float(np.sqrt(np.mean(spread**2)))
        spread = np.maximum(np.where(told.sum(axis=0) < _SHORTEST, 2 * usual, spread), _LEAST_SPREAD)
        spread[~told.any(axis=0)] = np.nan  # how a cell reads that was never loaded is unknown
        return cls(
            inputs, outputs, place, mean, scale, weight, bias,
            covariance, precision, spread, surest,
        )  # fmt: skip

    def expect(
        self, features: Array, trusted: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return P(never loaded), P(always loaded) and the mean root load of the outputs, ``[n, outputs]`` each."""
        z = (features[:, :, self.inputs] - self.mean) / self.scale
        known = trusted[self.inputs]
        self._fill(z, known)
        odds = z.reshape(len(z), -1) @ self.weight + self.bias
        p = np.clip(expit(odds.astype(np.float64)), self.surest, 1 - self.surest)
        never, always = p[:, : len(self.outputs)], p[:, len(self.outputs) :]
        # What all the other cells say of a cell: for those filled in, just what they were filled with.
        mean = z[:, 1].astype(np.float64)
        mean = mean[:, self.place] - mean @ self.precision[:, self.place] / np.diag(self.precision)[self.place]
        scale = np.where(np.isfinite(self.scale[1]), self.scale[1], 0)[self.place]
        return never, always, mean * scale + self.mean[1][self.place]

    def _fill(self, z: Array, known: NDArray[np.bool_]) -> None:
        """Write into ``z`` ``[n, 4, inputs]`` what the unknown cells would say, as the linear regression has it."""
        unknown = ~known
        if not unknown.any():
            return
        if not known.any():
            z[:] = 0
            return
        if unknown.sum() <= known.sum():
            among, between = self.precision[np.ix_(unknown, unknown)], self.precision[np.ix_(unknown, known)]
            regression = -linalg.solve(among, between, assume_a="pos")
        else:
            among, between = self.covariance[np.ix_(known, known)], self.covariance[np.ix_(known, unknown)]
            regression = linalg.solve(among, between, assume_a="pos").T
        z[:, :, unknown] = z[:, :, known] @ regression.T.astype(np.float32)


@dataclass(frozen=True)
class ContactModel:
    """See the module; ``tiles`` cover the array."""

    tiles: tuple[Tile, ...]

    @classmethod
    def fit(
        cls, recordings: Sequence[NDArray[np.float64]], layout: SensorLayout, scale: Scale, seed: int = 0
    ) -> ContactModel:
        """Fit on fault-free recordings, ``[T, D]`` each, all cells together; large arrays: ``patch_models``."""
        features, n_touches = stretches(recordings, scale, np.random.default_rng(seed))
        every = np.flatnonzero(layout.present)
        return cls((Tile.fit(features, every, every, surest_of(n_touches)),))

    def expect(self, features: Array, trusted: NDArray[np.bool_]) -> Expected:
        """Say what healthy cells would do.

        Args:
            features: ``[n, 4, D]``, of n stretches (see ``Summary.features``).
            trusted: bool ``[D]``, the cells that may be asked.
        """
        shape = (len(features), features.shape[2])
        never, always, mean = np.ones(shape), np.ones(shape), np.zeros(shape)
        spread = np.ones(shape[1])
        for tile in self.tiles:
            never[:, tile.outputs], always[:, tile.outputs], mean[:, tile.outputs] = tile.expect(features, trusted)
            spread[tile.outputs] = tile.spread
        return Expected(never, always, mean, spread)


def _student_t(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distribution function of Student's t with 4 degrees of freedom: objects have edges, edges surprise.

    In closed form, ten times as fast as the general one.
    """
    x = np.clip(x, -1e6, 1e6)
    u = x / np.sqrt(1 + x**2 / 4)
    return 0.5 + 0.375 * u * (1 - u**2 / 12)


def resting(recordings: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return where each cell rests, ``[D]``: a low quantile of its readings; 0 for a cell without any."""
    readings, n_cells = Readings.of(recordings), recordings[0].shape[1]
    rest = np.zeros(n_cells)
    for first in range(0, n_cells, _BLOCK):
        cells = np.arange(first, min(first + _BLOCK, n_cells))
        frames = np.concatenate([readings.piece(i, slice(None), cells) for i in range(len(readings))])
        heard = ~np.isnan(frames).all(axis=0)
        rest[cells[heard]] = np.nanquantile(frames[:, heard], _RESTING_QUANTILE, axis=0)
    return rest


def stretches(recordings: Sequence[NDArray[np.float64]], scale: Scale, rng: np.random.Generator) -> tuple[Array, int]:
    """Return features ``[n, 4, D]`` of random stretches of touches in fault-free recordings, and how many touches."""
    ranges = []
    for i, recording in enumerate(recordings):
        for touch in _touches(recording, scale):
            ranges.append((i, touch.first, sum(part.n for part in touch.parts)))
    return drawn(ranges, lambda i, frames: recordings[i][frames], scale, rng, _SAMPLES), len(ranges)


def drawn(
    ranges: list[tuple[int, int, int]],
    read: Callable[[int, slice], NDArray[np.float64]],
    scale: Scale,
    rng: np.random.Generator,
    most: int,
) -> Array:
    """Return features ``[n, 4, D]`` of random stretches of touches: (recording, first frame, frames) each."""
    draws = int(np.clip(round(most / len(ranges)), 1, _MOST_DRAWS))
    if len(ranges) > most:
        ranges = [ranges[i] for i in np.sort(rng.choice(len(ranges), most, replace=False))]
    features = []
    for i, first, n in ranges:
        root = scale.root_load(read(i, slice(first, first + n)))
        n = len(root)
        for draw in range(draws):
            length = int(rng.integers(min(_SHORTEST, n), n + 1)) if draw else n
            at = int(rng.integers(0, n - length + 1))
            features.append(Summary.of(root[at : at + length], first + at, scale.root_near).features())
    return np.stack(features)


def surest_of(n_touches: int) -> float:
    """What never happened in n touches may happen in the next with a chance of about 1 in n (rule of succession)."""
    return max(_SUREST, 1 / (n_touches + 2))


def _touches(recording: NDArray[np.float64], scale: Scale) -> tuple[Touch, ...]:
    touches = Touches()
    for frames, numbers, still in segments(recording, SEGMENT, scale.near / 2):
        touches = touches.extend(frames, numbers, scale, still)
    return touches.kept


def _logistic(x: Array, y: Array, forbidden: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Fit one ridge logistic regression for each column of ``y`` ``[n, k]``; weights that are forbidden stay 0."""
    n = len(x)
    bias = logit((y.sum(axis=0) + 1) / (n + 2)).astype(np.float32)  # an imaginary sample of each kind keeps it finite
    weight = np.zeros((x.shape[1], y.shape[1]), np.float32)
    vector = np.ones(x.shape[1], np.float32)
    for _ in range(20):  # the steepest direction, by power iteration
        vector = x.T @ (x @ vector)
        vector /= np.linalg.norm(vector) + 1e-12
    steepest = float(np.linalg.norm(x @ vector) ** 2 / n)
    step = np.float32(1 / (0.25 * (1.1 * steepest + 1) + RIDGE))
    ahead_w, ahead_b = weight, bias
    for k in range(_STEPS):  # Nesterov's method: each step from a point ahead of the last
        error = (expit(x @ ahead_w + ahead_b) - y) / np.float32(n)
        next_w = ahead_w - step * (x.T @ error + np.float32(RIDGE) * ahead_w)
        next_w[forbidden] = 0
        next_b = ahead_b - step * error.sum(axis=0)
        momentum = np.float32(k / (k + 3))
        ahead_w, ahead_b = next_w + momentum * (next_w - weight), next_b + momentum * (next_b - bias)
        weight, bias = next_w, next_b
    return weight, bias
