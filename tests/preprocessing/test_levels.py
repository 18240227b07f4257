"""Recordings that rest at levels of their own."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from round_contacts import presses

from diagnostics import SelfDiagnosis, SensorLayout
from diagnostics.preprocessing.levels import LIGHT
from diagnostics.preprocessing.offset import levelled, levels

LAYOUT = SensorLayout(1, 8, 8, full_scale=4095, unit="count", rate=20.0)
PRESENT = np.ones(64, bool)
GAIN = np.random.default_rng(7).uniform(0.4, 1.0, 64)  # of each cell


def lifted(
    recordings: list[np.ndarray], seed: int, share: tuple[float, float] = (0.05, 0.28)
) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [np.clip(f + np.rint(rng.uniform(*share) * 4095), 0, 4095) for f in recordings]


@pytest.fixture(scope="module")
def fitted() -> SelfDiagnosis:
    return SelfDiagnosis(LAYOUT).fit(lifted(presses(0), 1))


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(0, 0.3), min_size=8, max_size=20), st.integers(0, 2**20))
def test_the_levels_are_those_that_the_recordings_rest_at_or_none(shares: list[float], seed: int):
    rng = np.random.default_rng(seed)
    given_levels = np.rint(np.array(shares) * 4095)
    recordings = [rng.normal(100, 2, (40, 64)) + level for level in given_levels]
    found = levels(recordings, PRESENT, 4095)
    lowest = np.quantile(given_levels, 0.05)
    if abs(np.median(given_levels) - lowest - LIGHT * 4095) < 10:
        return
    if np.median(given_levels) - lowest < LIGHT * 4095:
        assert not found.any()
    else:
        np.testing.assert_allclose(found - found.min(), given_levels - given_levels.min(), atol=5)


@pytest.mark.parametrize("share", [(0.0, 0.0), (0.0, 0.05)])
def test_small_levels_leave_the_recordings_as_they_are(share: tuple[float, float]):
    recordings = lifted(presses(2, 12), 3, share)
    same = levelled(recordings, levels(recordings, PRESENT, 4095))
    assert all(a is b for a, b in zip(same.given, recordings, strict=True))


def test_loads_on_half_of_the_cells_are_no_level():
    recordings = [np.full((40, 64), 100.0) for _ in range(12)]
    for frames in recordings[2:]:
        frames[:, :32] = 2000
    assert not levels(recordings, PRESENT, 4095).any()


@pytest.mark.parametrize("seed", range(8))
def test_a_level_that_the_reference_shows_blames_no_healthy_cell_and_hides_no_dead_one(
    fitted: SelfDiagnosis, seed: int
):
    recordings = lifted(presses(10 + seed, 7)[:6], 20 + seed)
    dead = np.random.default_rng(seed).choice(64, 6, replace=False)
    before = recordings[3][-1, dead].copy()
    for frames in recordings[4:]:
        frames[:, dead] = before
    diagnosis = fitted.diagnose(recordings)
    assert set(map(int, diagnosis.fault_set)) <= set(map(int, dead))
    # A value that is as high as the rest of the others is no evidence.
    rise = max(float(np.median(frames)) for frames in recordings[4:]) - float(np.median(before))
    if rise > 2 * LIGHT * 4095:
        assert diagnosis.probability[dead].min() > 0.5


def test_exchanged_rows_are_found_at_other_levels(fitted: SelfDiagnosis):
    grid = np.arange(64).reshape(8, 8)
    grid[[2, 5]] = grid[[5, 2]]
    found = fitted.rewiring([f[:, grid.ravel()] for f in lifted(presses(30, 24), 31)])
    assert found is not None
    assert (found.source == grid.ravel()).all()


@pytest.fixture(scope="module")
def uneven() -> SelfDiagnosis:
    return SelfDiagnosis(LAYOUT).fit([f * GAIN for f in presses(0)])


def turned(quarters: int, transposed: bool) -> np.ndarray:
    grid = np.rot90(np.arange(64).reshape(8, 8), quarters)
    return (grid.T if transposed else grid).ravel()


@pytest.mark.parametrize("transposed", [True, False])
@pytest.mark.parametrize("quarters", range(4))
def test_a_pad_that_is_turned_or_transposed_is_put_in_order(
    uneven: SelfDiagnosis, quarters: int, transposed: bool
):
    order = turned(quarters, transposed)
    found = uneven.rewiring([(f * GAIN)[:, order] for f in presses(34, 40)])
    if not transposed and quarters == 0:
        assert found is None
    else:
        assert found is not None
        assert (order[found.source] == np.arange(64)).all()


@pytest.mark.parametrize("transposed", [True, False])
@pytest.mark.parametrize("seed", [34, 61, 62])
def test_where_cells_and_loads_are_symmetric_a_turned_pad_is_not_named(
    fitted: SelfDiagnosis, seed: int, transposed: bool
):
    assert (
        fitted.rewiring([f[:, turned(0, transposed)] for f in lifted(presses(seed, 40), 35)])
        is None
    )


def test_healthy_wiring_at_other_levels_is_not_called_exchanged(fitted: SelfDiagnosis):
    assert fitted.rewiring(lifted(presses(32, 24), 33)) is None
