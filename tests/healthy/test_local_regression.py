"""Local regressions equal ridge logistic regressions of scikit-learn, with and without a shared
prior."""

import numpy as np
import pytest
from scipy.special import expit
from sklearn.linear_model import LogisticRegression

from diagnostics.healthy import local_regression
from diagnostics.healthy.dual_ridge import STEPS
from diagnostics.healthy.local_regression import FEATURES, RIDGE, LocalRegression, Start

CELLS = 6
EVERY = np.arange(CELLS)


def excerpts(n: int, seed: int = 0) -> np.ndarray:
    """Return features ``[n, 4, 6]`` of neighbours that are often loaded together."""
    rng = np.random.default_rng(seed)
    load = np.clip(rng.normal(0.3, 0.3, (n, 1)) + rng.normal(0, 0.15, (n, CELLS)), 0, 1)
    share = (load > 0) * np.clip(load + rng.normal(0, 0.3, load.shape), 0, 1)
    return np.stack([load * 1.1, load, share, share > 0.5], axis=1).astype(np.float32)


def fit(features: np.ndarray, start: Start | None = None) -> LocalRegression:
    return LocalRegression.fit(features, EVERY, EVERY, 0.002, start)


def prior(ridge: float) -> Start:
    weight = np.random.default_rng(1).normal(0, 0.5, (FEATURES, CELLS, 2, CELLS))
    weight[:, EVERY, :, EVERY] = 0
    return Start(weight, np.array([-0.5, 0.5]), ridge, np.ones((CELLS, CELLS)))


def others(cell: int) -> np.ndarray:
    """Return the inputs of all cells but one."""
    return np.flatnonzero(np.tile(cell != EVERY, FEATURES))


@pytest.mark.parametrize("cell", [0, 3])
@pytest.mark.parametrize(("steps", "error"), [(STEPS, 0.02), (400, 1e-3)])
def test_each_cell_has_the_logistic_regression_of_scikit_learn_on_the_other_cells(
    monkeypatch: pytest.MonkeyPatch, cell: int, steps: int, error: float
):
    monkeypatch.setattr(local_regression, "STEPS", steps)
    features = excerpts(300)
    fitted = fit(features)
    z = ((features - fitted.mean) / fitted.scale).reshape(300, -1)[:, others(cell)]
    for output, did in (
        (cell, features[:, 2, cell] == 0),
        (CELLS + cell, features[:, 3, cell] == 1),
    ):
        peer = LogisticRegression(C=1 / (300 * RIDGE), tol=1e-8, max_iter=10_000).fit(z, did)
        np.testing.assert_allclose(fitted.weight[others(cell), output], peer.coef_[0], atol=error)
        assert fitted.bias[output] == pytest.approx(peer.intercept_[0], abs=error)


def test_a_cell_is_no_input_of_its_own_regressions():
    own = np.arange(FEATURES)[:, None] * CELLS + EVERY
    for start in (None, prior(0.1)):
        weight = fit(excerpts(50), start).weight
        assert not weight[own, EVERY].any()
        assert not weight[own, CELLS + EVERY].any()


def test_with_a_shared_prior_the_gradient_of_the_penalised_loss_is_0():
    # fewer excerpts than inputs
    features = excerpts(20)
    start = prior(0.3)
    fitted = fit(features, start)
    z = ((features - fitted.mean) / fitted.scale).reshape(20, -1)
    odds = z @ fitted.weight + fitted.bias
    did = np.concatenate([features[:, 2] == 0, features[:, 3] == 1], axis=1)
    shared = start.weight.reshape(FEATURES * CELLS, -1)
    added = fitted.weight - shared * fitted.scale.reshape(-1, 1)
    slope = z.T @ (expit(odds) - did) / 20 + start.ridge * added
    for cell in range(CELLS):
        assert np.abs(slope[others(cell)][:, [cell, CELLS + cell]]).max() < 5e-3


def test_a_strong_ridge_leaves_the_shared_prior():
    features = excerpts(20)
    start = prior(1e4)
    said = fit(features, start).predict(features, np.ones(CELLS, bool))
    shared = features.reshape(20, -1) @ start.weight.reshape(FEATURES * CELLS, -1)
    np.testing.assert_allclose(
        np.hstack(said[:2]), shared + np.repeat(start.bias, CELLS), atol=0.01
    )


def test_without_any_load_cells_count_as_independent():
    fitted = fit(np.zeros((9, FEATURES, CELLS), np.float32), prior(0.1))
    np.testing.assert_array_equal(fitted.precision, np.eye(CELLS))
    np.testing.assert_array_equal(fitted.covariance, np.eye(CELLS))


def test_the_precision_is_the_inverse_of_the_covariance_which_vanishes_where_the_taper_does():
    near = 1.0 * (np.abs(np.subtract.outer(EVERY, EVERY)) < 3)
    start = prior(0.1)
    fitted = fit(excerpts(8), Start(start.weight, start.bias, 0.1, near))
    np.testing.assert_allclose(fitted.covariance @ fitted.precision, np.eye(CELLS), atol=1e-8)
    assert not fitted.covariance[near == 0].any()
