"""What healthy looks like on a large array: a model for each patch, on top of what all patches have in common.

Two things are shared: where the model of a patch starts from (see ``shared_prior``), and how far its cells are believed
(see ``stacking``). The patches that were touched most teach both: the cost of that does not grow with the array.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diagnostics.events.constant_runs import segments
from diagnostics.events.contact_events import SEGMENT
from diagnostics.events.tiled_events import TiledEvents
from diagnostics.events.tiles import MOST_CELLS, Tile, tiles
from diagnostics.healthy.cross_fitting import FOLDS, CrossFitting, RegressionFit
from diagnostics.healthy.local_regression import FEATURES, RIDGE, LocalRegression, Start, predict_regressions
from diagnostics.healthy.model import HealthyModel, ReferenceEvent, count_events, drawn, p_floor_of
from diagnostics.healthy.shared_prior import Samples, SharedPrior
from diagnostics.preprocessing.readings import RecordingBlocks
from diagnostics.preprocessing.scale import Array, Scale

if TYPE_CHECKING:
    from diagnostics.healthy.stacking import Stacking
    from diagnostics.layout import SensorLayout

_SAMPLES = 256  # stretches for the model of one patch out of many
_RIDGE = 30.0  # of a patch, per touch: it sees far fewer of them than a whole array
_FAR = 3.0  # cells: as far as correlations in a patch are believed
_ASKED, _OF_EACH, _MOST_OF_EACH = 100, 64, 600  # patches that tell what all have in common; stretches, cells of each
_TEACHERS = 12  # patches that teach the rim


def fit_healthy_model(recordings: Sequence[NDArray[np.float64]], layout: SensorLayout, scale: Scale) -> HealthyModel:
    """Fit on fault-free recordings, ``[T, D]`` each; a small array as a whole, a large one patch by patch."""
    if layout.present.sum() <= MOST_CELLS:
        return HealthyModel.fit(recordings, layout, scale)
    rng = np.random.default_rng(0)
    touched = _Touched.of(RecordingBlocks.of(recordings), layout, scale)
    shared_prior = _shared_prior(touched, layout, rng)
    local_regressions = []
    for k, tile in enumerate(touched.tiles):
        features, _ = touched.drawn(k, _SAMPLES, rng)
        local_regressions.append(_fit_tile(features, touched.number(k), tile, shared_prior, layout).at(tile.inputs))
    return HealthyModel(tuple(local_regressions), layout, _stacking(touched, shared_prior, layout, rng))


@dataclass(frozen=True)
class _Touched:
    """The touches of each patch."""

    readings: RecordingBlocks
    scale: Scale
    tiles: tuple[Tile, ...]
    seen: list[list[ReferenceEvent]]

    @classmethod
    def of(cls, readings: RecordingBlocks, layout: SensorLayout, scale: Scale) -> _Touched:
        """Find them in fault-free recordings."""
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
        """How many touches taught patch k."""
        return count_events(self.seen[k])

    def drawn(self, k: int, most: int, rng: np.random.Generator) -> tuple[Array, NDArray[np.intp]]:
        """Return random stretches of the touches of patch k, features ``[n, 4, inputs]``, and their sources."""
        cells = self.tiles[k].inputs
        if not self.seen[k]:  # nothing is known of a patch that was never touched but what all have in common
            return np.zeros((2, FEATURES, len(cells)), np.float32), np.zeros(2, np.intp)
        return drawn(self.seen[k], partial(self.readings.piece, cells=cells), self.scale.of(cells), rng, most)


def _shared_prior(touched: _Touched, layout: SensorLayout, rng: np.random.Generator) -> SharedPrior | None:
    """Return what all patches have in common; None if none was touched."""
    some = rng.permutation(np.flatnonzero([bool(of) for of in touched.seen]))[:_ASKED].tolist()
    parts = [Samples.of(touched.drawn(k, _OF_EACH, rng)[0], touched.tiles[k], layout, rng, _MOST_OF_EACH) for k in some]
    return SharedPrior.fit(parts) if parts else None


def _fit_tile(
    features: Array, events: int, tile: Tile, shared_prior: SharedPrior | None, layout: SensorLayout
) -> LocalRegression:
    """Fit the model of a patch, whose inputs are all cells there are, on stretches of so many touches."""
    weight = np.zeros((FEATURES, len(tile.inputs), 2, len(tile.outputs)))
    usual = (weight, np.zeros(2)) if shared_prior is None else (shared_prior.on(tile, layout), shared_prior.bias)
    start = Start(*usual, max(RIDGE, _RIDGE / max(events, 1)), _taper(tile, layout))
    return LocalRegression.fit(features, np.arange(len(tile.inputs)), tile.place, p_floor_of(events), start)


def _stacking(
    touched: _Touched, shared_prior: SharedPrior | None, layout: SensorLayout, rng: np.random.Generator
) -> Stacking | None:
    """Return what the patches that were touched most teach; None if all were touched too seldom."""
    number = [touched.number(k) for k in range(len(touched.tiles))]
    busiest = [k for k in np.argsort(number)[::-1][:_TEACHERS].tolist() if number[k] >= FOLDS]
    cross_fits = [_cross_fit(touched, k, shared_prior, layout, 1 / len(busiest), rng) for k in busiest]
    return CrossFitting.joined(cross_fits).fit_stacking() if cross_fits else None


def _cross_fit(
    touched: _Touched,
    k: int,
    shared_prior: SharedPrior | None,
    layout: SensorLayout,
    share: float,
    rng: np.random.Generator,
) -> CrossFitting:
    """Return what patch k teaches the rim."""
    tile = touched.tiles[k]
    own = tile.rectangle(layout)
    features, source = touched.drawn(k, _SAMPLES, rng)
    number = touched.number(k)
    taught = number * (FOLDS - 1) // FOLDS

    def regressions(of: Array) -> RegressionFit:
        return partial(
            predict_regressions, (_fit_tile(of[:, :, own.cells], taught, tile, shared_prior, layout).at(own.cells),)
        )

    cells = own.cells[tile.place]
    return CrossFitting.of(own.on(features), source, number, own.layout, cells, regressions, share, rng)


def _taper(tile: Tile, layout: SensorLayout) -> NDArray[np.float64]:
    """Return how much two inputs may have to do with each other, by their distance."""
    rows, cols = tile.inputs // layout.cols % layout.rows, tile.inputs % layout.cols
    squared = (rows[:, None] - rows) ** 2 + (cols[:, None] - cols) ** 2
    return np.asarray(np.exp(-squared / (2 * _FAR**2)))
