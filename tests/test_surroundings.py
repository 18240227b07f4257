import numpy as np
import pytest

from diagnostics import SensorLayout
from diagnostics.memory import finished
from diagnostics.scale import Scale
from diagnostics.surroundings import Surroundings
from diagnostics.touches import Summary, Touch

LAYOUT = SensorLayout(1, 9, 9)
SCALE = Scale(np.zeros(81), 0.05, 5.0)
ALL = np.ones(81, bool)
ROW, COLUMN = np.divmod(np.arange(81), 9)


def touch(rng: np.random.Generator) -> Touch:
    """A round press somewhere on the pad."""
    r, c = rng.uniform(1, 7, 2)
    load = np.maximum(0, 2 - ((ROW - r) ** 2 + (COLUMN - c) ** 2) / 4)
    root = SCALE.root_load(load * np.linspace(0.5, 1, 20)[:, None])
    return Touch((Summary.of(root, 0, SCALE.root_near),), root.min(axis=0), root.max(axis=0), 0)


@pytest.fixture(scope="module")
def touches() -> list[Touch]:
    rng = np.random.default_rng(0)
    return [touch(rng) for _ in range(30)]


@pytest.fixture(scope="module")
def features(touches) -> np.ndarray:
    return np.stack([t.suffixes()[0].features() for t in touches])


def test_a_cell_enclosed_by_loaded_ones_is_expected_to_be_loaded_and_one_far_from_them_not(touches, features):
    never = finished(Surroundings.of(touches, LAYOUT).expect(features, ALL)).never
    grid = (features[:, 2] > 0).reshape(-1, 9, 9)
    enclosed = np.zeros_like(grid)
    far = np.zeros_like(grid)
    for r in range(1, 8):
        for c in range(1, 8):
            around = grid[:, r - 1 : r + 2, c - 1 : c + 2]
            enclosed[:, r, c], far[:, r, c] = around.all(axis=(1, 2)), ~around.any(axis=(1, 2))
    assert never[enclosed.reshape(-1, 81)].mean() < 0.05
    assert never[far.reshape(-1, 81)].mean() > 0.95


def test_what_a_cell_reads_itself_does_not_matter_where_it_is_not_trusted(touches, features):
    centre = LAYOUT.cell(0, 4, 4)
    trusted = ALL.copy()
    trusted[centre] = False
    spoiled = features.copy()
    spoiled[:, :, centre] = 1.0
    model = Surroundings.of(touches, LAYOUT)
    np.testing.assert_array_equal(
        finished(model.expect(spoiled, trusted)).never, finished(model.expect(features, trusted)).never
    )


def test_a_cell_between_no_two_trusted_neighbours_is_not_judged(touches, features):
    corner = LAYOUT.cell(0, 0, 0)
    expected = finished(Surroundings.of(touches, LAYOUT).expect(features, ALL))
    assert (expected.never[:, corner] == 1).all()
    assert (expected.always[:, corner] == 1).all()
    assert np.isnan(expected.spread[corner])
    assert np.isfinite(expected.spread[LAYOUT.cell(0, 4, 4)])


def test_without_trusted_cells_everything_is_as_expected(touches, features):
    expected = finished(Surroundings.of(touches, LAYOUT).expect(features, ~ALL))
    assert (expected.never == 1).all()
    assert np.isnan(expected.spread).all()


def test_positions_without_a_cell_are_not_judged(touches, features):
    present = np.ones(LAYOUT.shape, bool)
    present[0, 4, 4] = False
    layout = SensorLayout(1, 9, 9, present=present)
    expected = finished(Surroundings.of(touches, layout).expect(features, ALL))
    assert (expected.never[:, LAYOUT.cell(0, 4, 4)] == 1).all()
    assert (expected.never[:, LAYOUT.cell(0, 4, 6)] < 1).any()
