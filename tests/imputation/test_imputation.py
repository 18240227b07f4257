import numpy as np
import pytest
import torch

from adaptfault.data.windows import Windows
from adaptfault.imputation.linear import AffineFill
from adaptfault.imputation.statistics import CellStatistics
from diagnostics import FaultSet

D = 12
F = FaultSet((5, 6), D)


def edges(n: int = 200) -> Windows:
    """A block of width 5 somewhere on a line of cells: contact with edges, which no linear map can
    foresee."""
    rng = np.random.default_rng(0)
    start = rng.integers(-2, D - 2, (n, 10, 1))
    cells = np.arange(D)
    x = ((cells >= start) & (cells < start + 5)) * rng.uniform(0.3, 0.6, (n, 10, 1))
    return Windows(x.astype(np.float32), np.zeros(n), np.arange(n))


def test_healthy_cells_pass_unchanged_and_in_place_and_the_rest_is_within_range():
    rng = np.random.default_rng(0)
    linear = AffineFill(F, rng.normal(size=(2, D - 2)), rng.normal(size=2))
    x = torch.rand(2, 3, D - 2)
    for fill in (linear, CellStatistics.fit(edges()).nearest(F)):
        with torch.no_grad():
            whole = fill(x)
        assert torch.equal(whole[..., F.healthy], x)
        assert (whole >= 0).all()
        assert (whole <= 1).all()


def test_the_linear_fill_is_the_gaussian_conditional_mean():
    rng = np.random.default_rng(0)
    mixing = rng.normal(size=(D, D))
    statistics = CellStatistics(
        rng.normal(size=D), mixing @ mixing.T + np.eye(D), np.zeros((1, D), np.float32)
    )
    weight, bias = statistics.conditional_mean(F)
    s = statistics.covariance
    m = list(F)
    h = F.healthy
    np.testing.assert_allclose(weight, s[np.ix_(m, h)] @ np.linalg.inv(s[np.ix_(h, h)]), atol=1e-8)
    np.testing.assert_allclose(weight @ statistics.mean[h] + bias, statistics.mean[m], atol=1e-10)


def test_cells_that_never_moved_are_filled_with_their_value():
    still = Windows(np.full((4, 10, D), 0.25, np.float32), np.zeros(4), np.arange(4))
    statistics = CellStatistics.fit(still)
    for fill in (statistics.linear(F), statistics.nearest(F)):
        with torch.no_grad():
            np.testing.assert_allclose(fill(torch.full((1, 1, D - 2), 0.25)), 0.25, atol=1e-6)


def test_cells_that_switch_together_between_two_levels_are_filled_from_each_other():
    levels = np.tile([0.2, 0.6], 40)[:, None]
    statistics = CellStatistics.of_frames(np.repeat(levels, D, axis=1).astype(np.float32))
    weight, bias = statistics.conditional_mean(F)
    np.testing.assert_allclose(
        levels @ weight.sum(axis=1)[None] + bias, np.repeat(levels, 2, axis=1), atol=1e-6
    )
    assert np.isfinite(statistics.precision).all()


def test_the_nearest_fill_knows_edges_that_the_linear_one_cannot():
    known = edges().x[:150]
    fresh = edges().x[150:]
    statistics = CellStatistics.fit(Windows(known, np.zeros(150), np.arange(150)))
    x = torch.from_numpy(fresh[..., F.healthy])
    truth = fresh[..., list(F)]
    error = {}
    for name, fill in (("linear", statistics.linear(F)), ("nearest", statistics.nearest(F))):
        with torch.no_grad():
            error[name] = float(np.square(fill(x)[..., list(F)].numpy() - truth).mean())
    assert error["nearest"] < 0.5 * error["linear"]


@pytest.mark.parametrize("healthy", [1, D - 1])
def test_one_healthy_cell_or_one_missing_is_enough(healthy):
    statistics = CellStatistics.fit(edges())
    lost = FaultSet(range(D - healthy), D)
    with torch.no_grad():
        assert torch.isfinite(statistics.nearest(lost)(torch.rand(2, 3, healthy))).all()
