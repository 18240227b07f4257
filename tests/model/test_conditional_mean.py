"""E[load | others] and E[loaded | others]."""

import numpy as np
import pytest

from diagnostics import SensorLayout
from diagnostics.model.conditional_mean import ConditionalMean, Tile, loaded

LAYOUT = SensorLayout(1, 3, 4, full_scale=1.0)


@pytest.fixture(scope="module")
def load() -> np.ndarray:
    rng = np.random.default_rng(0)
    shared = rng.random((400, 1))
    own = rng.random((400, 12))
    return np.clip(shared + 0.3 * own - 0.6, 0, 1).astype(np.float32)


def test_a_cell_is_left_out_of_its_own_prediction_with_both_its_inputs(load):
    cells = np.arange(12)
    tile = Tile.fit(load, cells, cells)
    known = np.ones(12, bool)
    mean, surely = tile.predict(load, known)
    z = (np.hstack([load, loaded(load)]) - tile.mean) / tile.deviation
    for cell in (0, 7):
        own = np.array([cell, cell + 12])
        others = np.setdiff1d(np.arange(24), own)
        weights = np.linalg.solve(
            tile.covariance[np.ix_(others, others)], tile.covariance[np.ix_(others, own)]
        )
        expected = z[:, others] @ weights * tile.deviation[own] + tile.mean[own]
        np.testing.assert_allclose(mean[:, cell], expected[:, 0], atol=1e-8)
        np.testing.assert_allclose(surely[:, cell], expected[:, 1], atol=1e-8)


def test_what_an_unknown_cell_reads_changes_no_prediction(load):
    whole = ConditionalMean.fit(load, LAYOUT, np.ones(12, bool))
    known = np.arange(12) != 5
    other = load.copy()
    other[:, 5] = 0.9
    for one, two in zip(whole.predict(load, known), whole.predict(other, known), strict=True):
        np.testing.assert_array_equal(one, two)


def test_with_nobody_known_the_mean_of_the_reference_is_told(load):
    whole = ConditionalMean.fit(load, LAYOUT, np.ones(12, bool))
    mean, _ = whole.predict(load, np.zeros(12, bool))
    np.testing.assert_allclose(mean, np.broadcast_to(load.mean(axis=0), load.shape), atol=1e-5)
