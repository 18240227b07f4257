import numpy as np
from scipy.special import expit

from diagnostics.healthy import dual_ridge


def problem() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """40 samples of 15 cells with 2 columns each; two targets for each of the first 5 cells."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(40, 2, 15)).astype(np.float32)
    y = np.stack([x[:, 0, 5:10] + rng.normal(size=(40, 5)) > 0, x[:, 1, :5] > 0.3], axis=1).astype(
        np.float32
    )
    return x, y, x[:, :, :5]


def weights(x: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """``[2, 15, 2, 5]``, the own columns 0."""
    found = np.einsum("nfi,nqk->fiqk", x, coefficients)
    found[:, np.arange(5), :, np.arange(5)] = 0
    return found


def test_at_the_minimum_of_the_ridge_loss_the_gradient_is_0(monkeypatch):
    monkeypatch.setattr(dual_ridge, "STEPS", 400)
    x, y, own = problem()
    usual = np.float32(0.7)
    coefficients, bias = dual_ridge.logistic(x.reshape(40, -1), y, own, 0.1, usual)
    w = weights(x, coefficients)
    error = expit(np.einsum("nfi,fiqk->nqk", x, w) + bias + usual) - y
    slope = np.einsum("nfi,nqk->fiqk", x, error) / 40 + 0.1 * w
    slope[:, np.arange(5), :, np.arange(5)] = 0
    assert np.abs(slope).max() < 1e-3
    assert np.abs(error.mean(axis=0) + 0.1 * bias).max() < 1e-3


def test_the_default_number_of_steps_comes_near_the_minimum(monkeypatch):
    x, y, own = problem()
    soon = weights(x, dual_ridge.logistic(x.reshape(40, -1), y, own, 1.0, np.float32(0))[0])
    monkeypatch.setattr(dual_ridge, "STEPS", 400)
    late = weights(x, dual_ridge.logistic(x.reshape(40, -1), y, own, 1.0, np.float32(0))[0])
    assert np.linalg.norm(soon - late) < 0.1 * np.linalg.norm(late)


def test_the_reading_of_a_cell_does_not_change_its_own_weights(monkeypatch):
    x, y, _ = problem()
    spoiled = x.copy()
    spoiled[:, :, 2] = np.random.default_rng(1).normal(size=(40, 2))
    monkeypatch.setattr(dual_ridge, "STEPS", 400)
    said, of_spoiled = (
        dual_ridge.logistic(v.reshape(40, -1), y, v[:, :, :5], 0.1, np.float32(0))
        for v in (x, spoiled)
    )
    np.testing.assert_allclose(of_spoiled[0][..., 2], said[0][..., 2], atol=1e-4)
    np.testing.assert_allclose(of_spoiled[1][..., 2], said[1][..., 2], atol=1e-4)
    assert np.abs(of_spoiled[0][..., 3] - said[0][..., 3]).max() > 1e-3


def test_the_precision_is_the_inverse_of_the_covariance():
    far = np.abs(np.arange(30)[:, None] - np.arange(30)) > 5
    covariance, precision = dual_ridge.covariance_and_precision(
        np.random.default_rng(0).normal(size=(10, 30)), 1.0 * ~far
    )
    np.testing.assert_allclose(covariance @ precision, np.eye(30), atol=1e-8)
    assert not covariance[far].any()
