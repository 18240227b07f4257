"""Cells that read a share of what others of their row or column carry: told, and nobody is blamed
for it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import adaptfault as af
from adaptfault.inspection.long_log import inspect_parts
from diagnostics import SelfDiagnosis, SensorLayout, Verdict
from diagnostics.sensor.crosstalk import find_crosstalk, lowest_floors

LAYOUT = SensorLayout(2, 12, 8, full_scale=255.0)
REST = 20.0
ALONG = {"row": (3,), "column": (2,), "row and column": (3, 2)}


def presses(seed: int, layout: SensorLayout = LAYOUT, n: int = 20, wide: float = 1.0) -> np.ndarray:
    """Return recordings ``[n, 15, pads, rows, columns]`` of a press on each pad, above rest;
    ``wide``: of a contact, in cells along a row."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: layout.rows, : layout.cols]
    press = 200 * np.clip(np.sin(np.linspace(0, np.pi, 15)), 0, None)[:, None, None]
    loads = np.zeros((n, 15, *layout.shape))
    for recording in loads:
        for pad in range(layout.pads):
            row, column = rng.uniform((0, 0), (layout.rows - 1, layout.cols - 1))
            apart = (y - row) ** 2 / 2 + ((x - column) / wide) ** 2 / 2
            recording[:, pad] = rng.uniform(0.5, 1.0) * press * np.exp(-apart)
    return loads


def log(loads: np.ndarray, seed: int) -> list[np.ndarray]:
    noise = np.random.default_rng(seed).normal(0, 1, loads.shape)
    return [np.rint(frames).reshape(len(frames), -1) for frames in REST + loads + noise]


def crossed(loads: np.ndarray, share: float, lines: str, pad: int) -> np.ndarray:
    """Return what cells read on a pad, where they read a share of the highest of their lines."""
    read = loads.copy()
    for axis in ALONG[lines]:
        highest = loads.max(axis=axis + 1, keepdims=True)[:, :, pad]
        read[:, :, pad] = np.maximum(read[:, :, pad], share * highest)
    return read


USUAL = lowest_floors(log(presses(1), 1), np.full(LAYOUT.n_cells, REST), LAYOUT)


def found_in(recordings: list[np.ndarray]) -> np.ndarray:
    found = find_crosstalk(recordings, np.full(LAYOUT.n_cells, REST), USUAL, LAYOUT)
    return np.zeros((2, 2)) if found is None else found.shares


@settings(max_examples=12, deadline=None)
@given(st.floats(0.12, 0.5), st.integers(2, 1000), st.sampled_from(sorted(ALONG)))
def test_the_share_of_a_pad_is_found_along_its_lines_and_on_no_other(share, seed, lines):
    shares = found_in(log(crossed(presses(seed), share, lines, pad=1), seed))
    along = [name in lines for name in ("row", "column")]
    assert (shares > 0).tolist() == [[False, one] for one in along]
    assert shares[along, 1] == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize("wide", [1.0, 3.0, 6.0, 100.0])
def test_contacts_along_a_row_are_no_crosstalk(wide):
    assert not found_in(log(presses(3, wide=wide), 3)).any()


PAD = SensorLayout(1, 8, 8, full_scale=255.0)
SHORT = 9
OPEN = 50
NOTHING = 27  # a cell that carries nothing of its own, and reads what its lines give it


@pytest.fixture(scope="module")
def reference() -> list[np.ndarray]:
    return log(presses(1, PAD, 60), 1)


@pytest.fixture(scope="module")
def fitted(reference) -> SelfDiagnosis:
    return SelfDiagnosis(PAD).fit(reference)


@pytest.fixture(scope="module", params=[(0.35, "row and column"), (0.5, "row")])
def cross(request) -> list[np.ndarray]:
    loads = presses(2, PAD, 40)
    loads.reshape(*loads.shape[:2], -1)[:, :, NOTHING] = 0
    recordings = log(crossed(loads, *request.param, pad=0), 2)
    for frames in recordings:
        frames[:, SHORT] = 255
        frames[:, OPEN] = 0
    return recordings


def test_it_is_told_and_only_dead_cells_are_blamed_by_diagnosis_and_inspection(
    fitted, reference, cross
):
    diagnosis = fitted.diagnose(cross)
    assert set(diagnosis.fault_set) == {SHORT, OPEN}
    assert [fault.kind for fault in diagnosis.transport] == ["crosstalk"]
    inspected = af.inspect(cross, fitted, reference=reference)
    assert set(inspected.diagnosis.fault_set) == {SHORT, OPEN}
    assert {one.name for one in inspected.findings} == {"fault", "crosstalk"}
    assert (inspected.diagnosis.verdicts == diagnosis.verdicts).all()
    assert (diagnosis.verdicts == Verdict.ALIVE).sum() > 25


def test_a_cell_that_reads_only_what_its_lines_give_it_is_not_tested(fitted, cross):
    assert fitted.diagnose(cross).verdicts[NOTHING] == Verdict.UNTESTED


def test_a_log_in_parts_shows_it_as_a_whole(fitted, reference, cross):
    parts = iter([cross[:20], cross[20:]])
    found = inspect_parts(parts, fitted, reference=reference)
    assert set(found.diagnosis.fault_set) == {SHORT, OPEN}
    assert "crosstalk" in {one.name for one in found.findings}


def test_it_is_told_without_a_reference(cross):
    found = SelfDiagnosis(PAD).diagnose(cross[:20])
    assert [fault.kind for fault in found.transport] == ["crosstalk"]
    assert set(found.fault_set) == {SHORT, OPEN}
