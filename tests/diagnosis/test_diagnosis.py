import json
import subprocess
import sys
from collections.abc import Sequence

import numpy as np
import pytest

from adaptfault.data.recordings import Recordings
from adaptfault.data.simulated_grasps import simulate
from diagnostics import (
    Diagnosis,
    Fault,
    FaultKind,
    Line,
    SelfDiagnosis,
    SensorLayout,
    Verdict,
    bridge,
    freeze_stream,
    inject,
    line_fault,
    lose_frames,
)

LAYOUT = SensorLayout.paper()
COLD = SelfDiagnosis(LAYOUT)


@pytest.fixture(scope="module")
def log(grasps: Recordings) -> list[np.ndarray]:
    """Ten grasps that the reference does not hold."""
    return [grasps.frames[i] for i in range(21, 140, 12)]


def broken(log: Sequence[np.ndarray], faults: Sequence[Fault], **how: object) -> list[np.ndarray]:
    return [inject(r, faults, LAYOUT, seed=i, **how) for i, r in enumerate(log)]


def gappy(log: Sequence[np.ndarray], share: float) -> list[np.ndarray]:
    """A log of which single readings are missing."""
    rng = np.random.default_rng(0)
    return [np.where(rng.random(r.shape) < share, np.nan, r) for r in log]


def loaded(log: Sequence[np.ndarray], layout: SensorLayout = LAYOUT, n: int = 20) -> np.ndarray:
    """The ``n`` cells of each pad that carry the most load."""
    most = np.mean([np.minimum(r.max(axis=0), 1) for r in log], axis=0).reshape(layout.pads, -1)
    order = np.argsort(-most, axis=1, kind="stable")[:, :n]
    return np.sort(order + most.shape[1] * np.arange(layout.pads)[:, None], axis=1).ravel()


def often_loaded(log: Sequence[np.ndarray]) -> np.ndarray:
    """Cells that carry clear load in at least half of the recordings."""
    return np.flatnonzero(np.mean([r.max(axis=0) > 0.5 for r in log], axis=0) >= 0.5)


# Inject, then find


def test_what_is_injected_is_found_named_and_nothing_else(fitted, grasps: Recordings):
    log = [grasps.frames[i] for i in range(21, 140, 6)]
    row = line_fault(LAYOUT, Line(0, "row", 5), FaultKind.OPEN)
    cells = often_loaded(log)
    short, stuck = (int(c) for c in cells[cells >= 110][[5, 20]])
    faults = [row, Fault("short", (short,)), Fault("stuck", (stuck,), value=2.5)]
    diagnosis = fitted.diagnose(broken(log, faults))
    found = {(f.kind, f.line, f.cells) for f in diagnosis.faults}
    assert (FaultKind.SHORT, None, (short,)) in found
    assert (FaultKind.STUCK, None, (stuck,)) in found
    assert (FaultKind.OPEN, Line(0, "row", 5), row.cells) in found
    assert len(found) == 3
    assert diagnosis.exit_code == 2
    by_kind = {f.kind: f for f in diagnosis.faults}
    assert by_kind[FaultKind.STUCK].value == pytest.approx(2.5, abs=0.05)
    assert by_kind[FaultKind.SHORT].value == 5
    assert "pad 0, row 5 is open" in by_kind[FaultKind.OPEN].reason


@pytest.mark.parametrize("seed", range(4))
def test_healthy_logs_have_no_fault_fitted_or_not(fitted, seed: int):
    grasped = simulate(1, seed=100 + seed).frames
    rng = np.random.default_rng(seed)
    for n in (1, 3, 7):
        frames = [grasped[i] for i in rng.permutation(7)[:n]]
        for diagnoser in (fitted, COLD):
            diagnosis = diagnoser.diagnose(frames)
            assert not diagnosis.faults
            assert not diagnosis.transport


def test_a_healthy_log_has_no_fault(fitted, log):
    diagnosis = fitted.diagnose(log)
    assert not diagnosis.faults
    assert diagnosis.exit_code == 0
    assert (diagnosis.verdicts != Verdict.FAULTY).all()
    assert (diagnosis.verdicts == Verdict.ALIVE).sum() > 110


def test_a_static_hold_is_no_fault(fitted, log):
    rng = np.random.default_rng(0)
    hold = log[3][40:41] * (
        1 + 0.002 * rng.normal(size=(300, 1)) + 0.005 * rng.normal(size=(300, 220))
    )
    for diagnoser in (fitted, COLD):
        assert not diagnoser.diagnose([hold]).faults
        assert not diagnoser.diagnose([*log, hold]).faults
        assert not diagnoser.diagnose([hold, *log, hold]).faults


def test_cells_without_any_contact_are_untested_neither_faulty_nor_alive(fitted):
    diagnosis = fitted.diagnose(np.zeros((300, 220)))
    assert (diagnosis.verdicts == Verdict.UNTESTED).all()
    assert diagnosis.coverage.test_coverage == 0
    assert (
        diagnosis.coverage.advice[0] == "press pad 0, rows 0-10, columns 0-9 (110 cells untested)"
    )


@pytest.mark.parametrize(
    ("kind", "value", "cold"),
    [("short", None, False), ("short", None, True), ("stuck", 2.5, False), ("open", None, False)],
)
def test_a_fault_that_starts_in_the_log_is_found_named_and_dated(
    fitted, log, kind: str, value, cold: bool
):
    cell = int(loaded(log)[10])
    start = sum(len(r) for r in log[:2])
    parts = [*log[:2], *broken(log[2:], [Fault(kind, (cell,), value=value)])]
    (fault,) = (COLD if cold else fitted).diagnose(parts).faults
    assert (fault.kind, fault.cells) == (kind, (cell,))
    # An open cell may have been at rest already when it broke.
    assert start - 20 * (kind == "open") <= fault.onset <= start + 1
    assert "from frame" in fault.reason


LINES = {
    "an open row": line_fault(LAYOUT, Line(0, "row", 5), FaultKind.OPEN, onset=500),
    "an open column": line_fault(LAYOUT, Line(1, "column", 4), FaultKind.OPEN, onset=500),
    "a shorted row": line_fault(LAYOUT, Line(1, "row", 4), FaultKind.SHORT, onset=500),
    "a shorted column": line_fault(LAYOUT, Line(0, "column", 6), FaultKind.SHORT, onset=500),
    "a row that is cut": line_fault(
        LAYOUT, Line(0, "row", 5), FaultKind.SHORT, onset=500, break_at=4
    ),
    "a column that is cut": line_fault(
        LAYOUT, Line(1, "column", 4), FaultKind.SHORT, onset=500, break_at=6, driven_from="last"
    ),
    "bridged rows": bridge(LAYOUT, Line(0, "row", 4), onset=500),
    "bridged columns": bridge(LAYOUT, Line(1, "column", 3), onset=500),
}


@pytest.mark.parametrize("name", LINES)
def test_a_faulty_wire_is_one_fault_with_its_cells_and_its_onset(fitted, log, name: str):
    wire = LINES[name]
    (fault,) = fitted.diagnose(inject(np.concatenate(log), [wire], LAYOUT)).faults
    assert (fault.kind, fault.line, fault.cells) == (wire.kind, wire.line, wire.cells)
    assert abs(fault.onset - 500) <= 32
    assert fault.probability > 0.9
    assert str(wire.line) in fault.reason


@pytest.mark.parametrize("name", [name for name in LINES if "open" not in name])
def test_without_a_reference_too_and_hardly_anything_else(log, name: str):
    wire = LINES[name]
    fault, *others = COLD.diagnose(inject(np.concatenate(log), [wire], LAYOUT)).faults
    assert (fault.kind, fault.line, fault.cells) == (wire.kind, wire.line, wire.cells)
    assert sum(len(other.cells) for other in others) <= 1


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize(
    ("kind", "bit"), [("row_address", 0), ("row_address", 2), ("column_address", 1)]
)
def test_a_stuck_address_bit_is_named_with_its_level_and_what_is_read_instead(
    fitted, log, kind, bit, level: int
):
    wire = line_fault(LAYOUT, Line(0, kind, bit), FaultKind.ALIAS, value=level, onset=500)
    (fault,) = fitted.diagnose(inject(np.concatenate(log), [wire], LAYOUT)).faults
    assert (fault.kind, fault.line) == (FaultKind.ALIAS, wire.line)
    # two neighbouring lines that read alike may both make sense: then it says so
    if fault.value != level:
        assert fault.alternatives == (f"{wire.line} is stuck at {level}",)
        return
    assert fault.cells == wire.cells
    assert abs(fault.onset - 500) <= 32
    across, index = ("row", 1) if kind == "row_address" else ("column", 2)
    cells, sources = LAYOUT.misaddressed(wire.line, level)
    for cell, source in zip(cells.tolist(), sources.tolist(), strict=True):
        read = f"{across} {LAYOUT.position(source)[index]}" if source >= 0 else "nothing"
        assert f"{across} {LAYOUT.position(cell)[index]} reads {read}" in fault.reason


@pytest.mark.parametrize("cold", [False, True])
@pytest.mark.parametrize(
    ("kind", "value"),
    [("intermittent", None), ("intermittent", 5.0), ("noisy", None), ("noisy", 0.6)],
)
def test_a_cell_that_blinks_or_is_noisy_is_named_and_dated(
    fitted, log, kind: str, value, cold: bool
):
    cell = int(loaded(log)[10])
    frames = inject(
        np.concatenate(log), [Fault(kind, (cell,), value=value, onset=400)], LAYOUT, seed=0
    )
    (fault,) = (COLD if cold else fitted).diagnose(frames).faults
    assert (fault.kind, fault.cells) == (kind, (cell,))
    assert 350 <= fault.onset <= 500
    if kind == "intermittent":
        assert fault.value == (value or 0.0)
        assert f"blinks between its load and {fault.value:g} N" in fault.reason


def test_a_loose_contact_of_a_sensor_with_an_offset_is_told_with_what_it_reads():
    layout = SensorLayout(1, 3, 4, full_scale=1.0, unit="V", rate=50.0)
    course = np.maximum(np.sin(np.linspace(-0.5, np.pi + 0.5, 60)), 0)[:, None]
    rng = np.random.default_rng(0)
    contacts = [
        0.1 + course * rng.uniform(0.2, 0.8, 12) + rng.normal(0, 0.002, (60, 12)) for _ in range(28)
    ]
    fitted = SelfDiagnosis(layout).fit(contacts[:20])
    for reads in (0.1, 0.0):
        loose = Fault("intermittent", (7,), value=reads)
        log = [inject(one, [loose], layout, seed=i) for i, one in enumerate(contacts[20:])]
        (fault,) = fitted.diagnose(log).faults
        assert fault.value == pytest.approx(reads, abs=0.01)
        assert f"blinks between its load and {fault.value:.4g} V" in fault.reason


def test_a_cell_whose_offset_drifts_away_is_found(fitted, log):
    pause = np.zeros((30, 220))
    frames = np.concatenate([part for r in log for part in (r, pause)])
    cell = int(loaded(log)[10])
    (fault,) = fitted.diagnose(
        inject(frames, [Fault("drift", (cell,), value=0.03, onset=100)], LAYOUT)
    ).faults
    assert fault.cells == (cell,)
    assert fault.kind in (FaultKind.DRIFT, FaultKind.FLOATING)


@pytest.fixture(scope="module")
def long_log(grasps: Recordings) -> list[np.ndarray]:
    return [grasps.frames[i] for i in range(1, 140, 3)]


def test_of_a_long_healthy_log_nothing_is_told(fitted, long_log):
    assert not fitted.diagnose(long_log).faults


@pytest.mark.parametrize(("which", "onset"), [(6, None), (24, 2000), (36, None)])
def test_a_cell_that_has_lost_most_of_its_gain_is_found_with_that_reason(
    fitted, long_log, which, onset
):
    frames = np.concatenate(long_log)
    cell = int(often_loaded(long_log)[which])
    frames[onset:, cell] *= 0.15
    (fault,) = fitted.diagnose(frames).faults
    assert (fault.kind, fault.cells) == (FaultKind.WEAK, (cell,))
    assert fault.value == pytest.approx(0.15, abs=0.06)
    assert "is loaded when the others are, but reads about 0." in fault.reason
    assert fault.onset == onset or abs(fault.onset - onset) <= 100
    assert not COLD.diagnose(frames).faults  # what it was before, one log does not tell


def test_a_fault_that_has_gone_is_not_in_the_diagnosis(fitted, log):
    faults = [Fault("short", (int(loaded(log)[10]),)), Fault("open", (int(loaded(log)[12]),))]
    frames = np.concatenate(log)
    assert len(fitted.diagnose(inject(frames[:500], faults, LAYOUT)).faults) == 2
    assert not fitted.diagnose(inject(frames, faults, LAYOUT, until=500)).faults


# Transport


@pytest.mark.parametrize("cold", [False, True])
def test_a_frozen_stream_is_a_transport_fault_and_makes_no_cell_faulty(fitted, log, cold: bool):
    diagnosis = (COLD if cold else fitted).diagnose(freeze_stream(np.concatenate(log), 450, 850))
    assert not diagnosis.faults
    assert [(fault.kind, fault.onset, fault.frames) for fault in diagnosis.transport] == [
        ("frozen", 450, 400)
    ]


def test_a_stream_that_froze_for_good_makes_no_cell_faulty_either(fitted, log):
    frozen = np.concatenate([*log[:4], np.repeat(log[3][50:51], 2000, axis=0)])
    diagnosis = fitted.diagnose(frozen)
    assert not diagnosis.faults
    assert [fault.kind for fault in diagnosis.transport] == ["frozen"]


def test_a_stream_frozen_from_the_start_is_told_also_where_idle_frames_repeat_for_long(fitted, log):
    held = np.repeat(log[3][50:51], 60, axis=0)
    assert fitted.reference_.patience > len(held)
    for frames in (np.concatenate([held, *log]), held):
        diagnosis = fitted.diagnose(frames)
        assert not diagnosis.faults
        assert [(fault.kind, fault.onset, fault.frames) for fault in diagnosis.transport] == [
            ("frozen", 0, 60)
        ]
        assert diagnosis.exit_code == 1


def test_idle_frames_of_a_sensor_with_another_offset_are_not_frozen(fitted, log):
    shifted = [
        np.clip(frames + 1.5, 0.0, LAYOUT.full_scale) for frames in [np.zeros((400, 220)), *log]
    ]
    assert not fitted.diagnose(shifted).transport


@pytest.mark.parametrize("cold", [False, True])
def test_an_idle_pad_that_repeats_zeros_is_no_fault(fitted, log, cold: bool):
    diagnosis = (COLD if cold else fitted).diagnose([*log, np.zeros((2000, 220))])
    assert not diagnosis.faults
    assert not diagnosis.transport


@pytest.mark.parametrize("share", [0.05, 0.4])
def test_lost_frames_are_counted_and_are_no_fault_of_any_cell(fitted, log, share: float):
    frames = lose_frames(np.concatenate(log), share, seed=0)
    diagnosis = fitted.diagnose(frames)
    assert not diagnosis.faults
    assert [(fault.kind, fault.frames) for fault in diagnosis.transport] == [
        ("lost", round(share * len(frames)))
    ]


def test_a_fault_is_found_through_lost_frames(fitted, log):
    cell = int(loaded(log)[10])
    frames = lose_frames(
        inject(np.concatenate(log), [Fault("short", (cell,), onset=500)], LAYOUT), 0.2, seed=0
    )
    (fault,) = fitted.diagnose(frames).faults
    assert fault.cells == (cell,)
    assert abs(fault.onset - 500) <= 10


def test_a_stuck_cell_is_found_through_the_converters_dither(fitted, log):
    cells = loaded(log)[[3, -3]].tolist()
    stuck = [Fault("stuck", (c,), value=1.7) for c in cells]
    diagnosis = fitted.diagnose(broken(log, stuck, dither=0.002))  # 0.4 % of the range seen
    assert diagnosis.fault_set == set(cells)


def test_a_cell_that_delivers_nothing_is_open(fitted, log):
    silent = [r.copy() for r in log]
    for r in silent:
        r[:, 17] = np.nan
        r[10:13] = np.nan  # lost frames are no fault of any cell
    (fault,) = fitted.diagnose(silent).faults
    assert (fault.kind, fault.cells, fault.value) == (FaultKind.OPEN, (17,), None)
    assert "delivers no reading" in fault.reason


@pytest.mark.parametrize("values", [(0.4, 4.1), (1.2, 2.9), (3.3, 4.6)])
def test_the_value_of_a_stuck_cell_never_changes_the_verdict_on_the_others(fitted, log, values):
    cells = loaded(log)[[2, 9]].tolist()
    dead = [Fault("open", (int(loaded(log)[15]),)), Fault("short", (int(loaded(log)[-5]),))]
    others = ~np.isin(np.arange(220), cells)
    marked = []
    for value in values:
        stuck = [Fault("stuck", (c,), value=value) for c in cells]
        diagnosis = fitted.diagnose(broken(log, [*stuck, *dead]))
        assert set(cells) <= set(diagnosis.fault_set)
        marked.append(diagnosis.verdicts[others] == Verdict.FAULTY)
    np.testing.assert_array_equal(*marked)


def test_an_unloaded_cell_on_a_wire_proven_open_is_inferred_faulty_and_named_as_such(fitted, log):
    column = Line(0, "column", 6)
    cells = LAYOUT.cells_on(column)
    untouched = cells[np.max([r[:, cells].max(axis=0) for r in log], axis=0) == 0]
    assert len(untouched)
    (fault,) = fitted.diagnose(broken(log, [line_fault(LAYOUT, column, FaultKind.OPEN)])).faults
    assert fault.line == column
    assert set(untouched.tolist()) <= set(fault.cells)
    assert f"{len(untouched)} more, not tested, " in fault.reason
    assert "inferred from the wire" in fault.reason


def open_and_short(cells: np.ndarray, rng: np.random.Generator) -> dict[int, Fault]:
    return {
        c: Fault(k, (c,))
        for c, k in zip(cells.tolist(), rng.choice(["open", "short"], len(cells)), strict=True)
    }


@pytest.mark.parametrize(("share", "least"), [(0.4, 0.7), (0.8, 0.5)])
def test_many_dead_cells_are_found_with_hardly_a_false_one(fitted, log, share, least):
    rng = np.random.default_rng(1)
    faults = open_and_short(rng.choice(220, round(share * 220), replace=False), rng)
    found = fitted.diagnose(broken(log, list(faults.values()))).fault_set
    assert len(found & faults.keys()) > least * len(faults)
    assert len(found - faults.keys()) <= 2


def test_where_every_cell_is_dead_none_is_alive_shorts_are_found_and_no_kind_is_wrong(fitted, log):
    faults = open_and_short(np.arange(220), np.random.default_rng(1))
    diagnosis = fitted.diagnose(broken(log, list(faults.values())))
    assert (diagnosis.verdicts != Verdict.ALIVE).all()
    shorts = {cell for cell, fault in faults.items() if fault.kind is FaultKind.SHORT}
    assert len(diagnosis.fault_set & shorts) > 0.9 * len(shorts)
    assert all(
        faults[cell].kind is fault.kind for fault in diagnosis.faults for cell in fault.cells
    )


def test_a_healthy_cell_beside_dead_ones_is_not_reported(fitted, log):
    cells = loaded(log)
    dead = cells[::3].tolist()
    found = fitted.diagnose(broken(log, [Fault("short", (c,)) for c in dead])).fault_set
    assert set(dead) <= set(found)
    assert len(found) <= len(dead) + 1


def test_without_a_reference_shorts_and_opens_in_the_contact_are_still_found(log):
    cells = loaded(log)[[4, 10, -8]].tolist()
    faults = [Fault(k, (c,)) for k, c in zip(("open", "short", "open"), cells, strict=True)]
    diagnosis = SelfDiagnosis(LAYOUT).diagnose(broken(log, faults))
    assert set(cells) <= set(diagnosis.fault_set)
    assert len(diagnosis.fault_set) <= 4
    assert len(SelfDiagnosis(LAYOUT).diagnose(log).faults) == 0


def test_a_reference_with_contact_nowhere_or_in_one_corner_only_is_no_evidence_of_faults(
    small_grasps: Recordings,
):
    layout = small_grasps.layout
    log = small_grasps.frames[31::6]
    n = layout.n_cells
    for reference in ([np.zeros((50, n))] * 3, [np.where(np.arange(n) < 6, r, 0.0) for r in log]):
        fitted = SelfDiagnosis(layout).fit(reference)
        assert fitted.diagnose(reference).fault_set == set()
        diagnosis = fitted.diagnose(small_grasps.frames[30::3])
        assert len(diagnosis.fault_set) <= 0.05 * n
        assert np.isfinite(diagnosis.probability).all()


def test_positions_without_a_cell_have_no_verdict():
    present = np.ones((2, 6, 5), bool)
    present[:, 0] = False
    layout = SensorLayout(2, 6, 5, present=present)
    healthy = simulate(1, layout, seed=1).frames
    dead = [np.where(present.ravel(), r, 5.0) for r in healthy]  # whatever they read
    masked = np.flatnonzero(~present)
    for diagnoser in (SelfDiagnosis(layout), SelfDiagnosis(layout).fit(healthy)):
        diagnosis = diagnoser.diagnose(dead)
        assert not diagnosis.fault_set & set(masked.tolist())
        assert (diagnosis.verdicts[masked] == Verdict.UNTESTED).all()
        assert not np.isin(diagnosis.coverage.untested, masked).any()


def test_cells_that_no_reference_contact_loaded_and_now_hold_a_load_are_found(
    small_grasps: Recordings,
):
    def unreached(
        recordings: Sequence[np.ndarray], of: Sequence[int], value: float
    ) -> list[np.ndarray]:
        return [
            np.where(np.isin(np.arange(n), of), value, np.where(r < 0.1, 0.0, r))
            for r in recordings
        ]

    n = small_grasps.layout.n_cells
    corner = (0, 1, 5)
    fitted = SelfDiagnosis(small_grasps.layout).fit(
        unreached(small_grasps.frames[::2], corner, 0.0)
    )
    log = unreached(small_grasps.frames[61::4], corner, 0.0)
    assert fitted.diagnose(log).fault_set == set()
    assert fitted.diagnose(unreached(log, (0,), 1.0)).fault_set == {0}
    assert fitted.diagnose(unreached(log, corner, 5.0)).fault_set == set(corner)


def test_a_single_recording_and_one_of_another_unit_will_do():
    layout = SensorLayout(1, 4, 4, full_scale=4095, unit="count", rate=50)
    rng = np.random.default_rng(0)
    load = np.abs(np.sin(np.linspace(0, 40, 2000)))[:, None] * rng.uniform(800, 2000, 16)
    healthy = np.round(load + rng.normal(0, 5, load.shape)).clip(0)
    diagnosis = (
        SelfDiagnosis(layout).fit(healthy).diagnose(inject(healthy, [Fault("open", (6,))], layout))
    )
    assert diagnosis.fault_set == {6}


@pytest.mark.parametrize("cold", [False, True])
@pytest.mark.parametrize("value", [0.0, 2.5, 5.0])
def test_an_array_of_which_every_cell_is_dead_does_not_crash_it(fitted, value: float, cold: bool):
    diagnosis = (COLD if cold else fitted).diagnose(np.full((400, 220), value))
    assert (diagnosis.verdicts != Verdict.ALIVE).all()
    assert json.dumps(diagnosis.to_dict(), allow_nan=False)


@pytest.mark.parametrize("cold", [False, True])
@pytest.mark.parametrize("frames", [1, 2, 5])
def test_a_few_frames_prove_nothing_but_do_not_crash_it(fitted, log, frames: int, cold: bool):
    diagnosis = (COLD if cold else fitted).diagnose(log[3][:frames])
    assert not diagnosis.faults
    assert diagnosis.n_frames == frames
    assert json.dumps(diagnosis.to_dict(), allow_nan=False)


@pytest.mark.parametrize("share", [0.1, 0.4])
@pytest.mark.parametrize("cold", [False, True])
def test_readings_that_are_missing_here_and_there_are_no_fault(
    fitted, log, cold: bool, share: float
):
    assert not (COLD if cold else fitted).diagnose(gappy(log, share)).faults


def test_faults_are_found_with_a_reference_that_misses_many_readings(small_grasps: Recordings):
    layout = small_grasps.layout
    log = small_grasps.frames[31::3]
    fitted = SelfDiagnosis(layout).fit(gappy(small_grasps.frames[::7], 0.4))
    cells = loaded(log, layout, 8)[::3].tolist()
    faults = [Fault("short" if i % 2 else "open", (cell,)) for i, cell in enumerate(cells)]
    found = fitted.diagnose(
        [inject(r, faults, layout, seed=i) for i, r in enumerate(log)]
    ).fault_set
    assert set(cells) <= set(found)
    assert len(found) <= len(cells) + 1


def test_a_cell_that_falls_silent_under_load_is_open_from_then_on(fitted, log):
    frames = np.concatenate(log)
    cell = int(loaded(log)[10])
    onset = int(frames[: len(frames) // 2, cell].argmax())
    frames[onset:, cell] = np.nan
    (fault,) = fitted.diagnose(frames).faults
    assert (fault.kind, fault.cells, fault.value, fault.onset) == (
        FaultKind.OPEN,
        (cell,),
        None,
        onset,
    )
    assert f"delivers no reading from frame {onset} on" in fault.reason
    frames[-1, cell] = 0.0  # it is back
    assert not fitted.diagnose(frames).fault_set


def test_a_few_frames_with_gaps_are_no_silence(fitted, log):
    assert not fitted.diagnose(gappy([log[3][:3]], 0.5)).faults


def test_a_cell_that_delivers_most_of_its_readings_is_not_open(fitted, log):
    cell = int(loaded(log)[10])
    frames = np.concatenate(log)
    frames[31::32, cell] = np.nan
    assert cell not in fitted.diagnose(frames[:960]).fault_set


# The result


def test_a_diagnosis_survives_json(fitted, log):
    diagnosis = fitted.diagnose(
        broken(log, [line_fault(LAYOUT, Line(0, "row", 5), FaultKind.OPEN)])
    )
    d = json.loads(json.dumps(diagnosis.to_dict(), allow_nan=False))
    again = Diagnosis.from_dict(d)
    assert again.faults == diagnosis.faults
    assert again.fault_set == diagnosis.fault_set
    assert (again.verdicts == diagnosis.verdicts).all()
    np.testing.assert_array_equal(again.probability, diagnosis.probability)
    assert again.to_dict() == d
    with pytest.raises(ValueError, match="expected a diagnosis with schema"):
        Diagnosis.from_dict({"schema": "adaptfault.diagnosis/99"})


def test_verdicts_compare_elementwise(fitted, log):
    verdicts = fitted.diagnose(log).verdicts
    mask = verdicts == Verdict.ALIVE
    assert mask.dtype == bool
    assert mask.shape == (220,)
    assert isinstance(verdicts[0], Verdict)


def test_the_map_shows_each_cell_at_its_place(fitted, log):
    cell = int(often_loaded(log)[10])
    diagnosis = fitted.diagnose(broken(log, [Fault("short", (cell,))]))
    pad, row, column = LAYOUT.position(cell)
    line = diagnosis.map().splitlines()[1 + row]
    assert line[7 + pad * (19 + 3) + 2 * column] == "S"
    assert diagnosis.map().count("S") == 1


def test_the_picture_marks_the_faulty_cell(fitted, log, tmp_path):
    cell = int(often_loaded(log)[10])
    figure = fitted.diagnose(broken(log, [Fault("short", (cell,))])).plot()
    pad, row, column = LAYOUT.position(cell)
    (text,) = figure.axes[pad].texts
    assert (text.get_text(), text.get_position()) == ("S", (column, row))
    figure.savefig(tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 5000


# Bad input


@pytest.mark.parametrize(
    ("recordings", "message"),
    [
        (np.zeros((10, 219)), r"expected \[T, 220\]"),
        ([np.zeros((10, 220)), np.zeros((10, 3))], "recording 1: expected"),
        ([], "no frames"),
        (np.zeros((0, 220)), "no frames"),
        (np.full((5, 220), np.nan), "no frame with a reading"),
    ],
)
def test_a_log_that_cannot_be_diagnosed_is_refused_in_one_line(recordings, message: str):
    with pytest.raises(ValueError, match=message) as error:
        SelfDiagnosis(LAYOUT).diagnose(recordings)
    assert "\n" not in str(error.value)


def test_recordings_without_a_reading_do_not_change_the_fit(small_grasps: Recordings):
    diagnoser = SelfDiagnosis(small_grasps.layout)
    lost = np.full((5, small_grasps.layout.n_cells), np.nan)
    with pytest.raises(ValueError, match="no frame with a reading: nothing to learn"):
        diagnoser.fit([lost])
    few = small_grasps.frames[30:36]
    ours, theirs = (
        SelfDiagnosis(small_grasps.layout).fit(reference).state()[1]
        for reference in ([lost, *few], few)
    )
    assert all(np.array_equal(ours[name], theirs[name], equal_nan=True) for name in theirs)


def test_importing_diagnostics_loads_neither_torch_nor_adaptfault():
    code = (
        "import sys, diagnostics; sys.exit(any(m in sys.modules for m in ('torch', 'adaptfault',"
        " 'sklearn')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
