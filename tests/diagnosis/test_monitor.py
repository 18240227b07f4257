import copy
import gc
import os
import pickle
import subprocess
import sys
import threading
from time import sleep

import numpy as np
import pytest
from conftest import SIMULATED

from adaptfault.data.recordings import Recordings
from diagnostics import (
    Fault,
    FaultKind,
    FaultSet,
    Line,
    Monitor,
    Scan,
    SelfDiagnosis,
    SensorLayout,
    bridge,
    freeze_stream,
    inject,
    line_fault,
    lose_frames,
)
from diagnostics.simulation.circuit import Circuit, CutLine, StuckCell
from diagnostics.simulation.scan import scan_circuit

LAYOUT = SIMULATED
COLD = SelfDiagnosis(LAYOUT)


@pytest.fixture(scope="module")
def fitted(fitted_few: SelfDiagnosis) -> SelfDiagnosis:
    return fitted_few


@pytest.fixture(scope="module")
def log(few_cells: Recordings) -> np.ndarray:
    """Ten grasps that the reference does not hold, one after another."""
    return np.concatenate([few_cells.frames[i] for i in range(21, 140, 12)]).astype(float)


@pytest.fixture(scope="module")
def middle(log: np.ndarray) -> list[int]:
    """The 20 cells that carry the most load."""
    most = np.minimum(log.reshape(10, 100, -1).max(axis=1), 1).mean(axis=0)
    return np.sort(np.argsort(-most, kind="stable")[:20]).tolist()


def mixes(middle: list[int]) -> dict[str, list[Fault]]:
    a = middle[3]
    b = middle[-4]
    c = middle[len(middle) // 2]
    return {
        "none": [],
        "cells": [
            Fault("short", (a,), onset=300),
            Fault("open", (b,)),
            Fault("stuck", (c,), value=1.7, onset=500),
        ],
        "a row and a noisy cell": [
            line_fault(LAYOUT, Line(0, "row", 3), FaultKind.OPEN, onset=250),
            Fault("noisy", (b,), onset=100),
        ],
        "loose and drifting": [
            Fault("intermittent", (a,), onset=200),
            Fault("drift", (b,), onset=100),
        ],
        "an address": [
            line_fault(LAYOUT, Line(1, "row_address", 2), FaultKind.ALIAS, value=0, onset=333)
        ],
        "a bridge": [bridge(LAYOUT, Line(0, "column", 3), onset=450)],
    }


def watched(
    diagnoser: SelfDiagnosis, frames: np.ndarray
) -> tuple[Monitor, list[tuple[int, Fault]]]:
    """Feed a log frame by frame; return the monitor and (frame, what it reported)."""
    monitor = Monitor(diagnoser, wait=True)
    return monitor, told(monitor, frames)


def told(monitor: Monitor, frames: np.ndarray) -> list[tuple[int, Fault]]:
    """Feed frames; return (frame, what the monitor reported)."""
    changes = []
    for i, frame in enumerate(frames):
        changes += [(i, fault) for fault in monitor.update(frame)]
    return changes


def without_recordings(diagnosis) -> dict:
    unknown = ("n_recordings", "by_recording")
    return {key: value for key, value in diagnosis.to_dict().items() if key not in unknown}


EVERY = mixes([0, 1, 2, 3, 4])
# the others in make test-all, and most of the cold starts, which take longer
QUICK = {False: ("cells", "a row and a noisy cell", "loose and drifting"), True: ("none",)}


@pytest.mark.usefixtures("seldom_evaluated")
@pytest.mark.parametrize(
    ("cold", "mix"),
    [
        pytest.param(cold, mix, marks=() if mix in QUICK[cold] else pytest.mark.slow)
        for cold in (False, True)
        for mix in EVERY
    ],
)
def test_frame_by_frame_it_gives_the_diagnosis_of_all_frames(
    fitted, log, middle, mix: str, cold: bool
):
    diagnoser = COLD if cold else fitted
    frames = inject(log, mixes(middle)[mix], LAYOUT, seed=0, dither=0.004)[:970]
    frames = lose_frames(freeze_stream(frames, 700, 800), 0.02, seed=0)
    monitor, _ = watched(diagnoser, frames)
    assert without_recordings(monitor.diagnosis()) == without_recordings(diagnoser.diagnose(frames))


@pytest.mark.usefixtures("seldom_evaluated")
def test_a_diagnosis_in_between_changes_nothing(fitted, log, middle):
    frames = inject(log, mixes(middle)["cells"], LAYOUT)
    monitor = Monitor(fitted, wait=True)
    for i, frame in enumerate(frames):
        monitor.update(frame)
        if i % 222 == 50:
            assert without_recordings(monitor.diagnosis()) == without_recordings(
                fitted.diagnose(frames[: i + 1])
            )
    assert without_recordings(monitor.diagnosis()) == without_recordings(fitted.diagnose(frames))


@pytest.mark.usefixtures("seldom_evaluated")
def test_a_flush_tells_at_once_what_diagnose_tells(fitted, log, middle):
    for diagnoser in (fitted, COLD):
        frames = inject(log, mixes(middle)["cells"], LAYOUT, seed=0, dither=0.004)[:970]
        monitor, before = watched(diagnoser, frames)
        changes = monitor.flush()
        known = {fault.cells: fault for _, fault in before} | {f.cells: f for f in changes}
        faults = monitor.diagnosis().faults
        assert {cells for cells, fault in known.items() if fault.probability} == {
            fault.cells for fault in faults
        }
        assert monitor.flush() == ()
    assert Monitor(fitted).flush() == ()


def test_a_flush_tells_what_a_log_shorter_than_a_segment_shows():
    monitor = Monitor(COLD, wait=True)
    silent = np.ones((31, 60))
    silent[:, 7] = np.nan
    assert told(monitor, silent) == []
    assert {cell for fault in monitor.flush() for cell in fault.cells} == {7}
    assert monitor.diagnosis().fault_set == {7}


def test_a_fault_is_reported_once_soon_after_it_is_detectable(fitted, log, middle):
    cell = middle[3]
    broken = inject(log, [Fault("short", (cell,), onset=300)], LAYOUT)
    _, changes = watched(fitted, broken[:700])
    ((frame, fault),) = changes
    assert (fault.kind, fault.cells) == (FaultKind.SHORT, (cell,))
    assert 300 <= frame < 300 + 8 * 32  # it looks every 32 frames, twice
    assert fault.probability > 0.9


def test_a_healthy_run_is_silent(fitted, log):
    assert watched(fitted, log)[1] == []
    assert watched(COLD, log[:500])[1] == []


def test_a_fault_that_goes_away_is_reported_as_gone_with_probability_0(fitted, log, middle):
    cell = middle[3]
    _, changes = watched(
        fitted, inject(log, [Fault("short", (cell,), onset=200)], LAYOUT, until=600)
    )
    (_, came), *doubts, (frame, gone) = changes
    assert {fault.cells for _, fault in changes} == {(cell,)}
    assert came.probability > 0.9
    assert gone.probability == 0
    last = doubts[-1][1] if doubts else came
    assert gone.reason.startswith("gone since about frame")
    assert last.reason in gone.reason
    assert 600 <= frame <= 1000  # contacts with the cell begin with frames 700, 800 and 900


def test_a_fault_that_spreads_is_reported_as_changed_and_no_cell_of_it_as_gone(fitted, log):
    row = Line(0, "row", 3)
    first = Fault("short", LAYOUT.cells_on(row)[4:6], onset=100)
    rest = line_fault(LAYOUT, row, FaultKind.SHORT, onset=500)
    _, reported = watched(fitted, inject(log, [first, rest], LAYOUT)[:800])
    changes = [fault for _, fault in reported if set(fault.cells) & set(rest.cells)]
    assert (changes[-1].line, changes[-1].cells) == (row, rest.cells)
    assert all(fault.probability > 0 for fault in changes)


def test_while_a_row_breaks_hardly_a_cell_beside_it_is_reported_and_none_for_long(fitted, log):
    row = line_fault(LAYOUT, Line(0, "row", 3), FaultKind.SHORT, onset=500)
    monitor, changes = watched(fitted, inject(log, [row], LAYOUT)[:800])
    assert len({c for _, fault in changes for c in fault.cells} - set(row.cells)) <= 2
    assert set(monitor.diagnosis().fault_set) == set(row.cells)


class Said:
    """An evaluation that says what a test states: cells of single faults, and wires."""

    def __init__(self, *faults: Fault) -> None:
        self.faults = faults
        self.n_frames = 100
        self.fault_set = FaultSet.of([cell for fault in faults for cell in fault.cells], 60)


ROW = line_fault(LAYOUT, Line(0, "row", 3), FaultKind.OPEN)
ONE = Fault("stuck", ROW.cells[:1])
OTHER = Fault("drift", (7,))


@pytest.mark.parametrize(
    ("evaluations", "expected"),
    [
        ([(ONE,), ()], []),  # withdrawn by the next one
        ([(), (ONE, OTHER), (ONE,)], [ONE]),
        ([(ONE,), (ONE,), (), (ONE,)], [ONE]),  # missing once is not gone
        ([(ONE,), (ONE,), (), ()], [ONE, "gone"]),
        ([(ONE,), (ONE,), (ROW,), (ROW,), (ROW,)], [ONE, ROW]),
        ([tuple(Fault("open", (c,)) for c in ROW.cells), (ROW,)], [ROW]),
    ],
)
def test_a_change_is_told_once_the_next_evaluation_confirms_it(evaluations, expected):
    monitor = Monitor(COLD, wait=True)
    changes = [change for said in evaluations for change in monitor._changes(Said(*said))]
    assert ["gone" if fault.probability == 0 else fault for fault in changes] == expected
    said = {cell for fault in evaluations[-1] for cell in fault.cells}
    assert monitor.evaluated.fault_set == said
    last = {cell for fault in monitor._changes(Said(OTHER), final=True) for cell in fault.cells}
    assert 7 in last
    assert {cell for fault in monitor.faults for cell in fault.cells} >= {7}


def test_frames_missing_according_to_the_clock_are_counted(fitted, log):
    monitor = Monitor(fitted, wait=True)
    for i, frame in enumerate(log[:200]):
        if i not in (40, 41, 42, 150):
            monitor.update(frame, time=i / LAYOUT.rate)
    (fault,) = monitor.diagnosis().transport
    assert (fault.kind, fault.frames, fault.onset) == ("lost", 4, 40)


def test_a_clock_that_jitters_or_stops_or_runs_back_loses_no_frames(fitted, log):
    jitter = np.random.default_rng(0).uniform(-0.02, 0.02, 100)
    for times in (np.arange(100) / 10 + jitter, np.zeros(100), -np.arange(100) / 10):
        monitor = Monitor(fitted, wait=True)
        for frame, time in zip(log[:100], times, strict=True):
            monitor.update(frame, time=float(time))
        assert monitor.diagnosis().transport == ()


def test_a_frame_may_be_a_grid_and_hold_missing_readings(fitted, log):
    frames = log[:100].copy()
    frames[::5, 7] = np.nan
    flat = Monitor(fitted, wait=True)
    grid = Monitor(fitted, wait=True)
    for frame in frames:
        flat.update(frame)
        grid.update(LAYOUT.grid(frame))
    assert without_recordings(flat.diagnosis()) == without_recordings(grid.diagnosis())


def test_a_cell_that_falls_silent_is_reported_soon_and_so_is_its_return(fitted, log, middle):
    frames = log[:800].copy()
    cell = middle[10]
    frames[300:600, cell] = np.nan
    monitor, changes = watched(fitted, frames)
    (silent, first), (back, last) = [(i, fault) for i, fault in changes if fault.cells == (cell,)]
    assert first.kind is FaultKind.OPEN
    assert "delivers no reading from frame 300 on" in first.reason
    assert 300 + 64 <= silent < 300 + 64 + 3 * 32
    assert "gone since about frame" in last.reason
    assert 600 <= back < 600 + 3 * 32
    assert without_recordings(monitor.diagnosis()) == without_recordings(fitted.diagnose(frames))


@pytest.mark.usefixtures("seldom_evaluated")
@pytest.mark.parametrize("share", [0.1, 0.4])
def test_online_equals_batch_where_readings_are_missing(fitted, log, middle, share: float):
    frames = inject(log, mixes(middle)["cells"], LAYOUT)
    frames[np.random.default_rng(0).random(frames.shape) < share] = np.nan
    monitor, _ = watched(fitted, frames)
    assert without_recordings(monitor.diagnosis()) == without_recordings(fitted.diagnose(frames))


@pytest.mark.parametrize("size", [0, 59, 61])
def test_a_frame_of_the_wrong_size_is_refused_with_both_sizes(size: int):
    with pytest.raises(ValueError, match=rf"expected a frame of 60 readings .*, got {size}"):
        Monitor(COLD).update(np.zeros(size))


def test_before_any_reading_there_is_nothing_to_diagnose():
    monitor = Monitor(COLD, wait=True)
    with pytest.raises(ValueError, match="no frame with a reading"):
        monitor.diagnosis()
    monitor.update(np.full(60, np.nan))
    with pytest.raises(ValueError, match="no frame with a reading"):
        monitor.diagnosis()
    for _ in range(100):
        assert monitor.update(np.full(60, np.nan)) == ()


@pytest.mark.usefixtures("seldom_evaluated")
def test_two_monitors_of_one_diagnoser_do_not_disturb_each_other(fitted, log, middle):
    broken = inject(log, [Fault("short", (middle[3],))], LAYOUT)
    a = Monitor(fitted, wait=True)
    b = Monitor(fitted, wait=True)
    for healthy_frame, broken_frame in zip(log[:400], broken[:400], strict=True):
        a.update(healthy_frame)
        b.update(broken_frame)
    assert not a.diagnosis().faults
    assert b.diagnosis().fault_set == {middle[3]}


def test_a_time_that_is_not_finite_is_refused_and_a_clock_that_is_set_loses_no_frames():
    layout = SensorLayout(1, 2, 3)
    monitor = Monitor(SelfDiagnosis(layout), wait=True)
    for time in (np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match="expected seconds"):
            monitor.update(np.ones(6), time)
    for time in (0.0, 0.1, -1e300, 1e300, 5.0, 4.0, 4.1, 4.3):
        monitor.update(np.ones(6), time)
    diagnosis = monitor.diagnosis()
    assert diagnosis.n_frames == 8  # those that were refused are not among them
    assert np.isfinite(diagnosis.probability).all()
    (lost,) = diagnosis.transport
    assert (lost.kind, lost.frames) == ("lost", 1)


@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda monitor: pickle.loads(pickle.dumps(monitor))]
)
def test_a_copy_of_a_monitor_goes_on_as_the_monitor_does_and_apart_from_it(
    fitted, log, middle, duplicate
):
    broken = inject(log, [Fault("short", (middle[3],), onset=200)], LAYOUT)
    monitor = Monitor(fitted, wait=True)
    told(monitor, broken[:140])
    twin = duplicate(monitor)  # while frames 0 to 127 are evaluated
    found = told(twin, broken[140:400])
    assert middle[3] in {cell for _, fault in found for cell in fault.cells}
    assert monitor.diagnosis().n_frames == 140
    assert told(monitor, broken[140:400]) == found
    assert twin.diagnosis().to_dict() == monitor.diagnosis().to_dict()


def test_which_frame_tells_which_fault_does_not_depend_on_the_speed(
    fitted, log, middle, monkeypatch
):
    frames = inject(log, mixes(middle)["cells"], LAYOUT, seed=0)[:400]
    _, changes = watched(fitted, frames)
    evaluate = SelfDiagnosis.evaluate

    def slowly(self, stream, **given):
        sleep(0.02)
        return evaluate(self, stream, **given)

    monkeypatch.setattr(SelfDiagnosis, "evaluate", slowly)
    assert watched(fitted, frames)[1] == changes != []


def test_an_update_never_waits_for_an_evaluation(fitted, log, middle, monkeypatch, caplog):
    frames = inject(log, mixes(middle)["cells"], LAYOUT, seed=0)[:600]
    goes_on = threading.Event()
    evaluate = SelfDiagnosis.evaluate

    def held_up(self, stream, **given):
        goes_on.wait(300)
        return evaluate(self, stream, **given)

    monkeypatch.setattr(SelfDiagnosis, "evaluate", held_up)
    monitor = Monitor(fitted)
    assert told(monitor, frames) == []  # or the test would not come here
    assert [record.message[:30] for record in caplog.records] == ["frames come faster than they c"]
    goes_on.set()
    faults = {fault.cells for fault in monitor.flush()}
    assert faults == {fault.cells for fault in fitted.diagnose(frames).faults} != set()


def test_what_comes_late_is_told_by_a_later_update(fitted, log, middle):
    frames = inject(log, mixes(middle)["cells"], LAYOUT, seed=0)
    monitor = Monitor(fitted)
    changes = told(monitor, frames[:400])
    while not changes:
        monitor._work.result(300)
        changes = told(monitor, frames[:200])
    assert all(fault.probability > 0 for _, fault in changes)


def test_the_first_evaluation_is_there_after_frames_that_the_size_and_the_rate_state():
    for side, rate, first in ((4, 10.0, 48), (40, 40.0, 128)):  # 1.6 s are 64 frames
        layout = SensorLayout(1, side, side, rate=rate)
        monitor = Monitor(SelfDiagnosis(layout), wait=True)
        frames = np.random.default_rng(0).uniform(1, 2, (first, layout.n_cells))
        for frame in frames:
            assert monitor.evaluated is None
            monitor.update(frame)
        assert monitor.evaluated is not None


def test_what_an_evaluation_raises_reaches_an_update_and_its_frames_count_as_lost(
    fitted, log, middle, monkeypatch
):
    def fails(self, stream, **given):
        raise MemoryError("no memory")

    broken = inject(log, [Fault("short", (middle[3],))], LAYOUT)
    monitor = Monitor(fitted, wait=True)
    with monkeypatch.context() as patch:
        patch.setattr(SelfDiagnosis, "evaluate", fails)
        assert told(monitor, broken[:47]) == []
        with pytest.raises(MemoryError, match="no memory"):
            monitor.update(broken[47])
    changes = told(monitor, broken[48:400])
    assert {cell for _, fault in changes for cell in fault.cells} == {middle[3]}
    (lost,) = monitor.diagnosis().transport
    assert (lost.kind, lost.frames) == ("lost", 32)


def test_the_thread_of_a_monitor_ends_with_it(log):
    before = set(threading.enumerate())
    monitor = Monitor(COLD, wait=True)
    told(monitor, log[:40])
    (thread,) = set(threading.enumerate()) - before
    del monitor
    gc.collect()
    thread.join(60)
    assert not thread.is_alive()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")  # it has several threads
def test_a_forked_process_goes_on_as_the_monitor_does(fitted, log, middle):
    broken = inject(log, [Fault("short", (middle[3],), onset=100)], LAYOUT)
    monitor = Monitor(fitted, wait=True)
    told(monitor, broken[:130])  # 0 to 127 are evaluated
    reads, writes = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.write(writes, repr(told(monitor, broken[130:300])).encode())
        finally:
            os._exit(0)
    os.close(writes)
    expected = told(monitor, broken[130:300])
    with os.fdopen(reads) as pipe:
        assert pipe.read() == repr(expected)
    os.waitpid(child, 0)
    assert expected


WITHOUT_MAIN = """
import sys, threading
import numpy as np
from diagnostics import Monitor, SelfDiagnosis

monitor = Monitor(SelfDiagnosis.load(sys.argv[1]), wait=True)

def goes_on():
    threading.main_thread().join()
    for i, frame in enumerate(np.load(sys.argv[2])):
        for fault in monitor.update(frame):
            print(i, fault.cells, flush=True)

threading.Thread(target=goes_on).start()
"""


def test_a_thread_that_outlives_the_main_thread_is_told_the_same(fitted, log, middle, tmp_path):
    fitted.save(tmp_path / "fitted.npz")
    frames = inject(log, [Fault("short", (middle[3],), onset=50)], LAYOUT)[:320]
    np.save(tmp_path / "frames.npy", frames)
    script = (sys.executable, "-c", WITHOUT_MAIN)
    given = (str(tmp_path / "fitted.npz"), str(tmp_path / "frames.npy"))
    done = subprocess.run((*script, *given), capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")
    expected = [f"{i} {fault.cells}" for i, fault in watched(fitted, frames)[1]]
    assert done.stdout.splitlines() == expected != []


ROW = Line(1, "row", 4)
BROKEN = (StuckCell(7, np.inf), CutLine(ROW))


def scan_of(*faults) -> Scan:
    """Return a scan of the untouched array, with lines held."""
    scan = scan_circuit(Circuit(LAYOUT, faults=faults), np.full(LAYOUT.n_cells, 0.01))
    return Scan(scan.levels, scan.readings, holds_lines=True)


def cells_of(faults: tuple[Fault, ...]) -> set[int]:
    return {cell for fault in faults for cell in fault.cells}


@pytest.mark.usefixtures("seldom_evaluated")
@pytest.mark.parametrize("at", [0, 50, 400, 970])
def test_with_a_scan_it_gives_the_diagnosis_of_all_frames_and_the_scan(fitted, log, middle, at):
    frames = inject(log, mixes(middle)["cells"], LAYOUT, seed=0, dither=0.004)[:970]
    scan = scan_of(*BROKEN)
    for diagnoser in (fitted, COLD):
        monitor = Monitor(diagnoser)
        told(monitor, frames[:at])
        monitor.scan(scan)
        told(monitor, frames[at:])
        expected = diagnoser.diagnose(frames, scan=scan)
        assert without_recordings(monitor.diagnosis()) == without_recordings(expected)
        assert set(expected.fault_set) >= {7, *LAYOUT.cells_on(ROW).tolist()}


def test_what_a_scan_finds_is_told_at_once_and_once(fitted, log):
    monitor = Monitor(fitted, wait=True)
    scan = scan_of(*BROKEN)
    expected = {7, *LAYOUT.cells_on(ROW).tolist()}
    assert cells_of(monitor.scan(scan)) == expected
    assert monitor.scan(scan) == ()
    assert not {cell for _, fault in told(monitor, log[:400]) for cell in fault.cells}
    assert cells_of(monitor.faults) == expected
    assert monitor.evaluated is not None
    assert set(monitor.evaluated.fault_set) == expected
    assert monitor.flush() == ()


def test_what_the_next_scan_does_not_find_is_told_as_gone(fitted, log):
    monitor = Monitor(fitted, wait=True)
    monitor.scan(scan_of(*BROKEN))
    told(monitor, log[:200])
    assert monitor.scan(scan_of(BROKEN[0])) == ()
    gone = told(monitor, log[200:400])
    assert [(fault.line, fault.probability) for _, fault in gone] == [(ROW, 0.0)]
    assert cells_of(monitor.faults) == {7}
    assert set(monitor.diagnosis().fault_set) == {7}


def test_a_scan_that_was_interrupted_leaves_the_one_before(fitted, log):
    monitor = Monitor(fitted, wait=True)
    whole = scan_of(*BROKEN)
    monitor.scan(whole)
    told(monitor, log[:40])
    before = monitor.diagnosis()
    assert monitor.scan(Scan(whole.levels[:20], whole.readings[:20], holds_lines=True)) == ()
    assert monitor.diagnosis().to_dict() == before.to_dict()


def test_a_scan_of_another_array_is_refused_in_one_line_and_changes_nothing(fitted, log):
    monitor = Monitor(fitted, wait=True)
    told(monitor, log[:40])
    before = monitor.diagnosis().to_dict()
    with pytest.raises(ValueError, match=r"a scan of 4 cells, but the array has 60") as caught:
        monitor.scan(Scan(np.array([0.0, 1.0]), np.zeros((2, 4))))
    assert "\n" not in str(caught.value)
    assert monitor.diagnosis().to_dict() == before


def test_a_copy_of_a_monitor_holds_the_scan(fitted, log):
    monitor = Monitor(fitted, wait=True)
    monitor.scan(scan_of(*BROKEN))
    told(monitor, log[:40])
    twin = pickle.loads(pickle.dumps(monitor))
    assert twin.diagnosis().to_dict() == monitor.diagnosis().to_dict()
    assert cells_of(twin.faults) == cells_of(monitor.faults)
