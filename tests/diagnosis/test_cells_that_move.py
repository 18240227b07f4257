"""Cells that move by themselves are no healthy cells."""

from __future__ import annotations

import numpy as np
import pytest

from adaptfault.data.recordings import Recordings
from diagnostics import Fault, FaultKind, Line, Monitor, SelfDiagnosis, Verdict, inject
from diagnostics.simulation.circuit import Circuit, StuckCell


@pytest.fixture(scope="module")
def long_log(grasps: Recordings) -> list[np.ndarray]:
    """Forty grasps that the reference does not hold."""
    return [np.asarray(frames, dtype=np.float64) for frames in grasps.frames[1::2][:40]]


@pytest.fixture(scope="module")
def log(long_log: list[np.ndarray]) -> list[np.ndarray]:
    """Half of them, where they show it."""
    return long_log[:20]


@pytest.fixture(scope="module")
def used(long_log: list[np.ndarray]) -> np.ndarray:
    """The cells by their load, the one that carries most first."""
    return np.argsort(-np.mean([frames.max(axis=0) for frames in long_log], axis=0), kind="stable")


def broken(log: list[np.ndarray], fault: Fault, diagnoser: SelfDiagnosis) -> list[np.ndarray]:
    whole = inject(np.concatenate(log), [fault], diagnoser.layout, seed=1)
    return np.split(whole, np.cumsum([len(frames) for frames in log])[:-1])


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (FaultKind.FLOATING, 1.0),
        (FaultKind.FLOATING, 0.25),
        (FaultKind.LATE, 10),
        (FaultKind.CLAMPED, 0.5),
    ],
)
def test_a_dead_cell_that_moves_is_found_named_by_how_it_fails_and_no_other_cell_is(
    fitted, long_log, used, kind, value
):
    cell = int(used[0])
    found = fitted.diagnose(broken(long_log, Fault(kind, (cell,), value=value), fitted))
    assert [(fault.kind, fault.cells) for fault in found.faults] == [(kind, (cell,))]


def test_a_cell_that_keeps_its_peak_to_the_end_of_each_recording_is_found_and_no_other_is(
    fitted, log, used
):
    cell = int(used[0])
    seen = [frames.copy() for frames in log]
    for frames in seen:
        frames[:, cell] = np.maximum.accumulate(frames[:, cell])
    (fault,) = fitted.diagnose(seen).faults
    assert (fault.kind, fault.cells) == (FaultKind.DRIFT, (cell,))


def test_of_cells_that_end_at_a_limit_far_below_their_loads_none_is_called_alive(fitted, log, used):
    for cell in used[5:50:5].tolist():
        peak = max(frames[:, cell].max() for frames in log)
        limited = Fault(FaultKind.CLAMPED, (cell,), value=0.3 * peak)
        found = fitted.diagnose(broken(log, limited, fitted))
        assert found.verdicts[cell] != Verdict.ALIVE or found.probability[cell] >= 0.1
        assert found.fault_set <= {cell}


def test_of_two_cells_that_read_the_same_the_one_that_contradicts_the_others_is_the_copy(
    fitted, long_log, used
):
    cell = int(used[0])
    copied = broken(long_log, Fault(FaultKind.COPY, (cell,), value=cell + 1), fitted)
    (fault,) = fitted.diagnose(copied).faults
    assert (fault.kind, fault.cells, fault.value) == (FaultKind.COPY, (cell,), cell + 1)
    assert fitted.layout.place(cell + 1) in fault.reason


def test_a_cell_that_reads_the_mean_of_those_beside_it_is_told_as_such(fitted, long_log, used):
    cell = int(used[0])
    (fault,) = fitted.diagnose(broken(long_log, Fault(FaultKind.COPY, (cell,)), fitted)).faults
    assert (fault.kind, fault.cells, fault.value) == (FaultKind.COPY, (cell,), None)
    assert "the mean of the cells beside it" in fault.reason


def test_a_cell_that_is_dead_in_every_second_recording_is_not_called_alive(fitted, log, used):
    cell = int(used[0])
    dead = Fault(FaultKind.OPEN, (cell,))
    seen = [
        inject(frames, [dead], fitted.layout) if i % 2 else frames for i, frames in enumerate(log)
    ]
    found = fitted.diagnose(seen)
    assert found.verdicts[cell] != Verdict.ALIVE or found.probability[cell] >= 0.1


@pytest.mark.parametrize("line", [Line(0, "row", 6), Line(1, "column", 4)])
def test_a_wire_that_opens_under_load_or_flickers_is_named_and_none_of_its_cells_is_called_alive(
    fitted, log, line
):
    layout = fitted.layout
    cells = layout.cells_on(line)
    whole = np.concatenate(log)
    load = whole[:, layout.pad_of == line.pad].sum(axis=1)
    flickers = np.repeat(np.random.default_rng(0).random(len(load) // 30 + 1) < 0.4, 30)
    for fails in (load > np.quantile(load[load > 0], 0.4), flickers[: len(load)]):
        seen = whole.copy()
        seen[np.ix_(fails, cells)] = 0.0
        found = fitted.diagnose(np.split(seen, np.cumsum([len(frames) for frames in log])[:-1]))
        assert {fault.line for fault in found.faults if fault.line is not None} == {line}
        assert set(found.fault_set) <= set(cells.tolist())
        alive = (found.verdicts[cells] == Verdict.ALIVE) & (found.probability[cells] < 0.1)
        assert not alive.any()


def test_cells_that_read_a_part_of_their_load_through_a_shorted_crossing_are_not_called_alive(
    fitted, log, used
):
    layout = fitted.layout
    cell = int(used[0])
    circuit = Circuit(layout)
    shorted = circuit.with_faults(StuckCell(cell, 0.0))
    whole = np.concatenate(log)
    seen = np.clip(whole + shorted.read(whole) - circuit.read(whole), 0, layout.full_scale)
    wrong = (np.abs(seen - whole) > 0.05 * layout.full_scale).sum(axis=0) >= 10
    wrong[cell] = False
    assert wrong.sum() > 5
    found = fitted.diagnose([seen])
    fault = next(fault for fault in found.faults if cell in fault.cells)
    assert (fault.kind, fault.cells) == (FaultKind.SHORT, (cell,))
    assert len(found.fault_set - {cell} - set(np.flatnonzero(wrong).tolist())) <= 1
    assert "cells of its row and column read a part of their load through it" in fault.reason
    alone = fitted.diagnose(broken(log, Fault(FaultKind.SHORT, (cell,)), fitted))
    assert "through it" not in alone.faults[0].reason
    alive = [(d.verdicts == Verdict.ALIVE)[wrong].sum() for d in (found, alone)]
    assert alive[0] < alive[1] / 4


def test_healthy_cells_in_use_are_shown_to_be_alive_and_none_is_blamed(fitted, log, used):
    found = fitted.diagnose(log)
    assert not found.faults
    assert found.contradicting == 0
    assert (found.verdicts[used[:100]] == Verdict.ALIVE).mean() >= 0.95


def test_where_many_cells_contradict_at_once_the_sensor_is_disturbed_and_no_cell_is_floating(
    fitted, log
):
    some = np.random.default_rng(0).choice(fitted.layout.n_cells, 110, replace=False)
    seen = broken(log, Fault(FaultKind.FLOATING, tuple(some.tolist()), value=1.5), fitted)
    found = fitted.diagnose(seen)
    assert not [fault for fault in found.faults if fault.kind is FaultKind.FLOATING]
    assert found.contradicting > 1 / 3
    assert type(found).from_dict(found.to_dict()).contradicting == found.contradicting


@pytest.mark.usefixtures("seldom_evaluated")
def test_frame_by_frame_a_floating_cell_is_told_as_in_batch(fitted, log, used):
    cell = int(used[0])
    frames = np.concatenate(broken(log[:16], Fault(FaultKind.FLOATING, (cell,), value=1.0), fitted))
    monitor = Monitor(fitted, wait=True)
    told = set[FaultKind]()
    for frame in frames:
        told |= {
            fault.kind
            for fault in monitor.update(frame)
            if fault.cells == (cell,) and fault.probability
        }
    assert FaultKind.FLOATING in told
    assert monitor.diagnosis().to_dict() | {"n_recordings": 1} == fitted.diagnose(frames).to_dict()


def test_two_cells_side_by_side_that_move_by_themselves_are_found_and_none_of_those_between(
    fitted, log, used
):
    first = int(used[0])
    dead = (first, first + 1)
    seen = broken(log, Fault(FaultKind.FLOATING, (first,), value=1.0), fitted)
    seen = broken(seen, Fault(FaultKind.LATE, (first + 1,), value=10), fitted)
    found = fitted.diagnose(seen)
    assert tuple(sorted(found.fault_set)) == dead
