import numpy as np
import pytest

from diagnostics import SensorLayout
from diagnostics.events.contact_events import ContactEvent, Summary
from diagnostics.evidence.nearest_neighbours import NearestNeighbours
from diagnostics.preprocessing.scale import Scale

LAYOUT = SensorLayout(1, 9, 9)
SCALE = Scale(np.zeros(81), 0.05, 5.0)
ALL = np.ones(81, bool)
ROW, COLUMN = np.divmod(np.arange(81), 9)


def event(rng: np.random.Generator) -> ContactEvent:
    """A round press somewhere on the pad."""
    r, c = rng.uniform(1, 7, 2)
    load = np.maximum(0, 2 - ((ROW - r) ** 2 + (COLUMN - c) ** 2) / 4)
    root = SCALE.root_load(load * np.linspace(0.5, 1, 20)[:, None])
    return ContactEvent(
        (Summary.of(root, 0, SCALE.root_near),), root.min(axis=0), root.max(axis=0), 0
    )


@pytest.fixture(scope="module")
def events() -> list[ContactEvent]:
    rng = np.random.default_rng(0)
    return [event(rng) for _ in range(30)]


@pytest.fixture(scope="module")
def features(events) -> np.ndarray:
    return np.stack([t.whole.features() for t in events])


def test_a_cell_enclosed_by_loaded_ones_is_expected_to_be_loaded_and_one_far_from_them_not(
    events, features
):
    never = NearestNeighbours.of(events, LAYOUT).predict(features, ALL).never
    grid = (features[:, 2] > 0).reshape(-1, 9, 9)
    enclosed = np.zeros_like(grid)
    far = np.zeros_like(grid)
    for r in range(1, 8):
        for c in range(1, 8):
            block = grid[:, r - 1 : r + 2, c - 1 : c + 2]
            enclosed[:, r, c] = block.all(axis=(1, 2))
            far[:, r, c] = ~block.any(axis=(1, 2))
    assert never[enclosed.reshape(-1, 81)].mean() < 0.05
    assert never[far.reshape(-1, 81)].mean() > 0.95


def test_the_reading_of_a_cell_that_is_no_predictor_does_not_matter(events, features):
    centre = LAYOUT.cell(0, 4, 4)
    predictors = ALL.copy()
    predictors[centre] = False
    spoiled = features.copy()
    spoiled[:, :, centre] = 1.0
    model = NearestNeighbours.of(events, LAYOUT)
    np.testing.assert_array_equal(
        model.predict(spoiled, predictors).never, model.predict(features, predictors).never
    )


def test_a_cell_without_two_opposite_predictors_is_not_predicted(events, features):
    corner = LAYOUT.cell(0, 0, 0)
    expected = NearestNeighbours.of(events, LAYOUT).predict(features, ALL)
    assert (expected.never[:, corner] == 1).all()
    assert (expected.always[:, corner] == 1).all()
    assert np.isnan(expected.spread[corner])
    assert np.isfinite(expected.spread[LAYOUT.cell(0, 4, 4)])


def test_without_predictors_all_probabilities_are_1(events, features):
    expected = NearestNeighbours.of(events, LAYOUT).predict(features, ~ALL)
    assert (expected.never == 1).all()
    assert np.isnan(expected.spread).all()


def test_positions_without_a_cell_are_not_predicted(events, features):
    present = np.ones(LAYOUT.shape, bool)
    present[0, 4, 4] = False
    layout = SensorLayout(1, 9, 9, present=present)
    expected = NearestNeighbours.of(events, layout).predict(features, ALL)
    assert (expected.never[:, LAYOUT.cell(0, 4, 4)] == 1).all()
    assert (expected.never[:, LAYOUT.cell(0, 4, 6)] < 1).any()
