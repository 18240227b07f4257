import json

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from sklearn.kernel_ridge import KernelRidge

from adaptfault.adaptation.cell_summary import CellSummary
from adaptfault.models.heads import (
    Head,
    calibrate,
    fit_head,
    linear_head,
    mixture,
    pooled,
    ridge_regression,
)
from diagnostics import FaultSet, SensorLayout


def windows(n: int = 90, classes: int = 3) -> tuple[list[torch.Tensor], np.ndarray]:
    """Five views of three classes: the first two each tell another class from the rest, the others
    a little."""
    rng = np.random.default_rng(0)
    y = rng.integers(0, classes, n)
    told = ((0, 2), (1, 2), (2, 1), (2, 0.5), (2, 0.5))
    views = [rng.normal((y == c)[:, None] * far, 1.0, (n, 4)).astype(np.float32) for c, far in told]
    return with_course([torch.from_numpy(v) for v in views[:4]], views[4]), y


def with_course(views: list[torch.Tensor], course: np.ndarray | None = None) -> list[torch.Tensor]:
    """The views of kernels, and that of the forest: constant if it is not given."""
    last = np.zeros((len(views[0]), 1)) if course is None else course
    return [*views, torch.from_numpy(last).double()]


def one_hot(y: np.ndarray, n_classes: int = 3) -> np.ndarray:
    return np.eye(n_classes, dtype=np.float32)[y]


def parts(views: list[torch.Tensor], n: int) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """All but the last n windows, and these."""
    return [view[:-n] for view in views], [view[-n:] for view in views]


def fitted(
    n: int = 300, n_classes: int = 3
) -> tuple[Head, torch.Tensor, list[torch.Tensor], np.ndarray]:
    """A head for n windows, the outputs for its held-out half, and that half."""
    views, y = windows(n)
    held = n // 2
    first, second = parts(views, held)
    head, outputs = fit_head(
        first,
        second,
        one_hot(y[:-held], n_classes),
        one_hot(y[-held:], n_classes),
        np.arange(n) % 5,
    )
    return head, outputs, second, y[-held:]


def kernel_of(views: list[torch.Tensor]) -> torch.Tensor:
    return torch.exp(
        -sum(torch.cdist(view.double(), view.double()).square() for view in views) / 10
    )


# The summary of the healthy cells


LAYOUT = SensorLayout(2, 4, 3, present=tuple(bool(i != 5) for i in range(24)))


def test_the_summary_of_the_cells_is_the_root_of_mean_and_maximum():
    x = torch.tensor([[[0.0, 0.25], [0.5, 0.25]]])  # one window of two frames
    cells, _, course = CellSummary(SensorLayout(1, 1, 2), FaultSet((), 2))(x)
    torch.testing.assert_close(cells, torch.tensor([[0.5, 0.5, 0.5**0.5, 0.5]]))
    expected = torch.tensor([[0.25, 0.25, 0.5, 0.25, 0.0, 0.25, 0.25, 0.0, 0.5, 0.0]]).double()
    torch.testing.assert_close(course, expected)
    assert torch.isfinite(
        torch.cat(CellSummary(SensorLayout(1, 1, 2), FaultSet((), 2))(x - 1), 1)
    ).all()


def test_the_smoothed_summary_is_a_gaussian_filter_of_each_pad_and_its_sum():
    faults = FaultSet((0, 7, 20), 24)
    x = np.random.default_rng(0).random((5, 3, 24)).astype(np.float32)
    grid = np.where(LAYOUT.present.ravel() & ~faults.mask, x, 0).reshape(5, 3, 2, 4, 3)
    smooth = gaussian_filter(grid, (0, 0, 0, 1, 1), mode="constant", truncate=3).reshape(5, 3, 24)
    frames = np.concatenate([smooth[..., LAYOUT.present.ravel()], grid.sum((3, 4))], axis=2)
    expected = np.sqrt(np.concatenate([frames.mean(1), frames.max(1)], axis=1))
    _, found, _ = CellSummary(LAYOUT, faults)(torch.from_numpy(x[..., faults.healthy]))
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


def test_positions_that_the_array_lacks_do_not_reach_the_summary():
    summary = CellSummary(LAYOUT, FaultSet((), 24))
    x = torch.rand(4, 3, 24)
    other = x.clone()
    other[..., 5] = torch.nan
    for one, two in zip(summary(x), summary(other), strict=True):
        torch.testing.assert_close(one, two)


def test_a_window_that_is_shifted_by_a_cell_is_nearer_after_smoothing():
    layout = SensorLayout(1, 8, 8)
    frame = np.zeros((8, 8), np.float32)
    frame[2:4, 3:5] = 1.0
    x = torch.from_numpy(np.stack([frame, np.roll(frame, 1, axis=0)]).reshape(2, 1, 64))
    cells, smooth, _ = (
        view / view.norm(dim=1, keepdim=True) for view in CellSummary(layout, FaultSet((), 64))(x)
    )
    assert (smooth[0] - smooth[1]).norm() < 0.7 * (cells[0] - cells[1]).norm()


# The regression


@pytest.mark.parametrize("ridge", [0.05, 0.0005])
def test_the_regression_is_scikit_learns_and_the_held_out_one_that_without_the_fold(ridge):
    views, y = windows()
    kernel = kernel_of(views)
    targets = torch.from_numpy(one_hot(y)).double()
    folds = np.arange(30) % 3
    weights, held_out = ridge_regression(kernel, targets, folds, ridge)
    expected = KernelRidge(alpha=ridge, kernel="precomputed").fit(kernel.numpy(), targets.numpy())
    np.testing.assert_allclose(weights.numpy(), expected.dual_coef_, atol=1e-7)
    for fold in range(3):
        out = 60 + np.flatnonzero(folds == fold)
        known = np.setdiff1d(np.arange(90), out)
        without = KernelRidge(alpha=ridge, kernel="precomputed").fit(
            kernel[known][:, known].numpy(), targets[known]
        )
        predicted = without.predict(kernel[out][:, known].numpy())
        np.testing.assert_allclose(held_out[folds == fold].numpy(), predicted, atol=1e-7)


# The head


def test_views_tell_more_together_than_the_smoothed_cells_alone():
    head, outputs, _, y = fitted()
    views, classes = windows()
    first, second = parts(views, 45)
    blind = [
        with_course([torch.zeros_like(v), torch.zeros_like(v), w, torch.zeros_like(v)])
        for v, _, w, _, _ in (first, second)
    ]
    _, alone = fit_head(
        *blind, one_hot(classes[:-45]), one_hot(classes[-45:]), np.arange(len(classes)) % 5
    )
    assert (outputs.argmax(1).numpy() == y).mean() > (
        alone.argmax(1).numpy() == classes[-45:]
    ).mean() + 0.05
    assert head.shares[0] > 0.5


def test_weights_follow_the_expert_that_predicts_held_out_windows():
    views, y = windows(300)
    noise = torch.randn(300, 4, generator=torch.Generator().manual_seed(0)) * 5
    told = views[0] + views[1]
    classes = one_hot(y[:150]), one_hot(y[150:]), np.arange(len(y)) % 5
    first, second = parts(with_course([noise, noise, told, noise], noise.numpy()), 150)
    head, _ = fit_head(first, second, *classes)
    assert head.shares[0] > 0.5
    assert head.shares.sum().item() == pytest.approx(1)
    assert head.pooling[0] > 2 * head.pooling[1]
    first, second = parts(with_course([noise, noise, noise, noise], told.numpy()), 150)
    head, outputs = fit_head(first, second, *classes)
    assert head.pooling[1] > 0.5
    assert (outputs.argmax(1).numpy() == y[150:]).mean() > 0.55  # 0.33 by chance


def test_probabilities_of_held_out_windows_are_as_sure_as_they_are_right():
    _, outputs, _, y = fitted(600)
    sure = torch.softmax(outputs, 1).max(1).values.mean()
    assert sure == pytest.approx((outputs.argmax(1).numpy() == y).mean(), abs=0.05)
    assert calibrate(outputs, y)[0] == pytest.approx(1, abs=0.15)


def test_a_class_that_no_window_has_is_never_the_answer():
    head, outputs, held, _ = fitted(90, n_classes=5)
    for z in (head(held), outputs):
        assert (z[:, 3:] < -1000).all()
        assert torch.isfinite(z).all()
    views, y = windows()
    weight, bias = linear_head(views[0].double().numpy(), y, 5)
    assert ((views[0] @ weight.T + bias)[:, 3:] < -1000).all()


def test_identical_windows_do_not_break_the_fit():
    views = with_course([torch.ones(20, 3), *torch.zeros(3, 20, 2)])
    first, second = parts(views, 10)
    head, outputs = fit_head(
        first, second, one_hot(np.arange(10) % 3), one_hot(np.arange(10) % 3), np.arange(20) % 5
    )
    assert torch.isfinite(head(second)).all()
    assert torch.isfinite(outputs).all()


@pytest.mark.parametrize("share", [1.0, 0.8])
@pytest.mark.parametrize("noise", [0.0, 1e-7, 1e-5, 1e-3])
def test_windows_that_differ_by_noise_alone_do_not_break_the_fit(share, noise):
    rng = np.random.default_rng(0)
    x = 0.5 + noise * rng.normal(size=(400, 60))
    x[: round((1 - share) * 400)] = rng.random((round((1 - share) * 400), 60))
    kernels = [torch.from_numpy(v.astype(np.float32)) for v in (10 * x, x, x[:, ::2], x[:, :5])]
    views = with_course(kernels, x)
    first, second = parts(views, 100)
    classes = one_hot(rng.integers(0, 3, 400))
    head, outputs = fit_head(
        first, second, classes[:300], classes[300:], np.arange(len(classes)) % 5
    )
    assert torch.isfinite(head(second)).all()
    assert torch.isfinite(outputs).all()


@pytest.mark.parametrize("value", [np.nan, 1e30])
def test_features_that_are_not_finite_are_refused(value):
    views, y = windows()
    views[0][3, 1] = value
    with pytest.raises(ValueError, match="features that are not finite"):
        fit_head(*parts(views, 45), one_hot(y[:-45]), one_hot(y[-45:]), np.arange(len(y)) % 5)


def test_values_are_predicted_in_their_own_unit():
    views, _ = windows(200)
    truth = np.stack(
        [100 + 20 * np.tanh(views[0].numpy().mean(1)), np.full(200, 7.0)], axis=1
    ).astype(np.float32)
    first, second = parts(views, 100)
    head, outputs = fit_head(
        first, second, truth[:100], truth[100:], np.arange(len(truth)) % 5, values=True
    )
    for predicted in (head(second).numpy(), outputs.numpy()):
        assert np.abs(predicted[:, 0] - truth[100:, 0]).mean() < 0.5 * truth[100:, 0].std()
        np.testing.assert_allclose(predicted[:, 1], 7, atol=1e-3)


def test_a_mixture_is_the_mean_of_probabilities():
    one, other = torch.randn(2, 6, 3, generator=torch.Generator().manual_seed(0))
    mixed = mixture([one, other], torch.tensor([0.3, 0.7]))
    torch.testing.assert_close(mixed.exp(), 0.3 * one.softmax(1) + 0.7 * other.softmax(1))
    torch.testing.assert_close(
        mixture([one, other], torch.tensor([1.0, 0.0])).exp(), one.softmax(1)
    )


def test_a_pool_is_the_product_of_powers_of_probabilities():
    one, other = torch.randn(2, 6, 3, generator=torch.Generator().manual_seed(0))
    found = pooled([one, other], torch.tensor([0.3, 0.7])).softmax(1)
    product = one.softmax(1) ** 0.3 * other.softmax(1) ** 0.7
    torch.testing.assert_close(found, product / product.sum(1, keepdim=True))
    alone = pooled([one, other], torch.tensor([1.0, 0.0])).softmax(1)
    torch.testing.assert_close(alone, one.softmax(1))
    values = pooled([one, other], torch.tensor([0.3, 0.7]), values=True)
    torch.testing.assert_close(values, 0.3 * one + 0.7 * other)


def test_a_head_comes_back_from_its_state():
    head, _, held, _ = fitted(90)
    again = Head.empty(json.loads(json.dumps(head.about)), 3)
    again.load_state_dict(head.state_dict())
    assert torch.equal(again(held), head(held))


def test_windows_that_differ_in_one_moment_are_told_apart_by_the_laplacian_kernel():
    rng = np.random.default_rng(0)
    moments = rng.random((400, 40)).astype(np.float32)
    y = (moments[:, 0] > 0.5).astype(int) + 2 * (moments[:, 1] > 0.5)
    views = with_course([*torch.zeros(3, 400, 2), torch.from_numpy(moments)])
    first, second = parts(views, 200)
    head, outputs = fit_head(
        first, second, one_hot(y[:200], 4), one_hot(y[200:], 4), np.arange(len(y)) % 5
    )
    assert head.shares[1] + head.shares[3] > 0.5  # the same kernel: nothing has to be restored
    assert (outputs.argmax(1).numpy() == y[200:]).mean() > 0.4  # 0.25 by chance


def with_dead_cells(n: int = 400) -> tuple[list[torch.Tensor], torch.Tensor, np.ndarray]:
    """Views of windows whose class lies in a moment that only the cells show, the whole moments,
    and the classes."""
    rng = np.random.default_rng(0)
    cells = rng.random((n, 3)).astype(np.float32)
    hidden = cells[:, :1] + cells[:, 1:2] ** 2
    shown = np.zeros((n, 2), np.float32)
    whole = np.hstack([hidden, rng.random((n, 1))]).astype(np.float32)
    nothing = torch.zeros(n, 2)
    views = with_course([nothing, torch.from_numpy(cells), nothing, torch.from_numpy(shown)])
    return views, torch.from_numpy(whole), (hidden[:, 0] > np.median(hidden)).astype(int)


def test_moments_are_restored_from_the_cells_that_are_left():
    views, whole, y = with_dead_cells()
    first, second = parts(views, 200)
    one = one_hot(y[:200], 2), one_hot(y[200:], 2), np.arange(len(y)) % 5
    head, _ = fit_head(first, second, *one, whole=whole)
    restored = head.known[4] * head.get_buffer("units")
    error = (restored - whole).square().mean(0) / whole.var(0)
    assert error[0] < 0.05
    assert error[1] > 0.5  # noise is not restored
    assert head.shares[2:].sum() > 0.5


def test_a_window_is_restored_without_what_its_own_dead_cells_read():
    views, whole, y = with_dead_cells()
    first, second = parts(views, 200)
    folds = np.arange(len(y)) % 5
    other = whole.clone()
    other[folds == 2, 0] = whole[folds == 2, 0].flip(0)
    one = one_hot(y[:200], 2), one_hot(y[200:], 2), folds
    a, b = (fit_head(first, second, *one, whole=w)[0].known[4] for w in (whole, other))
    torch.testing.assert_close(a[folds == 2], b[folds == 2], rtol=1e-3, atol=1e-3)
    assert (a - b)[folds != 2].abs().max() > 0.1


def test_moments_count_in_their_own_units():
    views, y = windows(300)
    views[3] = views[0] + views[1]
    scaled = [
        *views[:3],
        views[3] * torch.tensor([1e-3, 1.0, 1e3, 0.0]) + torch.tensor([0.0, 0.0, 0.0, 5.0]),
        views[4],
    ]
    plain = [*views[:3], views[3] * torch.tensor([1.0, 1.0, 1.0, 0.0]), views[4]]
    found = []
    for each in (plain, scaled):
        first, second = parts(each, 150)
        head, _ = fit_head(first, second, one_hot(y[:150]), one_hot(y[150:]), np.arange(len(y)) % 5)
        found.append(head(second).softmax(1))
    torch.testing.assert_close(found[0], found[1], atol=1e-3, rtol=0)
