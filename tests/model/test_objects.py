"""Objects that lie still: told with their cells, which are neither faulty nor tested."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pressed_recordings import presses as presses_of_pressed

from diagnostics import FaultKind, SelfDiagnosis, SensorLayout, Verdict
from diagnostics.model.objects import HeldLoads
from diagnostics.model.record import record_of

LAYOUT = SensorLayout(1, 8, 8, full_scale=4095.0, rate=20.0, unit="count")
REST = 40.0
UNDER = (9, 10, 11, 17, 18, 19, 25, 26, 27)  # three rows of three cells
HEAVY = (300, 500, 300, 500, 900, 500, 300, 500, 300)

Log = list[np.ndarray]


def presses(seed: int, recordings: int) -> Log:
    """Presses that come and go anywhere, in whole counts with noise."""
    rng = np.random.default_rng(seed)
    rows, cols = np.divmod(np.arange(64), 8)
    course = np.sin(np.linspace(0, np.pi, 20))[:, None]
    found = []
    for _ in range(recordings):
        frames = REST + rng.normal(0, 2, (60, 64))
        for begin in rng.integers(0, 40, 3).tolist():
            row, col = rng.uniform(0, 7, 2)
            press = 3000 * np.exp(-((rows - row) ** 2 + (cols - col) ** 2) / 4)
            frames[begin : begin + 20] += course * press
        found.append(np.clip(frames, 0, 4095).round())
    return found


def with_loads(
    log: Log, cells: Sequence[int], loads: Sequence[float], since: int = 0, noise: float = 0.0
) -> Log:
    """Return a log with loads on some cells from recording ``since`` on."""
    rng = np.random.default_rng(0)
    found = [frames.copy() for frames in log]
    for frames in found[since:]:
        frames[:, cells] += loads + noise * rng.standard_normal((len(frames), len(cells)))
        np.clip(frames.round(), 0, 4095, out=frames)
    return found


def held(log: Log, cells: Sequence[int], values: Sequence[float] | float) -> Log:
    """Return a log in which some cells hold values."""
    found = [frames.copy() for frames in log]
    for frames in found:
        frames[:, cells] = values
    return found


@cache
def diagnosis_of_presses() -> SelfDiagnosis:
    return SelfDiagnosis(LAYOUT).fit(presses(0, 80))


@pytest.fixture
def fitted() -> SelfDiagnosis:
    return diagnosis_of_presses()


@pytest.fixture
def log() -> Log:
    return presses(1, 12)


@pytest.mark.parametrize(("since", "noise"), [(0, 0.0), (4, 0.0), (0, 12.0)])
def test_an_object_is_told_with_its_cells_and_nobody_is_blamed(fitted, log, since, noise):
    diagnosis = fitted.diagnose(with_loads(log, UNDER, HEAVY, since, noise))
    assert not diagnosis.fault_set
    (load,) = diagnosis.static_loads
    assert load.cells == UNDER
    assert (load.onset or 0) == pytest.approx(60 * since, abs=16)
    assert {diagnosis.verdicts[cell] for cell in UNDER} == {Verdict.UNTESTED}
    assert diagnosis.probability[list(UNDER)].max() < 0.1
    assert "something lies still" in str(diagnosis)


@pytest.mark.parametrize(
    ("seed", "since", "row", "column"), [(1, 0, 2, 2), (2, 0, 1, 2), (4, 15, 1, 1), (14, 15, 2, 2)]
)
def test_an_object_on_much_of_a_pad_is_told_though_lines_beside_it_looked_broken(
    pressed, seed, since, row, column
):
    rng = np.random.default_rng(seed)
    under = np.arange(64).reshape(8, 8)[row : row + 5, column : column + 5].ravel()
    loads = rng.uniform(200, 900, len(under)).round()
    log = with_loads(presses_of_pressed(seed, 40), under.tolist(), loads, since)
    diagnosis = pressed.diagnose(log)
    assert not diagnosis.faults
    assert {cell for load in diagnosis.static_loads for cell in load.cells} >= {*under.tolist()}


def test_cells_that_are_stuck_beside_an_object_are_found(fitted, log):
    dead = [20, 44, 60]  # the first of them touches it
    seen = held(with_loads(log, UNDER, HEAVY), dead, [700, 2500, REST])
    diagnosis = fitted.diagnose(seen)
    assert set(diagnosis.fault_set) == set(dead)
    (load,) = diagnosis.static_loads
    assert load.cells == UNDER


def test_cells_that_hold_loads_without_their_noise_are_stuck(fitted, log):
    diagnosis = fitted.diagnose(held(log, UNDER, REST + np.array(HEAVY)))
    assert set(diagnosis.fault_set) == set(UNDER)
    assert not diagnosis.static_loads


@pytest.mark.parametrize("value", [0.0, 4095.0])
def test_no_object_holds_cells_below_rest_or_at_full_scale(fitted, log, value):
    diagnosis = fitted.diagnose(held(log, UNDER, value))
    assert set(diagnosis.fault_set) == set(UNDER)
    assert not diagnosis.static_loads


def test_two_cells_are_no_object(fitted, log):
    assert not fitted.diagnose(with_loads(log, (27, 28), (500, 700))).static_loads


def test_a_pad_that_rests_elsewhere_is_no_object(fitted, log):
    everywhere = range(64)
    assert not fitted.diagnose(with_loads(log, everywhere, [200] * 64, since=4)).static_loads


def test_a_wire_that_holds_a_value_is_no_object(fitted, log):
    diagnosis = fitted.diagnose(held(log, range(16, 24), 900.0))
    (fault,) = diagnosis.faults
    assert (fault.kind, fault.cells) == (FaultKind.STUCK, tuple(range(16, 24)))
    assert not diagnosis.static_loads


@pytest.mark.parametrize("share", [0.0, 0.16, 0.4])
@pytest.mark.parametrize("seed", [2, 3])
def test_no_object_is_invented_among_dead_cells(fitted, share, seed):
    rng = np.random.default_rng(seed)
    dead = rng.choice(64, int(share * 64), replace=False)
    values = rng.choice([0.0, REST, 600.0, 1500.0, 2500.0, 4095.0], len(dead)).tolist()
    assert not fitted.diagnose(held(presses(seed, 12), dead, values)).static_loads


@settings(max_examples=20)
@given(load=st.integers(300, 3500), since=st.integers(0, 9), seed=st.integers(0, 20))
def test_what_a_cell_holds_is_what_was_laid_on_it_whatever_presses_it_besides(load, since, seed):
    model = diagnosis_of_presses()._model
    assert model is not None
    record = record_of(with_loads(presses(seed, 12), (27,), (load,), since), model.length)
    found = HeldLoads.of(model.log_of_record(record), model)
    assert float(found.load[27]) == pytest.approx(load, rel=0.2)
    assert record.begins[found.since[27]] <= 60 * since
