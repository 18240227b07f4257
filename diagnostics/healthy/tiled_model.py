"""The healthy model of a large array: local regressions for each tile, shrunk towards a shared prior.

Tiles share the prior (:mod:`~diagnostics.healthy.shared_prior`) and the stacking
(:mod:`~diagnostics.healthy.stacking`). Both are fitted on a limited number of tiles with many events, so their cost
does not grow with the array. Equals a hierarchical (multi-task) ridge regression with fixed variances. Cells of two
tiles that are further apart than the halo are independent in the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.constant_runs import segments
from diagnostics.events.tiled_events import TiledEvents
from diagnostics.events.tiles import MOST_CELLS, Tile, tiles
from diagnostics.healthy.cross_fitting import FOLDS, CrossFitting, RegressionFit
from diagnostics.healthy.local_regression import FEATURES, RIDGE, LocalRegression, Start, predict_regressions
from diagnostics.healthy.model import HealthyModel, ReferenceEvent, count_events, drawn, p_floor_of
from diagnostics.healthy.shared_prior import REACH, Samples, SharedPrior
from diagnostics.preprocessing.readings import SEGMENT, RecordingBlocks
from diagnostics.preprocessing.scale import Array, Scale

if TYPE_CHECKING:
    from diagnostics.healthy.stacking import Stacking
    from diagnostics.layout import SensorLayout

_SAMPLES = 256  # excerpts for the model of one tile: a size
_RIDGE = 30.0  # towards the shared prior, divided by the number of events of the tile
_PRIOR_TILES, _EXCERPTS, _PRIOR_SAMPLES = 100, 64, 600  # tiles of the shared prior; excerpts and samples of each: sizes
_STACKING_TILES = 12  # tiles with the most events, from which the stacking is fitted: a size


def fit_healthy_model(recordings: Sequence[NDArray[np.float64]], layout: SensorLayout, scale: Scale) -> HealthyModel:
    """Fit to fault-free recordings, ``[T, D]`` each; a small array is one tile."""
    if layout.present.sum() <= MOST_CELLS:
        return HealthyModel.fit(recordings, layout, scale)
    rng = np.random.default_rng(0)
    events_of = _TileEvents.of(RecordingBlocks.of(recordings), layout, scale)
    shared_prior = _shared_prior(events_of, layout, rng)
    local_regressions = []
    for k, tile in enumerate(events_of.tiles):
        features, _ = events_of.drawn(k, _SAMPLES, rng)
        local_regressions.append(_fit_tile(features, events_of.number(k), tile, shared_prior, layout).at(tile.inputs))
    return HealthyModel(tuple(local_regressions), layout, _stacking(events_of, shared_prior, layout, rng))


@dataclass(frozen=True)
class _TileEvents:
    """The reference events of each tile."""

    readings: RecordingBlocks
    scale: Scale
    tiles: tuple[Tile, ...]
    seen: list[list[ReferenceEvent]]

    @classmethod
    def of(cls, readings: RecordingBlocks, layout: SensorLayout, scale: Scale) -> _TileEvents:
        """Find the events in fault-free recordings."""
        every = tiles(layout)
        seen: list[list[ReferenceEvent]] = [[] for _ in every]
        for i, recording in enumerate(readings):
            events = TiledEvents.begin(every)
            for frames, numbers, start in segments(recording, SEGMENT, scale.near / 2):
                none = np.zeros(len(start), bool)
                events = events.extend(scale.root_load(frames), numbers, scale.root_near, start, none)
            for k, of_tile in events.kept():
                seen[k] += ReferenceEvent.of(of_tile.kept, i)
        return cls(readings, scale, every, seen)

    def number(self, k: int) -> int:
        """Return the number of distinct events of tile k."""
        return count_events(self.seen[k])

    def drawn(self, k: int, most: int, rng: np.random.Generator) -> tuple[Array, NDArray[np.intp]]:
        """Return random excerpts of the events of tile k, features ``[n, 4, inputs]``, and their sources ``[n]``."""
        cells = self.tiles[k].inputs
        if not self.seen[k]:  # no event in this tile: the shared prior alone
            return np.zeros((2, FEATURES, len(cells)), np.float32), np.zeros(2, np.intp)
        return drawn(self.seen[k], partial(self.readings.piece, cells=cells), self.scale.of(cells), rng, most)


def _shared_prior(events_of: _TileEvents, layout: SensorLayout, rng: np.random.Generator) -> SharedPrior | None:
    """Return the shared prior; None without any event."""
    some = rng.permutation(np.flatnonzero([bool(of) for of in events_of.seen]))[:_PRIOR_TILES].tolist()
    parts = [
        Samples.of(events_of.drawn(k, _EXCERPTS, rng)[0], events_of.tiles[k], layout, rng, _PRIOR_SAMPLES) for k in some
    ]
    return SharedPrior.fit(parts) if parts else None


def _fit_tile(
    features: Array, events: int, tile: Tile, shared_prior: SharedPrior | None, layout: SensorLayout
) -> LocalRegression:
    """Fit the regressions of a tile; ``features`` (``[n, 4, inputs]``) hold its inputs alone."""
    weight = np.zeros((FEATURES, len(tile.inputs), 2, len(tile.outputs)))
    prior = (weight, np.zeros(2)) if shared_prior is None else (shared_prior.on(tile, layout), shared_prior.bias)
    start = Start(*prior, max(RIDGE, _RIDGE / max(events, 1)), _taper(tile, layout))
    return LocalRegression.fit(features, np.arange(len(tile.inputs)), tile.place, p_floor_of(events), start)


def _stacking(
    events_of: _TileEvents, shared_prior: SharedPrior | None, layout: SensorLayout, rng: np.random.Generator
) -> Stacking | None:
    """Return the stacking fitted on the tiles with the most events; None if all have too few."""
    number = [events_of.number(k) for k in range(len(events_of.tiles))]
    busiest = [k for k in np.argsort(number)[::-1][:_STACKING_TILES].tolist() if number[k] >= FOLDS]
    cross_fits = [_cross_fit(events_of, k, shared_prior, layout, 1 / len(busiest), rng) for k in busiest]
    return CrossFitting.joined(cross_fits).fit_stacking() if cross_fits else None


def _cross_fit(
    events_of: _TileEvents,
    k: int,
    shared_prior: SharedPrior | None,
    layout: SensorLayout,
    share: float,
    rng: np.random.Generator,
) -> CrossFitting:
    """Return the stacking samples of tile k."""
    tile = events_of.tiles[k]
    own = tile.rectangle(layout)
    features, source = events_of.drawn(k, _SAMPLES, rng)
    number = events_of.number(k)
    training_events = number * (FOLDS - 1) // FOLDS

    def regressions(training: Array) -> RegressionFit:
        return partial(
            predict_regressions,
            (_fit_tile(training[:, :, own.cells], training_events, tile, shared_prior, layout).at(own.cells),),
        )

    cells = own.cells[tile.place]
    return CrossFitting.of(own.on(features), source, number, own.layout, cells, regressions, share, rng)


def _taper(tile: Tile, layout: SensorLayout) -> NDArray[np.float64]:
    """Return the factor on the covariance of two inputs, exp(-distance^2 / (2 * 3^2)), ``[inputs, inputs]``."""
    rows, cols = tile.inputs // layout.cols % layout.rows, tile.inputs % layout.cols
    squared = (rows[:, None] - rows) ** 2 + (cols[:, None] - cols) ** 2
    return np.asarray(np.exp(-squared / (2 * REACH**2)))
