"""Fits the healthy model: local regressions for each tile of the array, and the stacking that all
tiles share.

The regressions of the tiles of a large array are shrunk towards a shared prior
(:mod:`~diagnostics.healthy.shared_prior`). The prior and the stacking
(:mod:`~diagnostics.healthy.stacking`) are fitted on a limited number of tiles with many events, so
their cost does not grow with the array. Equals a hierarchical (multi-task) ridge regression with
fixed variances. Cells of two tiles that are further apart than the halo are independent in the
model. A small array is one tile, and has no prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.constant_runs import SHORTEST_RUN, segments
from diagnostics.events.contact_events import Summary, count_repeats
from diagnostics.events.tiled_events import TiledEvents
from diagnostics.events.tiles import Tile, tiles
from diagnostics.healthy.cross_fitting import FOLDS, stacking_samples
from diagnostics.healthy.local_regression import FEATURES, RIDGE, LocalRegression, Start
from diagnostics.healthy.model import HealthyModel, p_floor_of
from diagnostics.healthy.shared_prior import REACH, Samples, SharedPrior
from diagnostics.healthy.stacking import Stacking
from diagnostics.preprocessing.levels import FEWEST
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.preprocessing.scale import Array, Scale

if TYPE_CHECKING:
    from diagnostics.layout import SensorLayout

# excerpts for the model of a small array, and of one of several tiles: sizes
_SAMPLES = 3000
_TILE_SAMPLES = 256
_MOST_DRAWS = 8  # excerpts of one event: more of them are nearly the same
_RIDGE = 30.0  # towards the shared prior, divided by the number of events of the tile
# tiles of the shared prior; excerpts and samples of each: sizes
_PRIOR_TILES = 28
_EXCERPTS = 64
_PRIOR_SAMPLES = 600
_STACKING_TILES = 12  # tiles with the most events, from which the stacking is fitted: a size


def fit_healthy_model(
    recordings: Sequence[NDArray[np.float64]], layout: SensorLayout, scale: Scale
) -> HealthyModel:
    """Fit to fault-free recordings, ``[T, D]`` each."""
    rng = np.random.default_rng(0)
    events_of = ReferenceEvents.of(RecordingBlocks.of(recordings), layout, scale)
    if len(events_of.tiles) == 1:
        return _fit_small(events_of, rng)
    shared_prior = _shared_prior(events_of, rng)
    local_regressions = []
    for k, tile in enumerate(events_of.tiles):
        features, _ = events_of.drawn(k, _TILE_SAMPLES, rng)
        local_regressions.append(
            _fit_tile(features, events_of.number(k), tile, shared_prior, layout).at(tile.inputs)
        )
    return HealthyModel(tuple(local_regressions), layout, _stacking(events_of, shared_prior, rng))


class ReferenceEvent(NamedTuple):
    """Where a contact event lies in the fault-free recordings.

    Attributes:
        recording: index of the recording.
        first: number of the first frame.
        frames: number of frames.
        again: whether it loads the same cells as an earlier event of the recording.
    """

    recording: int
    first: int
    frames: int
    again: bool


@dataclass(frozen=True)
class ReferenceEvents:
    """The contact events of each tile in fault-free recordings.

    Attributes:
        readings: the recordings.
        layout: the array.
        scale: baseline and full scale.
        tiles: the tiles of the array.
        seen: the events of each tile.
    """

    readings: RecordingBlocks
    layout: SensorLayout
    scale: Scale
    tiles: tuple[Tile, ...]
    seen: list[list[ReferenceEvent]]

    @classmethod
    def of(cls, readings: RecordingBlocks, layout: SensorLayout, scale: Scale) -> ReferenceEvents:
        """Find the events."""
        every = tiles(layout)
        seen: list[list[ReferenceEvent]] = [[] for _ in every]
        for i, recording in enumerate(readings):
            events = TiledEvents.begin(every)
            for frames, numbers, runs in segments(recording, scale):
                events = events.extend(
                    scale.root_load(frames), numbers, scale.root_near, runs.start
                )
            for k, of_tile in events.kept():
                again = (count_repeats(of_tile.kept) > 0).tolist()
                seen[k] += [
                    ReferenceEvent(i, e.first, e.n, a)
                    for e, a in zip(of_tile.kept, again, strict=True)
                ]
        return cls(readings, layout, scale, every, seen)

    def number(self, k: int) -> int:
        """Return the number of distinct events of tile k; with few recordings repeated ones count
        too."""
        few = _few_recordings(self.seen[k])
        return sum(few or not event.again for event in self.seen[k])

    def drawn(self, k: int, most: int, rng: np.random.Generator) -> tuple[Array, NDArray[np.intp]]:
        """Return about ``most`` random excerpts of the events of tile k: features
        ``[n, 4, inputs]``, and sources.

        The source, int ``[n]``, is that of correlated excerpts: a recording or, with few
        recordings, an event.
        """
        seen = self.seen[k]
        cells = self.tiles[k].inputs if len(self.tiles) > 1 else slice(None)
        scale = self.scale.of(cells)
        if not seen:  # no event in this tile: the shared prior alone
            return np.zeros((2, FEATURES, len(scale.baseline)), np.float32), np.zeros(2, np.intp)
        draws = int(np.clip(round(most / len(seen)), 1, _MOST_DRAWS))
        if len(seen) > most:
            seen = [seen[i] for i in np.sort(rng.choice(len(seen), most, replace=False))]
        features = []
        for i, first, n, _ in seen:
            root = scale.root_load(self.readings.piece(i, slice(first, first + n), cells))
            n = len(root)
            for draw in range(draws):
                length = int(rng.integers(min(SHORTEST_RUN, n), n + 1)) if draw else n
                at = int(rng.integers(0, n - length + 1))
                features.append(
                    Summary.of(root[at : at + length], first + at, scale.root_near).features()
                )
        sources = range(len(seen)) if _few_recordings(seen) else [event.recording for event in seen]
        return np.stack(features), np.unique(sources, return_inverse=True)[1].repeat(draws)


def _few_recordings(seen: Sequence[ReferenceEvent]) -> bool:
    """Return whether there are too few recordings for cross-fitting by recording."""
    return len({event.recording for event in seen}) < FEWEST


def _fit_small(events_of: ReferenceEvents, rng: np.random.Generator) -> HealthyModel:
    """Fit the model of an array that is one tile."""
    layout = events_of.layout
    number = events_of.number(0)
    features, source = events_of.drawn(0, _SAMPLES, rng)
    every = np.flatnonzero(layout.present)
    fit = partial(LocalRegression.fit, inputs=every, outputs=every, p_floor=p_floor_of(number))
    stacking = None
    if number >= FOLDS:
        stacking = Stacking.fit(
            *stacking_samples(features, source, layout, every, fit, 1.0, rng), number
        )
    return HealthyModel((fit(features),), layout, stacking)


def _shared_prior(events_of: ReferenceEvents, rng: np.random.Generator) -> SharedPrior:
    """Return the shared prior."""
    layout = events_of.layout
    some = rng.permutation(np.flatnonzero([bool(of) for of in events_of.seen]))[
        :_PRIOR_TILES
    ].tolist()
    return SharedPrior.fit(
        [
            Samples.of(
                events_of.drawn(k, _EXCERPTS, rng)[0],
                events_of.tiles[k],
                layout,
                rng,
                _PRIOR_SAMPLES,
            )
            for k in some
        ]
    )


def _fit_tile(
    features: Array, events: int, tile: Tile, shared_prior: SharedPrior, layout: SensorLayout
) -> LocalRegression:
    """Fit the regressions of a tile; ``features`` (``[n, 4, inputs]``) hold its inputs alone."""
    rows = tile.inputs // layout.cols % layout.rows
    cols = tile.inputs % layout.cols
    # (inputs, inputs)
    down = rows[:, None] - rows
    across = cols[:, None] - cols
    weight = shared_prior.weights(down[:, tile.place], across[:, tile.place])
    taper = np.exp(-(down**2 + across**2) / (2 * REACH**2))
    start = Start(weight, shared_prior.bias, max(RIDGE, _RIDGE / max(events, 1)), taper)
    return LocalRegression.fit(
        features, np.arange(len(tile.inputs)), tile.place, p_floor_of(events), start
    )


def _stacking(
    events_of: ReferenceEvents, shared_prior: SharedPrior, rng: np.random.Generator
) -> Stacking | None:
    """Return the stacking fitted on the tiles with the most events; None if all have too few."""
    number = [events_of.number(k) for k in range(len(events_of.tiles))]
    busiest = [k for k in np.argsort(number)[::-1][:_STACKING_TILES].tolist() if number[k] >= FOLDS]
    if not busiest:
        return None
    parts = [_samples(events_of, k, shared_prior, 1 / len(busiest), rng) for k in busiest]
    samples, did = (np.concatenate(of_tiles) for of_tiles in zip(*parts, strict=True))
    return Stacking.fit(samples, did, sum(number[k] for k in busiest))


def _samples(
    events_of: ReferenceEvents,
    k: int,
    shared_prior: SharedPrior,
    share: float,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the stacking samples of tile k."""
    layout = events_of.layout
    tile = events_of.tiles[k]
    own = tile.rectangle(layout)
    features, source = events_of.drawn(k, _TILE_SAMPLES, rng)
    training_events = events_of.number(k) * (FOLDS - 1) // FOLDS

    def fit(training: Array) -> LocalRegression:
        return _fit_tile(training[:, :, own.cells], training_events, tile, shared_prior, layout).at(
            own.cells
        )

    return stacking_samples(
        own.on(features), source, own.layout, own.cells[tile.place], fit, share, rng
    )
