"""Wiring that is exchanged in some of the recordings is named with them and put back."""

import numpy as np
import pytest
from conftest import worn

import adaptfault as af
from diagnostics import SelfDiagnosis, SensorLayout

LAYOUT = SensorLayout(2, 7, 4, full_scale=1023.0, unit="count", rate=30.0)
GRID = LAYOUT.grid(np.arange(LAYOUT.n_cells))
PADS = GRID[::-1].ravel()
ROWS = np.concatenate([GRID[:1, [0, 5, 2, 3, 4, 1, 6]], GRID[1:]]).ravel()


def walks(seed: int, n: int) -> list[np.ndarray]:
    """Return recordings of two soles: the load rolls from heel to toe, along the outer edge."""
    rng = np.random.default_rng(seed)
    places = np.argwhere(np.ones((7, 4)))
    found = []
    for _ in range(n):
        phase = rng.uniform(0, 2 * np.pi) + rng.uniform(0.15, 0.22) * np.arange(70)
        force = rng.uniform(400, 800)
        feet = []
        for foot, edge in enumerate((0.8, 2.2)):
            cycle = phase + foot * np.pi
            rolled = (cycle % np.pi) / np.pi
            centres = np.stack([6 - 6 * rolled, np.full_like(rolled, edge)], axis=1)
            apart = (places - centres[:, None]) / (1.8, 0.9)
            load = np.clip(np.sin(cycle), 0, None)[:, None] * np.exp(-(apart**2).sum(axis=2) / 2)
            feet.append(force * load)
        frames = np.concatenate(feet, axis=1)
        found.append(np.clip(np.rint(frames + rng.normal(0, 2, frames.shape)), 0, 1023))
    return found


@pytest.fixture(scope="module")
def reference() -> list[np.ndarray]:
    return walks(1, 40)


@pytest.fixture(scope="module")
def fitted(reference) -> SelfDiagnosis:
    return SelfDiagnosis(LAYOUT).fit(reference)


@pytest.fixture(scope="module")
def log() -> list[np.ndarray]:
    return walks(2, 16)


def wired(log: list[np.ndarray], order: np.ndarray, which: list[int]) -> list[np.ndarray]:
    return [frames[:, order] if i in which else frames for i, frames in enumerate(log)]


@pytest.mark.parametrize(
    ("order", "which", "said"),
    [
        (PADS, [0, 3, 6, 9, 12, 15], "pads 0 and 1 are exchanged in recordings 0, 3, 6, 9, 12"),
        (PADS, [7], "pads 0 and 1 are exchanged in recording 7"),
        (PADS, list(range(8, 16)), "pads 0 and 1 are exchanged from recording 8 on"),
        (ROWS, list(range(8, 16)), "rows 1 and 5 of pad 0 are exchanged from recording 8 on"),
    ],
)
def test_wires_exchanged_in_some_recordings_are_named_and_nobody_is_blamed(
    fitted, reference, log, order, which, said
):
    broken = wired(log, order, which)
    found = af.inspect(broken, fitted, reference=reference)
    assert [finding.name for finding in found.findings] == ["swapped_in_part"]
    assert said in found.findings[0].reason
    assert found.severity == 2
    assert not found.diagnosis.fault_set
    assert found.rewiring is None
    for frames, healthy in zip(found.readings.frames, log, strict=True):
        np.testing.assert_array_equal(frames, healthy)


def test_a_healthy_log_a_worn_pad_and_wires_exchanged_throughout_are_not_swapped_in_part(
    fitted, log
):
    assert fitted.swapped_in_part(log) is None
    assert fitted.swapped_in_part(wired(log, PADS, list(range(16)))) is None
    assert fitted.swapped_in_part(worn(log, LAYOUT, "strap", force=400.0)) is None
