"""What healthy looks like on a large array: a model for each patch, on top of what all patches have in common.

Two things are shared: where the model of a patch starts from (see ``nearby``), and how far its cells are believed (see
``rim``). The patches that were touched most teach both: the cost of that does not grow with the array.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from diagnostics.contact import ContactModel, Seen, drawn, number_of, surest_of
from diagnostics.layout import SensorLayout
from diagnostics.lessons import FOLDS, Lessons, Regressions
from diagnostics.nearby import Nearby, Samples
from diagnostics.patches import MOST_CELLS, Patch, PatchTouches, patches
from diagnostics.readings import Readings
from diagnostics.rim import Rim
from diagnostics.scale import Array, Scale
from diagnostics.temporal import segments
from diagnostics.tiles import FEATURES, RIDGE, Start, Tile, foreseen_by
from diagnostics.touches import SEGMENT

_SAMPLES = 256  # stretches for the model of one patch out of many
_RIDGE = 30.0  # of a patch, per touch: it sees far fewer of them than a whole array
_FAR = 3.0  # cells: as far as correlations in a patch are believed
_ASKED, _OF_EACH, _MOST_OF_EACH = 100, 64, 600  # patches that tell what all have in common; stretches, cells of each
_TEACHERS = 12  # patches that teach the rim


def contact_model(recordings: Sequence[NDArray[np.float64]], layout: SensorLayout, scale: Scale) -> ContactModel:
    """Fit on fault-free recordings, ``[T, D]`` each; a small array as a whole, a large one patch by patch."""
    if layout.present.sum() <= MOST_CELLS:
        return ContactModel.fit(recordings, layout, scale)
    rng = np.random.default_rng(0)
    touched = _Touched.of(Readings.of(recordings), layout, scale)
    nearby = _nearby(touched, layout, rng)
    tiles = []
    for k, patch in enumerate(touched.patches):
        features, _ = touched.drawn(k, _SAMPLES, rng)
        tiles.append(_tile(features, touched.number(k), patch, nearby, layout).at(patch.inputs))
    return ContactModel(tuple(tiles), layout, _rim(touched, nearby, layout, rng))


@dataclass(frozen=True)
class _Touched:
    """The touches of each patch."""

    readings: Readings
    scale: Scale
    patches: tuple[Patch, ...]
    seen: list[list[Seen]]

    @classmethod
    def of(cls, readings: Readings, layout: SensorLayout, scale: Scale) -> _Touched:
        """Find them in fault-free recordings."""
        every = patches(layout)
        seen: list[list[Seen]] = [[] for _ in every]
        for i, recording in enumerate(readings):
            touches = PatchTouches.begin(every)
            for frames, numbers, start in segments(recording, SEGMENT, scale.near / 2):
                none = np.zeros(len(start), bool)
                touches = touches.extend(scale.root_load(frames), numbers, scale.root_near, start, none)
            for k, of_patch in touches.kept():
                seen[k] += Seen.of(of_patch.kept, i)
        return cls(readings, scale, every, seen)

    def number(self, k: int) -> int:
        """How many touches taught patch k."""
        return number_of(self.seen[k])

    def drawn(self, k: int, most: int, rng: np.random.Generator) -> tuple[Array, NDArray[np.intp]]:
        """Return random stretches of the touches of patch k, features ``[n, 4, inputs]``, and their sources."""
        cells = self.patches[k].inputs
        if not self.seen[k]:  # nothing is known of a patch that was never touched but what all have in common
            return np.zeros((2, FEATURES, len(cells)), np.float32), np.zeros(2, np.intp)
        return drawn(self.seen[k], partial(self.readings.piece, cells=cells), self.scale.of(cells), rng, most)


def _nearby(touched: _Touched, layout: SensorLayout, rng: np.random.Generator) -> Nearby | None:
    """Return what all patches have in common; None if none was touched."""
    some = rng.permutation(np.flatnonzero([bool(of) for of in touched.seen]))[:_ASKED].tolist()
    parts = [
        Samples.of(touched.drawn(k, _OF_EACH, rng)[0], touched.patches[k], layout, rng, _MOST_OF_EACH) for k in some
    ]
    return Nearby.fit(parts) if parts else None


def _tile(features: Array, touches: int, patch: Patch, nearby: Nearby | None, layout: SensorLayout) -> Tile:
    """Fit the model of a patch, whose inputs are all cells there are, on stretches of so many touches."""
    weight = np.zeros((FEATURES, len(patch.inputs), 2, len(patch.outputs)))
    usual = (weight, np.zeros(2)) if nearby is None else (nearby.on(patch, layout), nearby.bias)
    start = Start(*usual, max(RIDGE, _RIDGE / max(touches, 1)), _taper(patch, layout))
    return Tile.fit(features, np.arange(len(patch.inputs)), patch.place, surest_of(touches), start)


def _rim(touched: _Touched, nearby: Nearby | None, layout: SensorLayout, rng: np.random.Generator) -> Rim | None:
    """Return what the patches that were touched most teach; None if all were touched too seldom."""
    number = [touched.number(k) for k in range(len(touched.patches))]
    busiest = [k for k in np.argsort(number)[::-1][:_TEACHERS].tolist() if number[k] >= FOLDS]
    lessons = [_lessons(touched, k, nearby, layout, 1 / len(busiest), rng) for k in busiest]
    return Lessons.together(lessons).learned() if lessons else None


def _lessons(
    touched: _Touched, k: int, nearby: Nearby | None, layout: SensorLayout, share: float, rng: np.random.Generator
) -> Lessons:
    """Return what patch k teaches the rim."""
    patch = touched.patches[k]
    own = patch.rectangle(layout)
    features, source = touched.drawn(k, _SAMPLES, rng)
    number = touched.number(k)
    taught = number * (FOLDS - 1) // FOLDS

    def regressions(of: Array) -> Regressions:
        return partial(foreseen_by, (_tile(of[:, :, own.cells], taught, patch, nearby, layout).at(own.cells),))

    cells = own.cells[patch.place]
    return Lessons.of(own.on(features), source, number, own.layout, cells, regressions, share, rng)


def _taper(patch: Patch, layout: SensorLayout) -> NDArray[np.float64]:
    """Return how much two inputs may have to do with each other, by their distance."""
    rows, cols = patch.inputs // layout.cols % layout.rows, patch.inputs % layout.cols
    squared = (rows[:, None] - rows) ** 2 + (cols[:, None] - cols) ** 2
    return np.asarray(np.exp(-squared / (2 * _FAR**2)))
