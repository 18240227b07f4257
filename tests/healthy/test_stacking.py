"""Stacking of the local regressions with the loads around each cell."""

import numpy as np
import pytest
from scipy.special import logit

from diagnostics import SensorLayout
from diagnostics.healthy.stacking import N_FEATURES, Stacking, neighbourhood

PRESENT = np.ones((2, 5, 6), bool)
PRESENT[1, 0, :2] = False
LAYOUT = SensorLayout(2, 5, 6, present=PRESENT)
ALL = np.ones(60, bool)
EXCERPTS = 7


def random_features(seed: int) -> np.ndarray:
    """Return features of excerpts in which each cell is loaded at random."""
    rng = np.random.default_rng(seed)
    features = rng.random((EXCERPTS, 4, 60)).astype(np.float32)
    features[:, 2] = features[:, 2] > 0.5
    return features * LAYOUT.present.ravel()


def regressed(value: float = 0.0) -> np.ndarray:
    return np.full((4, EXCERPTS, 60), value)


def means(features: np.ndarray, predictors: np.ndarray = ALL) -> np.ndarray:
    """Return the means over rings, pad and array, ``[5, 4, D, n]``."""
    return neighbourhood(regressed(), features, predictors, LAYOUT)[8:].reshape(5, 4, 60, EXCERPTS)


@pytest.mark.parametrize(
    "predictors", [ALL, np.random.default_rng(5).random(60) < 0.6], ids=["all", "some"]
)
def test_each_ring_is_the_shrunk_mean_of_its_predictors(predictors: np.ndarray):
    features = random_features(0)
    rings = means(features, predictors)
    scored = predictors & LAYOUT.present.ravel()
    for cell in range(60):
        pad, row, column = LAYOUT.position(cell)
        others = [(LAYOUT.position(c), c) for c in range(60) if c != cell and scored[c]]
        steps = {c: sorted((abs(r - row), abs(k - column))) for (p, r, k), c in others if p == pad}
        of = [
            [c for c, s in steps.items() if s == [0, 1]],
            [c for c, s in steps.items() if s == [1, 1]],
            [c for c, s in steps.items() if s[1] == 2],
            list(steps),
        ]
        overall = features[:, :, [c for _, c in others]].mean(axis=2)
        on_pad = (features[:, :, of[3]].sum(axis=2) + 0.5 * overall) / (len(of[3]) + 0.5)
        for ring, cells in zip(rings[:3], of, strict=False):
            expected = (features[:, :, cells].sum(axis=2) + 0.5 * on_pad) / (len(cells) + 0.5)
            np.testing.assert_allclose(ring[:, cell].T, expected, atol=1e-5)
        np.testing.assert_allclose(rings[3][:, cell].T, on_pad, atol=1e-5)
        np.testing.assert_allclose(rings[4][:, cell].T, overall, atol=1e-5)


def test_features_of_some_cells_are_those_of_all():
    rng = np.random.default_rng(6)
    cells = np.array([1, 8, 33, 59])
    outputs = rng.normal(size=(4, EXCERPTS, 60))
    predictors = rng.random(60) < 0.7
    of_all = neighbourhood(outputs, random_features(4), predictors, LAYOUT)
    np.testing.assert_array_equal(
        neighbourhood(outputs, random_features(4), predictors, LAYOUT, cells), of_all[:, cells]
    )


def test_the_features_of_a_cell_do_not_use_its_own_reading():
    features = random_features(1)
    for cell in (0, 14, 40):
        changed = features.copy()
        changed[:, :, cell] = 1 - changed[:, :, cell]
        before, after = (
            neighbourhood(regressed(), f, ALL, LAYOUT)[:, cell] for f in (features, changed)
        )
        np.testing.assert_allclose(after, before, atol=1e-5)


def test_no_feature_uses_a_cell_that_is_no_predictor():
    features = random_features(2)
    predictors = ~np.isin(np.arange(60), (8, 45))
    changed = features.copy()
    changed[:, :, [8, 45]] = np.array([1.0, 0.5, 1.0, 0.3])[:, None]
    np.testing.assert_array_equal(
        *(neighbourhood(regressed(), f, predictors, LAYOUT) for f in (features, changed))
    )


def test_a_cell_between_two_loaded_ones_is_enclosed_and_one_beside_them_is_not():
    features = np.zeros((1, 4, 60), np.float32)
    features[:, :2, [LAYOUT.cell(0, 2, 1), LAYOUT.cell(0, 2, 3)]] = 0.8
    enclosed = neighbourhood(np.zeros((4, 1, 60)), features, ALL, LAYOUT)[7, :, 0]
    assert enclosed[LAYOUT.cell(0, 2, 2)] == pytest.approx(0.8)
    assert enclosed.sum() == pytest.approx(0.8)


def test_without_predictors_all_features_are_finite_and_loads_0():
    assert np.isfinite(neighbourhood(regressed(), random_features(3), ~ALL, LAYOUT)).all()
    assert not means(random_features(3), ~ALL).any()


@pytest.mark.parametrize("events", [5, 500])
def test_it_weights_regressions_by_their_accuracy(events: int):
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(20_000, N_FEATURES))
    sure = rng.normal(0, 3, 20_000)
    samples[:, 0] = sure
    samples[:, 1] = sure
    right = rng.random(20_000) < 1 / (1 + np.exp(-sure))
    no_better_than_chance = rng.random(20_000) < 0.5
    stacking = Stacking.fit(samples, np.column_stack([right, no_better_than_chance]), events)
    never, always = stacking.predict(samples.T.astype(np.float32))
    assert np.corrcoef(logit(never), sure)[0, 1] > 0.98
    assert np.abs(logit(never) - sure).mean() < 0.4
    assert np.abs(always - 0.5).mean() < 0.1


def test_it_uses_the_rings_where_the_regressions_are_uninformative():
    rng = np.random.default_rng(1)
    samples = rng.normal(size=(4000, N_FEATURES))
    samples[:, :2] = 0
    loaded_around = samples[:, 10] > 0
    stacking = Stacking.fit(samples, np.column_stack([~loaded_around, loaded_around]), 100)
    never, _ = stacking.predict(samples.T.astype(np.float32))
    assert (never < 0.5)[loaded_around].mean() > 0.95
    assert (never > 0.5)[~loaded_around].mean() > 0.95


def test_it_learns_an_interaction_of_two_rings():
    rng = np.random.default_rng(2)
    samples = rng.normal(size=(20_000, N_FEATURES))
    samples[:, :2] = 0
    one_of_two = (samples[:, 10] > 0) ^ (samples[:, 14] > 0)
    stacking = Stacking.fit(samples, np.column_stack([~one_of_two, one_of_two]), 500)
    never, always = stacking.predict(samples.T.astype(np.float32))
    for outputs in (1 - never, always):
        assert (outputs > 0.8)[one_of_two].mean() > 0.7
