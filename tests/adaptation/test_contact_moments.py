import numpy as np
import torch

from adaptfault.adaptation.contact_moments import ContactMoments
from diagnostics import SensorLayout

LAYOUT = SensorLayout(2, 5, 4)


def of(*frames: np.ndarray) -> np.ndarray:
    """The moments of one window, ``[pads, 16]``: eight of the mean frame, then how they change."""
    x = torch.from_numpy(np.stack(frames).astype(np.float32).reshape(1, len(frames), -1))
    return ContactMoments(LAYOUT)(x).numpy().reshape(LAYOUT.pads, 16)


def frame(weights: np.ndarray) -> np.ndarray:
    """A frame with a load on the second pad alone."""
    return np.stack([np.zeros((5, 4)), weights])


def test_the_moments_of_a_pad_are_those_of_its_readings():
    weights = np.random.default_rng(0).random((5, 4))
    y, x = np.mgrid[:5, :4] - np.array([2, 1.5])[:, None, None]
    mean_y = np.average(y, weights=weights)
    mean_x = np.average(x, weights=weights)
    (var_y, cov), (_, var_x) = np.cov(
        np.stack([y, x]).reshape(2, -1), aweights=weights.ravel(), ddof=0
    )
    size = np.sqrt(weights.sum() ** 2 / (weights**2).sum())
    spread_y = np.sqrt(var_y + 1 / 12)
    spread_x = np.sqrt(var_x + 1 / 12)
    expected = [
        weights.sum(),
        mean_y,
        mean_x,
        spread_y,
        spread_x,
        cov,
        np.sqrt(weights.max()),
        size,
    ]
    found = of(frame(weights), frame(weights))[1]
    np.testing.assert_allclose(found[:8], expected, atol=5e-3)
    np.testing.assert_allclose(found[8:], 0, atol=1e-6)


def test_a_load_that_moves_changes_its_centroid_alone():
    before, after = np.zeros((2, 5, 4))
    before[1, 1] = after[3, 2] = 0.5
    change = of(frame(before), frame(after))[1, 8:]
    np.testing.assert_allclose(change[1:3], [2, 1], atol=5e-3)
    np.testing.assert_allclose(np.delete(change, [1, 2]), 0, atol=5e-3)


def test_a_pad_without_contact_has_no_place():
    empty = of(frame(np.ones((5, 4))), frame(np.ones((5, 4))))[0]
    assert np.isfinite(empty).all()
    np.testing.assert_array_equal(np.delete(empty, [3, 4]), 0)


def test_positions_that_the_array_lacks_do_not_reach_the_moments():
    moments = ContactMoments(SensorLayout(1, 2, 3, present=tuple(i != 4 for i in range(6))))
    x = torch.rand(4, 3, 6, generator=torch.Generator().manual_seed(0))
    other = x.clone()
    other[..., 4] = torch.nan
    torch.testing.assert_close(moments(x), moments(other), rtol=0, atol=0)
