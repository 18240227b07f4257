"""Lines that fail now and then: named as one cause, and none in healthy logs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pressed_recordings import FRAMES, LAYOUT, REST, presses

from diagnostics import FaultKind, Line, SelfDiagnosis, SensorLayout, Verdict
from diagnostics.model.conditional_mean import ConditionalMean, Tile
from diagnostics.model.lines import carried_by_several, cells_on
from diagnostics.simulation.circuit import Circuit, StuckCell

LENGTH = 30  # frames of a press


@pytest.fixture(scope="module")
def fitted() -> SelfDiagnosis:
    return SelfDiagnosis(LAYOUT).fit(presses(0, 80, LENGTH))


@pytest.fixture
def log() -> list[np.ndarray]:
    return presses(1, 30, LENGTH)


@pytest.fixture(scope="module")
def load() -> np.ndarray:
    rng = np.random.default_rng(0)
    shared = rng.random((300, 1))
    return np.clip(shared + 0.3 * rng.random((300, 12)) - 0.6, 0, 1).astype(np.float32)


@settings(max_examples=20, deadline=None)
@given(
    known=st.lists(st.booleans(), min_size=12, max_size=12),
    on=st.lists(st.booleans(), min_size=12, max_size=12),
)
def test_the_load_of_a_line_is_what_the_cells_off_it_predict_one_by_one(load, known, on):
    cells = np.arange(12)
    tile = Tile.fit(load, cells, cells)
    line = np.array(on)
    mean, _ = tile.predict(load, np.array(known) & ~line)
    total = tile.sums(load, np.array(known), line[None], line[None])
    np.testing.assert_allclose(total[:, 0], mean[:, line].sum(axis=1), atol=1e-7)


def test_what_the_cells_of_a_line_read_does_not_change_what_is_expected_of_it(load):
    layout = SensorLayout(1, 3, 4, full_scale=1.0)
    whole = ConditionalMean.fit(load, layout, np.ones(12, bool))
    on = cells_on(layout, np.ones(12, bool))
    other = load.copy()
    other[:, on[0]] = 0.9
    known = np.ones(12, bool)
    told = [whole.sums(some, known, on, on)[:, 0] for some in (load, other)]
    np.testing.assert_allclose(*told, atol=1e-7)


def test_lines_of_fewer_than_three_living_cells_tell_nothing():
    living = np.ones(64, bool)
    living[2:8] = False
    on = cells_on(LAYOUT, living)
    assert len(on) == 15
    assert on.sum(axis=1).min() >= 3
    assert not on[:, ~living].any()


@given(
    loads=st.lists(st.floats(0.6, 1), min_size=3, max_size=12),
    scale=st.floats(0.01, 10),
    others=st.integers(0, 5),
)
def test_cells_that_are_hardly_loaded_make_no_line_of_one_that_is(loads, scale, others):
    alike = np.array([*loads, *[0.0] * others], np.float32) * scale
    alone = np.array([loads[0], *[0.01] * (len(loads) + others - 1)], np.float32) * scale
    np.testing.assert_array_equal(carried_by_several(np.array([alike, alone])), [True, False])
    assert not carried_by_several(np.zeros((1, 4), np.float32)).any()


@pytest.mark.parametrize("line", [Line(0, "row", 3), Line(0, "column", 5)])
@pytest.mark.parametrize("how", ["under load", "flickers"])
def test_a_line_that_fails_now_and_then_is_one_cause_and_none_of_its_cells_is_alive(
    fitted, log, line, how
):
    cells = LAYOUT.cells_on(line)
    whole = np.concatenate(log)
    load = (whole - REST).sum(axis=1)
    ways = {
        "under load": load > np.quantile(load, 0.6),
        "flickers": np.repeat(np.random.default_rng(0).random(100) < 0.4, 18),
    }
    whole[np.ix_(ways[how], cells)] = REST
    found = fitted.diagnose(np.split(whole, len(log)))
    (fault,) = found.faults
    assert (fault.kind, fault.line) == (FaultKind.INTERMITTENT, line)
    assert fault.cells == tuple(cells.tolist())
    assert fault.value == pytest.approx(REST, abs=10)
    assert Verdict.ALIVE not in set(found.verdicts[cells])


def test_a_line_that_is_away_in_some_recordings_is_told_with_these(fitted, log):
    for frames in log[1::3]:
        frames[:, LAYOUT.cells_on(Line(0, "row", 3))] = REST
    (fault,) = fitted.diagnose(log).faults
    assert fault.line == Line(0, "row", 3)
    assert fault.recordings == tuple(range(1, 30, 3))


def test_a_line_that_fails_in_the_last_recordings_is_told_with_the_first_of_them(fitted, log):
    cells = LAYOUT.cells_on(Line(0, "row", 3))
    for frames in log[18:]:
        frames[20:50, cells] = REST
    (fault,) = fitted.diagnose(log).faults
    assert fault.line == Line(0, "row", 3)
    assert fault.onset is not None
    assert 18 * FRAMES <= fault.onset <= 21 * FRAMES


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_no_line_fails_in_a_healthy_log_nor_beside_dead_cells(fitted, seed):
    log = presses(seed, 20, LENGTH)
    assert not fitted.diagnose(log).faults
    dead = np.random.default_rng(seed).choice(64, 10, replace=False)
    for frames in log:
        frames[:, dead] = 900.0
    found = fitted.diagnose(log)
    assert set(found.fault_set) == set(dead.tolist())
    assert all(fault.line is None for fault in found.faults)


def test_a_broken_row_beside_untested_cells_is_a_row(fitted, log):
    cells = LAYOUT.cells_on(Line(0, "row", 3))
    for frames in log[:8]:
        frames[:, cells] = REST
    (fault,) = fitted.diagnose(log[:8]).faults
    assert (fault.kind, fault.line) == (FaultKind.OPEN, Line(0, "row", 3))


def test_cells_that_read_a_part_of_their_load_through_a_shorted_crossing_are_not_called_alive(
    fitted, log
):
    cell = 27
    circuit = Circuit(LAYOUT)
    load = np.concatenate(log) - REST
    pulls = circuit.with_faults(StuckCell(cell, 0.0)).read(load) - circuit.read(load)
    pulled = np.clip(np.concatenate(log) + pulls, 0, 4095)
    alone = np.concatenate(log)
    alone[:, cell] = 4095.0
    wrong = (np.abs(pulls) > 200).sum(axis=0) >= 10
    wrong[cell] = False
    assert wrong.sum() > 5
    found = [fitted.diagnose(np.split(frames, len(log))) for frames in (pulled, alone)]
    fault = next(fault for fault in found[0].faults if cell in fault.cells)
    assert fault.cells == (cell,)
    assert "cells of its row and column read a part of their load through it" in fault.reason
    assert "through it" not in found[1].faults[0].reason
    alive = [(one.verdicts == Verdict.ALIVE)[wrong].sum() for one in found]
    assert alive[0] < alive[1] / 2
