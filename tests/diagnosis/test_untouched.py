"""Broken cells that nothing touches, by their noise and by where those beside them rest."""

import numpy as np
import pytest
from contact_recordings import events

from diagnostics import Fault, FaultKind, Monitor, SelfDiagnosis, SensorLayout, inject

LAYOUT = SensorLayout(1, 8, 8, full_scale=1.0)
CELLS = LAYOUT.n_cells
PADS = SensorLayout(2, 4, 5, full_scale=1.0)
PAD = 20  # cells
STEP = 1 / 1023
NOISE = 2 * STEP


def noisy_presses(
    seed: int, recordings: int = 24, noise: float = NOISE, rest: float = 0.0
) -> list[np.ndarray]:
    """Presses on an array with noise, and a converter whose readings end at 0."""
    rng = np.random.default_rng(seed)
    rests = rest + np.random.default_rng(99).uniform(0, STEP, CELLS)
    read = [r + rests + noise * rng.standard_normal(r.shape) for r in events(seed, recordings)]
    return [np.clip(np.round(r / STEP), 0, 1023) * STEP for r in read]


def test_cells_that_have_all_sunk_some_of_them_to_the_rail_are_not_suspected():
    rng = np.random.default_rng(4)
    rests = np.linspace(0.004, 0.04, CELLS)

    def read(seed: int, recordings: int, sunk: float = 0.0) -> list[np.ndarray]:
        idle = [
            np.maximum(r + rests - sunk + NOISE * rng.standard_normal(r.shape), 0)
            for r in events(seed, recordings)
        ]
        return [np.round(r / STEP) * STEP for r in idle]

    fitted = SelfDiagnosis(LAYOUT).fit(read(0, 24))
    assert not fitted.diagnose(read(1, 6, sunk=0.015)).fault_set


def test_dead_cells_without_contact_are_found_by_their_lack_of_noise_in_the_monitor_too():
    fitted = SelfDiagnosis(LAYOUT).fit(noisy_presses(0))
    log = noisy_presses(1, 4)
    assert not fitted.diagnose(log).fault_set
    dead = {LAYOUT.cell(0, 7, 4): None, LAYOUT.cell(0, 7, 7): 0.4}
    faults = [
        Fault(FaultKind.STUCK if v else FaultKind.OPEN, (cell,), value=v)
        for cell, v in dead.items()
    ]
    broken = [inject(r, faults, LAYOUT) for r in log]
    assert fitted.diagnose(broken).fault_set == dead.keys()
    diagnosis = fitted.diagnose(np.concatenate(broken))
    monitor = Monitor(fitted, wait=True)
    for frame in np.concatenate(broken):
        monitor.update(frame)
    np.testing.assert_array_equal(monitor.diagnosis().probability, diagnosis.probability)


def recording(rng: np.random.Generator, rest: tuple[float, float]) -> np.ndarray:
    """Presses that come and go on half of the cells of pads that rest at ``rest`` for a whole
    recording."""
    time = np.arange(128)[:, None]
    force = np.maximum(0, np.sin(time / rng.uniform(6, 12)))
    pressed = rng.random(2 * PAD) < 0.5
    load = force * pressed * rng.uniform(0, 0.4, 2 * PAD) + rng.normal(0, 0.002, (128, 2 * PAD))
    return np.clip(load + np.repeat(rest, PAD), 0, 1)


def rests(rng: np.random.Generator) -> tuple[float, float]:
    """Return where the pads of a sensor with a wandering supply rest."""
    return float(rng.uniform(0.2, 0.3)), float(rng.uniform(0.03, 0.1))


@pytest.fixture(scope="module")
def of_pads() -> SelfDiagnosis:
    rng = np.random.default_rng(0)
    healthy = [recording(rng, (0.25, 0.0)), *(recording(rng, rests(rng)) for _ in range(59))]
    return SelfDiagnosis(PADS).fit(healthy)


def opened(rest: tuple[float, float], cells: list[int]) -> np.ndarray:
    """Return a log without contact in which some cells read 0."""
    rng = np.random.default_rng(1)
    log = np.clip(np.repeat(rest, PAD) + rng.normal(0, 0.002, (480, 2 * PAD)), 0, 1)
    log[48:, cells] = 0.0
    return log


def test_an_open_cell_is_found_untouched_also_where_its_pad_has_rested_at_0(of_pads):
    assert of_pads.diagnose(opened((0.25, 0.06), [3, 27])).fault_set == {3, 27}


def test_where_a_pad_rests_at_0_now_no_cell_of_it_reads_too_little(of_pads):
    found = of_pads.diagnose(opened((0.25, 0.0), [3, 27]))
    assert not found.fault_set & set(range(PAD, 2 * PAD))


def test_healthy_cells_of_other_recordings_read_enough(of_pads):
    rng = np.random.default_rng(2)
    for _ in range(10):
        assert not of_pads.diagnose([recording(rng, rests(rng)) for _ in range(3)]).fault_set
