import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import worn

from adaptfault.adaptation.result import Adaptation
from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.lock import Busy
from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from adaptfault.data.windows import make_windows, recordings_of, scale
from adaptfault.inspection.inspection import inspect
from adaptfault.inspection.severity import Reason
from adaptfault.prediction.predictor import Predictor
from adaptfault.robot import decision
from adaptfault.robot.maintenance import maintain
from adaptfault.robot.maintenance_report import MaintenanceReport
from adaptfault.robot.model_comparison import Judgement
from adaptfault.robot.sensor_state import SensorState, weak_base
from diagnostics import FaultKind, FaultSet, Line, SensorLayout, inject, line_fault

LAYOUT = SensorLayout(2, 6, 5)


def broken(recordings, *faults):
    return [inject(r, faults, LAYOUT) for r in recordings]


def files(bundle: Bundle) -> dict[str, bytes]:
    return {
        str(p): p.read_bytes()
        for p in sorted(bundle.path.rglob("*"))
        if p.is_file() and p.suffix != ".lock"
    }


def test_a_broken_row_is_found_repaired_and_deployed_on_probation(bundle, later_grasps, broken_row):
    report = maintain(bundle, broken(later_grasps, broken_row))
    assert (report.decision, report.version) == ("deployed", 2)
    assert report.fault_set == set(broken_row.cells)
    assert report.judgement.better
    assert report.judgement.candidate > report.judgement.running + 0.1
    assert report.exit_code == (1 if report.accuracy >= 0.9 * report.fault_free_accuracy else 2)
    healthy = Adaptation.load(bundle.versions[1].folder)
    windows = bundle.parts.check_windows()
    assert report.fault_free_accuracy == (healthy.predict(windows.x) == windows.y).mean()
    assert str(report).startswith(
        f"ADAPTFAULT {('WARNING', 'CRITICAL')[report.exit_code - 1]} - deployed: accuracy"
    )
    assert bundle.active().fault_set == report.fault_set
    assert [bundle.begin(f"start {i}").number for i in range(3)] == [2, 2, 1]
    json.dumps(report.to_dict(), allow_nan=False)


def test_the_same_recordings_twice_change_nothing(repaired, later_grasps, broken_row):
    before = files(repaired)
    report = maintain(repaired, broken(later_grasps[:12], broken_row))
    assert (report.decision, report.version) == ("unchanged", 2)
    assert "used before" in report.reason
    assert files(repaired) == before


def test_healthy_recordings_change_nothing_but_the_journal(bundle, later_grasps):
    report = maintain(bundle, later_grasps)
    assert (report.decision, report.exit_code, report.version) == ("unchanged", 0, 1)
    assert str(report).startswith("ADAPTFAULT OK - unchanged: no faulty cell | faulty=0;;;0;60")
    assert bundle.active().number == 1


def test_a_dry_run_changes_no_file(bundle, later_grasps, broken_row):
    before = files(bundle)
    report = maintain(bundle, broken(later_grasps, broken_row), dry_run=True)
    assert (report.decision, report.version, report.dry_run) == ("deployed", 1, True)
    assert files(bundle) == before


def test_known_faults_in_new_recordings_deploy_nothing_again(repaired, later_grasps, broken_row):
    report = maintain(repaired, broken(later_grasps[12:], broken_row))
    assert (report.decision, report.version) == ("unchanged", 2)
    assert "excludes these cells already" in report.reason


def test_faults_add_up_over_runs(repaired, later_grasps, broken_row):
    second = line_fault(LAYOUT, Line(0, "column", 1), FaultKind.SHORT)
    report = maintain(repaired, broken(later_grasps[12:], broken_row, second))
    assert report.fault_set == set(broken_row.cells) | set(second.cells)
    assert report.version == 3


def test_after_a_rollback_the_same_faults_deploy_nothing(repaired, later_grasps, broken_row):
    repaired.rollback()
    report = maintain(repaired, broken(later_grasps[12:], broken_row))
    assert (report.decision, report.version, report.exit_code) == ("kept", 1, 2)
    assert "rolled back" in report.reason
    assert "version 1 runs, which uses 5 of the 5 faulty cells" in report.reason
    again = maintain(repaired, broken(later_grasps[12:], broken_row))
    assert (again.decision, again.exit_code) == ("unchanged", 2)


def test_the_state_of_a_sensor_names_the_faults_that_the_running_version_does_not_handle(
    bundle, later_grasps, broken_row
):
    assert SensorState.of(bundle).exit_code == 0
    report = maintain(bundle, broken(later_grasps[:12], broken_row))
    state = SensorState.of(bundle)
    assert (state.exit_code, state.unhandled, state.accuracy) == (
        report.exit_code,
        (),
        report.accuracy,
    )
    bundle.rollback()
    state = SensorState.of(bundle)
    assert state.exit_code == 2
    assert [fault.line for fault in state.unhandled] == [broken_row.line]
    assert state.accuracy == report.judgement.running
    assert not state.reason


def test_a_repair_that_exceeds_the_healthy_accuracy_shows_a_weak_base_model():
    assert weak_base(0.75, 0.71)
    assert not weak_base(0.715, 0.71)
    assert not weak_base(None, 0.71)


@pytest.mark.parametrize(
    ("poison", "reason", "code"),
    [
        (lambda r, rng: np.full_like(r, 5.0)[: rng.integers(20, 60)], "no reading of any cell", 2),
        (lambda r, rng: 5 * rng.random(r.shape), "no healthy cell|residual variance ratio", 2),
        (lambda r, rng: r * 800, "no recording is usable", 3),
        (lambda r, rng: np.full_like(r, np.nan), "no recording is usable", 3),
        (lambda r, rng: r[:, :59], "no recording is usable", 3),
        (lambda r, rng: r[:0], "no recording is usable", 3),
    ],
)
def test_poisoned_recordings_never_deploy(bundle, later_grasps, rng, poison, reason, code):
    report = maintain(bundle, [poison(r, rng) for r in later_grasps])
    assert report.decision == "refused"
    assert any(part in report.reason for part in reason.split("|"))
    assert report.exit_code == code
    assert bundle.active().number == 1
    assert bundle.versions.numbers == [1]


def test_cells_in_another_order_never_deploy(bundle, later_grasps, rng):
    order = rng.permutation(bundle.layout.n_cells)
    report = maintain(bundle, [r[:, order] for r in later_grasps])
    assert report.decision == "refused"
    assert bundle.versions.numbers == [1]


def test_idle_recordings_beside_grasps_hide_no_fault(bundle, later_grasps, rng):
    row = line_fault(bundle.layout, Line(1, "row", 2), FaultKind.OPEN)
    idle = [np.abs(rng.normal(0, 0.003, (60, 60))) for _ in range(24)]
    report = maintain(bundle, broken([*later_grasps, *idle], row), dry_run=True)
    assert report.decision != "refused"
    assert report.fault_set == set(row.cells)


def test_refused_recordings_are_diagnosed_again(bundle, later_grasps, rng):
    order = rng.permutation(bundle.layout.n_cells)
    log = [r[:, order] for r in later_grasps]
    first = maintain(bundle, log)
    second = maintain(bundle, log)
    assert (first.decision, first.exit_code, first.used) == ("refused", 2, ())
    assert (second.decision, second.exit_code, second.reason) == ("refused", 2, first.reason)
    assert [run["what"] for run in bundle.journal.runs()] == ["refused", "refused"]


def test_single_readings_outside_the_range_are_missing_and_counted(
    bundle, later_grasps, broken_row
):
    log = broken(later_grasps, broken_row)
    log[2][5, 3] = np.inf
    log[3][7, 0] = 1e308
    report = maintain(bundle, log, dry_run=True)
    json.dumps(report.to_dict(), allow_nan=False)
    assert report.fault_set == set(broken_row.cells)
    assert [text.split(":")[0] for text in report.left_out] == ["recording 2", "recording 3"]
    assert "1 readings outside 0 to 5 N are missing" in report.left_out[0]


def test_recovered_cells_lead_back_to_the_version_that_uses_them(bundle, later_grasps, broken_row):
    assert maintain(bundle, broken(later_grasps, broken_row)).version == 2
    bundle.confirm()
    reports = [maintain(bundle, later_grasps[i::3]) for i in range(3)]
    assert [len(r.fault_set) for r in reports] == [5, 5, 0]
    assert (reports[-1].decision, reports[-1].version, reports[-1].exit_code) == (
        "deployed",
        1,
        0,
    ), reports[-1].reason
    assert "recovered" in reports[-1].reason
    assert bundle.active().number == 1
    assert bundle.rollback().number == 2


def test_a_log_that_tests_nothing_says_so_in_the_first_line_and_by_its_exit_code(bundle):
    log = [np.zeros((60, 60)) for _ in range(6)]
    report = maintain(bundle, log, dry_run=True)
    assert (report.decision, report.exit_code, report.fault_set) == ("unchanged", 1, set())
    assert "only 0% of the cells were tested" in str(report).splitlines()[0]
    assert maintain(bundle, log, dry_run=True, untested_code=0).exit_code == 0


def test_a_frozen_stream_is_told_in_the_first_line_and_by_the_exit_code(bundle, later_grasps):
    loaded = max(later_grasps[0], key=np.sum)
    report = maintain(bundle, [np.repeat(loaded[None], 100, axis=0), *later_grasps], dry_run=True)
    assert (report.decision, report.exit_code, report.fault_set) == ("unchanged", 1, set())
    assert "the stream was frozen" in str(report).splitlines()[0]


def test_a_change_of_the_whole_sensor_is_measured_and_needs_a_technician_where_it_costs(
    bundle, later_grasps
):
    assert maintain(bundle, later_grasps, dry_run=True).change is None
    weak = maintain(bundle, [0.3 * r for r in later_grasps], dry_run=True)
    assert weak.change.gain == pytest.approx(0.3, rel=0.3)
    assert "sensor changed: readings are about 0." in str(weak).splitlines()[0]
    shifted = maintain(bundle, [r * 0.6 + 1.5 for r in later_grasps], dry_run=True)
    assert shifted.change.offset == pytest.approx(1.5, rel=0.05)
    for report in (weak, shifted):
        cost = [
            float(part)
            for part in report.reason.split("accuracy of version 1 ")[1]
            .split(" with")[0]
            .split(" -> ")
        ]
        assert report.exit_code >= (2 if cost[1] < 0.9 * cost[0] else 1)
        json.dumps(report.to_dict(), allow_nan=False)


def test_diagnose_and_maintain_tell_what_inspect_tells(
    bundle, later_grasps, broken_row, tmp_path, capsys
):
    shifted = [
        np.minimum(r + 0.4, bundle.layout.full_scale) for r in broken(later_grasps, broken_row)
    ]
    healthy = recordings_of(bundle.parts.adapter().train, bundle.layout)
    inspection = inspect(shifted, bundle.diagnoser(), reference=healthy)
    assert {finding.name for finding in inspection.findings} == {"offset", "wire"}
    report = maintain(bundle, shifted, dry_run=True)
    assert report.diagnosis.fault_set == inspection.diagnosis.fault_set == set(broken_row.cells)
    assert any(inspection.change.reason in reason.text for reason in report.reasons)
    save_npz(tmp_path / "log.npz", Recordings(tuple(shifted), bundle.layout))
    main(
        [
            "diagnose",
            str(tmp_path / "log.npz"),
            "--reference",
            str(bundle.path),
            "--json",
            "--quiet",
        ]
    )
    told = json.loads(capsys.readouterr().out)
    assert told["findings"] == inspection.to_dict()["findings"]
    assert told["fault_set"] == list(broken_row.cells)


@pytest.mark.parametrize(
    ("what", "told"), [("strap", "pad 0 changed"), ("gloves", "sensor changed")]
)
def test_a_strap_and_gloves_are_told_and_need_a_technician(bundle, later_grasps, what, told):
    report = maintain(bundle, worn(later_grasps, bundle.layout, what))
    assert told in str(report).splitlines()[0]
    assert (report.exit_code, report.version, report.rewiring) == (2, 1, ())


def test_an_object_that_lies_still_is_told_and_nothing_is_deployed(bundle, later_grasps, rng):
    load = np.zeros(bundle.layout.shape)
    load[0, :3, :2] = [[0.4, 0.7], [0.9, 1.3], [0.5, 0.8]]
    released = []
    for grasp in later_grasps:
        before, after = np.abs(rng.normal(0, 0.003, (2, 30, bundle.layout.n_cells)))
        released.append(np.concatenate([before, grasp, after]))
    report = maintain(
        bundle, [np.minimum(r + load.ravel(), bundle.layout.full_scale) for r in released]
    )
    assert "something lies still on pad 0" in str(report).splitlines()[0]
    assert (report.decision, report.version) == ("unchanged", 1)
    assert report.exit_code > 0
    assert not report.fault_set


def as_another_specimen(recordings, layout, pad, seed=0):
    """Return recordings in which a pad has other gains, 0.5 to 2, and other offsets."""
    rng = np.random.default_rng(seed)
    on = np.arange(layout.n_cells) // (layout.n_cells // layout.pads) == pad
    gain = np.where(on, np.exp(rng.uniform(np.log(0.5), np.log(2), layout.n_cells)), 1.0)
    offset = np.where(on, rng.uniform(0, 0.008, layout.n_cells) * layout.full_scale, 0.0)
    return [np.clip(gain * r + offset, 0, layout.full_scale) for r in recordings]


def test_a_replaced_pad_that_costs_nothing_is_told_and_not_undone(bundle, later_grasps):
    report = maintain(bundle, as_another_specimen(later_grasps, bundle.layout, pad=1))
    assert (report.decision, report.exit_code) == ("unchanged", 1)
    assert "not undone: version 1 is as good without it" in str(report)


def test_a_replaced_pad_is_recalibrated_without_labels(bundle, later_grasps, monkeypatch):
    # three classes are told apart by any gains: here they are not
    judged = decision._judged_readings
    monkeypatch.setattr(
        decision,
        "_judged_readings",
        lambda *given: replace(judged(*given), running=0.5, gain=0.5, low=0.4, high=0.6),
    )
    layout = bundle.layout
    healthy = bundle.diagnoser().diagnose(later_grasps).fault_set
    log = as_another_specimen(later_grasps, layout, pad=1)
    report = maintain(bundle, log)
    assert (report.decision, report.version, report.replaced_pads) == ("deployed", 2, (1,))
    assert report.fault_set == healthy
    assert "pad 1 replaced" in str(report).splitlines()[0]
    undone = [bundle.active().undo(frames) for frames in log]
    before, after = (
        np.abs(np.concatenate(given) - np.concatenate(later_grasps)).mean()
        for given in (log, undone)
    )
    assert after < 0.6 * before
    first = log[0][: bundle.active().length] / layout.full_scale
    with_undo = Predictor.load(bundle.path)
    plain = Predictor.load(bundle.path)
    for frame in log[0][: bundle.active().length]:
        reading = with_undo.stream(frame)
    np.testing.assert_allclose(
        reading.probabilities, plain.predict_proba(first[None])[0], atol=1e-5
    )
    assert not maintain(
        bundle, as_another_specimen(later_grasps[::-1], layout, pad=1)
    ).replaced_pads


@pytest.mark.usefixtures("worthwhile")
@pytest.mark.parametrize("replaced", [(0, 12), (12, 24)])
def test_a_pad_that_reads_otherwise_in_half_of_a_log_is_not_recalibrated(
    bundle, later_grasps, replaced
):
    changed = slice(*replaced)
    log = list(later_grasps)
    log[changed] = as_another_specimen(log[changed], bundle.layout, pad=1)
    assert not maintain(bundle, log).replaced_pads or bundle.versions.numbers == [1]


def test_one_bad_recording_does_not_stop_the_others(bundle, later_grasps, broken_row):
    log = [later_grasps[0][:, :7], *broken(later_grasps, broken_row)]
    report = maintain(bundle, log, names=["short.csv"])
    assert report.decision == "deployed"
    assert report.left_out[0].startswith("short.csv: ")


def test_a_single_recording_may_come_as_an_array(bundle, later_grasps):
    assert maintain(bundle, later_grasps[0]).used == ("recording 0",)
    assert maintain(bundle, later_grasps[1].reshape(-1, 2, 6, 5)).used == ("recording 0",)


def test_maintenance_is_refused_while_another_runs(bundle, later_grasps):
    with bundle.maintenance(), pytest.raises(Busy, match="another process"):
        maintain(bundle, later_grasps)


def test_a_damaged_version_is_replaced_by_a_new_one(repaired, later_grasps, broken_row):
    weights = next(repaired.versions.path(2).glob("*.safetensors"))
    weights.write_bytes(weights.read_bytes()[:-1])
    report = maintain(repaired, broken(later_grasps[12:], broken_row))
    assert (report.decision, report.version) == ("deployed", 3)
    assert any("0002" in warning for warning in report.warnings)


def test_what_was_kept_once_is_not_judged_again(bundle, later_grasps, broken_row, monkeypatch):
    def no_gain(running, candidate, windows):
        return Judgement(running=0.5, candidate=0.5, gain=0.0, low=-0.1, high=0.1, collapsed=())

    monkeypatch.setattr(decision, "compare_candidate", no_gain)
    first = maintain(bundle, broken(later_grasps[:8], broken_row))
    assert (first.decision, first.version) == ("kept", 1)
    assert "interval of the gain includes 0" in first.reason
    monkeypatch.setattr(decision, "compare_candidate", None)  # would fail if it were asked
    for log in (later_grasps[8:16], later_grasps[16:]):
        again = maintain(bundle, broken(log, broken_row))
        assert (again.decision, again.exit_code) == ("kept", first.exit_code)
        assert again.reason == f"compared before: {first.reason}"


def test_a_candidate_in_which_a_class_collapses_is_refused(
    bundle, later_grasps, broken_row, monkeypatch
):
    def collapse(running, candidate, windows):
        return Judgement(running=0.5, candidate=0.6, gain=0.1, low=0.05, high=0.15, collapsed=(1,))

    monkeypatch.setattr(decision, "compare_candidate", collapse)
    report = maintain(bundle, broken(later_grasps, broken_row))
    assert (report.decision, report.version) == ("refused", 1)
    assert bundle.class_names[1] in report.reason
    assert bundle.versions.numbers == [1]


def exchanged_rows(recordings, bundle):
    grid = bundle.layout.grid(np.arange(bundle.layout.n_cells))
    grid[0, [1, 4]] = grid[0, [4, 1]]
    return [recording[:, grid.ravel()] for recording in recordings]


def judged(monkeypatch, gain):
    """Let every comparison find this gain: of a network of five epochs, rows hardly change the
    accuracy."""
    found = Judgement(
        running=0.5,
        candidate=0.5 + gain,
        gain=gain,
        low=gain - 0.05,
        high=gain + 0.05,
        collapsed=(),
    )
    monkeypatch.setattr(decision, "compare_candidate", lambda running, candidate, windows: found)


@pytest.fixture
def worthwhile(monkeypatch):
    judged(monkeypatch, 0.1)


@pytest.mark.usefixtures("worthwhile")
def test_exchanged_rows_are_undone_in_software_and_the_robot_predicts_as_before(
    bundle, later_grasps
):
    x = make_windows(later_grasps, np.zeros(len(later_grasps), int), bundle.layout).x
    before = Predictor.load(bundle.path).predict(x)
    swapped = exchanged_rows(later_grasps, bundle)
    report = maintain(bundle, swapped)
    assert (report.decision, report.version, report.exit_code) == ("deployed", 2, 1)
    assert report.rewiring == ("rows 1 and 4 of pad 0 are exchanged",)
    assert not report.fault_set
    assert report.reason.startswith("wiring changed: rows 1 and 4 of pad 0 are exchanged")
    predictor = Predictor.load(bundle.path)
    y = make_windows(swapped, np.zeros(len(swapped), int), bundle.layout).x
    np.testing.assert_array_equal(predictor.predict(y), before)
    for frame in swapped[0]:
        label = predictor.stream(frame).label
    assert (
        label
        == Predictor.load(bundle.path).predict(scale(swapped[0][-10:], bundle.layout)[None])[0]
    )


@pytest.mark.usefixtures("worthwhile")
@pytest.mark.parametrize(
    "exchanged",
    [
        (0, 8),
        pytest.param((0, 12), marks=pytest.mark.slow),
        (12, 24),
        pytest.param((0, 20), marks=pytest.mark.slow),
    ],
)
def test_wires_that_not_each_half_of_a_log_shows_exchanged_are_not_undone(
    bundle, later_grasps, exchanged
):
    changed = slice(*exchanged)
    log = list(later_grasps)
    log[changed] = exchanged_rows(log[changed], bundle)
    report = maintain(bundle, log)
    assert report.decision != "deployed"
    assert bundle.versions.numbers == [1]


@pytest.mark.usefixtures("worthwhile")
def test_a_log_too_short_for_two_halves_names_exchanged_rows_and_how_many_recordings_undo_them(
    bundle, later_grasps
):
    report = maintain(bundle, exchanged_rows(later_grasps[:8], bundle))
    assert (report.decision, report.version, report.exit_code) == ("kept", 1, 2)
    assert "8 recordings do not prove it, record at least 12" in report.reason


@pytest.mark.usefixtures("worthwhile")
def test_the_next_run_starts_from_the_undone_wiring(bundle, later_grasps, broken_row):
    maintain(bundle, exchanged_rows(later_grasps[:16], bundle))
    again = maintain(bundle, exchanged_rows(broken(later_grasps[16:], broken_row), bundle))
    assert again.rewiring == ()
    assert again.fault_set == set(broken_row.cells)
    repaired = maintain(bundle, later_grasps)  # somebody mended the cable
    assert repaired.rewiring == ("rows 1 and 4 of pad 0 are exchanged",)
    np.testing.assert_array_equal(bundle.active().source, np.arange(bundle.layout.n_cells))


@pytest.mark.usefixtures("worthwhile")
def test_a_dry_run_tells_of_exchanged_rows_and_changes_nothing(bundle, later_grasps):
    before = files(bundle)
    report = maintain(bundle, exchanged_rows(later_grasps, bundle), dry_run=True)
    assert (report.decision, report.version, report.exit_code) == ("deployed", 1, 1)
    assert "a new version would undo it" in report.reason
    assert files(bundle) == before


def test_exchanged_rows_that_cost_no_accuracy_are_told_and_nothing_is_deployed(
    bundle, later_grasps, monkeypatch
):
    judged(monkeypatch, 0.0)
    report = maintain(bundle, exchanged_rows(later_grasps, bundle))
    assert (report.decision, report.version, report.exit_code, report.used) == ("kept", 1, 2, ())
    assert report.reason.startswith(
        "wiring changed: rows 1 and 4 of pad 0 are exchanged; check the connectors; not undone"
    )
    assert bundle.versions.numbers == [1]


def test_a_wiring_that_was_rolled_back_is_not_deployed_again(bundle, later_grasps, worthwhile):
    assert maintain(bundle, exchanged_rows(later_grasps[:16], bundle)).decision == "deployed"
    bundle.rollback()
    report = maintain(bundle, exchanged_rows(later_grasps[16:], bundle))
    assert (report.decision, report.version) == ("kept", 1)
    assert "rolled back before" in report.reason


def test_what_was_deployed_is_never_called_refused(bundle, later_grasps, worthwhile, monkeypatch):
    monkeypatch.setattr(decision, "contradiction", lambda *given: 2.0)
    report = maintain(bundle, exchanged_rows(later_grasps, bundle))
    assert (report.decision, report.version, report.exit_code) == ("refused", 1, 2)
    assert "residual variance ratio" in report.reason
    assert bundle.versions.numbers == [1]


def test_a_report_counts_the_cells_that_exist():
    report = MaintenanceReport(
        "kept", (Reason(1, "as good"),), FaultSet((3,), 10), version=1, n_cells=8
    )
    assert "| faulty=1;;;0;8" in str(report)
    assert "version 1 runs; 1 of 8 cells is faulty" in str(report)
