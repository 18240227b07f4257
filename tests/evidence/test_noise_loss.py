import numpy as np
import pytest
from contact_recordings import events

from diagnostics import Fault, FaultKind, Monitor, SelfDiagnosis, SensorLayout, inject
from diagnostics.events.constant_runs import ConstantRuns
from diagnostics.evidence.noise_loss import NoiseLoss
from diagnostics.evidence.term import ConstantCells

LAYOUT = SensorLayout(1, 8, 8, full_scale=1.0)
CELLS = LAYOUT.n_cells
PRESENT = np.ones(LAYOUT.n_cells, bool)
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


def runs_of(frames: np.ndarray) -> ConstantRuns:
    return ConstantRuns.begin(CELLS).extend(frames, np.arange(len(frames)), 0.005)


def cells_of(runs: ConstantRuns, rests: np.ndarray = PRESENT) -> ConstantCells:
    return ConstantCells(LAYOUT, 1.0, 0.005, runs, rests)


def test_the_longest_time_that_a_cell_read_the_same_is_found():
    recordings = noisy_presses(0)
    noise_loss = NoiseLoss.fit(recordings, PRESENT)
    frames = np.concatenate(recordings)
    cell = 60
    changed = np.flatnonzero(np.diff(frames[:, cell]))
    assert noise_loss.longest[cell] == np.diff([-1, *changed, len(frames) - 1]).max()
    assert noise_loss.recording == 64


@pytest.mark.parametrize("noise", [0.0, 0.1 * STEP])
def test_arrays_without_noise_or_with_less_than_a_converter_step_give_no_evidence(noise):
    assert np.isinf(NoiseLoss.fit(noisy_presses(0, noise=noise, rest=0.05), PRESENT).longest).all()


def test_few_recordings_give_no_evidence():
    assert np.isinf(NoiseLoss.fit(noisy_presses(0, recordings=7), PRESENT).longest).all()


def test_cells_that_held_a_reading_for_a_third_of_a_recording_may_do_so_again():
    recordings = noisy_presses(0)
    recordings[3][10:32] = recordings[3][10]
    assert np.isinf(NoiseLoss.fit(recordings, PRESENT).longest).all()


def test_a_cell_that_loses_its_noise_is_broken_unless_half_of_the_cells_do():
    noise_loss = NoiseLoss.fit(noisy_presses(0), PRESENT)
    idle = np.concatenate(noisy_presses(5, 4))[:200]

    def evidence_of(dead: int) -> np.ndarray:
        frames = idle.copy()
        frames[:, CELLS - dead :] = 0.0
        return noise_loss.evidence(cells_of(runs_of(frames)))

    assert np.flatnonzero(evidence_of(10) > 0).tolist() == list(range(CELLS - 10, CELLS))
    assert not (evidence_of(40) > 0).any()


def test_missing_readings_are_not_identical_readings():
    noise_loss = NoiseLoss.fit(noisy_presses(0), PRESENT)
    frames = np.concatenate(noisy_presses(5, 5))
    frames[50:, 60] = np.nan
    assert not (noise_loss.evidence(cells_of(runs_of(frames))) > 0).any()


@pytest.mark.usefixtures("uncalibrated")
def test_cells_that_have_all_sunk_some_of_them_to_the_rail_are_not_suspected_for_noise_loss():
    rng = np.random.default_rng(4)
    rests = np.linspace(0.004, 0.04, CELLS)

    def read(seed: int, recordings: int, sunk: float = 0.0) -> list[np.ndarray]:
        idle = [
            np.maximum(r + rests - sunk + NOISE * rng.standard_normal(r.shape), 0)
            for r in events(seed, recordings)
        ]
        return [np.round(r / STEP) * STEP for r in idle]

    fitted = SelfDiagnosis(LAYOUT).fit(read(0, 24))
    stream = fitted.stream()
    for frames in read(1, 6, sunk=0.015):
        stream.extend(frames)
    stream = stream.complete()
    same = fitted.reference_.noise_loss.evidence(cells_of(stream.runs, stream.rests()))
    assert (same > 0).any()  # they read 0, and nothing else
    assert not (stream.temporal() > 10).any()


@pytest.mark.usefixtures("uncalibrated")
def test_dead_cells_without_contact_are_found_by_noise_loss_in_the_monitor_too():
    fitted = SelfDiagnosis(LAYOUT).fit(noisy_presses(0))
    log = noisy_presses(1, 4)
    assert not fitted.diagnose(log).fault_set
    dead = {LAYOUT.cell(0, 7, 4): None, LAYOUT.cell(0, 7, 7): 0.4}
    faults = [
        Fault(FaultKind.STUCK if v else FaultKind.OPEN, (cell,), value=v)
        for cell, v in dead.items()
    ]
    broken = [inject(r, faults, LAYOUT) for r in log]
    diagnosis = fitted.diagnose(broken)
    assert diagnosis.fault_set == dead.keys()
    monitor = Monitor(fitted)
    for frame in np.concatenate(broken):
        monitor.update(frame)
    np.testing.assert_array_equal(monitor.diagnosis().probability, diagnosis.probability)
