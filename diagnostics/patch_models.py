"""What healthy looks like on a large array: a model for each patch, on top of what all patches have in common."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from diagnostics.contact import FEATURES, RIDGE, ContactModel, Start, Tile, drawn, surest_of
from diagnostics.layout import SensorLayout
from diagnostics.nearby import Nearby, Samples
from diagnostics.patches import MOST_CELLS, Patch, PatchTouches, patches
from diagnostics.readings import Readings
from diagnostics.temporal import segments
from diagnostics.touches import SEGMENT, Array, Scale

_SAMPLES = 256  # stretches for the model of one patch out of many
_RIDGE = 30.0  # of a patch, per touch: it sees far fewer of them than a whole array
_FAR = 3.0  # cells: as far as correlations in a patch are believed
_ASKED, _OF_EACH, _MOST_OF_EACH = 100, 64, 600  # patches that tell what all have in common; stretches, cells of each


def contact_model(recordings: Sequence[NDArray[np.float64]], layout: SensorLayout, scale: Scale) -> ContactModel:
    """Fit on fault-free recordings, ``[T, D]`` each; a small array as a whole, a large one patch by patch."""
    if layout.present.sum() <= MOST_CELLS:
        return ContactModel.fit(recordings, layout, scale)
    return ContactModel(tuple(_tiles(Readings.of(recordings), layout, scale, np.random.default_rng(0))))


def _tiles(readings: Readings, layout: SensorLayout, scale: Scale, rng: np.random.Generator) -> Iterator[Tile]:
    """Yield the model of each patch, fitted on the touches of that patch."""
    every = patches(layout)
    ranges: list[list[tuple[int, int, int]]] = [[] for _ in every]
    for i, recording in enumerate(readings):
        touches = PatchTouches.begin(every)
        for frames, numbers, still in segments(recording, SEGMENT, scale.near / 2):
            touches = touches.extend(frames, numbers, scale, still)
        for k, of_patch in touches.kept():
            ranges[k] += [(i, touch.first, sum(part.n for part in touch.parts)) for touch in of_patch.kept]

    def features_of(k: int, most: int) -> Array:
        cells = every[k].inputs
        if not ranges[k]:  # nothing is known of a patch that was never touched but what all have in common
            return np.zeros((2, FEATURES, len(cells)), np.float32)
        return drawn(ranges[k], partial(readings.piece, cells=cells), scale.of(cells), rng, most)

    some = rng.permutation(np.flatnonzero([bool(of) for of in ranges]))[:_ASKED].tolist()
    parts = [Samples.of(features_of(k, _OF_EACH), every[k], layout, rng, _MOST_OF_EACH) for k in some]
    nearby = Nearby.fit(parts) if parts else None
    for k, patch in enumerate(every):
        features, n = features_of(k, _SAMPLES), len(ranges[k])
        weight = np.zeros((FEATURES, len(patch.inputs), 2, len(patch.outputs)))
        usual = (weight, np.zeros(2)) if nearby is None else (nearby.on(patch, layout), nearby.bias)
        start = Start(*usual, max(RIDGE, _RIDGE / max(n, 1)), _taper(patch, layout))
        tile = Tile.fit(features, np.arange(len(patch.inputs)), patch.place, surest_of(n), start)
        yield replace(tile, inputs=patch.inputs, outputs=patch.outputs)


def _taper(patch: Patch, layout: SensorLayout) -> NDArray[np.float64]:
    """Return how much two inputs may have to do with each other, by their distance."""
    rows, cols = patch.inputs // layout.cols % layout.rows, patch.inputs % layout.cols
    squared = (rows[:, None] - rows) ** 2 + (cols[:, None] - cols) ** 2
    return np.asarray(np.exp(-squared / (2 * _FAR**2)))
