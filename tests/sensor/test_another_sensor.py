"""Recordings of two sensors in one log are told apart, and no healthy cell is blamed."""

import numpy as np
import pytest

import adaptfault as af
from diagnostics import Fault, SelfDiagnosis, SensorLayout, inject

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
