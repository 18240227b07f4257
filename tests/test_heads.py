import numpy as np
import pytest
import torch

from adaptfault.adaptation.heads import KernelFit, KernelHead, calibrate, linear_head, summarise


def windows(n: int = 90) -> tuple[list[torch.Tensor], np.ndarray]:
    """Two views of three classes: one tells the first class from the others, the other the second."""
    rng = np.random.default_rng(0)
    y = rng.integers(0, 3, n)
    views = [rng.normal((y == c)[:, None] * 2.0, 1.0, (n, 4)).astype(np.float32) for c in (0, 1)]
    return [torch.from_numpy(v) for v in views], y


def one_hot(y: np.ndarray, n_classes: int = 3) -> np.ndarray:
    return np.eye(n_classes, dtype=np.float32)[y]


def test_the_summary_is_the_root_of_mean_and_maximum():
    x = torch.tensor([[[0.0, 0.25], [0.5, 0.25]]])  # one window of two frames
    torch.testing.assert_close(summarise(x), torch.tensor([[0.5, 0.5, 0.5**0.5, 0.5]]))
    assert torch.isfinite(summarise(x - 1)).all()


def test_the_head_is_kernel_ridge_regression():
    views, y = windows()
    fit = KernelFit(views, one_hot(y), np.zeros(30, int))
    head, _ = fit.fit((0.5, 0.5))
    kernel = 0.5 * fit.kernels[0].numpy() + 0.5 * fit.kernels[1].numpy()
    expected = kernel @ np.linalg.solve(kernel + 0.05 * np.eye(90), one_hot(y) - 1 / 3)
    np.testing.assert_allclose(head(views).numpy(), expected, atol=1e-4)


def test_held_out_logits_are_those_of_a_head_fitted_without_that_fold():
    views, y = windows()
    folds = np.arange(30) % 3
    fit = KernelFit(views, one_hot(y), folds)
    _, logits = fit.fit((0.7, 0.3))
    kernel = 0.7 * fit.kernels[0].numpy() + 0.3 * fit.kernels[1].numpy()
    for fold in range(3):
        out = 60 + np.flatnonzero(folds == fold)
        known = np.setdiff1d(np.arange(90), out)
        weights = np.linalg.solve(kernel[np.ix_(known, known)] + 0.05 * np.eye(len(known)), one_hot(y)[known] - 1 / 3)
        np.testing.assert_allclose(logits[folds == fold].numpy(), kernel[np.ix_(out, known)] @ weights, atol=1e-4)


def test_both_views_together_tell_more_than_either():
    views, y = windows(300)
    fit = KernelFit(views, one_hot(y), np.arange(150) % 5)
    right = [(fit.fit(s)[1].argmax(1).numpy() == y[150:]).mean() for s in ((1.0, 0.0), (0.0, 1.0), (0.5, 0.5))]
    assert right[2] > max(right[:2]) + 0.05


def test_calibration_turns_scores_into_probabilities():
    views, y = windows(600)
    head, logits = KernelFit(views, one_hot(y), np.arange(300) % 5).fit((0.5, 0.5))
    scale, loss = calibrate(logits, y[300:])
    assert loss < torch.nn.functional.cross_entropy(logits, torch.from_numpy(y[300:])).item()
    sure = torch.softmax(logits * scale, 1).max(1).values.mean()
    assert sure == pytest.approx((logits.argmax(1).numpy() == y[300:]).mean(), abs=0.05)
    torch.testing.assert_close(head.scaled(scale)(views), head(views) * scale, rtol=0, atol=1e-3)


def test_a_class_that_no_window_has_is_never_the_answer():
    views, y = windows()
    head, logits = KernelFit(views, one_hot(y, 5), np.zeros(30, int)).fit((0.5, 0.5))
    for z in (head(views), logits):
        assert (z[:, 3:] < -1000).all()
    weight, bias = linear_head(views[0].double().numpy(), y, 5)
    assert ((views[0] @ weight.T + bias)[:, 3:] < -1000).all()


def test_identical_windows_do_not_break_the_fit():
    views = [torch.ones(20, 3), torch.zeros(20, 2)]
    head, logits = KernelFit(views, one_hot(np.arange(20) % 3), np.arange(10) % 5).fit((0.5, 0.5))
    assert torch.isfinite(head(views)).all()
    assert torch.isfinite(logits).all()


def test_a_head_comes_back_from_its_state():
    views, y = windows()
    head, _ = KernelFit(views, one_hot(y), np.zeros(30, int)).fit((0.2, 0.8))
    again = KernelHead.empty(head.shapes, 3)
    again.load_state_dict(head.state_dict())
    assert torch.equal(again(views), head(views))
