"""Recordings of two sensors in one log are told apart, and no healthy cell is blamed."""

from dataclasses import replace

import numpy as np
import pytest

import adaptfault as af
from adaptfault.inspection import find_changes
from diagnostics import Diagnosis, Fault, SelfDiagnosis, SensorLayout, inject
from diagnostics.sensor.other_gains import outliers_of_others

LAYOUT = SensorLayout(1, 6, 6, full_scale=1023.0, unit="count", rate=20.0)


def presses(seed: int, n: int, sensor: int, noise: float = 1.0) -> list[np.ndarray]:
    """Return recordings of a sensor: its cells have rests and gains of their own."""
    own = np.random.default_rng(sensor)
    rest = own.uniform(10, 30, 36)
    gain = np.exp(own.uniform(-0.6, 0.6, 36))
    rng = np.random.default_rng(seed)
    places = np.argwhere(np.ones((6, 6)))
    found = []
    for _ in range(n):
        load = np.zeros((48, 36))
        for _ in range(2):
            at = rng.uniform(0, 5, 2) + rng.normal(0, 0.05, 2) * np.arange(48)[:, None]
            begin, end = np.sort(rng.choice(np.arange(3, 45), 2, replace=False))
            time = np.arange(48)
            force = rng.uniform(100, 500) * np.clip((time - begin) / 3, 0, 1)
            force = force * np.clip((end - time) / 3, 0, 1)
            apart = ((places - at[:, None]) ** 2).sum(axis=2)
            load += force[:, None] * np.exp(-apart / 2 / rng.uniform(1, 1.6) ** 2)
        frames = rest + gain * load + rng.normal(0, noise, load.shape)
        found.append(np.clip(np.rint(frames), 0, 1023))
    return found


@pytest.fixture(scope="module")
def reference() -> list[np.ndarray]:
    return presses(1, 50, sensor=1)


@pytest.fixture(scope="module")
def fitted(reference) -> SelfDiagnosis:
    return SelfDiagnosis(LAYOUT).fit(reference)


def mixed(others: list[int], n: int = 24, sensor: int = 2) -> list[np.ndarray]:
    """Return a log of which some recordings come from another sensor."""
    ours = presses(2, n, sensor=1)
    theirs = presses(3, n, sensor=sensor)
    return [theirs[i] if i in others else ours[i] for i in range(n)]


@pytest.mark.parametrize(
    ("others", "said"),
    [
        (list(range(12, 24)), "recordings 12 to 23 (12 of 24)"),
        (list(range(0, 24, 2)), "recordings 0, 2, 4, 6, 8, 10"),
        (list(range(4)), "recordings 0 to 3 (4 of 24)"),
        (list(range(8, 16)), "recordings 8 to 15 (8 of 24)"),
    ],
)
def test_recordings_of_another_sensor_are_named_and_nobody_is_blamed(
    fitted, reference, others, said
):
    found = af.inspect(mixed(others), fitted, reference=reference)
    assert [finding.name for finding in found.findings] == ["another_sensor"]
    assert said in found.findings[0].reason
    assert "come from another sensor" in found.findings[0].reason
    assert found.severity == 2
    assert not found.diagnosis.fault_set
    assert found.diagnosis.coverage.test_coverage > 0.8


def test_a_dead_cell_is_found_beside_recordings_of_another_sensor(fitted, reference):
    log = mixed(list(range(8, 16)))
    frames = inject(np.concatenate(log), [Fault("open", [14])], LAYOUT)
    log = np.split(frames, np.cumsum([len(one) for one in log])[:-1])
    found = af.inspect(log, fitted, reference=reference)
    assert "another_sensor" in {finding.name for finding in found.findings}
    assert set(found.diagnosis.fault_set) == {14}


@pytest.mark.parametrize("noise", [1.0, 6.0])
def test_a_log_of_another_sensor_blames_no_healthy_cell(fitted, reference, noise):
    found = af.inspect(presses(3, 24, sensor=2, noise=noise), fitted, reference=reference)
    assert {"replaced_pad", "another_sensor"} & {finding.name for finding in found.findings}
    assert not found.diagnosis.fault_set


def test_dead_and_weak_cells_an_object_and_a_gain_are_no_other_sensor(fitted, reference):
    ours = presses(2, 24, sensor=1)
    rest = np.random.default_rng(1).uniform(10, 30, 36)
    grid = np.argwhere(np.ones((6, 6)))
    bump = 150 * np.exp(-((grid - (1, 1)) ** 2).sum(axis=1) / 3)
    dead = np.arange(36) % 6 == 2

    def changed(change) -> list[np.ndarray]:
        return [np.rint(change(one)) if i >= 12 else one for i, one in enumerate(ours)]

    logs = [
        ours,
        changed(lambda one: np.where(dead, 0, one)),
        changed(lambda one: np.where(np.arange(36) % 7 == 3, rest + 0.4 * (one - rest), one)),
        changed(lambda one: one + bump),
        changed(lambda one: rest + 1.5 * (one - rest)),
        changed(lambda one: one + 12),
    ]
    for log in logs:
        found = af.inspect(log, fitted, reference=reference)
        assert "another_sensor" not in {finding.name for finding in found.findings}


PAD = SensorLayout(1, 9, 7, full_scale=4095.0, unit="count", rate=20.0)
OWN = 12345  # the sensor of the reference


def slides(seed: int, n: int, sensor: int) -> list[np.ndarray]:
    """Return recordings in which one to three contacts slide over the pad of a sensor."""
    own = np.random.default_rng(sensor)
    rest = own.uniform(20, 60, 63)
    gain = own.uniform(0.6, 1.4, 63)
    rng = np.random.default_rng(seed)
    row, column = np.divmod(np.arange(63), 7)
    time = np.arange(60)[:, None]
    found = []
    for _ in range(n):
        load = np.zeros((60, 63))
        for _ in range(rng.integers(1, 4)):
            begin = int(rng.integers(2, 30))
            end = int(rng.integers(begin + 8, 58))
            swell = np.clip((time - begin) / 4, 0, 1) * np.clip((end - time) / 4, 0, 1)
            y = rng.uniform(0, 8) + rng.normal(0, 0.05) * (time - begin)
            x = rng.uniform(0, 6) + rng.normal(0, 0.05) * (time - begin)
            apart = (row - y) ** 2 + (column - x) ** 2
            peak = rng.uniform(600, 2900) * np.exp(-apart / 2 / rng.uniform(0.8, 1.8) ** 2)
            load += swell * peak
        frames = rest + gain * load + rng.normal(0, 2, load.shape)
        found.append(np.clip(np.rint(frames), 0, 4095))
    return found


@pytest.fixture(scope="module")
def slid() -> list[np.ndarray]:
    return slides(1, 50, sensor=OWN)


@pytest.fixture(scope="module")
def fitted_to_slides(slid) -> SelfDiagnosis:
    return SelfDiagnosis(PAD).fit(slid)


@pytest.mark.parametrize("sensor", [3, 6, 7])
def test_a_pad_of_the_same_kind_is_neither_faulty_nor_wired_otherwise(
    fitted_to_slides, slid, sensor
):
    found = af.inspect(slides(3, 24, sensor), fitted_to_slides, reference=slid)
    assert {"replaced_pad", "another_sensor"} & {finding.name for finding in found.findings}
    assert not {"rewired", "transposed", "fault", "wire"} & {f.name for f in found.findings}
    assert not found.diagnosis.fault_set


def test_exchanged_wires_and_dead_cells_of_the_own_pad_are_no_other_pad(fitted_to_slides, slid):
    own = slides(3, 24, sensor=OWN)
    rows = np.arange(63).reshape(9, 7)[[0, 5, 2, 3, 4, 1, 6, 7, 8]].ravel()
    found = af.inspect([one[:, rows] for one in own], fitted_to_slides, reference=slid)
    assert "rewired" in {finding.name for finding in found.findings}
    dead = np.random.default_rng(0).permutation(63)[:24]
    held = [np.where(np.isin(np.arange(63), dead), 40, one) for one in own]
    found = af.inspect(held, fitted_to_slides, reference=slid)
    assert "another_sensor" not in {finding.name for finding in found.findings}
    assert len(set(found.diagnosis.fault_set) & set(dead.tolist())) >= 20
    rest = np.random.default_rng(OWN).uniform(20, 60, 63)
    worn = {16, 17, 24, 46}
    gain = np.where(np.isin(np.arange(63), [*worn]), 0.1, 1.0)
    weak = [np.rint(rest + gain * (one - rest)) for one in own]
    found = af.inspect(weak, fitted_to_slides, reference=slid)
    assert "another_sensor" not in {finding.name for finding in found.findings}
    assert set(found.diagnosis.fault_set) == worn


@pytest.mark.parametrize(("spread", "seed"), [(0.15, 1), (0.15, 2), (0.2, 0), (0.2, 1), (0.2, 2)])
def test_a_pad_whose_cells_differ_little_in_gain_blames_no_healthy_cell(
    fitted_to_slides, slid, spread, seed
):
    gains = np.exp(spread * np.random.default_rng(seed).normal(size=63))
    log = [with_gains(one, gains) for one in slides(3, 24, sensor=OWN)]
    found = af.inspect(log, fitted_to_slides, reference=slid)
    told = {finding.name for finding in found.findings}
    assert {"replaced_pad", "another_sensor"} & told
    assert not {"rewired", "transposed", "swapped_in_part", "fault", "wire"} & told
    assert not found.diagnosis.fault_set


def with_gains(frames: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Return frames of the own pad as one with other gains reads them."""
    rest = np.random.default_rng(OWN).uniform(20, 60, 63)
    return np.clip(np.rint(rest + gains * (frames - rest)), 0, 4095)


@pytest.mark.parametrize("seed", [1, 2])
def test_what_stands_out_among_the_cells_of_another_pad_is_found_and_a_held_cell_too(
    fitted_to_slides, slid, seed
):
    gains = np.exp(0.15 * np.random.default_rng(seed).normal(size=63))
    gains[30] = 0.1
    log = [with_gains(one, gains) for one in slides(3, 24, sensor=OWN)]
    for one in log:
        one[:, 12] = 40
    found = af.inspect(log, fitted_to_slides, reference=slid)
    assert set(found.diagnosis.fault_set) == {12, 30}


def log_ratios(seed: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Return log ratios of 30 recordings of a reference and 24 of a log, and their precisions."""
    rng = np.random.default_rng(seed)
    ratio = rng.normal(0, 0.2, (54, 40))
    ratio[30:] += spread * rng.normal(size=40)
    return ratio, np.where(rng.random((54, 40)) < 0.6, 25.0, 0.0)


def others(ratio: np.ndarray, precision: np.ndarray) -> np.ndarray | None:
    pads = [np.arange(40) < 20, np.arange(40) >= 20]
    return outliers_of_others(ratio, precision, pads, np.ones(40, bool), 30)


def test_of_one_sensor_hardly_a_log_looks_as_of_another_and_of_others_most_do():
    assert sum(others(*log_ratios(seed, 0.0)) is not None for seed in range(40)) <= 2
    found = [others(*log_ratios(seed, 0.15)) for seed in range(10)]
    assert all(one is not None for one in found)
    assert sum(int(one.sum()) for one in found) <= 2


def test_a_cell_stands_out_by_what_cells_of_the_log_differ():
    ratio, precision = log_ratios(3, 0.15)
    ratio[30:, 7] -= 2.0
    found = others(ratio, precision)
    assert found is not None
    assert found[7]
    ratio, precision = log_ratios(3, 0.0)
    assert others(ratio[:34], precision[:34]) is None  # too few recordings
    assert others(ratio, precision * 0) is None


@pytest.mark.parametrize(
    ("kinds", "asks"),
    [(["late", "late"], False), (["floating"], False), (["floating"] * 2, True), (["weak"], True)],
)
def test_a_cell_that_moves_by_itself_or_late_asks_for_no_other_sensor(kinds, asks):
    layout = SensorLayout(1, 4, 4)
    faults = tuple(Fault(kind, (cell,), probability=1.0) for cell, kind in enumerate(kinds))
    diagnosis = replace(Diagnosis.untold(layout, [60]), faults=faults)
    assert find_changes._of_this_sensor(diagnosis) is asks
