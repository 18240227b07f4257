import json
import subprocess
import sys
from collections.abc import Sequence

import numpy as np
import pytest

from adaptfault.recordings import Recordings
from diagnostics import Diagnosis, Fault, FaultKind, Line, SelfDiagnosis, SensorLayout, Verdict, inject, line_fault
from diagnostics.temporal import last_runs

LAYOUT = SensorLayout.paper()


@pytest.fixture(scope="module")
def fitted(grasps: Recordings) -> SelfDiagnosis:
    return SelfDiagnosis(grasps.layout).fit(grasps.frames[::2])


@pytest.fixture(scope="module")
def log(grasps: Recordings) -> list[np.ndarray]:
    """Ten grasps that the reference does not hold."""
    return [grasps.frames[i] for i in range(21, 140, 12)]


def broken(log: Sequence[np.ndarray], faults: Sequence[Fault], **how: object) -> list[np.ndarray]:
    return [inject(r, faults, LAYOUT, seed=i, **how) for i, r in enumerate(log)]


def touched(log: Sequence[np.ndarray]) -> np.ndarray:
    """Cells that carry clear load in at least half of the recordings."""
    return np.flatnonzero(np.mean([r.max(axis=0) > 0.5 for r in log], axis=0) >= 0.5)


# Temporal evidence


def test_a_still_stretch_starts_where_a_cell_last_moved():
    log = np.array([[1, 1, 0], [2, 1, 0], [2, 1, 4], [2, 1.01, 4]], float)
    runs = last_runs(log, 0.02)
    assert runs.start.tolist() == [1, 0, 2]
    assert runs.moved.tolist() == [True, False, True]
    assert runs.value == pytest.approx([2, 1.005, 4])


def test_a_missing_reading_neither_breaks_nor_proves_stillness():
    runs = last_runs(np.array([[1, np.nan], [np.nan, np.nan], [1, np.nan]]), 0.02)
    assert runs.start.tolist() == [0, 0]
    assert runs.value[0] == 1
    assert np.isnan(runs.value[1])


# Inject, then find


def test_what_is_injected_is_found_named_and_nothing_else(fitted, log):
    row = line_fault(LAYOUT, Line(0, "row", 5), FaultKind.OPEN)
    cells = touched(log)
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


def test_a_healthy_log_has_no_fault(fitted, log):
    diagnosis = fitted.diagnose(log)
    assert not diagnosis.faults
    assert diagnosis.exit_code == 0
    assert (diagnosis.verdicts != Verdict.FAULTY).all()
    assert (diagnosis.verdicts == Verdict.ALIVE).sum() > 110


def test_a_static_hold_is_no_fault(fitted, log):
    hold = np.repeat(log[3][40:41], 300, axis=0)
    assert not fitted.diagnose([hold]).faults
    assert not fitted.diagnose([*log, hold]).faults


def test_cells_that_nothing_touched_are_untested_neither_faulty_nor_alive(fitted):
    diagnosis = fitted.diagnose(np.zeros((300, 220)))
    assert (diagnosis.verdicts == Verdict.UNTESTED).all()
    assert diagnosis.coverage.test_coverage == 0
    assert diagnosis.coverage.advice[0] == "press pad 0, rows 0-10, columns 0-9 (110 cells untested)"


def test_a_fault_that_starts_in_the_log_is_dated(fitted, log):
    cell = int(touched(log)[10])
    start = sum(len(r) for r in log[:6])
    parts = [*log[:6], *broken(log[6:], [Fault("short", (cell,))])]
    (fault,) = fitted.diagnose(parts).faults
    assert fault.cells == (cell,)
    assert fault.onset == start


def test_a_stuck_cell_is_found_through_the_converters_dither(fitted, log):
    cells = touched(log)[[3, 30]].tolist()
    diagnosis = fitted.diagnose(broken(log, [Fault("stuck", (c,), value=1.7) for c in cells], dither=0.004))
    assert diagnosis.fault_set == set(cells)


def test_a_cell_that_delivers_nothing_is_open(fitted, log):
    silent = [r.copy() for r in log]
    for r in silent:
        r[:, 17] = np.nan
        r[10:13] = np.nan  # lost frames are no fault of any cell
    (fault,) = fitted.diagnose(silent).faults
    assert (fault.kind, fault.cells, fault.value) == (FaultKind.OPEN, (17,), None)
    assert "delivers no reading" in fault.reason


@pytest.mark.parametrize("share", [0.4, 0.8, 1.0])
def test_many_dead_cells_do_not_crash_it_and_hardly_mislead_it(fitted, log, share: float):
    rng = np.random.default_rng(1)
    cells = rng.choice(220, round(share * 220), replace=False)
    faults = [Fault(k, (int(c),)) for c, k in zip(cells, rng.choice(["open", "short"], len(cells)), strict=True)]
    found = fitted.diagnose(broken(log, faults)).fault_set
    assert len(found & set(cells.tolist())) > 0.5 * share * 220
    assert len(found - set(cells.tolist())) <= 0.02 * max(1, len(found))


def test_without_a_reference_shorts_and_opens_in_the_contact_are_still_found(log):
    cells = touched(log)[[8, 25, 40]].tolist()
    faults = [Fault(k, (c,)) for k, c in zip(("open", "short", "open"), cells, strict=True)]
    diagnosis = SelfDiagnosis(LAYOUT).diagnose(broken(log, faults))
    assert set(cells) <= set(diagnosis.fault_set)
    assert len(diagnosis.fault_set) <= 4
    assert len(SelfDiagnosis(LAYOUT).diagnose(log).faults) == 0


def test_masked_positions_are_never_judged(log):
    present = np.ones(LAYOUT.shape, bool)
    present[:, 0] = False
    layout = SensorLayout(2, 11, 10, present=present)
    dead = [np.where(present.ravel(), r, 5.0) for r in log]  # whatever they read
    diagnosis = SelfDiagnosis(layout).fit(log).diagnose(dead)
    masked = np.flatnonzero(~present)
    assert not diagnosis.fault_set & set(masked.tolist())
    assert (diagnosis.verdicts[masked] == Verdict.UNTESTED).all()
    assert not np.isin(diagnosis.coverage.untested, masked).any()


def test_a_single_recording_and_one_of_another_unit_will_do():
    layout = SensorLayout(1, 4, 4, full_scale=4095, unit="count", rate=50)
    rng = np.random.default_rng(0)
    load = np.abs(np.sin(np.linspace(0, 40, 2000)))[:, None] * rng.uniform(800, 2000, 16)
    healthy = np.round(load + rng.normal(0, 5, load.shape)).clip(0)
    diagnosis = SelfDiagnosis(layout).fit(healthy).diagnose(inject(healthy, [Fault("open", (6,))], layout))
    assert diagnosis.fault_set == {6}


# The result


def test_a_diagnosis_survives_json(fitted, log):
    diagnosis = fitted.diagnose(broken(log, [line_fault(LAYOUT, Line(0, "row", 5), FaultKind.OPEN)]))
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
    cell = int(touched(log)[10])
    diagnosis = fitted.diagnose(broken(log, [Fault("short", (cell,))]))
    pad, row, column = LAYOUT.position(cell)
    line = diagnosis.map().splitlines()[1 + row]
    assert line[7 + pad * (19 + 3) + 2 * column] == "S"
    assert diagnosis.map().count("S") == 1


def test_the_picture_marks_the_faulty_cell(fitted, log, tmp_path):
    cell = int(touched(log)[10])
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


def test_importing_diagnostics_loads_neither_torch_nor_adaptfault():
    code = "import sys, diagnostics; sys.exit(any(m in sys.modules for m in ('torch', 'adaptfault', 'sklearn')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# Real grasps


def test_on_real_grasps_dead_cells_are_found_and_healthy_logs_are_clean(real_grasps: Recordings):
    layout, rng = real_grasps.layout, np.random.default_rng(0)
    order = rng.permutation(len(real_grasps))
    fitted = SelfDiagnosis(layout).fit([real_grasps.frames[i] for i in order[:428]])
    found = false = testable = hit = alarms = 0
    for _ in range(5):
        log = [real_grasps.frames[i] for i in rng.choice(order[428:], 6, replace=False)]
        alarms += len(fitted.diagnose(log).fault_set)
        cells = rng.choice(np.flatnonzero(layout.present), 22, replace=False)
        values = rng.choice([0, layout.full_scale, rng.uniform(0.1, 0.9) * layout.full_scale], 22)
        faults = [Fault("stuck", (int(c),), value=float(v)) for c, v in zip(cells, values, strict=True)]
        fault_set = fitted.diagnose([inject(r, faults, layout) for r in log]).fault_set
        hidden = np.concatenate(log)[:, cells]
        can = set(cells[(np.abs(hidden - values) > 0.05 * layout.full_scale).sum(axis=0) >= 10].tolist())
        found += len(fault_set & set(cells.tolist()))
        false += len(fault_set - set(cells.tolist()))
        testable, hit = testable + len(can), hit + len(fault_set & can)
    assert alarms <= 1
    assert found / (found + false) >= 0.97
    assert hit / testable >= 0.85
