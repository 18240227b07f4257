"""Disturbances of all cells in the one model: nobody is blamed for them, dead cells are found."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from pressed_recordings import REST, presses

from diagnostics import SelfDiagnosis, Verdict

DEAD = (18, 27, 45)


def _time(whole: np.ndarray) -> np.ndarray:
    return np.arange(len(whole))[:, None]


def _hum(whole: np.ndarray) -> np.ndarray:
    return whole + 120 * np.sin(_time(whole) / 1.7)


def _ramp(whole: np.ndarray) -> np.ndarray:
    return whole + 600 * _time(whole) / len(whole)


def _coarse(whole: np.ndarray) -> np.ndarray:
    return np.floor(whole / 250) * 250


def _eight_levels(whole: np.ndarray) -> np.ndarray:
    return np.floor(whole / 500) * 500


def _each_creeps(whole: np.ndarray) -> np.ndarray:
    share = np.random.default_rng(8).uniform(0, 300, whole.shape[1])
    return whole + share * _time(whole) / len(whole)


def _ages(whole: np.ndarray) -> np.ndarray:
    along = _time(whole) / len(whole)
    return REST + 250 * along + (whole - REST) * (1 - 0.2 * along)


def _saturates(whole: np.ndarray) -> np.ndarray:
    return np.minimum(REST + 10 * (whole - REST), 4095)


def _crosstalk(whole: np.ndarray) -> np.ndarray:
    return whole + 0.5 * (whole - REST).mean(axis=1, keepdims=True)


def _noise(whole: np.ndarray) -> np.ndarray:
    return whole + np.random.default_rng(7).normal(0, 60, whole.shape)


def _vibrates(whole: np.ndarray) -> np.ndarray:
    share = np.random.default_rng(5).uniform(0.5, 1.5, whole.shape[1])
    return whole + 80 * share * (1 + np.sin(_time(whole) / 1.3))


DISTURBANCES = [
    _hum,
    _ramp,
    _coarse,
    _eight_levels,
    _each_creeps,
    _ages,
    _saturates,
    _crosstalk,
    _noise,
    _vibrates,
]
Disturb = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def fitted(pressed: SelfDiagnosis) -> SelfDiagnosis:
    return pressed


def disturbed(disturb: Disturb) -> list[np.ndarray]:
    log = presses(3, 30)
    whole = np.clip(disturb(np.concatenate(log)).round(), 0, 4095)
    return np.split(whole, len(log))


@pytest.mark.parametrize("disturb", DISTURBANCES)
def test_nobody_is_blamed_for_what_all_cells_do(fitted, disturb):
    assert not fitted.diagnose(disturbed(disturb)).faults


@pytest.mark.parametrize("disturb", DISTURBANCES)
def test_cells_that_hold_a_value_while_all_others_move_are_found(fitted, disturb):
    log = disturbed(disturb)
    for frames in log:
        frames[:, DEAD] = [1500.0, 4095.0, 700.0]
    assert list(fitted.diagnose(log).fault_set) == list(DEAD)


@pytest.mark.parametrize("disturb", DISTURBANCES)
def test_a_cell_that_moves_by_itself_among_them_is_not_alive(fitted, disturb):
    log = disturbed(disturb)
    swing = 1000 + 600 * np.sin(np.arange(30 * 60) / 9)
    for i, frames in enumerate(log):
        frames[:, 27] = swing[60 * i :][:60].round()
    assert fitted.diagnose(log).verdicts[27] is not Verdict.ALIVE


@pytest.mark.parametrize("apart", [10, 15, 20])
def test_untouched_cells_that_rest_a_little_elsewhere_are_neither_faulty_nor_tested(fitted, apart):
    rng = np.random.default_rng(apart)
    rest = REST + rng.uniform(-apart, apart, 64)
    log = [(rest + rng.normal(0, 6, (60, 64))).round() for _ in range(30)]
    diagnosis = fitted.diagnose(log)
    assert not diagnosis.faults
    assert diagnosis.coverage.test_coverage == 0


def test_readings_of_a_converter_with_few_steps_may_be_any_load_of_a_step(fitted):
    log = [np.floor(frames / 1000) * 1000 for frames in presses(4, 30)]
    assert not fitted.diagnose(log).faults


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_cells_that_rest_elsewhere_each_by_its_own_amount_are_healthy_in_a_short_log(fitted, seed):
    apart = np.random.default_rng(seed).uniform(0, 80, 64)
    log = [(frames + apart).round() for frames in presses(seed, 6)]
    diagnosis = fitted.diagnose(log)
    assert not diagnosis.faults
    for frames in log:
        frames[:, 27] = 1500.0
    assert list(fitted.diagnose(log).fault_set) == [27]
