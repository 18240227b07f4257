"""One decision for a whole contact."""

import numpy as np
import pytest

from adaptfault.models.accumulation import ContactDecision, ContactStatistics

LOADED = np.full(4, 0.5, np.float32)
IDLE = np.zeros(4, np.float32)
HALF = np.array([0.5, 0.3, 0.2], np.float32)


def decision(dependence: float, length: int = 1) -> ContactDecision:
    return ContactDecision(
        ContactStatistics((0.0,) * 4, 0.05, dependence), np.ones(4, bool), length
    )


@pytest.mark.parametrize(("dependence", "power"), [(1.0, 1.0), (0.0, 3.0), (0.5, 1.5)])
def test_three_equal_windows_count_as_their_effective_number(dependence, power):
    contact = decision(dependence)
    for _ in range(3):
        reached = contact.update(LOADED, HALF)
    np.testing.assert_allclose(reached, HALF**power / (HALF**power).sum(), rtol=1e-5)


def test_windows_that_overlap_count_as_one_for_each_length_of_them():
    contact = decision(0.0, length=5)
    for _ in range(11):
        reached = contact.update(LOADED, HALF)
    np.testing.assert_allclose(reached, HALF**3 / (HALF**3).sum(), rtol=1e-5)


def test_a_contact_is_forgotten_at_its_release():
    contact = decision(0.0)
    other = HALF[::-1].copy()
    assert contact.update(IDLE, HALF) is None
    for _ in range(3):
        contact.update(LOADED, HALF)
    assert contact.update(LOADED * 0.2, HALF) is None
    np.testing.assert_allclose(contact.update(LOADED, other), other, rtol=1e-5)
    contact.reset()
    assert contact.update(IDLE, HALF) is None


def test_a_faulty_cell_neither_begins_nor_holds_a_contact():
    stuck = np.array([1, 0, 0, 0], np.float32)
    healthy = np.array([False, True, True, True])
    contact = ContactDecision(ContactStatistics((0.0,) * 4, 0.05, 1.0), healthy, 1)
    assert contact.update(stuck, HALF) is None
    assert contact.update(np.maximum(stuck, LOADED), HALF) is not None
    assert contact.update(stuck, HALF) is None


@pytest.mark.parametrize(("copies", "low", "high"), [(True, 0.9, 1.0), (False, 0.0, 0.1)])
def test_the_dependence_of_the_windows_is_estimated(copies, low, high):
    """Windows that repeat the first of their recording count as one; independent ones multiply."""
    rng = np.random.default_rng(0)
    n = 400
    t = 6
    k = 3
    y = rng.integers(0, k, n)
    logits = rng.normal(size=(n, t, k))
    logits[np.arange(n), :, y] += (
        1.0  # the log likelihood ratio of N(1, 1) and N(0, 1), up to a constant
    )
    if copies:
        logits[:] = logits[:, :1]
    p = np.exp(logits) / np.exp(logits).sum(axis=2, keepdims=True)
    x = rng.random((n * t, 5, 4)).astype(np.float32)
    found = ContactStatistics.fit(x, p.reshape(-1, k), np.repeat(y, t), np.repeat(np.arange(n), t))
    assert low <= found.dependence <= high
    assert ContactStatistics.from_dict(found.to_dict()) == found


def test_what_a_missing_position_holds_does_not_matter():
    x = np.random.default_rng(0).random((20, 5, 4)).astype(np.float32)
    given = (np.full((20, 2), 0.5), np.zeros(20, np.int64), np.arange(20) // 2)
    x[..., 3] = 0
    usual = ContactStatistics.fit(x, *given)
    x[..., 3] = np.nan
    assert ContactStatistics.fit(x, *given) == usual
