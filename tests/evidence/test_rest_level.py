"""Rest level: where living cells rest above 0, a cell that reads a constant 0 is open, whatever
touches it."""

import subprocess
import sys

import numpy as np
import pytest
from contact_recordings import CELLS, LAYOUT, events
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import betabinom

from diagnostics import Fault, FaultKind, SelfDiagnosis, inject
from diagnostics.events.constant_runs import ConstantRuns
from diagnostics.evidence.rest_level import RestLevel, beta_binomial

TOLERANCE = 0.005
STEP = 1 / 1023
LENGTH = 100
CORNERS = [LAYOUT.cell(0, r, c) for r in (0, LAYOUT.rows - 1) for c in (0, LAYOUT.cols - 1)]


def resting(readings: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Return the evidence about the ``asked`` cells, if all others moved after they had given these
    readings."""
    numbers = np.arange(len(readings))
    runs = ConstantRuns.begin(CELLS).extend(readings, numbers, TOLERANCE)
    moved = np.where(asked, readings[-1], readings[-1] + 0.5 + 0.1 * np.arange(8)[:, None])
    after = runs.extend(moved, len(numbers) + np.arange(8), TOLERANCE)
    level = RestLevel.begin(CELLS).extend(runs, after.start != runs.start)
    return level.evidence(after, asked, TOLERANCE, LAYOUT)[asked]


def test_healthy_cells_have_a_mean_likelihood_ratio_of_at_most_1():
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(100):
        levels = np.maximum(0, rng.normal(rng.uniform(0, 0.05), 0.01, CELLS))
        asked = rng.permutation(CELLS) < 8
        noise = rng.uniform(-0.4, 0.4, (LENGTH, CELLS)) * TOLERANCE * rng.integers(2)
        ratios.append(np.exp(resting(levels + noise, asked)))
    each = np.mean(ratios, axis=1)
    assert each.mean() < 1 + 2 * each.std() / np.sqrt(len(each))


def test_a_constant_0_is_the_more_evidence_the_farther_above_it_living_cells_rest():
    asked = np.arange(CELLS) == 3
    rng = np.random.default_rng(1)
    ratios = []
    for rest in (0.0, 0.02, 0.04, 0.08):
        readings = np.tile(rest + 0.25 * rest * rng.uniform(-1, 1, CELLS), (LENGTH, 1))
        readings[:, asked] = 0.0
        ratios.append(float(resting(readings, asked)[0]))
    assert abs(ratios[0]) < 0.5
    assert ratios[1] > 3
    assert (np.diff(ratios) > 0).all()


def test_a_level_above_0_and_readings_that_differ_do_not_count_against_a_cell():
    readings = np.full((LENGTH, CELLS), 0.05)
    asked = np.arange(CELLS) < 2
    readings[:, 0] = 0.03  # unlike all others
    readings[:, 1] = 0.001 * (np.arange(LENGTH) % 2) + 0.05
    assert (resting(readings, asked) <= 0).all()


def test_the_more_cells_read_0_the_less_it_counts_against_each_of_them():
    readings = np.full((LENGTH, CELLS), 0.05)
    ratios = []
    for n in (1, 3, 10, 25):
        asked = np.arange(CELLS) < n
        ratios.append(resting(np.where(asked, 0.0, readings), asked)[0])
    assert (np.diff(ratios) < 0).all()
    assert ratios[-1] < 1.5


def test_a_few_cells_that_read_0_among_idle_ones_that_rest_like_the_others_are_open():
    readings = np.full((LENGTH, CELLS), 0.05)
    idle = np.arange(CELLS) < 6
    assert (
        resting(np.where(np.arange(CELLS) < 3, 0.0, readings), idle)[:3] > 6
    ).all()  # log likelihood ratios


def test_many_idle_cells_that_rest_like_the_others_are_not_suspected():
    for n in (1, 5, 20):
        assert (resting(np.zeros((LENGTH, CELLS)), np.arange(CELLS) < n) < 0.2).all()


def recordings(seed: int, noise: float, rest: float) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    rests = rest * np.random.default_rng(99).uniform(0.5, 1.5, CELLS)
    read = [r + rests + noise * rng.standard_normal(r.shape) for r in events(seed, 6, 120)]
    return [np.clip(np.round(r / STEP), 0, 1023) * STEP for r in read]


@pytest.mark.parametrize(("noise", "rest"), [(0.0, 0.05), (0.0005, 0.05)])
def test_in_a_cold_start_an_open_cell_in_a_corner_is_found_and_healthy_corners_are_not(
    noise: float, rest: float
):
    log = recordings(5, noise, rest)
    seen = [inject(r, [Fault(FaultKind.OPEN, (CORNERS[1],))], LAYOUT) for r in log]
    cold = SelfDiagnosis(LAYOUT)
    assert cold.diagnose(seen).probability[CORNERS[1]] > 0.5
    assert cold.diagnose(log).probability[CORNERS].max() < 0.02


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 2000), st.floats(0.01, 50), st.floats(0.01, 50))
def test_the_beta_binomial_distribution_is_scipys(n: int, a: float, b: float):
    k = np.arange(0, n + 1, max(1, n // 20))
    np.testing.assert_allclose(beta_binomial(k, n, a, b), betabinom.pmf(k, n, a, b), rtol=1e-6)


def test_importing_the_diagnosis_does_not_import_the_statistics_of_scipy():
    code = "import sys, diagnostics; print('scipy.stats' in sys.modules)"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip()
        == "False"
    )
