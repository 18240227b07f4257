"""What healthy looks like: how a touch loads a cell, given how it loads the others.

Two logistic regressions for each cell, fitted on the touches of fault-free recordings, say whether it stays unloaded
throughout a touch and whether it stays loaded throughout, and a linear one how hard it is loaded. An open cell looks
unloaded, and so does a healthy one beside the contact: everything turns on how sharply the two can be told apart.
Models of single frames, nearest frames, trees, a neural network and one model shared by all cells were each worse on
real grasps than these regressions on whole touches.

Which cells can be trusted differs from log to log. What the others would have read is filled in from the trusted ones.
What the regressions say is then corrected by what all cells have in common (see ``rim``).
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import expit, logit

from diagnostics.few import covariance_and_precision
from diagnostics.few import logistic as logistic_of_few
from diagnostics.layout import SensorLayout
from diagnostics.lessons import FOLDS, Lessons, Regressions
from diagnostics.patches import Patch
from diagnostics.readings import Readings
from diagnostics.rim import Foreseen, Rim, around
from diagnostics.temporal import segments
from diagnostics.touches import SEGMENT, Array, Scale, Summary, Touch, Touches

_SAMPLES = 3000  # stretches of touches that the model is fitted on, about
_MOST_DRAWS = 8  # stretches of one touch: more of them say the same
_SHORTEST = 6  # frames of a stretch
RIDGE = 0.03  # on standardised inputs, per sample
_FREE = 1e-6  # the same for the bias
_STEPS = 25  # of accelerated descent; the ridge makes it converge
_RESTING_QUANTILE = 0.05  # of a cell's readings: where it rests
_SUREST = 0.002  # a probability is never taken for nearer to 0 or 1, however many touches there were
_LEAST_SPREAD = 0.02  # of the root load: nothing is predicted more exactly
_NOVEL = 0.1  # share of touches that resemble nothing known
_BLOCK = 4096  # cells looked at together
_AT_ONCE = 4096  # cells of stretches looked at between two pauses
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
        surest: no probability is taken for nearer to 0 or 1.
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

    def at(self, cells: NDArray[np.intp]) -> Tile:
        """Return the same model of another array, whose ``cells`` are the inputs here."""
        return replace(self, inputs=cells, outputs=cells[self.place])

    @classmethod
    def fit(
        cls,
        features: Array,
        inputs: NDArray[np.intp],
        outputs: NDArray[np.intp],
        surest: float,
        start: Start | None = None,
    ) -> Tile:
        """Fit on features ``[n, 4, D]``.

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
        own = np.arange(FEATURES) * len(inputs) + np.tile(place, 2)[:, None]
        flat = z.reshape(len(z), -1)
        if start is None:
            weight, bias = _logistic(flat, targets, own)
            estimate = LedoitWolf().fit(z[:, 1].astype(np.float64))
            covariance, precision = estimate.covariance_, estimate.precision_
        else:
            shared = start.weight.reshape(flat.shape[1], -1).astype(np.float32)
            shared_odds = x.reshape(len(z), -1) @ shared + np.repeat(start.bias, len(outputs)).astype(np.float32)
            y = targets.reshape(len(z), 2, -1)
            of_samples, own_bias = logistic_of_few(flat, y, z[:, :, place], start.ridge, shared_odds.reshape(y.shape))
            weight, bias = flat.T @ of_samples.reshape(len(z), -1), own_bias.ravel()
            weight[own, np.arange(len(own))[:, None]] = 0
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

    def expect(self, features: Array, trusted: NDArray[np.bool_]) -> tuple[NDArray[np.float64], ...]:
        """Return what ``Foreseen`` holds, of the outputs: ``[n, outputs]`` each."""
        z = (features[:, :, self.inputs] - self.mean) / self.scale
        known = trusted[self.inputs]
        self._fill(z, known)
        odds = (z.reshape(len(z), -1) @ self.weight + self.bias).astype(np.float64)
        never, always = odds[:, : len(self.outputs)], odds[:, len(self.outputs) :]
        # What all the other cells say of a cell: for those filled in, just what they were filled with.
        mean = z[:, 1].astype(np.float64)
        mean = mean[:, self.place] - mean @ self.precision[:, self.place] / np.diag(self.precision)[self.place]
        scale = np.where(np.isfinite(self.scale[1]), self.scale[1], 0)[self.place]
        usual = np.broadcast_to(self.mean[2][self.place], never.shape)
        return never, always, mean * scale + self.mean[1][self.place], usual

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
    """See the module.

    Attributes:
        tiles: the models of all cells.
        layout: the array; rim: corrects what they foresee. Without: believed as it is.
    """

    tiles: tuple[Tile, ...]
    layout: SensorLayout | None = None
    rim: Rim | None = None

    @classmethod
    def fit(
        cls, recordings: Sequence[NDArray[np.float64]], layout: SensorLayout, scale: Scale, seed: int = 0
    ) -> ContactModel:
        """Fit on fault-free recordings, ``[T, D]`` each, all cells together; large arrays: ``patch_models``."""
        rng = np.random.default_rng(seed)
        features, touch = stretches(recordings, scale, rng)
        n_touches = int(touch.max()) + 1
        every = np.flatnonzero(layout.present)

        def regressions(of: Array) -> Regressions:
            return partial(foreseen_by, (Tile.fit(of, every, every, _SUREST),))

        rim = None
        if n_touches >= FOLDS:
            rim = Lessons.of(features, touch, layout, every, regressions, 1.0, rng).learned()
        return cls((Tile.fit(features, every, every, surest_of(n_touches)),), layout, rim)

    def expect(self, features: Array, trusted: NDArray[np.bool_]) -> Generator[None, None, Expected]:
        """Say what healthy cells would do. A generator that pauses on its way, for those who cannot wait.

        Args:
            features: ``[n, 4, D]``, of n stretches (see ``Summary.features``).
            trusted: bool ``[D]``, the cells that may be asked.
        """
        foreseen = foreseen_by(self.tiles, features, trusted)
        shape = features.shape[2]
        spread, surest, known = np.ones(shape), np.zeros(shape), np.zeros(shape, bool)
        for tile in self.tiles:
            spread[tile.outputs], surest[tile.outputs], known[tile.outputs] = tile.spread, tile.surest, True
        never, always = expit(foreseen.never), expit(foreseen.always)
        if self.rim is not None and self.layout is not None:
            judged = np.flatnonzero(known)
            step = max(1, _AT_ONCE // len(judged))
            for first in range(0, len(features), step):
                yield
                some = slice(first, first + step)
                of_some = Foreseen(*(values[some] for values in vars(foreseen).values()))
                told = self.rim.believe(around(of_some, features[some], trusted, self.layout, judged))
                corrected, always[some, judged] = (p.T for p in told)
                # A cell that no touch of the reference reached may be out of reach, whatever those around it do.
                never[some, judged] = np.where(np.isnan(spread[judged]), never[some, judged], corrected)
        never, always = (np.where(known, np.clip(p, surest, 1 - surest), 1.0) for p in (never, always))
        return Expected(never, always, foreseen.mean, spread)


def foreseen_by(tiles: Sequence[Tile], features: Array, trusted: NDArray[np.bool_]) -> Foreseen:
    """Return what the models say of their cells, 0 for others; see :meth:`ContactModel.expect`."""
    shape = (len(features), features.shape[2])
    foreseen = Foreseen(np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape))
    for tile in tiles:
        of_tile = tile.expect(features, trusted)
        for values, said in zip(vars(foreseen).values(), of_tile, strict=True):
            values[:, tile.outputs] = said
    return foreseen


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


def stretches(
    recordings: Sequence[NDArray[np.float64]], scale: Scale, rng: np.random.Generator
) -> tuple[Array, NDArray[np.intp]]:
    """Return features ``[n, 4, D]`` of random stretches of touches in fault-free recordings, and of which touch."""
    ranges = []
    for i, recording in enumerate(recordings):
        for touch in _touches(recording, scale):
            ranges.append((i, touch.first, sum(part.n for part in touch.parts)))
    return drawn(ranges, lambda i, frames: recordings[i][frames], scale, rng, _SAMPLES)


def drawn(
    ranges: list[tuple[int, int, int]],
    read: Callable[[int, slice], NDArray[np.float64]],
    scale: Scale,
    rng: np.random.Generator,
    most: int,
) -> tuple[Array, NDArray[np.intp]]:
    """Return features ``[n, 4, D]`` of random stretches of touches: (recording, first frame, frames) each.

    And ``[n]``, which touch each is of, among those that were drawn.
    """
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
    return np.stack(features), np.arange(len(features)) // draws


def surest_of(n_touches: int) -> float:
    """What never happened in n touches may happen in the next with a chance of about 1 in n (rule of succession)."""
    return max(_SUREST, 1 / (n_touches + 2))


def _touches(recording: NDArray[np.float64], scale: Scale) -> tuple[Touch, ...]:
    touches = Touches()
    for frames, numbers, still in segments(recording, SEGMENT, scale.near / 2):
        touches = touches.extend(frames, numbers, scale, still)
    return touches.kept


def _logistic(x: Array, y: Array, own: NDArray[np.intp]) -> tuple[Array, Array]:
    """Fit one ridge logistic regression for each column of ``y`` ``[n, k]``, in which some weights stay 0.

    Each step minimises a parabola above the loss, of the same curvature for all (Boehning's bound), from a point ahead
    of the last (Nesterov): a tenth of the steps that plain gradients take.

    Args:
        x: ``[n, d]``.
        y: ``[n, k]``, 0 or 1.
        own: int ``[k, f]``, the inputs whose weight stays 0, for each column.
    """
    n, d = x.shape
    x = np.concatenate([x, np.ones((n, 1), np.float32)], axis=1)
    penalty = np.full((d + 1, 1), RIDGE, np.float32)
    penalty[d] = _FREE
    inverse = np.linalg.inv((x.T @ x).astype(np.float64) / (4 * n) + np.diag(penalty[:, 0])).astype(np.float32)
    # What a step has to give up for the weights that stay 0 is shared out among the others.
    block = np.linalg.inv(inverse[own[:, :, None], own[:, None, :]].astype(np.float64)).astype(np.float32)  # (k, f, f)
    given_up = np.einsum("dkf,kfg->kdg", inverse[:, own], block)
    weight = np.zeros((d + 1, y.shape[1]), np.float32)
    weight[d] = logit((y.sum(axis=0) + 1) / (n + 2))  # an imaginary sample of each kind keeps it finite
    ahead, column = weight, np.arange(len(own))[:, None]
    for step in range(_STEPS):
        change = inverse @ (x.T @ ((expit(x @ ahead) - y) / np.float32(n)) + penalty * ahead)
        change -= np.matmul(given_up, change[own, column][:, :, None])[:, :, 0].T
        change[own, column] = 0
        following = ahead - change
        ahead = following + np.float32(step / (step + 3)) * (following - weight)
        weight = following
    return weight[:d], weight[d]
