import numpy as np
import pytest
from test_constant_runs import FULL_SCALE, TOLERANCE, runs_of

from diagnostics import SensorLayout
from diagnostics.evidence.jumps import JumpHistogram
from diagnostics.evidence.term import ConstantCells
from diagnostics.preprocessing.scale import Scale


def cells_of(log: np.ndarray) -> ConstantCells:
    """Return the constant cells at the end of a log, none of them at rest."""
    layout = SensorLayout(1, 1, log.shape[1], full_scale=FULL_SCALE)
    return ConstantCells(layout, FULL_SCALE, TOLERANCE, runs_of(log), np.zeros(log.shape[1], bool))


@pytest.fixture(scope="module")
def gentle() -> list[np.ndarray]:
    """Loads that come and go little by little, at another time in each cell."""
    rng = np.random.default_rng(0)
    t = np.arange(200)[:, None]
    return [np.maximum(0, 3 * np.sin(t / 12 + rng.uniform(0, 6, 20))) for _ in range(10)]


def test_a_cell_that_jumps_further_than_healthy_ones_is_suspect_and_a_gradual_release_is_not(
    gentle,
):
    jumps_seen = JumpHistogram.fit(gentle, Scale(np.zeros(20), 2 * TOLERANCE, FULL_SCALE))
    log = gentle[0][:60].copy()
    log[30:, 4] = 5.0
    evidence = jumps_seen.evidence(cells_of(log))
    assert evidence[4] > 0.5
    let_go = np.concatenate([log, np.linspace(log[-1], 0, 40), np.zeros((10, 20))])
    assert jumps_seen.evidence(cells_of(let_go))[5] < 0


def test_jumps_in_company_and_cells_that_never_moved_are_no_evidence(gentle):
    jumps_seen = JumpHistogram.fit(gentle, Scale(np.zeros(20), 2 * TOLERANCE, FULL_SCALE))
    released = np.tile(np.linspace(1, 2, 20)[:, None], 10)
    released[12:] = 0.0
    released[:, 3] = 2.5
    assert (jumps_seen.evidence(cells_of(released)) == 0).all()


def test_without_a_reference_no_jump_is_evidence():
    log = np.tile(np.linspace(1, 2, 20)[:, None], 10)
    log[12:, 3] = 5.0
    assert (JumpHistogram.silent().evidence(cells_of(log)) == 0).all()
