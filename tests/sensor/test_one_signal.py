"""Cells that all show one signal are told as that; an array that is loaded alike is healthy."""

import numpy as np
import pytest

import adaptfault as af
from adaptfault.inspection.long_log import inspect_parts
from diagnostics import SelfDiagnosis, SensorLayout, Verdict
from diagnostics.preprocessing.levels import MAJORITY
from diagnostics.sensor.one_signal import find_one_signal

FINGER = SensorLayout(1, 4, 4, full_scale=1023.0, unit="count", rate=20.0)
PAIR = SensorLayout(2, 4, 4, full_scale=1023.0, unit="count", rate=20.0)


def presses(seed: int, n: int = 600) -> np.ndarray:
    """Return a signal of presses, one after the other, ``[n]``."""
    rng = np.random.default_rng(seed)
    signal = np.zeros(n)
    for begin in range(20, n - 30, 40):
        length = int(rng.integers(10, 25))
        shape = np.sin(np.pi * (np.arange(length) + MAJORITY) / length)
        signal[begin : begin + length] = rng.uniform(100, 500) * shape
    return signal


def counts(readings: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(readings), 0, 1023)


def shown(how: str, seed: int = 1) -> np.ndarray:
    """Return what 16 cells read that all show one input, ``[T, 16]``."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(0, 2, (600, 1 if how == "same" else 16))
    gains = np.linspace(1, 0.5, 16) if how == "scaled" else np.ones(16)
    return counts((40 + presses(seed))[:, None] * gains + noise)


def pressed_flat(seed: int, spread: float = 0.03) -> np.ndarray:
    """Return what 16 healthy cells read that are all loaded alike, ``[T, 16]``."""
    device = np.random.default_rng(seed)
    gains = np.exp(device.normal(0, spread, 16))
    rest = device.uniform(38, 42, 16)
    return counts(rest + presses(seed)[:, None] * gains + device.normal(0, 2, (600, 16)))


def names(inspection: af.Inspection) -> list[str]:
    return [finding.name for finding in inspection.findings]


@pytest.mark.parametrize("how", ["same", "noisy", "scaled"])
def test_an_array_that_shows_one_signal_is_told_and_no_cell_is_alive(how):
    log = shown(how)
    diagnosis = SelfDiagnosis(FINGER).diagnose(log)
    inspected = af.inspect(log, SelfDiagnosis(FINGER))
    assert diagnosis.faults[0].reason.startswith("all 16 cells show one signal")
    for found in (diagnosis, inspected.diagnosis):
        assert not (found.verdicts == Verdict.ALIVE).any()
        assert found.exit_code == 2
    assert (names(inspected), inspected.severity) == (["one_signal"], 2)


def test_one_pad_of_two_is_named_and_the_other_is_judged():
    rng = np.random.default_rng(3)
    other = counts(40 + rng.uniform(0, 1, 16) * presses(8)[:, None] + rng.normal(0, 2, (600, 16)))
    log = np.concatenate([other, shown("noisy")], axis=1)
    diagnosis = SelfDiagnosis(PAIR).diagnose(log)
    assert set(diagnosis.fault_set) == set(range(16, 32))
    assert diagnosis.faults[0].reason.startswith("all 16 cells of pad 1 show one signal")


def test_of_a_log_in_parts_the_array_as_a_whole_is_told_too():
    whole = inspect_parts(iter([[shown("noisy")], [shown("noisy", 2)]]), SelfDiagnosis(FINGER))
    assert (names(whole), whole.severity) == (["one_signal"], 2)
    rng = np.random.default_rng(3)
    other = counts(40 + rng.uniform(0, 1, 16) * presses(8)[:, None] + rng.normal(0, 2, (600, 16)))
    log = np.concatenate([other, shown("noisy")], axis=1)
    of_pad = inspect_parts(iter([[log], [log]]), SelfDiagnosis(PAIR))
    assert "one_signal" in names(of_pad)
    assert not (of_pad.diagnosis.verdicts[16:] == Verdict.ALIVE).any()


@pytest.mark.parametrize(("axis", "other"), [("row", "column"), ("column", "row")])
def test_lines_whose_cells_show_one_signal_each_are_told(axis, other):
    rng = np.random.default_rng(4)
    signals = np.stack([presses(seed) for seed in range(4)], axis=1)
    lines = np.repeat(signals, 4, axis=1) if axis == "row" else np.tile(signals, 4)
    (found,) = find_one_signal(counts(40 + lines + rng.normal(0, 2, lines.shape)), FINGER)
    assert found.cells == tuple(range(16))
    assert f"in each {axis} all cells show one signal: the {other} select lines" in found.reason


@pytest.mark.parametrize("seed", range(8))
def test_a_healthy_array_under_a_flat_press_or_on_a_vibrating_table_is_not_named(seed):
    assert find_one_signal(pressed_flat(seed), FINGER) == ()
    shaking = 300 * np.sin(np.arange(600) / 3)[:, None]
    gains = np.exp(np.random.default_rng(seed).normal(0, 0.03, 16))
    noise = np.random.default_rng(seed).normal(0, 2, (600, 16))
    assert find_one_signal(counts(500 + shaking * gains + noise), FINGER) == ()
