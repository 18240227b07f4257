import numpy as np
import pytest

from diagnostics.idle import IdleModel


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    """A blob that wanders over a line of 12 cells: what it does not reach reads exactly 0; cell 11 is never reached."""
    rng = np.random.default_rng(0)
    centre, force = rng.uniform(1, 7.5, (3000, 1)), rng.uniform(0.5, 2, (3000, 1))
    load = force * (1 - ((np.arange(12) - centre) / 2.5) ** 2)
    return np.where(load > 0.1, load, 0).astype(np.float32)


@pytest.fixture(scope="module")
def model(frames: np.ndarray) -> IdleModel:
    return IdleModel.fit(frames[::2], near=0.05)


def test_a_cell_between_loaded_ones_is_hardly_ever_idle_and_one_far_from_them_nearly_always(model, frames):
    held_out = frames[1::2]
    p = model.probability(held_out, np.arange(12))
    loaded = held_out > 0.5
    assert p[:, 4][loaded[:, 3] & loaded[:, 5]].max() < 0.1
    assert p[:, 10][~(held_out[:, 8:] > 0).any(axis=1)].min() > 0.9


def test_it_tells_more_about_frames_not_seen_than_each_cells_own_share_of_idle_frames(model, frames):
    held_out, cells = frames[1::2], np.arange(1, 9)
    idle = held_out[:, cells] <= 0.05

    def log_loss(p: np.ndarray) -> float:
        return float(-np.log(np.where(idle, p, 1 - p)).mean())

    own_share = np.broadcast_to((frames[::2, cells] <= 0.05).mean(axis=0), idle.shape)
    assert log_loss(model.probability(held_out, cells)) < 0.3 * log_loss(own_share)


def test_what_a_cell_reads_itself_does_not_matter(model, frames):
    spoiled = frames[:50].copy()
    spoiled[:, 4] = 5.0
    cells = np.array([4])
    np.testing.assert_array_equal(model.probability(spoiled, cells), model.probability(frames[:50], cells))


def test_a_cell_that_never_moved_is_always_idle(model, frames):
    assert model.probability(frames, np.array([11])).min() > 0.99


def test_cells_may_rest_at_any_value(frames):
    offset = np.linspace(0, 2, 12, dtype=np.float32)
    shifted = IdleModel.fit(frames[::2] + offset, near=0.05)
    np.testing.assert_allclose(shifted.resting, offset, atol=1e-6)
    plain = IdleModel.fit(frames[::2], near=0.05)
    cells = np.arange(1, 9)
    difference = shifted.probability(frames + offset, cells) - plain.probability(frames, cells)
    assert np.abs(difference).mean() < 0.01
