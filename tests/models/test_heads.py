import json

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from sklearn.kernel_ridge import KernelRidge

from adaptfault.adaptation.cell_summary import CellSummary
from adaptfault.models.heads import Head, fit_head, linear_head
from adaptfault.models.kernels import Kernels, Known, Views, kernels, ridge_regression
from adaptfault.models.targets import calibrate, mixture, pooled
from diagnostics import FaultSet, SensorLayout


def windows(n: int = 90, classes: int = 3) -> tuple[Views, np.ndarray]:
    """Views of three classes: the first two each tell another class from the rest, the others a
    little."""
    rng = np.random.default_rng(0)
    y = rng.integers(0, classes, n)
    told = ((0, 2), (1, 2), (2, 0.5), (2, 0.5))
    views = [rng.normal((y == c)[:, None] * far, 1.0, (n, 4)).astype(np.float32) for c, far in told]
    return seen(*views), y


def seen(
    features: np.ndarray,
    smooth: np.ndarray,
    moments: np.ndarray,
    course: np.ndarray | None = None,
) -> Views:
    """The views of kernels, and that of the forest: constant if it is not given."""
    kernels = [torch.as_tensor(view, dtype=torch.float32) for view in (features, smooth, moments)]
    last = np.zeros((len(features), 1)) if course is None else course
    return Views(*kernels, torch.as_tensor(last, dtype=torch.float64))


def one_hot(y: np.ndarray, n_classes: int = 3) -> np.ndarray:
    return np.eye(n_classes, dtype=np.float32)[y]


def parts(views: Views, n: int) -> tuple[Views, Views]:
    """All but the last n windows, and these."""
    return views.select(slice(None, -n)), views.select(slice(-n, None))


def fitted(n: int = 300, n_classes: int = 3) -> tuple[Head, torch.Tensor, Views, np.ndarray]:
    """A head for n windows, the outputs for its held-out half, and that half."""
    views, y = windows(n)
    held = n // 2
    first, second = parts(views, held)
    head, outputs = fit_head(
        first,
        second,
        one_hot(y[:-held], n_classes),
        one_hot(y[-held:], n_classes),
        np.arange(held) % 5,
    )
    return head, outputs, second, y[-held:]


def kernel_of(views: Views) -> torch.Tensor:
    return torch.exp(
        -sum(torch.cdist(view.double(), view.double()).square() for view in views) / 10
    )


def as_sets(y: np.ndarray, held: int, n_classes: int = 3) -> tuple[np.ndarray, ...]:
    """The targets of the windows that are never held out and of the last ones, and their folds."""
    targets = one_hot(y, n_classes)
    return targets[:-held], targets[-held:], np.arange(held) % 5


# The summary of the healthy cells


LAYOUT = SensorLayout(2, 4, 3, present=tuple(bool(i != 5) for i in range(24)))


def test_the_course_of_a_cell_is_mean_maximum_minimum_deviation_and_step():
    x = torch.tensor([[[0.0, 0.25], [0.5, 0.25]]])  # one window of two frames
    _, course = CellSummary(SensorLayout(1, 1, 2), FaultSet((), 2))(x)
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
    found, _ = CellSummary(LAYOUT, faults)(torch.from_numpy(x[..., faults.healthy]))
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
    smooth, _ = CellSummary(layout, FaultSet((), 64))(x)
    smooth = smooth / smooth.norm(dim=1, keepdim=True)
    cells = x.flatten(1) / x.flatten(1).norm(dim=1, keepdim=True)
    assert (smooth[0] - smooth[1]).norm() < 0.7 * (cells[0] - cells[1]).norm()


# The regression


@pytest.mark.parametrize("ridge", [0.05, 0.0005])
def test_the_regression_is_scikit_learns_and_the_held_out_one_that_without_the_fold(ridge):
    views, y = windows()
    kernel = kernel_of(views)
    targets = torch.from_numpy(one_hot(y)).double()
    folds = np.arange(30) % 3
    half = kernel.triu()  # it needs no more, and overwrites it
    weights, held_out = ridge_regression(half, targets, folds, ridge)
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
    views, classes = windows(300)
    blind = seen(torch.zeros(300, 4), views.smooth, torch.zeros(300, 4))
    _, alone = fit_head(*parts(blind, 150), *as_sets(classes, 150))
    right = (outputs.argmax(1).numpy() == y).mean()
    assert right > (alone.argmax(1).numpy() == classes[-150:]).mean() + 0.05
    assert head.shares[0] > 0.5


def test_weights_follow_the_expert_that_predicts_held_out_windows():
    views, y = windows(300)
    noise = torch.randn(300, 4, generator=torch.Generator().manual_seed(0)) * 5
    told = views.features + views.smooth
    classes = as_sets(y, 150)
    head, _ = fit_head(*parts(seen(noise, told, noise, noise), 150), *classes)
    assert head.shares[0] > 0.5
    assert head.shares.sum().item() == pytest.approx(1)
    assert head.pooling[0] > 2 * head.pooling[1]
    head, outputs = fit_head(*parts(seen(noise, noise, noise, told), 150), *classes)
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
    weight, bias = linear_head(views.features.double().numpy(), y, 5)
    assert ((views.features @ weight.T + bias)[:, 3:] < -1000).all()


def test_identical_windows_do_not_break_the_fit():
    views = seen(torch.ones(20, 3), *torch.zeros(2, 20, 2))
    first, second = parts(views, 10)
    head, outputs = fit_head(first, second, *as_sets(np.arange(20) % 3, 10))
    assert torch.isfinite(head(second)).all()
    assert torch.isfinite(outputs).all()


@pytest.mark.parametrize("share", [1.0, 0.8])
@pytest.mark.parametrize("noise", [0.0, 1e-7, 1e-5, 1e-3])
def test_windows_that_differ_by_noise_alone_do_not_break_the_fit(share, noise):
    rng = np.random.default_rng(0)
    x = 0.5 + noise * rng.normal(size=(400, 60))
    x[: round((1 - share) * 400)] = rng.random((round((1 - share) * 400), 60))
    first, second = parts(seen(10 * x, x[:, ::2], x[:, :5], x), 100)
    head, outputs = fit_head(first, second, *as_sets(rng.integers(0, 3, 400), 100))
    assert torch.isfinite(head(second)).all()
    assert torch.isfinite(outputs).all()


@pytest.mark.parametrize("value", [np.nan, 1e30])
def test_features_that_are_not_finite_are_refused(value):
    views, y = windows()
    views.features[3, 1] = value
    with pytest.raises(ValueError, match="features that are not finite"):
        fit_head(*parts(views, 45), *as_sets(y, 45))


def test_values_are_predicted_in_their_own_unit():
    views, _ = windows(200)
    truth = np.stack(
        [100 + 20 * np.tanh(views.features.numpy().mean(1)), np.full(200, 7.0)], axis=1
    ).astype(np.float32)
    first, second = parts(views, 100)
    head, outputs = fit_head(
        first, second, truth[:100], truth[100:], np.arange(100) % 5, values=True
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
    noise = rng.normal(size=(2, 400, 2))
    first, second = parts(seen(*noise, moments), 200)
    head, outputs = fit_head(first, second, *as_sets(y, 200, 4))
    assert head.shares[1] > 0.5
    assert (outputs.argmax(1).numpy() == y[200:]).mean() > 0.4  # 0.25 by chance


def test_moments_count_in_their_own_units():
    views, y = windows(300)
    told = views.features + views.smooth
    units = torch.tensor([1e-3, 1.0, 1e3, 0.0])
    level = torch.tensor([0.0, 0.0, 0.0, 5.0])
    found = []
    for moments in (told * torch.tensor([1.0, 1.0, 1.0, 0.0]), told * units + level):
        first, second = parts(views._replace(moments=moments), 150)
        head, _ = fit_head(first, second, *as_sets(y, 150))
        found.append(head(second).softmax(1))
    torch.testing.assert_close(found[0], found[1], atol=1e-3, rtol=0)


@pytest.mark.parametrize("values", [False, True])
def test_the_kernels_of_a_fit_are_those_of_a_prediction(values):
    views, _ = windows(300)
    known = Known(*views[:3])
    fit = Kernels(known, values=values)
    predicted = kernels(known, fit.widths, views, values=values)
    for joint, expected in zip((True, False), predicted, strict=True):
        found = fit.upper(joint=joint).triu()
        torch.testing.assert_close(found.double(), expected.triu(), atol=1e-5, rtol=0)
